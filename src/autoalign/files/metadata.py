"""What travels with a picture beside its pixels, and how it is made to describe a picture that was turned or aligned.

Kept: the ICC profile, the EXIF block (camera, time, place, maker notes), the XMP packet, the size of a pixel, and in
TIFF the descriptive tags, the georeference and what a microscope wrote.
Changed, so that it stays true: EXIF and XMP orientation become 1 (the pixels are upright), EXIF width, height and
resolution become those of the pixels, the EXIF thumbnail is unlinked (it shows the picture as it was), an ICC profile
for another number of colours is dropped. A picture drawn on the grid of another takes from it what belongs to the grid:
the size of a pixel and the georeference.
Dropped: what the format of the output has no place for (the table of the formats says what each keeps), comments,
IPTC and other makers' segments of JPEG, gamma and chromaticity chunks of PNG, EXIF over 65,527 bytes in JPEG, and the
georeference of the moving picture. Between TIFF and other formats maker notes are moved, which those that count from
the start of the file do not survive.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from autoalign.files import exif as tags
from autoalign.files.georeference import Georeference, shifted
from autoalign.geometry.homography import jacobian
from autoalign.picture.canvas import Canvas
from autoalign.picture.pixels import Picture, has_alpha, size_of

MAX_METADATA = 1 << 26  # bytes of one block; one that grows beyond this is a bomb


@dataclass(frozen=True, kw_only=True)
class Metadata:
    """What a file says about its picture; None where it says nothing."""

    icc: bytes | None = None
    exif: bytes | None = None  # the TIFF structure alone, from its "II" or "MM" on
    xmp: bytes | None = None
    extended_xmp: bytes | None = None  # a second packet, to which the first of a JPEG refers
    dpi: tuple[float, float] | None = None  # pixels per inch along x and y
    georeference: Georeference | None = None
    no_data: str | None = None  # the value that GDAL takes for no data
    microscope: str | None = None  # OME-XML, or the lines of ImageJ, of this one picture


def resolution(x: float, y: float, inches_per_unit: float = 1.0) -> tuple[float, float] | None:
    """Pixels per inch from pixels per unit along x and y; None where these are not positive."""
    return (x / inches_per_unit, y / inches_per_unit) if x > 0 and y > 0 else None


def turned(metadata: Metadata, orientation: int) -> Metadata:
    """The metadata of a picture turned upright: orientations 5 to 8 swap the resolutions along x and y.

    A resolution that only EXIF has is taken from there. A georeference counts the pixels as they are stored, and is
    dropped where they are turned.
    """
    dpi = metadata.dpi or tags.exif_dpi(tags.directory_of(metadata.exif))
    return replace(
        metadata,
        dpi=dpi[::-1] if dpi and orientation >= 5 else dpi,
        georeference=metadata.georeference if orientation == 1 else None,
    )


def on_grid_of(
    fixed: Metadata | None,
    moving: Metadata,
    frame: Canvas,
    fixed_from_moving: NDArray[np.float64],
    moving_size: tuple[int, int],
) -> Metadata:
    """What travels with the moving picture, `moving_size` (w, h), once it is drawn in a frame on the fixed one's grid.

    Its pixels are as large as the fixed picture's, and lie on the earth where those lie. Where the fixed picture says
    no size, or nothing is known of it (None), it is the moving one's, scaled as the transform scales in its middle.
    """
    on_grid = fixed or Metadata()
    x, y = frame.canvas_from_fixed[:2, 2].tolist()
    return replace(
        moving,
        dpi=on_grid.dpi or _scaled(moving.dpi, fixed_from_moving, moving_size),
        georeference=shifted(on_grid.georeference, x, y) if on_grid.georeference else None,
        # What is not covered is drawn as 0.
        no_data=moving.no_data or (on_grid.no_data if on_grid.no_data in ("0", "0.0") else None),
    )


def without_grid(metadata: Metadata) -> Metadata:
    """What travels with a picture that is drawn on a grid of its own, of which nothing is known."""
    return replace(metadata, dpi=None, georeference=None)


def describing(metadata: Metadata, pixels: Picture) -> Metadata:
    """The metadata made true for `pixels` (h, w) or (h, w, c), which are upright. Doing it twice changes nothing."""
    exif = metadata.exif
    return replace(
        metadata,
        icc=_fitting_icc(metadata.icc, pixels),
        exif=tags.describing_exif(exif, size_of(pixels), metadata.dpi) if exif else None,
        # One digit for another: the packet keeps its length. Readers that trust XMP would turn the picture again.
        xmp=re.sub(rb"(tiff:Orientation(?:=[\"']|>))[2-8]", rb"\g<1>1", metadata.xmp) if metadata.xmp else None,
    )


def _scaled(
    dpi: tuple[float, float] | None, fixed_from_moving: NDArray[np.float64], moving_size: tuple[int, int]
) -> tuple[float, float] | None:
    if dpi is None:
        return None
    middle = (np.array([moving_size], dtype=np.float64) - 1) / 2
    # Of a turned picture x and y are no longer what they were: one scale, that of areas, for both.
    scale = float(abs(np.linalg.det(jacobian(fixed_from_moving, middle)[0])) ** 0.5)
    return resolution(dpi[0] * scale, dpi[1] * scale)


def _fitting_icc(icc: bytes | None, pixels: Picture) -> bytes | None:
    """The profile unless it says that it is for grey and the pixels are RGB, or the other way round."""
    colours = 1 if pixels.ndim == 2 else pixels.shape[2] - has_alpha(pixels)
    return icc if icc and icc[16:20] != (b"RGB " if colours == 1 else b"GRAY") else None
