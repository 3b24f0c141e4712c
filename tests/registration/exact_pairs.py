"""Pairs of pictures whose transform is known exactly: two views rendered from one continuous scene.

A scene is a cubic spline through a picture of scikit-image's wheel. A view integrates it over each of its pixels
(3 x 3 samples, symmetric about the pixel's centre), so that neither view is the other's source and the truth is
`inverse(scene_from_fixed) @ scene_from_moving`, without any half pixel. Noise is drawn for each view.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import skimage.data
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates, spline_filter
from skimage.io import imread

from autoalign.geometry.homography import Array, apply, invert, project, scaling, shown, translation

Picture = NDArray[Any]
_SAMPLES = 3  # per pixel and axis


@cache
def photo(name: str) -> NDArray[np.uint8]:
    """A picture of the wheel, as it is; nothing is downloaded."""
    return np.asarray(imread(Path(skimage.data.__file__).parent / name))


@cache
def _spline(name: str) -> tuple[Array, ...]:
    """Spline coefficients of each channel, the picture smoothed to what its pixels can hold."""
    image = np.atleast_3d(photo(name)).astype(np.float64)
    return tuple(spline_filter(gaussian_filter(image[..., c], 0.7), order=3) for c in range(min(image.shape[2], 3)))


def render(name: str, scene_from_view: Array, size: tuple[int, int], *, colour: bool = False) -> Array:
    """(h, w) luminance or (h, w, 3) of the view of `size` (w, h); mirrored scene beyond the scene's edges."""
    inner = (np.arange(_SAMPLES) + 0.5) / _SAMPLES - 0.5
    x, y = np.meshgrid(*((np.arange(s)[:, None] + inner).ravel() for s in size))
    there, _ = project(scene_from_view, np.stack([x.ravel(), y.ravel()], 1))
    w, h = size
    planes = _spline(name)
    if not colour and len(planes) == 3:
        planes = (sum(weight * plane for weight, plane in zip((0.299, 0.587, 0.114), planes, strict=True)),)
    seen = [
        map_coordinates(plane, (there[:, 1], there[:, 0]), order=3, mode="mirror", prefilter=False)
        .reshape(h, _SAMPLES, w, _SAMPLES)
        .mean((1, 3))
        for plane in planes
    ]
    return np.stack(seen, 2) if colour else seen[0]


def camera(values: Array, seed: int, *, noise: float = 2.0, gain: float = 1.0, bias: float = 0.0) -> NDArray[np.uint8]:
    """What an 8-bit camera makes of a view: exposure, noise of its own, rounding."""
    noisy = values * gain + bias + np.random.default_rng(seed).normal(0.0, noise, values.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


@dataclass(frozen=True, kw_only=True)
class Pair:
    """Two views and the truth."""

    fixed: Picture
    moving: Picture
    fixed_from_moving: Array  # (3, 3), [2, 2] == 1


def about(x: float, y: float, linear: Sequence[Sequence[float]]) -> Array:
    """(3, 3) affine with this 2 x 2 linear part that keeps (x, y)."""
    out = np.eye(3)
    out[:2, :2] = linear
    return translation(x, y) @ out @ translation(-x, -y)


def turn(x: float, y: float, degrees: float, zoom: float = 1.0) -> Array:
    """(3, 3) turn and zoom about (x, y)."""
    c, s = zoom * np.cos(np.deg2rad(degrees)), zoom * np.sin(np.deg2rad(degrees))
    return about(x, y, [[c, -s], [s, c]])


def pair(
    name: str,
    fixed_from_moving: Array,
    size: tuple[int, int] = (400, 300),
    moving_size: tuple[int, int] | None = None,
    *,
    scene_from_fixed: Array | None = None,
    colour: bool = False,
    noise: float = 2.0,
    gain: float = 0.85,
    bias: float = 12.0,
) -> Pair:
    """A fixed view of the middle of the scene and a moving one, differently exposed."""
    rows, columns = photo(name).shape[:2]
    middle = translation((columns - size[0]) / 2, (rows - size[1]) / 2)
    scene_from_fixed = middle if scene_from_fixed is None else scene_from_fixed
    fixed = render(name, scene_from_fixed, size, colour=colour)
    moving = render(name, scene_from_fixed @ fixed_from_moving, moving_size or size, colour=colour)
    return Pair(
        fixed=camera(fixed, 1, noise=noise),
        moving=camera(moving, 2, noise=noise, gain=gain, bias=bias),
        fixed_from_moving=shown(fixed_from_moving),
    )


def errors_px(found: Array, truth: Array, moving_size: tuple[int, int], fixed_size: tuple[int, int]) -> Array:
    """(n,) distances in fixed px over a grid of the overlap."""
    grid = np.stack(np.meshgrid(*(np.linspace(0, s - 1, 24) for s in moving_size)), -1).reshape(-1, 2)
    there, w = project(truth, grid)
    inside = (w > 0) & (there >= 0).all(1) & (there <= np.array(fixed_size) - 1).all(1)
    return np.asarray(np.linalg.norm(apply(found, grid[inside]) - there[inside], axis=1))


def mean_error_px(found: Array, of: Pair) -> float:
    """Mean distance from the truth over the overlap, fixed px."""
    sizes = [(image.shape[1], image.shape[0]) for image in (of.moving, of.fixed)]
    return float(errors_px(found, of.fixed_from_moving, *sizes).mean())


__all__ = [
    "Pair",
    "about",
    "camera",
    "errors_px",
    "invert",
    "mean_error_px",
    "pair",
    "photo",
    "render",
    "scaling",
    "turn",
]
