"""Where a picture lies on the earth: the tags of a GeoTIFF, and how they follow when the grid is cropped or grown.

Positions on the grid count pixels, so that a shift by whole pixels is exact whether a file counts from their corners
or their centres.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from autoalign.files.exif import DOUBLE, Directory, Tag

PIXEL_SCALE, TIE_POINTS, TRANSFORMATION = 33550, 33922, 34264
KEYS = (34735, 34736, 34737)  # the coordinate system: directory, numbers, texts
NO_DATA = 42113  # GDAL's: the value that stands for no data, as text

Georeference = Mapping[int, Tag]
"""Tag code to value: how pixels become coordinates, and the system these are in."""


def georeference_of(directory: Directory) -> Georeference | None:
    """The tags of a page that place it on the earth; None if it has none that do."""
    found = {code: directory.get(code) for code in (PIXEL_SCALE, TIE_POINTS, TRANSFORMATION, *KEYS)}
    tags = {code: tag for code, tag in found.items() if isinstance(tag, Tag)}
    return tags if TIE_POINTS in tags or TRANSFORMATION in tags else None


def shifted(georeference: Georeference, dx: float, dy: float) -> Georeference:
    """That of a grid on which what was pixel (x, y) is pixel (x + dx, y + dy)."""
    tags = dict(georeference)
    if (ties := _numbers(tags.get(TIE_POINTS), 6)) is not None:
        # Six numbers a point: column, row, height on the grid, and the three coordinates.
        tags[TIE_POINTS] = _tag(ties + np.array([dx, dy, 0, 0, 0, 0]))
    if (matrix := _numbers(tags.get(TRANSFORMATION), 4)) is not None and matrix.shape == (4, 4):
        tags[TRANSFORMATION] = _tag(matrix - np.outer(matrix @ (dx, dy, 0, 0), (0, 0, 0, 1)))
    return tags


def _numbers(tag: Tag | None, columns: int) -> NDArray[np.float64] | None:
    if tag is None or tag.type != DOUBLE or tag.count % columns:
        return None
    return np.frombuffer(tag.data, "<f8").reshape(-1, columns)


def _tag(numbers: NDArray[np.float64]) -> Tag:
    return Tag(type=DOUBLE, data=numbers.astype("<f8").tobytes())
