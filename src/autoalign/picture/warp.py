"""A picture through a transform: exact bilinear resampling, by tiles, with a mask of where there is data.

An output pixel is valid where its place in the source lies between the centres of source pixels, so that all four
neighbours exist: 0 <= x <= w - 1, 0 <= y <= h - 1, on the source's own side of the horizon. Multiplied by the positive
homogeneous w, each of these conditions is linear in the output pixel. So the valid pixels of an output row are one run,
whose two ends `valid_runs` computes for all rows at once; mask, fill and the part of the source that a tile needs all
come from those runs.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from autoalign.geometry.homography import invert, project, translation
from autoalign.picture.pixels import Picture, PixelSource, check_source, full_scale, has_alpha, size_of

Interpolation = Literal["linear", "nearest"]

# A place this close outside the outermost pixel centres counts as on them: rounding must not cost an identity its rim.
RIM_PX = 1e-6

# Weight of a colour that is fully transparent, where an opaque one has 1: too little to bleed, enough to survive alone.
TRANSPARENT_WEIGHT = 1e-6

# A tile may read this many tile sides of the source; past that float32 places get coarse, and the tile is split.
MAX_READ_TILES = 4


@dataclass(frozen=True, kw_only=True)
class Warped:
    """A resampled picture and where it has data."""

    pixels: Picture  # (h, w) or (h, w, c), dtype and channels of the source; the fill where not valid
    valid: NDArray[np.bool_]  # (h, w)


@dataclass(frozen=True, kw_only=True)
class _Box:
    """Pixels x0 <= x < x1, y0 <= y < y1 of a picture."""

    x0: int
    y0: int
    x1: int
    y1: int

    @property
    def size(self) -> tuple[int, int]:
        return self.x1 - self.x0, self.y1 - self.y0

    @property
    def slices(self) -> tuple[slice, slice]:
        return slice(self.y0, self.y1), slice(self.x0, self.x1)

    def halves(self) -> tuple[_Box, _Box]:
        w, h = self.size
        if w >= h:
            x = self.x0 + w // 2
            return _Box(x0=self.x0, y0=self.y0, x1=x, y1=self.y1), _Box(x0=x, y0=self.y0, x1=self.x1, y1=self.y1)
        y = self.y0 + h // 2
        return _Box(x0=self.x0, y0=self.y0, x1=self.x1, y1=y), _Box(x0=self.x0, y0=y, x1=self.x1, y1=self.y1)


def warp(
    image: PixelSource,
    size: tuple[int, int],
    dst_from_src: NDArray[np.float64],
    *,
    interpolation: Interpolation = "linear",
    fill: float | Sequence[float] = 0,
    anchor: tuple[float, float] | None = None,
    tile_px: int = 1024,
) -> Warped:
    """Resample `image` into a frame of `size` (w, h); `dst_from_src` (3, 3) takes its pixels to those of the frame.

    Bilinear between the four neighbours, rounded to the picture's dtype, or the nearest pixel. Colours are weighted by
    alpha where there is one. NaN and infinity spread to all they are among the four of. `fill`, a number or one per
    channel, is painted where there is no data and never mixed into what is valid. A source crossed by the horizon is
    drawn only on that side of it where `anchor` (x, y) lies, by default the picture's centre.

    `image` is an array, or what is read where it is asked for: each tile of the output asks once, for what it needs.
    Output is made in tiles of at most `tile_px` a side, each from the part of the source it needs and in coordinates of
    its own: no limit on the sides of either picture, and the place of a sample is good to about 1e-4 px.

    Raises ValueError for what is no picture, a size without pixels, a singular transform, a fill that does not fit.
    """
    check_source(image)
    if interpolation not in ("linear", "nearest"):
        raise ValueError(f'interpolation must be "linear" or "nearest", not {interpolation!r}')
    if tile_px < 1:
        raise ValueError(f"tile_px must be at least 1, not {tile_px}")
    paint = _fill_values(fill, image)
    src_size, channels = size_of(image), image.shape[2:]
    src_from_dst = _src_from_dst(src_size, dst_from_src, anchor)
    nearest = interpolation == "nearest" or _takes_pixels_onto_pixels(src_from_dst, size)
    resample = _nearest if nearest else _bilinear_under_alpha if has_alpha(image) else _bilinear

    starts, stops = _runs(src_size, size, src_from_dst)
    # cv2 drops a lone channel; it comes back at the end.
    pixels = np.empty((size[1], size[0], *(() if channels == (1,) else channels)), image.dtype)
    for tile, read in _tiles(src_size, size, src_from_dst, starts, stops, tile_px):
        read_from_tile = translation(-read.x0, -read.y0) @ src_from_dst @ translation(tile.x0, tile.y0)
        part = image[read.slices]
        resample(part.reshape(part.shape[:2] + pixels.shape[2:]), pixels[tile.slices], read_from_tile)

    pixels = pixels.reshape(*pixels.shape[:2], *channels)
    _paint_outside(pixels, starts, stops, paint)
    return Warped(pixels=pixels, valid=_mask(starts, stops, size))


def valid_mask(
    src_size: tuple[int, int],
    size: tuple[int, int],
    dst_from_src: NDArray[np.float64],
    *,
    anchor: tuple[float, float] | None = None,
) -> NDArray[np.bool_]:
    """(h, w) True where `warp` of a picture of `src_size` (w, h) into a frame of `size` (w, h) has data.

    Raises ValueError as `warp` does.
    """
    return _mask(*valid_runs(src_size, size, dst_from_src, anchor=anchor), size)


def valid_runs(
    src_size: tuple[int, int],
    size: tuple[int, int],
    dst_from_src: NDArray[np.float64],
    *,
    anchor: tuple[float, float] | None = None,
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """(starts, stops), each (h,): in row y the pixels starts[y] <= x < stops[y] have data; see `valid_mask`.

    Raises ValueError as `warp` does.
    """
    return _runs(src_size, size, _src_from_dst(src_size, dst_from_src, anchor))


def _src_from_dst(
    src_size: tuple[int, int], dst_from_src: NDArray[np.float64], anchor: tuple[float, float] | None
) -> NDArray[np.float64]:
    """(3, 3) inverse, with the sign that makes w positive on the anchor's side of the horizon.

    dst_from_src (p, 1) = w (q, 1) means src_from_dst (q, 1) = (p, 1) / w: both ends have the same sign of w.
    """
    transform = np.asarray(dst_from_src, np.float64)
    if transform.shape != (3, 3) or not np.isfinite(transform).all() or np.linalg.matrix_rank(transform) < 3:
        raise ValueError(f"dst_from_src must be a regular (3, 3) transform, not {transform.tolist()}")
    x, y = anchor or ((src_size[0] - 1) / 2, (src_size[1] - 1) / 2)
    return invert(transform * np.copysign(1.0, transform[2] @ (x, y, 1.0)))


def _runs(
    src_size: tuple[int, int], size: tuple[int, int], src_from_dst: NDArray[np.float64]
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """`valid_runs` of a transform whose sign is settled."""
    if min(size) < 1:
        raise ValueError(f"the output must have pixels, its size is {size}")
    to_x, to_y, to_w = src_from_dst
    # Together the first two leave only w >= 0, and w = 0 only where x and y are 0 too, which no regular transform has.
    forms = (
        to_x + RIM_PX * to_w,
        (src_size[0] - 1 + RIM_PX) * to_w - to_x,
        to_y + RIM_PX * to_w,
        (src_size[1] - 1 + RIM_PX) * to_w - to_y,
    )
    starts, stops = np.zeros(size[1]), np.full(size[1], float(size[0]))
    y = np.arange(size[1])
    for per_x, per_y, constant in forms:  # each must be >= 0
        at_0 = per_y * y + constant
        if per_x > 0:
            starts = np.maximum(starts, np.ceil(-at_0 / per_x))
        elif per_x < 0:
            stops = np.minimum(stops, np.floor(at_0 / -per_x) + 1)
        else:
            stops = np.where(at_0 >= 0, stops, 0)
    starts = np.minimum(starts, size[0])
    return starts.astype(np.intp), np.maximum(starts, stops).astype(np.intp)


def _mask(starts: NDArray[np.intp], stops: NDArray[np.intp], size: tuple[int, int]) -> NDArray[np.bool_]:
    mask = np.zeros((size[1], size[0]), bool)
    for row, start, stop in zip(mask, starts.tolist(), stops.tolist(), strict=True):
        row[start:stop] = True
    return mask


def _paint_outside(pixels: Picture, starts: NDArray[np.intp], stops: NDArray[np.intp], paint: Picture) -> None:
    for row, start, stop in zip(pixels, starts.tolist(), stops.tolist(), strict=True):
        row[:start] = paint
        row[stop:] = paint


def _fill_values(fill: float | Sequence[float], image: PixelSource) -> Picture:
    """The fill as () or (c,) in the picture's dtype."""
    wanted = np.asarray(fill, np.float64)
    if wanted.shape not in ((), image.shape[2:]):
        raise ValueError(f"fill must be one number or one per channel, not {fill!r}")
    if image.dtype != np.float32:
        limit = np.iinfo(image.dtype).max
        if not np.all((wanted >= 0) & (wanted <= limit) & (wanted == np.rint(wanted))):
            raise ValueError(f"fill must be whole numbers from 0 to {limit} for {image.dtype}, not {fill!r}")
    return wanted.astype(image.dtype)


