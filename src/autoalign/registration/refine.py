"""Consensus -> sub-pixel transform with its uncertainty, by least-squares matching of patches at full resolution.

Patches around corners of the fixed picture are compared with the moving picture seen through the current transform.
One Gauss-Newton step per patch says how far it is off, robust least squares over all patches moves the transform, and
the patches are sampled again, first on shrunken pictures, then on the full ones. Each patch is reduced to mean 0 and
contrast 1, which is what makes it work under other light; gradients are the mean of both pictures', which makes the
step of second order and the same for swapped roles (so that a forward-backward check would say nothing).

A part of the patches takes no part in the fit and decides whether it helped, and the keypoints must not deny it.

Sources: Gruen 1985 (least-squares matching); Lucas and Kanade 1981; Benhimane and Malis 2004 (efficient second-order).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from autoalign.geometry.family import MODELS, Model
from autoalign.geometry.homography import (
    Array,
    Mask,
    apply,
    invert,
    jacobian,
    project,
    symmetric_transfer_error_squared,
    unit,
)
from autoalign.geometry.least_squares import Correspondences, polish
from autoalign.geometry.ransac import Consensus
from autoalign.picture.pixels import Picture, shrink, shrink_by, size_of, to_8_bit

_COMMON_BIAS = 0.25  # sigmas that all keypoints may be off together: ORB's corners are whole pixels
_SCOUTS = 400  # patches that lead the way, at least
_HELD_OUT = 5  # every fifth patch judges
_SMOOTHING = 0.6  # px; takes away what bilinear sampling would distort (measured: 0.4 to 0.7 are alike, 1.0 is worse)
_Float = NDArray[np.float32]


@dataclass(frozen=True, kw_only=True)
class RefineOptions:
    """How the transform is sharpened on the pixels."""

    patches: int = 1500
    """patches compared, at most; 0 leaves the transform of the keypoints as it is"""
    radius: int = 12
    """a patch is 2 x radius + 1 pixels wide"""
    rounds: int = 1
    """times that all patches are compared at full size, after a few of them have led the way"""
    min_correlation: float = 0.6
    """normalised correlation above which a patch takes part"""
    max_shift: float = 2.0
    """px; a patch that wants to move further takes no part"""

    def __post_init__(self) -> None:
        if self.patches < 0 or self.radius < 3 or self.rounds < 1 or not 0 < self.min_correlation < 1:
            raise ValueError(f"RefineOptions out of range: {self}")


@dataclass(frozen=True, kw_only=True)
class Patches:
    """What was measured on the pixels, under the transform that came out."""

    pairs: Correspondences  # src moving px, dst fixed px, n
    before: Array  # (n,) normalised correlation under the consensus
    after: Array  # (n,) the same under the result
    kept: Mask  # (n,) took part in the fit


@dataclass(frozen=True, kw_only=True)
class Refinement:
    """The transform that explains the pixels best, and the evidence it rests on."""

    fixed_from_moving: Array  # (3, 3) of unit norm
    pairs: Correspondences  # the inliers its uncertainty is computed from: patches if sharpened, else keypoints
    patches: Patches | None  # None where too few could be compared
    sharpened: bool  # False: the transform is the consensus's, because the patches did not prove better


def refine(
    fixed: Picture,
    moving: Picture,
    consensus: Consensus,
    matched: Correspondences,
    options: RefineOptions,
    masks: tuple[Mask | None, Mask | None] = (None, None),
    skip: bool = False,
) -> Refinement:
    """Sharpen `consensus.dst_from_src` (fixed from moving) on the grey pictures (h, w) at their full size.

    `masks` (fixed, moving) are True where pixels may be used. Returns the consensus unchanged where patches are few or
    do not prove better, and where `skip` says that it is not worth the time.
    """
    unchanged = Refinement(
        fixed_from_moving=consensus.dst_from_src, pairs=matched[consensus.inliers], patches=None, sharpened=False
    )
    if skip or options.patches == 0:
        return unchanged
    model = MODELS[consensus.model]
    transform = consensus.dst_from_src
    fixed, moving = _in_grey_levels(fixed), _in_grey_levels(moving)
    levels = _levels(fixed, moving, transform, consensus, matched)
    level_px = levels[-1].fixed_from_level[0, 0], levels[-1].moving_from_level[0, 0]
    clear = [_clear(mask, (options.radius + 2) * px) for mask, px in zip(masks, level_px, strict=True)]
    corners = _corners(fixed, transform, size_of(moving), options, (clear[0], clear[1]))
    judges = np.arange(len(corners)) % _HELD_OUT == 0
    # A few hundred patches lead the way; all of them, and the dearer interpolation, are for the last step.
    scouts = np.flatnonzero(~judges)[:: max(1, len(corners) // _SCOUTS)]
    finest = replace(levels[-1], moving_bends=_bends(levels[-1].moving))
    everyone = np.arange(len(corners))
    rounds = [(level, scouts) for level in levels for _ in range(2)] + [(finest, everyone)] * options.rounds
    for level, chosen in rounds:
        seen = _look(level, transform, corners[chosen], options)
        moved = _fit(model, transform, seen, judges[chosen], options)
        if moved is None:
            return unchanged
        transform = moved
    first = _look(finest, consensus.dst_from_src, corners, options)
    last = _look(finest, transform, corners, options)
    patches = Patches(pairs=last.pairs, before=first.correlation, after=last.correlation, kept=_usable(last, options))
    helped = _helped(first, last, judges & (first.inside | last.inside))
    if not helped or _contradicts(model, consensus, transform, matched):
        return Refinement(
            fixed_from_moving=consensus.dst_from_src, pairs=unchanged.pairs, patches=patches, sharpened=False
        )
    return Refinement(fixed_from_moving=transform, pairs=last.pairs[patches.kept], patches=patches, sharpened=True)


def _in_grey_levels(image: Picture) -> Picture:
    """Integers as they are; float32, whose unit can be anything, with about the contrast of 8 bits."""
    if image.dtype != np.float32:
        return image
    mean, deviation = float(image.mean(dtype=np.float64)), float(image.std(dtype=np.float64))
    return np.asarray((image - mean) * (50.0 / max(deviation, 1e-30)), np.float32)


@dataclass(frozen=True, kw_only=True)
class _Level:
    """Both pictures brought to about the same resolution, and the maps to their full sizes."""

    fixed: Picture
    moving: _Float  # sampled between its pixels, hence float
    moving_bends: tuple[_Float, _Float] | None = None  # its second differences along x and y; None: bilinear will do
    fixed_from_level: Array
    moving_from_level: Array


def _levels(
    fixed: Picture, moving: Picture, transform: Array, consensus: Consensus, matched: Correspondences
) -> list[_Level]:
    """From the level at which the consensus is good to about a pixel to the finest, by halves."""
    centre = matched.src[consensus.inliers].mean(0, keepdims=True)
    zoom = float(np.sqrt(abs(np.linalg.det(jacobian(transform, centre)[0]))))  # fixed px per moving px
    fixed_shrink, moving_shrink = max(1.0, zoom), max(1.0, 1.0 / zoom)
    doubt_px = float(np.median(matched.dst_sigma[consensus.inliers])) / fixed_shrink
    halvings = int(np.clip(np.round(np.log2(max(doubt_px, 1.0))), 0, 4))
    return [_level(fixed, moving, fixed_shrink * 2**h, moving_shrink * 2**h) for h in range(halvings, -1, -1)]


def _level(fixed: Picture, moving: Picture, fixed_shrink: float, moving_shrink: float) -> _Level:
    small_fixed, small_moving = shrink_by(fixed, fixed_shrink), shrink_by(moving, moving_shrink)
    return _Level(
        fixed=small_fixed.pixels,
        moving=small_moving.pixels.astype(np.float32),
        fixed_from_level=small_fixed.full_from_small,
        moving_from_level=small_moving.full_from_small,
    )


def _bends(image: _Float) -> tuple[_Float, _Float]:
    """Second differences along x and along y."""
    second = np.array([[1.0, -2.0, 1.0]], np.float32)
    along_x, along_y = (cv2.filter2D(image, -1, kernel) for kernel in (second, np.ascontiguousarray(second.T)))
    return np.asarray(along_x), np.asarray(along_y)


def _clear(mask: Mask | None, reach_px: float) -> Mask | None:
    """True where no pixel of a patch that reaches so far is masked."""
    if mask is None:
        return None
    side = 2 * int(np.ceil(reach_px)) + 1
    return np.asarray(cv2.erode(mask.astype(np.uint8), np.ones((side, side), np.uint8)) > 0)


def _corners(
    fixed: Picture,
    transform: Array,
    moving_size: tuple[int, int],
    options: RefineOptions,
    masks: tuple[Mask | None, Mask | None],
) -> Array:
    """(n, 2) corners of the fixed picture, spread, whose patches lie in both pictures."""
    small = shrink(to_8_bit(fixed), 1e6)
    w, h = size_of(small.pixels)
    apart = max(4.0, np.sqrt(w * h / options.patches) * 0.6)
    usable, moving_usable = masks
    mask = None if usable is None else cv2.resize(usable.astype(np.uint8), (w, h), interpolation=cv2.INTER_NEAREST)
    found = cv2.goodFeaturesToTrack(small.pixels, 3 * options.patches, 0.003, apart, mask=mask, blockSize=7)
    if found is None:
        return np.zeros((0, 2))
    points = apply(small.full_from_small, found.reshape(-1, 2))
    there, w_there = project(invert(transform), points)
    inside = (w_there > 0) & (there > 0).all(1) & (there < np.array(moving_size) - 1).all(1)
    if moving_usable is not None:
        column, row = np.rint(there[inside]).astype(int).T
        inside[inside] = moving_usable[row, column]
    return points[inside][: options.patches]


@dataclass(frozen=True, kw_only=True)
class _Look:
    """All patches compared under one transform."""

    pairs: Correspondences  # (n) src: where the patch is in moving, dst: where it is in fixed, full px
    shift: Array  # (n, 2) how far it wants to move, level px
    correlation: Array  # (n,) -1 where it lies outside
    inside: Mask  # (n,)


def _look(level: _Level, transform: Array, corners: Array, options: RefineOptions) -> _Look:
    """Sample, normalise and compare all patches; one Gauss-Newton step each."""
    reach = options.radius + 2  # one more for the gradients, one for the smoothing
    moving_from_fixed = unit(invert(level.moving_from_level) @ invert(transform) @ level.fixed_from_level)
    centres = np.rint(apply(invert(level.fixed_from_level), corners))
    inside = _patch_inside(centres, reach, size_of(level.fixed), np.eye(3), size_of(level.fixed))
    inside &= _patch_inside(centres, reach, size_of(level.fixed), moving_from_fixed, size_of(level.moving))
    shift, correlation, sigma = np.zeros((len(corners), 2)), np.full(len(corners), -1.0), np.ones(len(corners))
    if inside.any():
        a = _fixed_patches(level.fixed, centres[inside], reach)
        b = _moving_patches(level, moving_from_fixed, centres[inside], reach)
        shift[inside], correlation[inside], sigma[inside] = _gauss_newton(a, b)
    src = np.where(inside[:, None], project(moving_from_fixed, centres + shift)[0], 0.0)
    fixed_px, moving_px = level.fixed_from_level[0, 0], level.moving_from_level[0, 0]
    return _Look(
        pairs=Correspondences(
            src=apply(level.moving_from_level, src),
            dst=apply(level.fixed_from_level, centres),
            src_sigma=sigma * moving_px,
            dst_sigma=sigma * fixed_px,
        ),
        shift=shift,
        correlation=correlation,
        inside=inside,
    )


def _patch_inside(centres: Array, reach: int, own: tuple[int, int], transform: Array, other: tuple[int, int]) -> Mask:
    """(n,) True where the four corners of a patch, seen through `transform`, lie in a picture of size `other`."""
    ok = np.ones(len(centres), bool)
    for dx, dy in ((-reach, -reach), (reach, -reach), (reach, reach), (-reach, reach)):
        there, w = project(transform, centres + np.array([dx, dy], np.float64))
        with np.errstate(invalid="ignore"):
            ok &= (w > 0) & (there >= 0).all(1) & (there <= np.array(other) - 1).all(1)
    return ok


def _fixed_patches(image: Picture, centres: Array, reach: int) -> _Float:
    """(n, s, s) patches at whole pixels."""
    windows = np.lib.stride_tricks.sliding_window_view(image, (2 * reach + 1, 2 * reach + 1))
    column, row = centres.astype(np.int64).T - reach
    return np.asarray(windows[row, column], np.float32)


def _moving_patches(level: _Level, moving_from_fixed: Array, centres: Array, reach: int) -> _Float:
    """(n, s, s) patches of the moving picture on the pixel grid of the fixed one; cubic if the level has bends.

    Everett's formula along x and along y: linear - t (1 - t) / 2 x (the second difference at (1 + t) / 3). Bilinear
    interpolation alone moves fine structure by up to 0.03 px, all of it the same way where t is the same all over.
    """
    offset = np.arange(-reach, reach + 1, dtype=np.float64)
    x = centres[:, 0, None, None] + offset[None, None, :]
    y = centres[:, 1, None, None] + offset[None, :, None]
    t = moving_from_fixed
    w = t[2, 0] * x + t[2, 1] * y + t[2, 2]
    x, y = (t[0, 0] * x + t[0, 1] * y + t[0, 2]) / w, (t[1, 0] * x + t[1, 1] * y + t[1, 2]) / w
    linear = _bilinear(level.moving, x, y)
    if level.moving_bends is None:
        return linear
    whole_x, whole_y = np.floor(x), np.floor(y)
    t_x, t_y = x - whole_x, y - whole_y
    bend_x = _bilinear(level.moving_bends[0], whole_x + (1.0 + t_x) / 3.0, y) * (0.5 * t_x * (1.0 - t_x))
    bend_y = _bilinear(level.moving_bends[1], x, whole_y + (1.0 + t_y) / 3.0) * (0.5 * t_y * (1.0 - t_y))
    return np.asarray(linear - (bend_x + bend_y), np.float32)


def _bilinear(image: _Float, x: Array, y: Array) -> _Float:
    """The picture at positions (n, s, s)."""
    n, side = x.shape[:2]
    # Sheets of 8000 rows: cv2.remap refuses sides over 32,767 px.
    per_sheet = max(1, 8000 // side)
    sheets = [
        cv2.remap(
            image,
            x[i : i + per_sheet].reshape(-1, side).astype(np.float32),
            y[i : i + per_sheet].reshape(-1, side).astype(np.float32),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        for i in range(0, n, per_sheet)
    ]
    return np.asarray(np.concatenate(sheets).reshape(n, side, side))


def _smoothed(patches: _Float) -> _Float:
    """Patches (n, s, s) after a small Gaussian, without their outermost pixels (n, s - 2, s - 2)."""
    outer = float(np.exp(-0.5 / _SMOOTHING**2))
    kernel = np.array([outer, 1.0, outer], np.float32) / np.float32(1 + 2 * outer)
    rows = kernel[0] * (patches[:, :-2] + patches[:, 2:]) + kernel[1] * patches[:, 1:-1]
    return np.asarray(kernel[0] * (rows[:, :, :-2] + rows[:, :, 2:]) + kernel[1] * rows[:, :, 1:-1])


def _normalise(patches: _Float, window: _Float) -> tuple[_Float, _Float]:
    """Patches (n, s, s) with weighted mean 0 and weighted variance 1, and their standard deviations (n,)."""
    mean = np.einsum("nij,ij->n", patches, window)
    centred = patches - mean[:, None, None]
    deviation = np.sqrt(np.einsum("nij,nij,ij->n", centred, centred, window, optimize=False))
    return centred / np.maximum(deviation, 1e-6)[:, None, None], deviation


def _gauss_newton(a: _Float, b: _Float) -> tuple[Array, Array, Array]:
    """Shift (n, 2) of b against a in px, normalised correlation (n,), and the shift's standard deviation (n,).

    a, b are patches (n, s, s) with a rim of two pixels, one spent on the smoothing and one on the gradients.
    """
    a, b = _smoothed(a), _smoothed(b)
    side = a.shape[1] - 2
    bell = np.exp(-0.5 * (np.arange(side) - (side - 1) / 2) ** 2 / (side / 3.5) ** 2)
    window = (np.outer(bell, bell) / bell.sum() ** 2).astype(np.float32)
    rimmed = np.zeros((side + 2, side + 2), np.float32)
    rimmed[1:-1, 1:-1] = window
    (a, a_contrast), (b, b_contrast) = _normalise(a, rimmed), _normalise(b, rimmed)
    both = 0.25 * (a + b)
    gx = both[:, 1:-1, 2:] - both[:, 1:-1, :-2]
    gy = both[:, 2:, 1:-1] - both[:, :-2, 1:-1]
    inner_a, inner_b = a[:, 1:-1, 1:-1], b[:, 1:-1, 1:-1]
    difference = inner_a - inner_b
    wx, wy = gx * window, gy * window
    xx, xy, yy = (np.einsum("nij,nij->n", p, q).astype(np.float64) for p, q in ((wx, gx), (wx, gy), (wy, gy)))
    ex, ey = (np.einsum("nij,nij->n", p, difference).astype(np.float64) for p in (wx, wy))
    determinant = np.maximum(xx * yy - xy * xy, 1e-12)
    shift = np.stack([yy * ex - xy * ey, xx * ey - xy * ex], 1) / determinant[:, None]
    correlation = np.einsum("nij,nij,ij->n", inner_a, inner_b, window).astype(np.float64)
    flat = (a_contrast < 1e-3) | (b_contrast < 1e-3)
    correlation[flat] = -1.0
    # Variance of the mean of about s^2 / 4 independent pixels with the noise that the correlation leaves.
    noise = np.maximum(1.0 - correlation, 1e-4) * 2.0 * 4.0 / side**2
    sigma = np.sqrt(noise * (xx + yy) / (2.0 * determinant))
    return shift, correlation, np.clip(sigma, 0.01, 2.0)


def _usable(seen: _Look, options: RefineOptions) -> Mask:
    return np.asarray(
        seen.inside
        & (seen.correlation > options.min_correlation)
        & (np.abs(seen.shift).max(1) < options.max_shift)
        & (seen.pairs.dst_sigma < 1.0 * options.max_shift)
    )


def _fit(model: Model, transform: Array, seen: _Look, judges: Mask, options: RefineOptions) -> Array | None:
    """Robust least squares on the patches that do not judge; None where they are too few to trust."""
    used = _usable(seen, options) & ~judges
    if used.sum() < 3 * model.degrees_of_freedom:
        return None
    return polish(model, transform, seen.pairs[used], sigma_floor=0.02)


def _helped(first: _Look, last: _Look, judges: Mask) -> bool:
    """The held-out patches correlate no worse on the whole, and more of them better than worse."""
    gain = last.correlation[judges] - first.correlation[judges]
    return bool(len(gain) >= 3 and np.median(gain) >= 0 and (gain > 0).sum() >= (gain < 0).sum())


def _contradicts(model: Model, consensus: Consensus, transform: Array, matched: Correspondences) -> bool:
    """True where the keypoints deny the transform: their squared error rises by more than the noise of their own fit,
    and by more than what they may all be off together.

    If `transform` were the truth, the error at it would exceed that at the keypoints' own least squares by a chi-square
    of as many degrees as the model has. A scene that is no plane breaks this: its patches vote for one plane of it.
    """
    pairs = matched[consensus.inliers]

    def cost(of: Array) -> float:
        error = symmetric_transfer_error_squared(of, pairs.src, pairs.dst, pairs.src_sigma, pairs.dst_sigma)
        return float(np.minimum(error, consensus.errors[consensus.inliers].max() ** 2).sum())

    freedom = model.degrees_of_freedom
    before, after = cost(consensus.dst_from_src), cost(transform)
    rise = (after / max(before, 1e-12) - 1.0) * max(2 * len(pairs) - freedom, 1)
    return bool(rise > freedom + 6.0 * np.sqrt(2.0 * freedom) and after - before > len(pairs) * _COMMON_BIAS**2)
