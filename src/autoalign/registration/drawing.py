"""A transform put to use: the moving picture drawn in the frame of the fixed one, or in a frame that holds more."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from autoalign.geometry.homography import Array, translation
from autoalign.picture.border import Border, bordered
from autoalign.picture.canvas import Canvas, CanvasKind, canvas
from autoalign.picture.pixels import Picture, PixelSource, check_picture, size_of
from autoalign.picture.warp import Interpolation, Warped, warp
from autoalign.registration.alignment import Alignment


@dataclass(frozen=True, kw_only=True)
class Drawing:
    """How the moving picture is drawn."""

    canvas: CanvasKind = "fixed"
    """frame of the result: FIXED's own, one with both, their overlap, the largest full box in it, or all of MOVING"""
    border: Border = "constant"
    """where there is no data: see-through, which needs alpha; black; or the nearest pixel repeated"""


@dataclass(frozen=True, kw_only=True)
class Drawn:
    """The moving picture as it was drawn, and the frame it was drawn in."""

    warped: Warped  # with its border
    frame: Canvas


def draw(
    moving: Picture,
    fixed_size: tuple[int, int],
    fixed_from_moving: Array,
    drawing: Drawing,
    *,
    interpolation: Interpolation = "linear",
) -> Drawn:
    """`moving` (h, w) or (h, w, c) through a transform (3, 3) onto a fixed picture of size (w, h).

    Raises CanvasError where no canvas can hold what `drawing` asks for, ValueError for what no drawing can ask for.
    """
    frame = canvas(drawing.canvas, fixed_size, size_of(moving), fixed_from_moving)
    warped = warp(moving, frame.size, frame.canvas_from_fixed @ fixed_from_moving, interpolation=interpolation)
    return Drawn(warped=replace(warped, pixels=bordered(warped, drawing.border)), frame=frame)


def draw_in_strips(
    moving: PixelSource,
    size: tuple[int, int],
    canvas_from_moving: Array,
    drawing: Drawing,
    rows: int,
    interpolation: Interpolation = "linear",
) -> Iterator[Warped]:
    """The moving picture drawn in a frame of `size` (w, h), `rows` rows at a time, from the top to the bottom.

    Raises ValueError for a border that no strip has all of what it needs for.
    """
    if drawing.border == "replicate":
        raise ValueError("the nearest pixel with data may lie in another strip")
    for y in range(0, size[1], rows):
        strip_from_moving = translation(0, -y) @ canvas_from_moving
        warped = warp(moving, (size[0], min(rows, size[1] - y)), strip_from_moving, interpolation=interpolation)
        yield replace(warped, pixels=bordered(warped, drawing.border))


def warp_onto_fixed(
    moving: Picture,
    alignment: Alignment,
    *,
    interpolation: Interpolation = "linear",
    fill: float | Sequence[float] = 0,
) -> Picture:
    """`moving` (h, w) or (h, w, c) resampled to the size of the fixed picture; `fill` where it has no data.

    For the mask of where it has data, call `warp` itself. Raises AlignmentError if the pair was rejected, and
    ValueError for what is no picture, or one of another size than the moving one, such as the fixed one.
    """
    fixed_from_moving = alignment.fixed_from_moving
    check_picture(moving, "moving")
    if size_of(moving) != alignment.moving_size:
        raise ValueError(f"moving is {size_of(moving)}, the picture that was aligned {alignment.moving_size}")
    return warp(moving, alignment.fixed_size, fixed_from_moving, interpolation=interpolation, fill=fill).pixels
