"""Patches of two pictures compared under one transform: how alike they are, and how far each wants to move.

A patch lies on whole pixels of the fixed picture, and the moving picture is sampled there through the transform. Both
are reduced to mean 0 and contrast 1, which is what makes it work under other light; gradients are the mean of both
pictures', which makes the Gauss-Newton step of second order and the same for swapped roles (so that a forward-backward
check would say nothing).

Only what lies around the patches is read, a few patches at a time. They are last in memory, (s, s, n) for n patches of
s x s pixels, so that all that is done to a pixel is done to a run of them.

Sources: Gruen 1985 (least-squares matching); Lucas and Kanade 1981; Benhimane and Malis 2004 (efficient second-order).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from autoalign.geometry.homography import Array, Mask, apply, invert, jacobian, project, unit
from autoalign.geometry.least_squares import Correspondences, joined_pairs
from autoalign.picture.pixels import Picture, Shrunken, size_of

RIM = 2  # px around a patch that its comparison needs: one for the gradients, one for the smoothing
_SMOOTHING = 0.6  # px; takes away what bilinear sampling would distort (measured: 0.4 to 0.7 are alike, 1.0 is worse)
_STRETCH = 4.0  # times that a patch may be longer in the moving picture; beyond, its pixels are too far apart
_AT_ONCE = 128  # patches; what is computed on so many stays in the processor's cache
_REMAP_LIMIT = 32_767  # px, the longest side that cv2.remap takes

Manner = Literal["rough", "fine", "both ways"]
"""With bilinear or cubic interpolation of the moving picture, or with cubic interpolation of each in turn."""

_Float = NDArray[np.float32]
_Index = NDArray[np.intp]


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """All patches compared under one transform."""

    pairs: Correspondences  # (n) src: where the patch is in moving, dst: where it is in fixed, full px
    shift: Array  # (n, 2) how far it wants to move, px of the compared pictures; both ways: at most, along x and y
    correlation: Array  # (n,) -1 where it lies outside
    inside: Mask  # (n,) lies in both pictures


def joined(parts: Sequence[Comparison]) -> Comparison:
    """All patches of several comparisons, in their order."""
    return Comparison(
        pairs=joined_pairs([part.pairs for part in parts]),
        shift=np.concatenate([part.shift for part in parts]),
        correlation=np.concatenate([part.correlation for part in parts]),
        inside=np.concatenate([part.inside for part in parts]),
    )


def _both_ways(fixed: Shrunken, moving: Shrunken, fixed_from_moving: Array, places: Array, radius: int) -> Comparison:
    """As `compare`, cubic: each patch is laid on the fixed picture's pixels, then on the moving one's, and the mean of
    both is taken. What interpolation does to either picture is lost in it, and the answer is that of swapped roles."""
    moving_from_fixed = invert(fixed_from_moving)
    there = compare(fixed, moving, fixed_from_moving, places, radius, cubic=True)
    back = compare(moving, fixed, moving_from_fixed, apply(moving_from_fixed, places), radius, cubic=True)
    inside = there.inside & back.inside
    return Comparison(
        pairs=_mean(there.pairs, back.pairs),
        shift=np.maximum(np.abs(there.shift), np.abs(back.shift)),
        correlation=np.where(inside, (there.correlation + back.correlation) / 2, -1.0),
        inside=inside,
    )


def _mean(there: Correspondences, back: Correspondences) -> Correspondences:
    """The same pairs, measured both ways, as one. Both lie within a pixel, where a transform is as good as affine: the
    residual of their mean is the mean of their residuals. Both see the same noise, so that it is no smaller."""
    return replace(
        there,
        src=(there.src + back.dst) / 2,
        dst=(there.dst + back.src) / 2,
        src_sigma=(there.src_sigma + back.dst_sigma) / 2,
        dst_sigma=(there.dst_sigma + back.src_sigma) / 2,
    )


def compare_as(
    manner: Manner, fixed: Shrunken, moving: Shrunken, fixed_from_moving: Array, places: Array, radius: int
) -> Comparison:
    """Compare in one of the manners."""
    if manner == "both ways":
        return _both_ways(fixed, moving, fixed_from_moving, places, radius)
    return compare(fixed, moving, fixed_from_moving, places, radius, cubic=manner == "fine")


def compare(
    fixed: Shrunken, moving: Shrunken, fixed_from_moving: Array, places: Array, radius: int, *, cubic: bool
) -> Comparison:
    """Compare the patches of 2 x `radius` + 1 pixels a side around `places` (n, 2) of the full fixed picture.

    The pictures are grey (h, w), `fixed_from_moving` (3, 3) is between their full sizes. Interpolation is bilinear, or
    `cubic`, which costs more and has no bias.
    """
    reach = radius + RIM
    moving_from_fixed = unit(invert(moving.full_from_small) @ invert(fixed_from_moving) @ fixed.full_from_small)
    centres = np.rint(apply(invert(fixed.full_from_small), places))
    corners = centres + reach * np.array([[[-1.0, -1.0]], [[1.0, -1.0]], [[1.0, 1.0]], [[-1.0, 1.0]]])  # (4, n, 2)
    there, w = project(moving_from_fixed, corners.reshape(-1, 2))
    there, w = there.reshape(corners.shape), w.reshape(4, -1)
    inside = _inside(corners, size_of(fixed.pixels)) & _inside(there, size_of(moving.pixels)) & (w > 0).all(0)
    inside &= np.ptp(there, axis=0).max(1) <= _STRETCH * 2 * reach
    shift, correlation, sigma = np.zeros((len(places), 2)), np.full(len(places), -1.0), np.ones(len(places))
    fixed_parts = _parts(fixed.pixels, corners, inside, margin=0)
    moving_parts = _parts(moving.pixels, there, inside, margin=1)
    window = np.pad(_bell(2 * radius + 1), 1)
    everyone = np.flatnonzero(inside)
    at_once = max(1, min(_AT_ONCE, _REMAP_LIMIT // max(2 * reach + 1, moving_parts.windows.shape[2])))
    for i in range(0, len(everyone), at_once):
        some = everyone[i : i + at_once]
        still = np.ascontiguousarray(fixed_parts.read(some).transpose(1, 2, 0))
        x, y = _grid(moving_from_fixed, centres[some], moving_parts.start[some], reach)
        seen = (_cubic if cubic else _bilinear)(moving_parts.read(some), x, y)
        a, b = _normalised(still, window), _normalised(seen, window)
        shift[some], correlation[some], sigma[some] = _gauss_newton(a, b, window)
    src = np.where(inside[:, None], project(moving_from_fixed, centres + shift)[0], 0.0)
    return Comparison(
        pairs=Correspondences(
            src=apply(moving.full_from_small, src),
            dst=apply(fixed.full_from_small, centres),
            src_sigma=sigma * moving.full_from_small[0, 0],
            dst_sigma=sigma * fixed.full_from_small[0, 0],
            support_px=float((2 * radius + 1) * fixed.full_from_small[0, 0]),
        ),
        shift=shift,
        correlation=correlation,
        inside=inside,
    )


def _inside(corners: Array, size: tuple[int, int]) -> Mask:
    """(n,) True where all four corners (4, n, 2) of a patch lie in a picture of `size` (w, h)."""
    with np.errstate(invalid="ignore"):
        return np.asarray(((corners >= 0) & (corners <= np.array(size) - 1)).all((0, 2)))


@dataclass(frozen=True, kw_only=True)
class _Parts:
    """The part of a picture around every patch, all of one size."""

    windows: NDArray[np.generic]  # (rows, columns, h, w) view of the part that begins at a pixel
    start: _Index  # (n, 2) pixel (x, y) where a patch's begins

    def read(self, some: _Index) -> _Float:
        """(n, h, w) the parts around some patches."""
        x, y = self.start[some].T
        return np.asarray(self.windows[y, x], np.float32)


def _parts(image: Picture, corners: Array, inside: Mask, margin: int) -> _Parts:
    """What holds the pixels around the `corners` (4, n, 2) of patches, and `margin` more, as far as there are any."""
    size = np.array(size_of(image))
    start, extent = np.zeros((corners.shape[1], 2), np.intp), np.ones(2, np.intp)
    if inside.any():
        low = np.floor(corners[:, inside].min(0)).astype(np.intp) - margin
        high = np.ceil(corners[:, inside].max(0)).astype(np.intp) + margin
        extent = np.minimum((high - low).max(0) + 1, size)
        start[inside] = np.clip(low, 0, size - extent)
    return _Parts(windows=sliding_window_view(image, (extent[1], extent[0])), start=start)


def _grid(moving_from_fixed: Array, centres: Array, start: _Index, reach: int) -> tuple[_Float, _Float]:
    """x and y, each (s, s, n), of a patch's pixels in the part of the moving picture that begins at `start` (n, 2).

    Places are those of the centres and, in float32, the way from there: with (p, w) the image of a centre c,
    H (c + d) = p + J d / (1 + h d / w) for the derivative J at c and the last row (h, 1) of H.
    """
    there, w = project(moving_from_fixed, centres)
    derivative = jacobian(moving_from_fixed, centres).transpose(1, 2, 0).astype(np.float32)
    tilt = (moving_from_fixed[2, :2, None] / w).astype(np.float32)
    begin = (there - start).T.astype(np.float32)
    offset = np.arange(-reach, reach + 1, dtype=np.float32)
    dx, dy = offset[None, :, None], offset[:, None, None]
    nearness = 1.0 / (tilt[0] * dx + (tilt[1] * dy + 1.0))
    x, y = ((row[0] * dx + row[1] * dy) * nearness + c for row, c in zip(derivative, begin, strict=True))
    return x, y


def _bilinear(parts: _Float, x: _Float, y: _Float) -> _Float:
    """(s, s, n) values of parts (n, h, w) at places (s, s, n) in them."""
    n, height, width = parts.shape
    # One part below the other, for one call.
    below = y + np.arange(0, n * height, height, dtype=np.float32)
    seen = cv2.remap(
        parts.reshape(-1, width),
        x.reshape(len(x), -1),
        below.reshape(len(x), -1),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return np.asarray(seen, np.float32).reshape(x.shape)


def _cubic(parts: _Float, x: _Float, y: _Float) -> _Float:
    """The same, cubic, by Everett's formula along x and along y.

    It is linear - t (1 - t) / 2 x (the second difference at (1 + t) / 3). Bilinear interpolation alone moves fine
    structure by up to 0.03 px, all of it the same way where t is the same all over.
    """
    along_x, along_y = np.diff(parts, 2, axis=2), np.diff(parts, 2, axis=1)
    value = _bilinear(parts, x, y)
    weight, at = _everett(x, along_x.shape[2])
    value -= weight * _bilinear(along_x, at, y)
    weight, at = _everett(y, along_y.shape[1])
    value -= weight * _bilinear(along_y, x, at)
    return value


def _everett(places: _Float, count: int) -> tuple[_Float, _Float]:
    """Weights of the second differences, and their places among `count` of them, of which the first is at pixel 1.

    Beyond the first and the last, where the picture ends, those stand for all.
    """
    whole = np.floor(places)
    t = places - whole
    return 0.5 * t * (1.0 - t), np.clip(whole + (t - 2.0) / 3.0, 0.0, count - 1.0)


def _smoothed(patches: _Float) -> _Float:
    """Patches (s, s, n) after a small Gaussian, without their outermost pixels (s - 2, s - 2, n)."""
    outer = np.float32(np.exp(-0.5 / _SMOOTHING**2))
    inner = 1 / (1 + 2 * outer)
    outer *= inner
    rows = outer * (patches[:-2] + patches[2:]) + inner * patches[1:-1]
    return np.asarray(outer * (rows[:, :-2] + rows[:, 2:]) + inner * rows[:, 1:-1])


def _bell(side: int) -> _Float:
    """(s, s) weights of a patch's pixels, of sum 1: a bell around its middle."""
    bell = np.exp(-0.5 * (np.arange(side) - (side - 1) / 2) ** 2 / (side / 2.0) ** 2)
    return np.asarray(np.outer(bell, bell) / bell.sum() ** 2, np.float32)


