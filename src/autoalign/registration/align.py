"""The page: two pictures in, one Alignment out. Detect, match, consensus, refine, verdict; then harder, if not clear."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from time import perf_counter
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from autoalign.errors import AlignmentError
from autoalign.geometry.family import MODELS, ModelName, fit
from autoalign.geometry.homography import Array, Mask, as_points, shown
from autoalign.geometry.least_squares import Correspondences, correspondences, polish
from autoalign.geometry.ransac import Consensus, RansacOptions, ransac
from autoalign.geometry.selection import simplest_model
from autoalign.picture.pixels import Picture, check_picture, grey, opaque, size_of, to_8_bit
from autoalign.registration.agreement import agreement
from autoalign.registration.features import Features, detect
from autoalign.registration.ladder import Effort, Rung, rungs
from autoalign.registration.matching import Matches, match
from autoalign.registration.refine import Refinement, RefineOptions, refine
from autoalign.registration.verdict import (
    Evidence,
    Sizes,
    Status,
    Verdict,
    VerdictOptions,
    hints,
    judge,
    judge_typed,
    nothing_found,
    significant,
    unfit_points,
    weigh,
)

if TYPE_CHECKING:
    from skimage.transform import ProjectiveTransform

ModelChoice = Literal["auto", "homography", "affine", "similarity", "rigid", "translation"]
DetectorChoice = Literal["auto", "orb", "sift"]


@dataclass(frozen=True, kw_only=True)
class AlignOptions:
    """What kind of transform, how hard to look, and the options of every stage."""

    model: ModelChoice = "auto"
    """kind of transform; auto takes the simplest that explains the pictures"""
    detector: DetectorChoice = "auto"
    """kind of keypoints; auto begins with orb and goes on with sift where the verdict is not clear"""
    effort: Effort = "normal"
    """how hard to look before a pair is given up; max also looks from all sides, which takes seconds"""
    ransac: RansacOptions = field(default_factory=RansacOptions)
    refine: RefineOptions = field(default_factory=RefineOptions)
    verdict: VerdictOptions = field(default_factory=VerdictOptions)


@dataclass(frozen=True, kw_only=True)
class Attempt:
    """What one rung of the ladder found; None where a stage was not reached."""

    rung: str
    verdict: Verdict
    pairs: Correspondences  # the matches as points, src moving px, dst fixed px, best first
    fixed_features: Features | None = None
    moving_features: Features | None = None
    matches: Matches | None = None
    consensus: Consensus | None = None
    refinement: Refinement | None = None
    model: ModelName | None = None
    fixed_from_moving: Array | None = None  # (3, 3) of unit norm: the refinement's, in its simplest model
    evidence: Evidence | None = None
    seconds: dict[str, float] = field(default_factory=dict)  # per stage


@dataclass(frozen=True, kw_only=True)
class Alignment:
    """The whole record of a pair: the verdict, the transform, and the evidence of every stage of every attempt."""

    fixed_size: tuple[int, int]  # (w, h)
    moving_size: tuple[int, int]
    options: AlignOptions
    attempts: tuple[Attempt, ...]  # in the order they were made
    best: Attempt  # the one that the verdict is about

    @property
    def verdict(self) -> Verdict:
        return self.best.verdict

    @property
    def status(self) -> Status:
        return self.best.verdict.status

    @property
    def reason(self) -> str:
        """One sentence with the numbers."""
        return self.best.verdict.reason

    @property
    def expected_error_px(self) -> float | None:
        """Mean error to expect over the overlap, px of the fixed picture; None if rejected or not known."""
        return self.best.verdict.expected_error_px

    @property
    def model(self) -> ModelName | None:
        return self.best.model

    @property
    def fixed_from_moving(self) -> Array:
        """(3, 3) scaled to [2, 2] == 1: takes points (x, y, 1) of moving to fixed. AlignmentError if rejected."""
        if self.status == "rejected" or self.best.fixed_from_moving is None:
            raise AlignmentError(f"rejected: {self.reason}")
        return shown(self.best.fixed_from_moving)

    @property
    def transform(self) -> ProjectiveTransform:
        """`fixed_from_moving` for those who live in scikit-image. AlignmentError if rejected."""
        from skimage.transform import ProjectiveTransform

        return ProjectiveTransform(self.fixed_from_moving)  # type: ignore[no-untyped-call]

    @property
    def matches(self) -> int:
        return len(self.best.pairs)

    @property
    def inliers(self) -> int:
        return self.best.consensus.count if self.best.consensus else 0

    @property
    def overlap(self) -> float:
        """Share of the fixed picture that is covered, 0 to 1."""
        return self.best.evidence.overlap if self.best.evidence else 0.0

    @property
    def seconds(self) -> dict[str, float]:
        """Time of every stage, over all attempts."""
        total: dict[str, float] = {}
        for attempt in self.attempts:
            for stage, spent in attempt.seconds.items():
                total[stage] = total.get(stage, 0.0) + spent
        return total

    def counts(self) -> dict[str, Any]:
        """What every stage of the best attempt found, in numbers."""
        best = self.best
        patches = best.refinement.patches if best.refinement else None
        return {
            "rung": best.rung,
            "attempts": len(self.attempts),
            "fixed_keypoints": len(best.fixed_features) if best.fixed_features else 0,
            "moving_keypoints": len(best.moving_features) if best.moving_features else 0,
            "matches": self.matches,
            "trials": best.consensus.trials if best.consensus else 0,
            "inliers": self.inliers,
            "patches": len(patches.kept) if patches else 0,
            "patches_kept": int(patches.kept.sum()) if patches else 0,
            "sharpened": bool(best.refinement and best.refinement.sharpened),
        }

    def evidence(self) -> dict[str, Any]:
        """The evidence of the verdict as plain numbers; empty where no transform was found."""
        return asdict(self.best.evidence) if self.best.evidence else {}


def align(
    fixed: Picture,
    moving: Picture,
    options: AlignOptions | None = None,
    *,
    fixed_valid: Mask | None = None,
    moving_valid: Mask | None = None,
) -> Alignment:
    """Find the transform that puts `moving` onto `fixed`, and say whether to trust it.

    Pictures are (h, w) or (h, w, 1..4), uint8, uint16 or float32; masks are (h, w), True where a pixel may be used, and
    pixels of zero alpha are not used either. A pair that cannot be aligned is a result, `status == "rejected"`.
    Raises ValueError for arrays that are no pictures. The same input gives the same bits.
    """
    options = options or AlignOptions()
    pair = _prepare(fixed, moving, fixed_valid, moving_valid)
    attempts: list[Attempt] = []
    for rung in rungs(options.effort, options.detector):
        if rung.on_a_hint and not any(hints(attempt.evidence) for attempt in attempts):
            continue
        attempts.append(_attempt(pair, rung, options))
        error = attempts[-1].verdict.expected_error_px
        if attempts[-1].verdict.status == "aligned" and error is not None and error <= rung.enough_px:
            break
    return Alignment(
        fixed_size=size_of(fixed),
        moving_size=size_of(moving),
        options=options,
        attempts=tuple(attempts),
        best=max(attempts, key=_rank),
    )


def align_points(
    fixed_points: ArrayLike,
    moving_points: ArrayLike,
    fixed_size: tuple[int, int],
    moving_size: tuple[int, int],
    options: AlignOptions | None = None,
) -> Alignment:
    """The alignment that typed correspondences (n, 2) give; sizes are (w, h). No pixel is looked at.

    A person's points are trusted: all of them are fitted, and the verdict is about how well they fit. `model="auto"`
    takes the most general model that so many points fix. Rejected where they do not fix it.
    Raises ValueError for points of a wrong shape.
    """
    options = options or AlignOptions()
    fixed_points, moving_points = as_points(fixed_points, "fixed_points"), as_points(moving_points, "moving_points")
    if len(fixed_points) != len(moving_points):
        raise ValueError(f"{len(fixed_points)} points in fixed, but {len(moving_points)} in moving")
    attempt = _typed(fixed_points, moving_points, Sizes(fixed=fixed_size, moving=moving_size), options)
    return Alignment(fixed_size=fixed_size, moving_size=moving_size, options=options, attempts=(attempt,), best=attempt)


def _typed(fixed_points: Array, moving_points: Array, sizes: Sizes, options: AlignOptions) -> Attempt:
    pairs = correspondences(src=moving_points, dst=fixed_points)
    enough = [name for name, model in MODELS.items() if 0 < model.sample_size <= len(pairs)]
    model = options.model if options.model != "auto" else (enough or ["translation"])[-1]
    attempt = Attempt(rung="typed points", verdict=nothing_found(len(pairs)), pairs=pairs)
    try:
        transform = polish(MODELS[model], fit(model, pairs.src, pairs.dst), pairs, sigma_floor=1.0)
    except ValueError as unfit:
        return replace(attempt, verdict=unfit_points(str(unfit)))
    verdict = judge_typed(model, transform, pairs, options.verdict, sizes)
    return replace(attempt, model=model, fixed_from_moving=transform, verdict=verdict)


def _attempt(pair: _Pair, rung: Rung, options: AlignOptions) -> Attempt:
    """One rung: every stage in turn."""
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
        consensus=consensus,
        verdict=nothing_found(len(pairs)),
        seconds=seconds,
    )
    return attempt if consensus is None else _concluded(attempt, consensus, pair, options)


def _concluded(attempt: Attempt, consensus: Consensus, pair: _Pair, options: AlignOptions) -> Attempt:
    """The attempt with its consensus refined and judged."""
    with _timed(attempt.seconds, "refine"):
        sharp = significant(attempt.pairs, consensus, pair.sizes, options.verdict)
        refinement = refine(
            pair.fixed, pair.moving, consensus, attempt.pairs, options.refine, pair.masks, skip=not sharp
        )
        model, transform = consensus.model, refinement.fixed_from_moving
        if options.model == "auto":
            model, transform = simplest_model(model, transform, refinement.pairs)
    with _timed(attempt.seconds, "verdict"):
        agreed = agreement(pair.fixed_8_bit, pair.moving_8_bit, transform, *pair.masks)
        evidence = weigh(model, transform, attempt.pairs, consensus, refinement.pairs, agreed, pair.sizes)
        verdict = judge(evidence, options.verdict, pair.sizes)
    return replace(
        attempt,
        refinement=refinement,
        model=model,
        fixed_from_moving=transform,
        evidence=evidence,
        verdict=verdict,
    )


@dataclass(frozen=True, kw_only=True)
class _Pair:
    """Both pictures in grey, prepared once for all rungs."""

    fixed: Picture  # (h, w), own depth
    moving: Picture
    fixed_8_bit: NDArray[np.uint8]
    moving_8_bit: NDArray[np.uint8]
    masks: tuple[Mask | None, Mask | None]  # fixed, moving; True where usable, None where all is

    @property
    def sizes(self) -> Sizes:
        return Sizes(fixed=size_of(self.fixed), moving=size_of(self.moving))


def _prepare(fixed: Picture, moving: Picture, fixed_valid: Mask | None, moving_valid: Mask | None) -> _Pair:
    check_picture(fixed, "fixed")
    check_picture(moving, "moving")
    masks = _usable(fixed, fixed_valid, "fixed_valid"), _usable(moving, moving_valid, "moving_valid")
    fixed_grey, moving_grey = grey(fixed), grey(moving)
    return _Pair(
        fixed=fixed_grey,
        moving=moving_grey,
        fixed_8_bit=to_8_bit(fixed_grey),
        moving_8_bit=to_8_bit(moving_grey),
        masks=masks,
    )


def _usable(image: Picture, valid: Mask | None, name: str) -> Mask | None:
    """The mask, less what the picture's own alpha hides; None where every pixel may be used."""
    if valid is not None and valid.shape != image.shape[:2]:
        raise ValueError(f"{name} has shape {valid.shape}, its picture {image.shape[:2]}")
    shown_part = opaque(image)
    if valid is None or shown_part is None:
        usable = shown_part if valid is None else valid.astype(bool)
    else:
        usable = valid.astype(bool) & shown_part
    return None if usable is None or usable.all() else usable


