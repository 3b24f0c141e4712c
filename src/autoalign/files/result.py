"""The result of a pair as files: the moving picture drawn over the fixed one, with what travels with it.

It is drawn as a whole, or strip by strip where that would be too large for memory.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from autoalign.errors import ImageWriteError
from autoalign.files.formats import TIFF, of_name
from autoalign.files.large import AnyPicture
from autoalign.files.metadata import Metadata, on_grid_of
from autoalign.files.read import LoadedPicture
from autoalign.files.ready import Both
from autoalign.files.write import write_picture
from autoalign.geometry.homography import Array
from autoalign.picture.border import like_bordered
from autoalign.picture.canvas import Canvas, canvas
from autoalign.picture.compose import compose
from autoalign.picture.pixels import Picture, opaque, size_of
from autoalign.picture.warp import Interpolation, Warped, warp
from autoalign.registration.drawing import Drawing, Drawn, draw, draw_in_strips

Watch = Callable[[Iterator[Warped], int], Iterator[Warped]]
"""Strips, and how many there will be, to the same strips; on the way it may tell how far it has come."""


def unwatched(strips: Iterator[Warped], _: int) -> Iterator[Warped]:
    """The `Watch` that tells nothing."""
    return strips


@dataclass(frozen=True, kw_only=True)
class ResultFiles:
    """Where the pictures of a result go; None for one that is not wanted."""

    aligned: Path | None = None
    mask: Path | None = None
    overlay: Path | None = None
    overlay_style: str = "mean"

    @property
    def wanted(self) -> list[Path]:
        return [path for path in (self.aligned, self.mask, self.overlay) if path is not None]


@dataclass(frozen=True, kw_only=True)
class Placed:
    """A picture, and where and how it is drawn."""

    picture: AnyPicture
    fixed_size: tuple[int, int]  # (w, h)
    fixed_from_moving: Array
    drawing: Drawing
    interpolation: Interpolation = "linear"

    @cached_property
    def frame(self) -> Canvas:
        """Raises CanvasError where there is none."""
        return canvas(self.drawing.canvas, self.fixed_size, size_of(self.picture.pixels), self.fixed_from_moving)

    @property
    def like(self) -> Picture:
        """A picture of the size, dtype and channels of the drawing; it takes no memory."""
        pixels = self.picture.pixels
        blank = np.broadcast_to(np.zeros((), pixels.dtype), (*self.frame.size[::-1], *pixels.shape[2:]))
        return like_bordered(blank, self.drawing.border)

    def strips(self, watch: Watch = unwatched) -> Iterator[Warped]:
        """The drawing from the top to the bottom."""
        from autoalign.files.pyramid import TILE

        transform = self.frame.canvas_from_fixed @ self.fixed_from_moving
        strips = draw_in_strips(self.picture.pixels, self.frame.size, transform, self.drawing, TILE, self.interpolation)
        return watch(strips, math.ceil(self.frame.size[1] / TILE))

    def metadata(self, fixed: Metadata | None, frame: Canvas) -> Metadata:
        """What travels with the drawing; `fixed` is what the fixed picture says of itself, None if not at hand."""
        return on_grid_of(fixed, self.picture.metadata, frame, self.fixed_from_moving, size_of(self.picture.pixels))


def check_in_strips(drawing: Drawing, *outputs: Path | None) -> None:
    """Raise ImageWriteError, the path last, for what cannot be drawn or written strip by strip."""
    for path in outputs:
        if path is not None and drawing.border == "replicate":
            raise ImageWriteError(f"--border replicate needs the whole result at once, which is too large: {path}")
        if path is not None and of_name(path) is not TIFF:
            raise ImageWriteError(f"a picture of so many pixels is written as TIFF: {path}")


def write_result(
    files: ResultFiles,
    both: Both,
    fixed_from_moving: Array,
    drawing: Drawing,
    watch: Watch = unwatched,
    overwrite: bool = False,
) -> list[Path]:
    """Draw the pictures of a pair that are wanted, write them, and say which they are.

    The overlay is one of what the pictures were aligned by. Raises CanvasError where no canvas can hold them,
    ImageWriteError as `write_picture` does.
    """
    if not files.wanted:
        return []
    fixed, moving = both.pictures
    what = Placed(
        picture=moving, fixed_size=size_of(fixed.pixels), fixed_from_moving=fixed_from_moving, drawing=drawing
    )
    drawn = write_placed(files, what, fixed.metadata, in_strips=both.is_large, watch=watch, overwrite=overwrite)
    if files.overlay is not None:
        still, moved = (seen.copy.pixels for seen in both.seen())
        drawn = drawn or draw(moved, size_of(still), both.as_seen(fixed_from_moving), drawing)
        write_overlay(files.overlay, files.overlay_style, still, drawn, overwrite)
    return files.wanted


def write_placed(
    files: ResultFiles,
    what: Placed,
    fixed: Metadata | None,
    *,
    in_strips: bool,
    watch: Watch = unwatched,
    overwrite: bool = False,
) -> Drawn | None:
    """Draw a picture, and write it and where it has data as far as wanted; what was drawn, unless it was in strips.

    `fixed` is what the fixed picture says of itself, None where that is not at hand. Raises as `write_result` does.
    """
    if not in_strips:
        return _write_whole(files, what, fixed, overwrite)
    from autoalign.files.pyramid import write_in_strips

    if files.aligned is not None:
        pixels, metadata = (strip.pixels for strip in what.strips(watch)), what.metadata(fixed, what.frame)
        write_in_strips(files.aligned, pixels, what.like, metadata, overwrite=overwrite)
    if files.mask is not None:
        like = np.broadcast_to(np.zeros((), np.uint8), what.frame.size[::-1])
        write_in_strips(files.mask, map(seen_in, what.strips(watch)), like, overwrite=overwrite)
    return None


def _write_whole(files: ResultFiles, what: Placed, fixed: Metadata | None, overwrite: bool) -> Drawn:
    picture = what.picture
    assert isinstance(picture, LoadedPicture), "what stays in its file is drawn in strips"
    drawn = draw(
        picture.pixels, what.fixed_size, what.fixed_from_moving, what.drawing, interpolation=what.interpolation
    )
    if files.aligned is not None:
        metadata = what.metadata(fixed, drawn.frame)
        write_picture(files.aligned, drawn.warped.pixels, metadata, overwrite=overwrite)
    if files.mask is not None:
        write_picture(files.mask, seen_in(drawn.warped), overwrite=overwrite)
    return drawn


def seen_in(warped: Warped) -> NDArray[np.uint8]:
    """(h, w) white where a result has data, black where it has none or is wholly see-through."""
    seen = opaque(warped.pixels)
    data = warped.valid if seen is None else warped.valid & seen
    return np.asarray(data * np.uint8(255))


def write_overlay(path: Path, style: str, fixed: Picture, drawn: Drawn, overwrite: bool = False) -> None:
    """Write both pictures as one, in the frame that the moving one was drawn in.

    Raises ImageWriteError as `write_picture` does.
    """
    still, moved = warp(fixed, drawn.frame.size, drawn.frame.canvas_from_fixed), drawn.warped
    both = compose(style, still.pixels, moved.pixels, still.valid, moved.valid)
    write_picture(path, both, overwrite=overwrite)
