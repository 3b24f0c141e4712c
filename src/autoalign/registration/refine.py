"""Consensus -> sub-pixel transform with its uncertainty, by least-squares matching of patches at full resolution.

Patches around corners of one picture are compared with the other picture seen through the current transform. One
Gauss-Newton step per patch says how far it is off, robust least squares over all patches moves the transform, and the
patches are sampled again, first on halved pictures, then on the full ones, at last from both pictures' point of view.

A part of the patches takes no part in the fit until it has decided whether it helped, and the keypoints must not deny
it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
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
from autoalign.geometry.uncertainty import overlap_points, overlap_share, point_errors, uncertainty
from autoalign.picture.pixels import Picture, Shrunken, halve, size_of, to_8_bit
from autoalign.registration.patches import RIM, Comparison, Manner, compare_as

_COMMON_BIAS = 0.25  # sigmas that all keypoints may be off together: ORB's corners are whole pixels
_DOUBT = 2.0  # times the error that a consensus expects of itself, it may have
_FEW = 300  # patches; where there is no room for so many side by side, they may overlap more
_SCOUTS = 400  # patches that lead the way, at least
_CORNER_PIXELS = 1e6  # corners are looked for in a picture that is halved to at most so many
_LEADING_STEPS = 4  # of the least squares, while a new look corrects them anyway,
_LAST_STEPS = 30  # and when none will
_HELD_OUT = 5  # every fifth patch judges
_LEAST_SIGMAS = 0.02  # of what a patch claims, that residuals may show; under it lies rounding


Look = Callable[[Array, NDArray[np.intp], Manner], Comparison]
"""Patches compared at one resolution: under a transform, those of these numbers, in one of the manners."""


@dataclass(frozen=True, kw_only=True)
class RefineOptions:
    """How the transform is sharpened on the pixels."""

    patches: int = 1000
    """patches compared, at most; 0 leaves the transform of the keypoints as it is"""
    radius: int = 12
    """a patch is 2 x radius + 1 pixels wide"""
    min_correlation: float = 0.6
    """normalised correlation above which a patch takes part"""
    max_shift: float = 2.0
    """px; a patch that wants to move further takes no part"""

    def __post_init__(self) -> None:
        if self.patches < 0 or self.radius < 3 or not 0 < self.min_correlation < 1:
            raise ValueError(f"RefineOptions out of range: {self}")


@dataclass(frozen=True, kw_only=True)
class Patches:
    """What was measured on the pixels, under the transform that came out."""

    pairs: Correspondences  # src moving px, dst fixed px, n
    before: Array  # (n,) normalised correlations under the consensus
    after: Array  # (n,) the same under the result; of those that were fitted, just before their last fit
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
    if skip or options.patches == 0:
        return _unchanged(consensus, matched)
    fixed, moving = in_grey_levels(fixed), in_grey_levels(moving)
    levels = _levels(fixed, moving, consensus, matched)
    places = _places(levels[-1], consensus.dst_from_src, options, masks)
    looks = [_look_at(level, places, options.radius) for level in levels]
    return follow(looks, len(places), consensus, matched, options)


def follow(
    looks: Sequence[Look], count: int, consensus: Consensus, matched: Correspondences, options: RefineOptions
) -> Refinement:
    """Sharpen `consensus.dst_from_src` by `count` patches, which `looks` compare, the coarsest look first.

    Returns the consensus unchanged as `refine` does.
    """
    unchanged, model = _unchanged(consensus, matched), MODELS[consensus.model]
    led = _led(looks, count, consensus, options)
    finest, everyone = looks[-1], np.arange(count)
    judges = everyone % _HELD_OUT == 0
    seen = finest(led, everyone, "both ways")
    kept = _usable(seen, options)
    fitted = _fit(model, led, seen, kept & ~judges, _LAST_STEPS)
    if fitted is None:
        return unchanged
    before, after = finest(consensus.dst_from_src, everyone, "fine").correlation, seen.correlation.copy()
    after[judges] = finest(fitted, everyone[judges], "fine").correlation
    patches = Patches(pairs=seen.pairs, before=before, after=after, kept=kept)
    transform = polish(model, fitted, seen.pairs[kept], sigma_floor=_LEAST_SIGMAS)  # the judges know something too
    if not _helped(before[judges], after[judges]) or _contradicts(model, consensus, transform, matched):
        return replace(unchanged, patches=patches)
    return Refinement(fixed_from_moving=transform, pairs=seen.pairs[kept], patches=patches, sharpened=True)


def _led(looks: Sequence[Look], count: int, consensus: Consensus, options: RefineOptions) -> Array:
    """Where a few hundred patches lead, so that the others need not go the way."""
    transform = consensus.dst_from_src
    scouts = np.flatnonzero(np.arange(count) % _HELD_OUT)[:: max(1, count // _SCOUTS)]
    for look in [looks[0], *looks]:
        seen = look(transform, scouts, "rough")
        moved = _fit(MODELS[consensus.model], transform, seen, _usable(seen, options), _LEADING_STEPS)
        if moved is not None:  # of a small picture halved, too few patches are left
            transform = moved
    return transform


def _unchanged(consensus: Consensus, matched: Correspondences) -> Refinement:
    pairs = matched[consensus.inliers]
    return Refinement(fixed_from_moving=consensus.dst_from_src, pairs=pairs, patches=None, sharpened=False)


def in_grey_levels(image: Picture) -> Picture:
    """Integers as they are; float32, whose unit can be anything, with about the contrast of 8 bits."""
    if image.dtype != np.float32:
        return image
    mean, deviation = float(image.mean(dtype=np.float64)), float(image.std(dtype=np.float64))
    return np.asarray((image - mean) * (50.0 / max(deviation, 1e-30)), np.float32)


@dataclass(frozen=True, kw_only=True)
class _Level:
    """Both pictures brought to about the same resolution."""

    fixed: Shrunken
    moving: Shrunken


def _look_at(level: _Level, places: Array, radius: int) -> Look:
    """How the patches around `places` (n, 2) of the full fixed picture are compared at one level."""

    def look(transform: Array, chosen: NDArray[np.intp], manner: Manner) -> Comparison:
        return compare_as(manner, level.fixed, level.moving, transform, places[chosen], radius)

    return look


def zoom(fixed_from_moving: Array, pairs: Correspondences) -> float:
    """Halvings that bring fixed to the resolution that moving has in the middle of the pairs; of moving if negative."""
    centre = pairs.src.mean(0, keepdims=True)
    return float(np.log2(abs(np.linalg.det(jacobian(fixed_from_moving, centre)[0]))) / 2)


def _levels(fixed: Picture, moving: Picture, consensus: Consensus, matched: Correspondences) -> list[_Level]:
    """From the level at which the consensus is good to about a pixel all over to the finest, by halves."""
    pairs, model, transform = matched[consensus.inliers], MODELS[consensus.model], consensus.dst_from_src
    halvings = zoom(transform, pairs)
    far = point_errors(
        model,
        transform,
        uncertainty(model, transform, pairs),
        overlap_points(transform, size_of(moving), size_of(fixed)),
    )
    doubt_px = max(float(np.median(pairs.dst_sigma)), _DOUBT * float(far.max(initial=0.0))) / max(1.0, 2**halvings)
    coarser = int(np.clip(np.round(np.log2(max(doubt_px, 1.0))), 0, 4))
    fixed_levels = pyramid(fixed, max(0, round(halvings)), coarser)
    moving_levels = pyramid(moving, max(0, round(-halvings)), coarser)
    return [_Level(fixed=f, moving=m) for f, m in zip(fixed_levels, moving_levels, strict=True)]


def pyramid(image: Picture, finest: int, coarser: int) -> list[Shrunken]:
    """The picture halved from `finest` + `coarser` times to `finest` times."""
    levels = [Shrunken(pixels=image, full_from_small=np.eye(3))]
    for _ in range(finest + coarser):
        half = halve(levels[-1].pixels)
        levels.append(Shrunken(pixels=half.pixels, full_from_small=levels[-1].full_from_small @ half.full_from_small))
    return levels[: finest - 1 if finest else None : -1]


def _clear(mask: Mask | None, reach_px: float) -> Mask | None:
    """True where no pixel of a patch that reaches so far is masked."""
    if mask is None:
        return None
    side = 2 * int(np.ceil(reach_px)) + 1
    return np.asarray(cv2.erode(mask.astype(np.uint8), np.ones((side, side), np.uint8)) > 0)


def _places(
    level: _Level, fixed_from_moving: Array, options: RefineOptions, masks: tuple[Mask | None, Mask | None]
) -> Array:
    """(n, 2) what patches are laid around, full px of the fixed picture: corners, the strongest first."""
    reach = options.radius + RIM
    clear_fixed, clear_moving = (
        _clear(mask, reach * of.full_from_small[0, 0])
        for mask, of in zip(masks, (level.fixed, level.moving), strict=True)
    )
    in_fixed = _corners(level.fixed, level.moving, invert(fixed_from_moving), options, (clear_fixed, clear_moving))
    in_moving = _corners(level.moving, level.fixed, fixed_from_moving, options, (clear_moving, clear_fixed))
    # What the picture with fewer corners shows, the other shows too; and they are the same for swapped roles.
    places = in_fixed if len(in_fixed) <= len(in_moving) else project(fixed_from_moving, in_moving)[0]
    return places[: options.patches]


def _corners(
    picture: Shrunken,
    other: Shrunken,
    other_from_picture: Array,
    options: RefineOptions,
    masks: tuple[Mask | None, Mask | None],
) -> Array:
    """(n, 2) corners of one picture that lie in the other too, apart from each other, full px.

    The transform is between the full pictures; `masks`, of this picture and the other, are True where a patch may lie.
    """
    halvings = max(0, int(np.ceil(np.log2(picture.pixels.size / _CORNER_PIXELS) / 2)))
    small = pyramid(picture.pixels, halvings, 0)[0]
    full_from_small = picture.full_from_small @ small.full_from_small
    size = size_of(small.pixels)
    other_from_small = unit(invert(other.full_from_small) @ other_from_picture @ full_from_small)
    share = overlap_share(invert(other_from_small), size_of(other.pixels), size)
    # Patches nearer than their radius see the same noise, and would be counted as if they did not.
    spread, scarce = (0.6 * np.sqrt(share * small.pixels.size / count) for count in (options.patches, _FEW))
    apart = max(4.0, spread, min(options.radius / small.full_from_small[0, 0], scarce))
    usable, usable_there = masks
    mask = None if usable is None else cv2.resize(usable.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    most = round(3 * options.patches / max(share, 0.01))
    found = cv2.goodFeaturesToTrack(to_8_bit(small.pixels), most, 0.003, apart, mask=mask, blockSize=7)
    if found is None:
        return np.zeros((0, 2))
    points = apply(full_from_small, found.reshape(-1, 2))
    there, w_there = project(other_from_picture, points)
    far_end = apply(other.full_from_small, np.array([size_of(other.pixels)]) - 1)
    inside = (w_there > 0) & (there > 0).all(1) & (there < far_end).all(1)
    if usable_there is not None:
        column, row = np.rint(there[inside]).astype(int).T
        inside[inside] = usable_there[row, column]
    return points[inside]


def _usable(seen: Comparison, options: RefineOptions) -> Mask:
    return np.asarray(
        seen.inside
        & (seen.correlation > options.min_correlation)
        & (np.abs(seen.shift).max(1) < options.max_shift)
        & (seen.pairs.dst_sigma < 1.0 * options.max_shift)
    )


def _fit(model: Model, transform: Array, seen: Comparison, used: Mask, steps: int) -> Array | None:
    """Robust least squares on some of the patches; None where they are too few to trust."""
    if used.sum() < 3 * model.degrees_of_freedom:
        return None
    return polish(model, transform, seen.pairs[used], sigma_floor=_LEAST_SIGMAS, max_steps=steps)


def _helped(before: Array, after: Array) -> bool:
    """The held-out patches correlate (n,) no worse on the whole, and more of them better than worse."""
    seen = np.maximum(before, after) > -1.0
    gain = after[seen] - before[seen]
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
