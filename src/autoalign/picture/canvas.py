"""The frame a result is drawn in: the fixed picture's, one that holds both or the moving one, or one of their overlap.

A picture covers [-0.5, w - 0.5] x [-0.5, h - 0.5], and so does a canvas. The canvas of a pair keeps the fixed picture's
pixel grid, so that fixed pixels are copied and only the moving ones resampled.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from autoalign.errors import CanvasError
from autoalign.geometry.homography import project, scaling, translation
from autoalign.picture.warp import valid_runs

CanvasKind = Literal["fixed", "union", "intersection", "inner", "moving"]
KINDS: tuple[CanvasKind, ...] = get_args(CanvasKind)

# A canvas may have this many times the pixels that went in, and always this many.
MAX_GROWTH = 4
ALWAYS_ALLOWED_PIXELS = 16_000_000

# An edge that rounding puts this far over a pixel boundary does not make the canvas a pixel larger.
EDGE_PX = 1e-6

# w at the horizon, relative to w at the middle of the picture; closer than this the bounds are not worth computing.
HORIZON = 1e-9


@dataclass(frozen=True, kw_only=True)
class Canvas:
    """A frame and where the fixed picture lies in it."""

    size: tuple[int, int]  # (w, h)
    canvas_from_fixed: NDArray[np.float64]  # (3, 3), a shift by whole pixels


@dataclass(frozen=True, kw_only=True)
class PlaneCanvas:
    """A frame that shows a plane of the world upright and to scale.

    Draw it with `warp(image, size, canvas_from_image, anchor=anchor)`.
    """

    size: tuple[int, int]  # (w, h)
    canvas_from_image: NDArray[np.float64]  # (3, 3)
    canvas_from_world: NDArray[np.float64]  # (3, 3), scale and shift: [0, 0] is the canvas pixels per world unit
    anchor: tuple[float, float]  # (x, y) in the image, on the side of the horizon that is drawn
    cropped: str | None  # what was left out and why, a sentence; None if nothing was


def canvas(
    kind: CanvasKind,
    fixed_size: tuple[int, int],
    moving_size: tuple[int, int],
    fixed_from_moving: NDArray[np.float64],
    max_pixels: int | None = None,
) -> Canvas:
    """The frame for a pair of pictures of sizes (w, h) and the transform (3, 3) between them.

    "fixed": the fixed picture's own frame. "union": the smallest that holds both. "intersection": the smallest that
    holds every fixed pixel where the moving picture has data. "inner": the largest in which every pixel has data of
    both. "moving": the smallest that holds the moving picture as it lies on the fixed one. `max_pixels` is by default
    four times the pixels of both pictures together, and at least 16 million.

    Raises CanvasError where the pictures do not overlap and the frame is to be of their overlap, the horizon crosses a
    moving picture that must fit in, or the frame has too many pixels; ValueError for another kind.
    """
    if kind not in KINDS:
        raise ValueError(f"kind must be one of {', '.join(KINDS)}, not {kind!r}")
    if kind in ("intersection", "inner"):
        x0, y0, x1, y1 = _box_of_overlap(kind, fixed_size, moving_size, fixed_from_moving)
    else:
        x0, y0, x1, y1 = _box_of_pictures(kind, fixed_size, moving_size, fixed_from_moving)
    size = (x1 - x0, y1 - y0)
    if max_pixels is None:
        max_pixels = default_max_pixels(fixed_size, moving_size)
    _check_pixels(size, max_pixels)
    return Canvas(size=size, canvas_from_fixed=translation(-x0, -y0))


def plane_canvas(
    image_size: tuple[int, int],
    world_from_image: NDArray[np.float64],
    scale: float | None = None,
    *,
    crop: bool = True,
    max_distance: float = 4.0,
    anchor: tuple[float, float] | None = None,
    max_pixels: int | None = None,
) -> PlaneCanvas:
    """The frame that shows the world plane seen in a picture of `image_size` (w, h), through `world_from_image` (3, 3).

    `scale` is in canvas pixels per world unit; by default the canvas is as wide as the picture, or smaller where it
    would have more than `max_pixels` (default: four times the picture's, and at least 16 million). World axes are kept
    as they are, x to the right and y down: nothing is flipped.

    What is far away is cropped. In a picture of a plane, w falls towards the horizon as one over the distance from the
    camera (measured along its line of sight), and at n times the distance a picture pixel covers n times as much
    ground across and n * n times as much along the line of sight. So ground further away than `max_distance` times the
    `anchor` (x, y; a point of the picture, at best the middle of the measured points; by default its centre) is not
    made room for; neither is anything beyond the horizon. With the default of 4 a pixel stands for at most 16 times
    the length it has at the anchor. `crop=False` makes room for the whole picture.

    Raises CanvasError where `crop` is off and the horizon crosses the picture, where the anchor lies on it, or where
    the `scale` asked for makes too many pixels; ValueError for a singular transform, or a scale, distance or anchor out
    of range.
    """
    if scale is not None and not 0 < scale < math.inf:
        raise ValueError(f"scale must be positive, not {scale}")
    if not max_distance > 1:
        raise ValueError(f"max_distance must be more than 1, not {max_distance}")
    w, h = image_size
    anchor = _centre(image_size) if anchor is None else anchor
    if not (-0.5 <= anchor[0] <= w - 0.5 and -0.5 <= anchor[1] <= h - 0.5):
        raise ValueError(f"the anchor {anchor} must lie in the picture, whose size is {image_size}")
    if max_pixels is None:
        max_pixels = default_max_pixels(image_size)
    if crop:
        ground, cropped = _near_ground(image_size, world_from_image, anchor, max_distance)
    else:
        ground, cropped = _whole_picture(image_size, world_from_image, anchor, "the picture"), None
    low, high = _bounds(ground)
    span = high - low
    if not (np.isfinite(span).all() and span.min() > 0):
        raise ValueError(f"world_from_image must be a regular (3, 3) transform, not {world_from_image.tolist()}")
    if scale is None:
        scale = min(w / float(span[0]), _largest_scale(span, max_pixels))
    width, height = (max(1, math.ceil(v - EDGE_PX)) for v in (span * scale).tolist())
    _check_pixels((width, height), max_pixels)
    # 0.5: the first pixel's edge, not its centre, lies on the edge of the ground.
    canvas_from_world = translation(-0.5, -0.5) @ scaling(scale, scale) @ translation(-low[0], -low[1])
    return PlaneCanvas(
        size=(width, height),
        canvas_from_image=canvas_from_world @ world_from_image,
        canvas_from_world=canvas_from_world,
        anchor=anchor,
        cropped=cropped,
    )


def default_max_pixels(*sizes: tuple[int, int]) -> int:
    """Pixels a canvas may have, made from pictures of these sizes (w, h)."""
    return max(ALWAYS_ALLOWED_PIXELS, MAX_GROWTH * sum(w * h for w, h in sizes))


def _box_of_pictures(
    kind: CanvasKind, fixed_size: tuple[int, int], moving_size: tuple[int, int], fixed_from_moving: NDArray[np.float64]
) -> tuple[int, int, int, int]:
    """x0, y0, x1, y1 of the fixed picture's pixel grid that hold whole pictures."""
    low, high = fixed_bounds = _bounds(_outline(fixed_size))
    if kind != "fixed":
        low, high = _bounds(_whole_picture(moving_size, fixed_from_moving, _centre(moving_size), "the moving picture"))
    if kind == "union":
        low, high = np.minimum(low, fixed_bounds[0]), np.maximum(high, fixed_bounds[1])
    # 0.5: the left edge of pixel n is at n - 0.5, and the canvas begins with a whole pixel of the fixed grid.
    x0, y0 = (math.floor(v + 0.5 + EDGE_PX) for v in low.tolist())
    x1, y1 = (math.ceil(v + 0.5 - EDGE_PX) for v in high.tolist())
    return x0, y0, max(x0 + 1, x1), max(y0 + 1, y1)


def _box_of_overlap(
    kind: CanvasKind, fixed_size: tuple[int, int], moving_size: tuple[int, int], fixed_from_moving: NDArray[np.float64]
) -> tuple[int, int, int, int]:
    """x0, y0, x1, y1 around the fixed pixels where the moving picture has data, or within them."""
    starts, stops = valid_runs(moving_size, fixed_size, fixed_from_moving)
    rows = np.flatnonzero(starts < stops)
    if not len(rows):
        raise CanvasError("the pictures do not overlap, so that their overlap is no canvas")
    if kind == "inner":
        return largest_inner_box(starts, stops)
    return int(starts[rows].min()), int(rows[0]), int(stops[rows].max()), int(rows[-1]) + 1


def largest_inner_box(starts: NDArray[np.intp], stops: NDArray[np.intp]) -> tuple[int, int, int, int]:
    """x0, y0, x1, y1 of the largest box all of whose pixels lie in the runs starts[y] <= x < stops[y], each (h,).

    The runs must be those of a convex shape: then what two rows have in common, all rows between them have, and the
    box is found among all pairs of rows. Of several that are equally large it is the topmost.
    """
    best, box = 0, (0, 0, 0, 0)
    heights = np.arange(1, len(starts) + 1)
    for top in np.flatnonzero(starts < stops).tolist():
        if (stops[top] - starts[top]) * (len(starts) - top) <= best:
            continue
        widths = np.minimum(stops[top:], stops[top]) - np.maximum(starts[top:], starts[top])
        areas = widths * heights[: len(widths)]
        most = int(areas.argmax())
        if areas[most] > best:
            bottom = top + most
            best = int(areas[most])
            box = int(max(starts[top], starts[bottom])), top, int(min(stops[top], stops[bottom])), bottom + 1
    return box


def _check_pixels(size: tuple[int, int], max_pixels: int) -> None:
    w, h = size
    if w * h > max_pixels:
        raise CanvasError(f"the canvas would be {w} x {h} = {w * h:,} pixels; {max_pixels:,} are allowed")


def _largest_scale(span: NDArray[np.float64], max_pixels: int) -> float:
    """The scale s with (s x + 1) (s y + 1) = max_pixels: each side may be rounded up by nearly a pixel."""
    area, half = span[0] * span[1], (span[0] + span[1]) / 2
    return float((max_pixels - 1) / (half + math.sqrt(half * half + area * (max_pixels - 1))))


def _centre(size: tuple[int, int]) -> tuple[float, float]:
    return (size[0] - 1) / 2, (size[1] - 1) / 2


def _outline(size: tuple[int, int]) -> NDArray[np.float64]:
    """(4, 2) corners of a picture: edges, not centres, of its corner pixels, hence the 0.5."""
    right, bottom = size[0] - 0.5, size[1] - 0.5
    return np.array([[-0.5, -0.5], [right, -0.5], [right, bottom], [-0.5, bottom]])


def _bounds(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    return points.min(axis=0), points.max(axis=0)


def _nearness(
    points: NDArray[np.float64], dst_from_src: NDArray[np.float64], anchor: tuple[float, float]
) -> NDArray[np.float64]:
    """(n,) w at points (n, 2), 1 at the anchor and 0 at the horizon: one over the distance, in anchor distances."""
    _, w = project(dst_from_src, np.array([*points, anchor]))
    if abs(w[-1]) <= HORIZON * abs(w).max():
        raise CanvasError(f"the horizon goes through the point {anchor}, which is to be drawn")
    return np.asarray(w[:-1] / w[-1])


def _whole_picture(
    size: tuple[int, int], dst_from_src: NDArray[np.float64], anchor: tuple[float, float], name: str
) -> NDArray[np.float64]:
    """(4, 2) corners of a picture where the transform takes them; CanvasError if the horizon is in between."""
    corners = _outline(size)
    if _nearness(corners, dst_from_src, anchor).min() <= HORIZON:
        raise CanvasError(f"the horizon crosses {name}: a canvas that holds all of it would be endless")
    return project(dst_from_src, corners)[0]


def _near_ground(
    size: tuple[int, int], world_from_image: NDArray[np.float64], anchor: tuple[float, float], max_distance: float
) -> tuple[NDArray[np.float64], str | None]:
    """(n, 2) corners, in the world, of what is near enough, and what was left out."""
    corners = _outline(size)
    # How much nearer than the furthest allowed; linear over the picture, like w.
    margin = _nearness(corners, world_from_image, anchor) - 1 / max_distance
    kept = _where_positive(corners, margin)
    cropped = None
    if margin.min() < 0:
        share = 1 - _area(kept) / _area(corners)
        horizon = "beyond the horizon or " if margin.min() <= -1 / max_distance else ""
        distance = f"over {max_distance:g} times as far as its point ({anchor[0]:g}, {anchor[1]:g})"
        cropped = f"{share:.0%} of the picture left out: {horizon}{distance}"
    return project(world_from_image, kept)[0], cropped


def _where_positive(corners: NDArray[np.float64], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """(m, 2) the part of a convex polygon (n, 2) where a linear function, given by its `values` (n,) there, is >= 0."""
    kept = []
    for i in range(len(corners)):
        a, b = values[i - 1], values[i]
        if a * b < 0:
            kept.append(corners[i - 1] + (corners[i] - corners[i - 1]) * (a / (a - b)))
        if b >= 0:
            kept.append(corners[i])
    return np.array(kept)


def _area(polygon: NDArray[np.float64]) -> float:
    x, y = polygon.T
    return float(abs(np.dot(x, np.roll(y, 1)) - np.dot(y, np.roll(x, 1))) / 2)
