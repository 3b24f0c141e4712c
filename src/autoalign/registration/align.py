"""The page: two pictures in, one Alignment out. Detect, match, consensus, refine, verdict; harder while not clear."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from time import perf_counter

import numpy as np

from autoalign.geometry.family import ModelName
from autoalign.geometry.homography import Mask
from autoalign.geometry.least_squares import Correspondences
from autoalign.geometry.ransac import ransac
from autoalign.geometry.selection import simplest_model
from autoalign.picture.pixels import Picture
from autoalign.registration.agreement import agreement
from autoalign.registration.alignment import Alignment, AlignOptions, Attempt, ModelChoice
from autoalign.registration.features import Features, threads, with_reversed_contrast
from autoalign.registration.frames import unmirrored
from autoalign.registration.ladder import Rung, rungs
from autoalign.registration.matching import Matches, match
from autoalign.registration.prepared import Pair, Prepared, prepare
from autoalign.registration.refine import refine
from autoalign.registration.verdict import (
    SPOT_SIGMAS,
    chance,
    hints,
    judge,
    nothing_found,
    set_aside,
    weigh,
)


def align(
    fixed: Picture | Prepared,
    moving: Picture | Prepared,
    options: AlignOptions | None = None,
    *,
    fixed_valid: Mask | None = None,
    moving_valid: Mask | None = None,
) -> Alignment:
    """Find the transform that puts `moving` onto `fixed`, and say whether to trust it.

    Pictures are (h, w) or (h, w, 1..4), uint8, uint16 or float32; masks are (h, w), True where a pixel may be used, and
    pixels of zero alpha are not used either. A picture that has many partners is worth a `prepare` of its own.
    A pair that cannot be aligned is a result, `status == "rejected"`. Raises ValueError for arrays that are no
    pictures, and for a mask beside a prepared one. The same input gives the same bits.
    """
    options = options or AlignOptions()
    pair = Pair(fixed=_prepared(fixed, fixed_valid, "fixed"), moving=_prepared(moving, moving_valid, "moving"))
    attempts = _climb(pair, options)
    if options.mirror and not any(attempt.verdict.status == "aligned" for attempt in attempts):
        attempts += [unmirrored(attempt, pair.sizes.moving) for attempt in _climb(pair.mirrored(), options)]
    return Alignment(
        fixed_size=pair.fixed.size,
        moving_size=pair.moving.size,
        options=options,
        attempts=tuple(attempts),
        best=max(attempts, key=_rank),
    )


def _prepared(picture: Picture | Prepared, valid: Mask | None, name: str) -> Prepared:
    if not isinstance(picture, Prepared):
        return prepare(picture, valid, name=name)
    if valid is not None:
        raise ValueError(f"{name}_valid is given beside a picture that is prepared already, with or without a mask")
    return picture


def _climb(pair: Pair, options: AlignOptions) -> list[Attempt]:
    """Attempts, each harder than the one before, until a verdict is clear or the time is up."""
    start, attempts = perf_counter(), list[Attempt]()
    for rung in rungs(options.effort, options.detector):
        if rung.on_a_hint and not hints(min((of.log10_false_alarms for of in attempts), default=np.inf)):
            continue
        attempt = _attempt(pair, rung, options)
        if attempt.log10_false_alarms <= rung.enough_log10:
            attempt = _concluded(attempt, pair, options)
        attempts.append(attempt)
        if _is_clear(attempt, rung):
            break
        if options.time_limit is not None and perf_counter() - start > options.time_limit:
            break
    return _settled(attempts, pair, options)


def _settled(attempts: list[Attempt], pair: Pair, options: AlignOptions) -> list[Attempt]:
    """The attempts, of which the most telling are concluded, one after the other until one is aligned."""
    settled = list(attempts)
    for i in sorted(range(len(attempts)), key=lambda i: attempts[i].log10_false_alarms):
        settled[i] = _concluded(attempts[i], pair, options)
        if settled[i].verdict.status == "aligned":
            break
    return settled


def _is_clear(attempt: Attempt, rung: Rung) -> bool:
    """Whether no harder attempt could tell more: aligned, precise enough, and on more than a thin consensus."""
    error = attempt.verdict.expected_error_px
    return attempt.verdict.status == "aligned" and error is not None and error <= rung.enough_px


def _attempt(pair: Pair, rung: Rung, options: AlignOptions) -> Attempt:
    """One rung, as far as its consensus."""
    seconds: dict[str, float] = {}
    with _timed(seconds, "detect"):
        fixed_features, moving_features = _detect_both(pair, rung)
    with _timed(seconds, "match"):
        matches = match(fixed_features, moving_features, rung.matching)
        pairs = _as_pairs(fixed_features, moving_features, matches)
    with _timed(seconds, "consensus"):
        consensus = ransac(pairs, _general(options.model), options.ransac)
    attempt = Attempt(
        rung=rung.name,
        fixed_features=fixed_features,
        moving_features=moving_features,
        matches=matches,
        pairs=pairs,
        verdict=nothing_found(len(fixed_features), len(moving_features), len(pairs)),
        seconds=seconds,
    )
    if consensus is None:
        return attempt
    known = chance(pairs, consensus, pair.sizes)
    return replace(
        attempt,
        consensus=consensus,
        chance=known,
        model=consensus.model,
        fixed_from_moving=consensus.dst_from_src,
        verdict=set_aside(known),
    )


def _concluded(attempt: Attempt, pair: Pair, options: AlignOptions) -> Attempt:
    """The attempt with its consensus, if there is one, refined and judged."""
    consensus, known, seconds = attempt.consensus, attempt.chance, dict(attempt.seconds)
    if consensus is None or known is None or not attempt.is_set_aside:
        return attempt
    with _timed(seconds, "refine"):
        lucky = known.log10_false_alarms > options.verdict.max_log10_false_alarms
        refinement = refine(
            pair.fixed.grey, pair.moving.grey, consensus, attempt.pairs, options.refine, pair.masks, skip=lucky
        )
        model, transform = consensus.model, refinement.fixed_from_moving
        if options.model == "auto":
            model, transform = simplest_model(model, transform, refinement.pairs)
    with _timed(seconds, "verdict"):
        agreed = agreement(pair.fixed.grey_8_bit, pair.moving.grey_8_bit, transform, *pair.masks)
        evidence = weigh(model, transform, refinement.pairs, known, agreed, pair.sizes)
        verdict = judge(evidence, options.verdict, pair.sizes)
    return replace(
        attempt,
        refinement=refinement,
        model=model,
        fixed_from_moving=transform,
        evidence=evidence,
        verdict=verdict,
        seconds=seconds,
    )


def _detect_both(pair: Pair, rung: Rung) -> tuple[Features, Features]:
    """The features of both pictures, found side by side where there are threads for it."""
    with ThreadPoolExecutor(min(2, threads())) as pool:
        fixed, moving = (pool.submit(picture.features, rung.features) for picture in (pair.fixed, pair.moving))
        found = moving.result()
        return fixed.result(), with_reversed_contrast(found) if rung.either_contrast else found


def _as_pairs(fixed: Features, moving: Features, matches: Matches) -> Correspondences:
    return Correspondences(
        src=moving.points[matches.moving_index],
        dst=fixed.points[matches.fixed_index],
        src_sigma=moving.sigmas[matches.moving_index],
        dst_sigma=fixed.sigmas[matches.fixed_index],
        support_px=SPOT_SIGMAS * float(fixed.sigmas[matches.fixed_index].mean()) if len(matches) else 0.0,
    )


def _general(choice: ModelChoice) -> ModelName:
    """The model to search with: auto is decided afterwards, among those inside the homography."""
    return "homography" if choice == "auto" else choice


def _rank(attempt: Attempt) -> tuple[int, float, int]:
    """Better verdicts first, then the consensus that is less probable by chance, then more matches."""
    order = {"aligned": 2, "doubtful": 1, "rejected": 0}
    return order[attempt.verdict.status], -attempt.log10_false_alarms, len(attempt.pairs)


@contextmanager
def _timed(seconds: dict[str, float], stage: str) -> Iterator[None]:
    start = perf_counter()
    yield
    seconds[stage] = seconds.get(stage, 0.0) + perf_counter() - start
