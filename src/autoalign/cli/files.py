"""The files that a command reads and writes, refused before any work is done."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from autoalign.errors import ImageWriteError
from autoalign.files.formats import PNG, TIFF, of_name
from autoalign.files.write import check_format, check_writable
from autoalign.picture.pixels import Picture

SCREEN_PIXEL: Picture = np.zeros((1, 1, 3), np.uint8)
"""What a picture made for the eye is made of."""


def check_mask_format(path: Path | None) -> None:
    """Raise ImageWriteError, the path last, unless it is a name for a format that keeps black and white apart."""
    if path is not None and of_name(path) not in (PNG, TIFF):
        raise ImageWriteError(f"a mask is written as PNG or TIFF: {path}")


def check_outputs(
    outputs: Iterable[tuple[Path | None, Picture | None]], *, inputs: Iterable[Path | None], overwrite: bool
) -> None:
    """Go through (path, pixels like those to be written or None for no picture); a path that is None is not wanted.

    Raises ImageWriteError, the path last, for what cannot be written, and ValueError for a file that is named twice or
    is an input as well: even --overwrite must not cost an original.
    """
    taken = {path.resolve() for path in inputs if path is not None}
    for path, pixels in outputs:
        if path is None:
            continue
        if path.resolve() in taken:
            raise ValueError(f"is an input, or another output, as well: {path}")
        taken.add(path.resolve())
        if pixels is not None:
            check_format(path, pixels)
        check_writable(path, overwrite)
