"""The result of a pair as files: the moving picture drawn over the fixed one, with what travels with it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from autoalign.files.metadata import on_grid_of
from autoalign.files.read import LoadedPicture
from autoalign.files.write import write_picture
from autoalign.geometry.homography import Array
from autoalign.picture.compose import compose
from autoalign.picture.pixels import Picture, opaque, size_of
from autoalign.picture.warp import Warped, warp
from autoalign.registration.drawing import Drawing, Drawn, draw


@dataclass(frozen=True, kw_only=True)
class ResultFiles:
    """Where the pictures of a result go; None for one that is not wanted."""

    aligned: Path | None = None
    mask: Path | None = None
    overlay: Path | None = None
    overlay_style: str = "mean"


def write_result(
    files: ResultFiles,
    fixed: LoadedPicture,
    moving: LoadedPicture,
    fixed_from_moving: Array,
    drawing: Drawing,
    overwrite: bool = False,
) -> list[Path]:
    """Draw the pictures that are wanted, write them, and say which they are.

    Raises CanvasError where no canvas can hold them, ImageWriteError as `write_picture` does.
    """
    written: list[Path] = []
    if files == ResultFiles(overlay_style=files.overlay_style):
        return written
    drawn = draw(moving.pixels, size_of(fixed.pixels), fixed_from_moving, drawing)
    if files.aligned is not None:
        size = size_of(moving.pixels)
        metadata = on_grid_of(fixed.metadata, moving.metadata, drawn.frame, fixed_from_moving, size)
        write_picture(files.aligned, drawn.warped.pixels, metadata, overwrite=overwrite)
        written.append(files.aligned)
    if files.mask is not None:
        write_mask(files.mask, drawn.warped, overwrite)
        written.append(files.mask)
    if files.overlay is not None:
        write_overlay(files.overlay, files.overlay_style, fixed.pixels, drawn, overwrite)
        written.append(files.overlay)
    return written


def write_mask(path: Path, warped: Warped, overwrite: bool = False) -> None:
    """Write where a result has data, as `seen_in` shows it. Raises ImageWriteError as `write_picture` does."""
    write_picture(path, seen_in(warped), overwrite=overwrite)


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