def _takes_pixels_onto_pixels(src_from_dst: NDArray[np.float64], size: tuple[int, int]) -> bool:
    """True for whole shifts, turns and steps, where there is nothing to interpolate and not even NaN may spread."""
    if not src_from_dst[2, 2]:
        return False
    whole = np.rint(src_from_dst / src_from_dst[2, 2])
    right, bottom = size[0] - 1.0, size[1] - 1.0
    corners = np.array([[0.0, 0.0], [right, 0.0], [0.0, bottom], [right, bottom]])
    if whole[2].tolist() != [0, 0, 1]:
        return False
    return bool(np.all(np.abs(project(src_from_dst, corners)[0] - project(whole, corners)[0]) < RIM_PX))


def _tiles(
    src_size: tuple[int, int],
    size: tuple[int, int],
    src_from_dst: NDArray[np.float64],
    starts: NDArray[np.intp],
    stops: NDArray[np.intp],
    tile_px: int,
) -> Iterator[tuple[_Box, _Box]]:
    """Output boxes that hold every valid pixel, each with the box of the source it reads."""
    width, height = size
    waiting = [
        _Box(x0=x, y0=y, x1=min(x + tile_px, width), y1=min(y + tile_px, height))
        for y in range(0, height, tile_px)
        for x in range(0, width, tile_px)
    ]
    while waiting:
        whole = waiting.pop()
        ends = _run_ends(whole, starts, stops)
        if not len(ends):
            continue
        (x0, y0), (x1, y1) = _bounds(ends)
        tile = _Box(x0=int(x0), y0=int(y0), x1=int(x1) + 1, y1=int(y1) + 1)
        read = _read_box(src_size, project(src_from_dst, ends)[0])
        if max(read.size) > MAX_READ_TILES * tile_px and max(tile.size) > 1:
            waiting += tile.halves()
        else:
            yield tile, read


