"""Two pictures too large for memory -> Alignment: as working copies first, then on patches of the full ones."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from time import perf_counter

import cv2
import numpy as np
from numpy.typing import NDArray

from autoalign.geometry.homography import Array, invert, project, translation
from autoalign.geometry.least_squares import Correspondences
from autoalign.picture.pixels import PixelSource, Shrunken, grey, opaque, size_of, to_8_bit
from autoalign.registration.align import align
from autoalign.registration.alignment import Alignment, AlignOptions, Attempt
from autoalign.registration.frames import in_pixels_of
from autoalign.registration.patches import RIM, Comparison, Manner, compare_as, joined
from autoalign.registration.prepared import Prepared
from autoalign.registration.refine import Look, follow, in_grey_levels, pyramid, zoom
from autoalign.registration.verdict import Sizes, judge, weigh

WORKING_PIXELS = 16e6  # of each working copy
PATCHES = 400  # read from the full pictures, at most
_PLACED_ON = 1e6  # pixels of the copy on which patches were placed
_SLACK = 4  # px around a patch for what the transform is still off


@dataclass(frozen=True, kw_only=True)
class Large:
    """A picture that is read box by box, and a copy of it that fits into memory, ready to be aligned."""

    pixels: PixelSource
    copy: Prepared
    full_from_copy: Array  # (3, 3)


def align_large(fixed: Large, moving: Large, options: AlignOptions | None = None) -> Alignment:
    """As `align`, for pictures of which only patches are read at their full size.

    The alignment is told in pixels of the full pictures, and its expected error is that of patches compared there.
    Where these did not prove better, it is that of the copies, as many times larger as they are smaller. What reading
    raises goes through.
    """
    options = options or AlignOptions()
    small = align(fixed.copy, moving.copy, options)
    sizes = Sizes(fixed=size_of(fixed.pixels), moving=size_of(moving.pixels))
    told = {id(of): in_pixels_of(of, fixed.full_from_copy, moving.full_from_copy) for of in small.attempts}
    if small.status != "rejected":
        started = perf_counter()
        best = _sharpened(told[id(small.best)], fixed.pixels, moving.pixels, options)
        told[id(small.best)] = replace(best, seconds=best.seconds | {"full size": perf_counter() - started})
    judged = {key: _judged(attempt, options, sizes) for key, attempt in told.items()}
    return Alignment(
        fixed_size=sizes.fixed,
        moving_size=sizes.moving,
        options=options,
        attempts=tuple(judged.values()),
        best=judged[id(small.best)],
    )


def _judged(attempt: Attempt, options: AlignOptions, sizes: Sizes) -> Attempt:
    """The attempt with the evidence and the verdict that its numbers give in full pixels."""
    refined, before = attempt.refinement, attempt.evidence
    if refined is None or before is None or attempt.model is None or attempt.fixed_from_moving is None:
        return attempt
    evidence = weigh(attempt.model, attempt.fixed_from_moving, refined.pairs, before, before.agreement, sizes)
    return replace(attempt, evidence=evidence, verdict=judge(evidence, options.verdict, sizes))


def _sharpened(attempt: Attempt, fixed: PixelSource, moving: PixelSource, options: AlignOptions) -> Attempt:
    """The attempt with its transform settled on patches of the full pictures, if these prove better."""
    found, refined, model, transform = (
        attempt.consensus,
        attempt.refinement,
        attempt.model,
        attempt.fixed_from_moving,
    )
    if found is None or refined is None or refined.patches is None or model is None or transform is None:
        return attempt
    places = refined.patches.pairs.dst[refined.patches.kept][:PATCHES]
    steps = _steps(fixed, refined.pairs, transform)
    samples = list(_samples(fixed, moving, transform, places, steps, options.refine.radius))
    if not samples:
        return attempt
    looks = [_look_at(samples, level, options.refine.radius) for level in range(steps.coarser + 1)]
    start = replace(found, model=model, dst_from_src=transform)
    refinement = follow(looks, len(samples), start, attempt.pairs, options.refine)
    if not refinement.sharpened:
        return attempt
    return replace(attempt, refinement=refinement, fixed_from_moving=refinement.fixed_from_moving)


@dataclass(frozen=True, kw_only=True)
class _Steps:
    """How often each picture is halved until both have about the same resolution, and how much further at first."""

    fixed: int
    moving: int
    coarser: int


def _steps(fixed: PixelSource, pairs: Correspondences, transform: Array) -> _Steps:
    halvings = round(zoom(transform, pairs))
    shrunken = float(np.log2(np.prod(size_of(fixed)) / WORKING_PIXELS)) / 2
    # Copies are aligned to a tenth of their pixels or better: what is left of a px at a quarter of it may be.
    return _Steps(fixed=max(0, halvings), moving=max(0, -halvings), coarser=int(np.clip(shrunken - 2, 0, 3)) + 1)


@dataclass(frozen=True, kw_only=True)
class _Sample:
    """A patch of the fixed picture and what lies there of the moving one, from coarse to fine."""

    place: Array  # (1, 2) full px
    fixed: list[Shrunken]
    moving: list[Shrunken]


def _samples(
    fixed: PixelSource, moving: PixelSource, transform: Array, places: Array, steps: _Steps, radius: int
) -> Iterator[_Sample]:
    """What is to be compared around corners near `places` (n, 2), read from the top to the bottom."""
    reach = (radius + RIM + 1) * 2.0 ** (steps.fixed + steps.coarser)
    search = np.ceil((np.prod(size_of(fixed)) / _PLACED_ON) ** 0.5 / 2)
    around = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    for place in places[np.argsort(places[:, 1], kind="stable")]:
        still = _window(fixed, place + around * (search + reach))
        corner = None if still is None else _best_corner(still, place, search)
        if still is None or corner is None:
            continue
        there, w = project(invert(transform), corner + around * reach)
        slack = _SLACK * 2.0 ** (steps.moving + steps.coarser)
        moved = _window(moving, there + around * slack) if (w > 0).all() else None
        if moved is not None:
            yield _Sample(
                place=corner,
                fixed=_levels(still, steps.fixed, steps.coarser),
                moving=_levels(moved, steps.moving, steps.coarser),
            )


def _window(source: PixelSource, corners: Array) -> Shrunken | None:
    """Grey pixels of the box around points (n, 2), as far as it lies in the picture; None where some hold nothing."""
    limit = np.array(size_of(source))
    (x0, y0), (x1, y1) = (
        np.clip(edge, 0, limit).astype(int).tolist() for edge in (np.floor(corners.min(0)), np.ceil(corners.max(0)) + 1)
    )
    if x1 - x0 < 2 or y1 - y0 < 2:
        return None
    pixels = source[slice(y0, y1), slice(x0, x1)]
    seen = opaque(pixels)
    if (seen is not None and not seen.all()) or not np.isfinite(pixels).all():
        return None
    return Shrunken(pixels=in_grey_levels(grey(pixels)), full_from_small=translation(x0, y0))


def _best_corner(window: Shrunken, place: Array, search: float) -> Array | None:
    """(1, 2) where the fixed picture has most structure, at most `search` px from `place` along x and y, full px."""
    x0, y0 = window.full_from_small[:2, 2]
    allowed = np.zeros(window.pixels.shape, np.uint8)
    left, top = np.maximum(place - (x0, y0) - search, 0).astype(int).tolist()
    allowed[top : top + int(2 * search) + 1, left : left + int(2 * search) + 1] = 1
    found = cv2.goodFeaturesToTrack(to_8_bit(window.pixels), 1, 0.01, 1, mask=allowed, blockSize=7)
    return None if found is None else np.asarray(found.reshape(1, 2) + np.array([x0, y0]), np.float64)


def _levels(window: Shrunken, finest: int, coarser: int) -> list[Shrunken]:
    levels = pyramid(window.pixels, finest, coarser)
    return [replace(level, full_from_small=window.full_from_small @ level.full_from_small) for level in levels]


def _look_at(samples: Sequence[_Sample], level: int, radius: int) -> Look:
    """How the samples are compared at one level, from the coarsest."""

    def look(transform: Array, chosen: NDArray[np.intp], manner: Manner) -> Comparison:
        some = [samples[i] for i in chosen.tolist()]
        return joined(
            [compare_as(manner, of.fixed[level], of.moving[level], transform, of.place, radius) for of in some]
        )

    return look