def _detect_both(pair: _Pair, rung: Rung) -> tuple[Features, Features]:
    """The features of both pictures, found side by side."""
    with ThreadPoolExecutor(2) as pool:
        fixed, moving = (
            pool.submit(detect, image, rung.features, mask)
            for image, mask in zip((pair.fixed_8_bit, pair.moving_8_bit), pair.masks, strict=True)
        )
        return fixed.result(), moving.result()


def _as_pairs(fixed: Features, moving: Features, matches: Matches) -> Correspondences:
    return Correspondences(
        src=moving.points[matches.moving_index],
        dst=fixed.points[matches.fixed_index],
        src_sigma=moving.sigmas[matches.moving_index],
        dst_sigma=fixed.sigmas[matches.fixed_index],
    )


def _general(choice: ModelChoice) -> ModelName:
    """The model to search with: auto is decided afterwards, among those inside the homography."""
    return "homography" if choice == "auto" else choice


def _rank(attempt: Attempt) -> tuple[int, float]:
    """Better verdicts first; then the smaller expected error, or where there is none the less probable consensus."""
    error = attempt.verdict.expected_error_px
    if error is not None:
        return (2 if attempt.verdict.status == "aligned" else 1), -error
    return 0, -attempt.evidence.log10_false_alarms if attempt.evidence else -np.inf


@contextmanager
def _timed(seconds: dict[str, float], stage: str) -> Iterator[None]:
    start = perf_counter()
    yield
    seconds[stage] = seconds.get(stage, 0.0) + perf_counter() - start
