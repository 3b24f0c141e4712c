"""An Alignment put to use: the moving picture in the frame of the fixed one."""

from __future__ import annotations

from collections.abc import Sequence

from autoalign.picture.pixels import Picture
from autoalign.picture.warp import Interpolation, warp
from autoalign.registration.alignment import Alignment


def warp_onto_fixed(
    moving: Picture,
    alignment: Alignment,
    *,
    interpolation: Interpolation = "linear",
    fill: float | Sequence[float] = 0,
) -> Picture:
    """`moving` (h, w) or (h, w, c) resampled to the size of the fixed picture; `fill` where it has no data.

    For the mask of where it has data, call `warp` itself. Raises AlignmentError if the pair was rejected.
    """
    fixed_from_moving = alignment.fixed_from_moving
    return warp(moving, alignment.fixed_size, fixed_from_moving, interpolation=interpolation, fill=fill).pixels