@dataclass(frozen=True, kw_only=True)
class _Normalised:
    """Patches of mean 0 and variance 1 under a window."""

    values: _Float  # (s, s, n)
    contrast: _Float  # (n,) standard deviations that they had


def _normalised(patches: _Float, window: _Float) -> _Normalised:
    """Patches (s + 2, s + 2, n) smoothed and normalised under a window (s, s)."""
    values = _smoothed(patches)
    values -= np.einsum("ijn,ij->n", values, window)
    contrast = np.sqrt(np.einsum("ijn,ijn,ij->n", values, values, window, optimize=False))
    values /= np.maximum(contrast, 1e-6)
    return _Normalised(values=values, contrast=contrast)


def _gauss_newton(a: _Normalised, b: _Normalised, window: _Float) -> tuple[Array, Array, Array]:
    """Shift (n, 2) of b against a in px, normalised correlation (n,), and the shift's standard deviation (n,).

    The window they were normalised under is 0 on a rim of one pixel, which is spent on the gradients.
    """
    both = 0.25 * (a.values + b.values)
    root = np.sqrt(window[1:-1, 1:-1, None])
    gx = root * (both[1:-1, 2:] - both[1:-1, :-2])
    gy = root * (both[2:, 1:-1] - both[:-2, 1:-1])
    e = root * (a.values - b.values)[1:-1, 1:-1]

    def product(p: _Float, q: _Float) -> Array:
        return np.asarray(np.einsum("ijn,ijn->n", p, q), np.float64)

    xx, xy, yy, ex, ey = product(gx, gx), product(gx, gy), product(gy, gy), product(gx, e), product(gy, e)
    determinant = np.maximum(xx * yy - xy * xy, 1e-12)
    shift = np.stack([yy * ex - xy * ey, xx * ey - xy * ex], 1) / determinant[:, None]
    correlation = 1.0 - 0.5 * product(e, e)
    correlation[np.minimum(a.contrast, b.contrast) < 1e-3] = -1.0  # flat
    # Variance of the mean of about s^2 / 4 independent pixels with the noise that the correlation leaves.
    noise = np.maximum(1.0 - correlation, 1e-4) * 2.0 * 4.0 / len(root) ** 2
    sigma = np.sqrt(noise * (xx + yy) / (2.0 * determinant))
    return shift, correlation, np.clip(sigma, 0.01, 2.0)