def _run_ends(tile: _Box, starts: NDArray[np.intp], stops: NDArray[np.intp]) -> NDArray[np.float64]:
    """(n, 2) first and last valid pixel (x, y) of every row of a tile that has any.

    A row of pixels maps onto a straight line, so the extremes of what a tile reads are among these.
    """
    first = np.maximum(starts[tile.y0 : tile.y1], tile.x0)
    last = np.minimum(stops[tile.y0 : tile.y1], tile.x1) - 1
    some = np.flatnonzero(first <= last)
    ends = np.empty((2, len(some), 2))
    ends[0, :, 0], ends[1, :, 0] = first[some], last[some]
    ends[..., 1] = some + tile.y0
    return ends.reshape(-1, 2)


def _read_box(src_size: tuple[int, int], places: NDArray[np.float64]) -> _Box:
    """The source pixels among which `places` (n, 2) lie, with one to spare for the kernel's rounding."""
    limit = np.array(src_size)
    low, high = _bounds(places)
    low = np.clip(np.floor(low) - 1, 0, limit - 1)
    high = np.clip(np.ceil(high) + 2, low + 1, limit)
    return _Box(x0=int(low[0]), y0=int(low[1]), x1=int(high[0]), y1=int(high[1]))


def _kernel(src: Picture, dst: Picture, src_from_dst: NDArray[np.float64], flag: int) -> None:
    """Write into `dst`, a view with the source's dtype and channels."""
    flags = flag | cv2.WARP_INVERSE_MAP
    # Replicate: a place that rounding puts a hair outside the rim must not be mixed with a fill.
    cv2.warpPerspective(src, src_from_dst, size_of(dst), dst, flags=flags, borderMode=cv2.BORDER_REPLICATE)


def _nearest(src: Picture, dst: Picture, src_from_dst: NDArray[np.float64]) -> None:
    _kernel(src, dst, src_from_dst, cv2.INTER_NEAREST)


def _bounds(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(2,) lowest and (2,) highest x and y of points (n, 2)."""
    columns = points.T.copy()  # ten times as fast as a minimum along the first axis
    return columns.min(axis=1), columns.max(axis=1)


def _bilinear(src: Picture, dst: Picture, src_from_dst: NDArray[np.float64]) -> None:
    if src.shape[2:] != (2,):
        _kernel(src, dst, src_from_dst, cv2.INTER_LINEAR)
        return
    for channel in (0, 1):  # of two together OpenCV 5.0 still rounds the places to 1/32 px
        dst[..., channel] = _bilinear_plane(cv2.extractChannel(src, channel), size_of(dst), src_from_dst)


def _bilinear_plane(src: Picture, size: tuple[int, int], src_from_dst: NDArray[np.float64]) -> Picture:
    dst = np.empty(size[::-1], src.dtype)
    _kernel(src, dst, src_from_dst, cv2.INTER_LINEAR)
    return dst


def _bilinear_under_alpha(src: Picture, dst: Picture, src_from_dst: NDArray[np.float64]) -> None:
    """Two or four channels; a colour counts as much as it is opaque, so that transparent pixels do not bleed."""
    _bilinear(src, dst, src_from_dst)
    alpha = cv2.extractChannel(src, src.shape[2] - 1)
    if alpha.min() == alpha.max():
        return
    weight = alpha.astype(np.float32) / full_scale(src) + np.float32(TRANSPARENT_WEIGHT)
    total = _bilinear_plane(weight, size_of(dst), src_from_dst)
    for channel in range(src.shape[2] - 1):
        mean = _bilinear_plane(src[..., channel] * weight, size_of(dst), src_from_dst) / total
        dst[..., channel] = mean if src.dtype == np.float32 else np.rint(mean)
