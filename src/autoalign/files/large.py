"""Pictures that may be too large for memory: opened, looked at as a copy, drawn strip by strip.

What knows TIFF is imported when one is met.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from autoalign.errors import ImageWriteError
from autoalign.files.formats import HEAD_BYTES, TIFF, of_name
from autoalign.files.metadata import Metadata
from autoalign.files.read import LoadedPicture, ReadOptions, opened, read_picture
from autoalign.files.result import ResultFiles, seen_in, write_overlay
from autoalign.files.sized import check_sized
from autoalign.geometry.homography import Array, Mask, invert
from autoalign.picture.border import like_bordered
from autoalign.picture.canvas import Canvas
from autoalign.picture.pixels import PixelSource, grey, size_of, working_copy
from autoalign.picture.warp import Interpolation, Warped
from autoalign.registration.drawing import Drawing, draw, draw_in_strips
from autoalign.registration.large import WORKING_PIXELS, Large

if TYPE_CHECKING:
    from autoalign.files.tiled import LargePicture

LARGE_PIXELS = 100e6  # a TIFF with more is read box by box
MAX_PIXELS = 2**30  # of such a TIFF

AnyPicture: TypeAlias = "LoadedPicture | LargePicture"
Watch = Callable[[Iterator[Warped], int], Iterator[Warped]]
"""Strips, and how many there will be, to the same strips; on the way it may tell how far it has come."""


@contextmanager
def opened_picture(path: Path, options: ReadOptions = ReadOptions(), *, page: int = 0) -> Iterator[AnyPicture]:
    """A picture from a file: a large TIFF that can be read box by box is, everything else is read as a whole.

    Raises ImageReadError as `read_picture` does.
    """
    with opened(path) as file:
        is_tiff = re.match(TIFF.mark, file.read(HEAD_BYTES), re.DOTALL)
    if is_tiff:
        from autoalign.files.tiled import opened_large

        max_pixels = options.max_pixels or MAX_PIXELS
        with opened_large(path, above_pixels=LARGE_PIXELS, max_pixels=max_pixels, number=page) as large:
            if large is not None:
                yield large
                return
    yield read_picture(path, options, page=page)


def is_large(picture: AnyPicture) -> bool:
    """True for one that stays in its file."""
    return not isinstance(picture, LoadedPicture)


def with_copy(picture: AnyPicture) -> Large:
    """The picture, and a working copy of it. Raises ImageReadError, the path last, where the pixels are damaged."""
    if isinstance(picture, LoadedPicture):
        return Large(pixels=picture.pixels, copy=working_copy(picture.pixels, WORKING_PIXELS))
    return Large(pixels=picture.pixels, copy=picture.working_copy(WORKING_PIXELS))


def read_mask_of_copy(path: Path, picture: Large) -> Mask:
    """(h, w) of the picture's copy: True where the mask in this file, of the picture's full size, is black.

    Raises ImageReadError, the path last.
    """
    with opened_picture(path) as mask:
        check_sized(mask.pixels, size_of(picture.pixels), path)
        hidden = grey(working_copy(mask.pixels, WORKING_PIXELS).pixels) != 0
    # The copy may be of an overview, which is smaller by another number.
    rows, columns = (np.arange(n) * m // n for n, m in zip(picture.copy.pixels.shape, hidden.shape, strict=False))
    return np.asarray(~hidden[np.ix_(rows, columns)])


def check_large_drawing(drawing: Drawing, *outputs: Path | None) -> None:
    """Raise ImageWriteError, the path last, for what is not written by strips, ValueError for what is not drawn so."""
    if drawing.border == "replicate":
        raise ValueError("--border replicate needs the whole result at once, which is too large")
    for path in outputs:
        if path is not None and of_name(path) is not TIFF:
            raise ImageWriteError(f"a picture of so many pixels is written as TIFF: {path}")


@dataclass(frozen=True, kw_only=True)
class LargeDrawing:
    """What is to be drawn strip by strip, and where."""

    pixels: PixelSource  # of the moving picture
    frame: Canvas
    fixed_from_moving: Array
    drawing: Drawing
    interpolation: Interpolation = "linear"

    def strips(self, watch: Watch) -> Iterator[Warped]:
        from autoalign.files.pyramid import TILE

        transform = self.frame.canvas_from_fixed @ self.fixed_from_moving
        strips = draw_in_strips(self.pixels, self.frame.size, transform, self.drawing, TILE, self.interpolation)
        return watch(strips, math.ceil(self.frame.size[1] / TILE))


def write_large(path: Path, what: LargeDrawing, metadata: Metadata, watch: Watch, overwrite: bool = False) -> None:
    """Draw a picture into a tiled BigTIFF. Raises ImageWriteError as `write_in_strips` does."""
    from autoalign.files.pyramid import write_in_strips

    like = like_bordered(_blank(what.frame.size, what.pixels), what.drawing.border)
    write_in_strips(path, (strip.pixels for strip in what.strips(watch)), like, metadata, overwrite=overwrite)


def write_large_mask(path: Path, what: LargeDrawing, watch: Watch, overwrite: bool = False) -> None:
    """Where the drawing has data, as `write_mask` shows it, into a tiled BigTIFF."""
    from autoalign.files.pyramid import write_in_strips

    like = np.broadcast_to(np.zeros((), np.uint8), what.frame.size[::-1])
    write_in_strips(path, map(seen_in, what.strips(watch)), like, overwrite=overwrite)


def write_large_result(
    files: ResultFiles,
    what: LargeDrawing,
    metadata: Metadata,
    copies: tuple[Large, Large] | None,
    watch: Watch,
    overwrite: bool = False,
) -> list[Path]:
    """Draw the pictures that are wanted, write them, and say which they are; an overlay is of the copies.

    `copies` are those of (fixed, moving). Raises CanvasError where no canvas can hold them, ImageWriteError as
    `write_in_strips` does.
    """
    written = [path for path in (files.aligned, files.mask, files.overlay) if path is not None]
    if files.aligned is not None:
        write_large(files.aligned, what, metadata, watch, overwrite)
    if files.mask is not None:
        write_large_mask(files.mask, what, watch, overwrite)
    if files.overlay is not None and copies is not None:
        still, moved = (of.copy for of in copies)
        transform = invert(still.full_from_small) @ what.fixed_from_moving @ moved.full_from_small
        drawn = draw(moved.pixels, size_of(still.pixels), transform, what.drawing)
        write_overlay(files.overlay, files.overlay_style, still.pixels, drawn, overwrite)
    return written


def _blank(size: tuple[int, int], like: PixelSource) -> PixelSource:
    """A picture of `size` (w, h) with the dtype and channels of another; it takes no memory."""
    return np.broadcast_to(np.zeros((), like.dtype), (*size[::-1], *like.shape[2:]))
