"""What a transform does to the middle of a picture, in numbers that people have words for."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from autoalign.geometry.homography import jacobian, project


@dataclass(frozen=True, kw_only=True)
class Motion:
    """The best similarity near the middle of the moving picture; inf and nan where the horizon goes through it."""

    shift_px: tuple[float, float]  # (x, y) from where the middle is in moving to where it lands in fixed
    turn_rad: float  # from x towards y: clockwise, as pictures are seen
    scale: float  # fixed px per moving px
    mirrored: bool


def motion(fixed_from_moving: ArrayLike, moving_size: tuple[int, int]) -> Motion:
    """Of a transform (3, 3) at the middle of a picture of size (w, h)."""
    transform = np.asarray(fixed_from_moving, np.float64)
    middle = (np.array([moving_size], np.float64) - 1) / 2
    landed, _ = project(transform, middle)
    (a, b), (c, d) = jacobian(transform, middle)[0].tolist()
    determinant = a * d - b * c
    x, y = (landed - middle)[0].tolist()
    return Motion(
        shift_px=(x, y),
        turn_rad=math.atan2(c - b, a + d),
        scale=math.sqrt(abs(determinant)),
        mirrored=determinant < 0,
    )
