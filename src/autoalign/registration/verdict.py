"""Evidence -> aligned | doubtful | rejected, the reason in words and numbers, the error to expect in pixels.

A consensus proves that two pictures share something; a caption is something. So three questions are asked in turn:
could random matches agree as well (a-contrario), could a camera have made this transform (geometry), and do the pixels
under the overlay agree all over it, not only where the matches are. Last, the expected error says what it is good for.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from autoalign.geometry.chance import disc_chance, first_in_each_cell, log10_false_alarms
from autoalign.geometry.family import MODELS, Model, ModelName
from autoalign.geometry.homography import Array, invert, jacobian, project
from autoalign.geometry.least_squares import Correspondences, polish
from autoalign.geometry.ransac import Consensus
from autoalign.geometry.uncertainty import overlap_points, overlap_share, point_errors, uncertainty
from autoalign.registration.agreement import Agreement

Status = Literal["aligned", "doubtful", "rejected"]

SPOT_SIGMAS = 5.0  # matches nearer than this are one observation


# What the defaults below rest on (scripts/calibrate.py, 77 true pairs, 100 made-up captions, 8 traps, 2,000 unrelated):
#                                   true pairs, aligned or doubtful   false pairs
#   log10 of false alarms           -62 and below                     -2.0 and above; captions are like true ones
#   share of the overlap agreeing   0.26 and above, aligned 0.52      0.16 and below
# Thresholds found without a scene decide that scene rightly, for every scene.
@dataclass(frozen=True, kw_only=True)
class VerdictOptions:
    """What is asked of the evidence before it counts."""

    max_log10_false_alarms: float = -4.0
    """log10 of how often random matches agree as well; above, the pair is rejected"""
    sure_log10_false_alarms: float = -12.0
    """above this, the pixels must make up for the few matches, or the pair is doubtful"""
    min_agreement: float = 0.25
    """share of the overlap that must agree, or the pair is rejected; 0.05 does by chance"""
    sure_agreement: float = 0.4
    """share of the overlap below which the pair is doubtful"""
    max_expected_error_px: float = 3.0
    """px of expected error above which the pair is doubtful, if it is above the share too"""
    max_expected_error_share: float = 0.005
    """the same as a share of the diagonal of the fixed picture"""
    max_stretch: float = 20.0
    """largest change of scale, either way, that is believed"""
    max_anisotropy: float = 12.0
    """largest ratio of the two scales at one point that is believed"""
    min_overlap: float = 0.01
    """share of the fixed picture that must be covered"""

    def __post_init__(self) -> None:
        if self.max_expected_error_px <= 0 or self.max_stretch <= 1 or not 0 <= self.min_agreement <= 1:
            raise ValueError(f"VerdictOptions out of range: {self}")


@dataclass(frozen=True, kw_only=True)
class Chance:
    """Whether random matches could agree as well."""

    matches: int
    independent_matches: int  # at most one to a spot of either picture
    independent_inliers: int
    log10_false_alarms: float  # of the independent inliers


@dataclass(frozen=True, kw_only=True)
class Evidence(Chance):
    """All that the verdict rests on, in numbers."""

    overlap: float  # share of the fixed picture that is covered
    agreement: Agreement
    stretch: tuple[float, float]  # least and greatest scale over the overlap, fixed px per moving px
    anisotropy: float  # greatest ratio of the two scales at one point; inf if the overlay folds or mirrors
    halves_px: float  # mean distance over the overlap of the transforms of two disjoint halves of the evidence
    fit_px: float  # what the covariance of the fit leaves, mean over the overlap
    residual_px: float  # standard deviation of one coordinate of what is left of the pairs that were fitted
    model_px: float  # what the residuals show that the model cannot follow


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """What to make of a pair."""

    status: Status
    reason: str  # one sentence with the numbers
    advice: str  # what would help; empty for an aligned pair
    expected_error_px: float | None  # mean over the overlap, px of the fixed picture; None if rejected or not known


@dataclass(frozen=True, kw_only=True)
class Sizes:
    """(w, h) of both pictures."""

    fixed: tuple[int, int]
    moving: tuple[int, int]


def chance(pairs: Correspondences, consensus: Consensus, sizes: Sizes) -> Chance:
    """How telling a consensus is; `pairs` are all matches, src moving, dst fixed, the subject of `consensus`."""
    alone = _independent(pairs)
    independent = pairs[alone]
    chances = _chances(consensus.dst_from_src, independent, sizes.moving, sizes.fixed)
    return Chance(
        matches=len(pairs),
        independent_matches=len(independent),
        independent_inliers=int(consensus.inliers[alone].sum()),
        log10_false_alarms=log10_false_alarms(chances, MODELS[consensus.model].sample_size)[0],
    )


def weigh(
    model: ModelName, transform: Array, fitted: Correspondences, known: Chance, agreed: Agreement, sizes: Sizes
) -> Evidence:
    """Collect the evidence for a transform of the model `model`, fixed from moving.

    `fitted` are the matches or patches that the transform was fitted to in the end, src moving, dst fixed; `known` is
    what tells the consensus from chance, `agreed` what the pixels say.
    """
    overlap = overlap_points(transform, sizes.moving, sizes.fixed)
    spread = uncertainty(MODELS[model], transform, fitted)
    stretch, anisotropy = _shape(transform, overlap)
    return Evidence(
        matches=known.matches,
        independent_matches=known.independent_matches,
        independent_inliers=known.independent_inliers,
        log10_false_alarms=known.log10_false_alarms,
        overlap=overlap_share(transform, sizes.moving, sizes.fixed),
        agreement=agreed,
        stretch=stretch,
        anisotropy=anisotropy,
        halves_px=_halves(MODELS[model], transform, fitted, overlap),
        fit_px=_root_mean_square(point_errors(MODELS[model], transform, spread, overlap)),
        residual_px=spread.residual_px,
        model_px=spread.model_px,
    )


def _root_mean_square(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else float("inf")


def _independent(pairs: Correspondences) -> NDArray[np.int64]:
    """Indices of the matches that repeat no better one's spot, in either picture."""
    by_dst = first_in_each_cell(pairs.dst / pairs.dst_sigma.mean(), SPOT_SIGMAS)
    return np.asarray(by_dst[first_in_each_cell(pairs.src[by_dst] / pairs.src_sigma.mean(), SPOT_SIGMAS)])


def _chances(transform: Array, pairs: Correspondences, src_size: tuple[int, int], dst_size: tuple[int, int]) -> Array:
    """(n,) probability that a random match agrees as well, the less telling of the two directions."""
    chances = []
    for to, src, dst, sigma, size in (
        (transform, pairs.src, pairs.dst, pairs.dst_sigma, dst_size),
        (invert(transform), pairs.dst, pairs.src, pairs.src_sigma, src_size),
    ):
        there, w = project(to, src)
        with np.errstate(invalid="ignore", over="ignore"):
            error = np.where(w > 0, np.linalg.norm(there - dst, axis=1), np.inf)
        chances.append(disc_chance(error, size, float(np.median(sigma)) if len(sigma) else 1.0))
    return np.maximum(*chances)


def _shape(transform: Array, points: Array) -> tuple[tuple[float, float], float]:
    """Least and greatest scale over points, and the greatest anisotropy; a fold or a mirror is infinitely bad."""
    if not len(points):
        return (0.0, float("inf")), float("inf")
    slope = jacobian(transform, points)
    scales = np.linalg.svd(slope, compute_uv=False)
    folds = (np.linalg.det(slope) <= 0).any()
    anisotropy = float("inf") if folds else float((scales[:, 0] / np.maximum(scales[:, 1], 1e-12)).max())
    return (float(scales[:, 1].min()), float(scales[:, 0].max())), anisotropy


def _halves(model: Model, transform: Array, fitted: Correspondences, points: Array) -> float:
    """Mean distance over points between the transforms that every other fitted pair and the rest give."""
    if len(fitted) < 2 * (model.sample_size + 1) or not len(points):
        return float("inf")
    halves = [polish(model, transform, fitted[np.arange(i, len(fitted), 2)]) for i in (0, 1)]
    (a, wa), (b, wb) = (project(half, points) for half in halves)
    if (wa <= 0).any() or (wb <= 0).any():
        return float("inf")
    return float(np.linalg.norm(a - b, axis=1).mean())


def expected_error(evidence: Evidence) -> float:
    """Mean error over the overlap in fixed px: the fit's, what the model cannot follow, a bias, and a floor.

    Two independent halves of the evidence differ by twice the error of the whole, which is the fit's error measured
    without any assumption; the larger of the two counts. What the model cannot follow is seen only where the evidence
    is, and robust fitting leaves out the worst of it: it counts several times. What moves all pairs the same way, as
    light of another gradation moves the middle of every edge, is seen in none of these, but makes pairs scatter.
    """
    fit = max(evidence.fit_px, 0.5 * evidence.halves_px if np.isfinite(evidence.halves_px) else 0.0)
    model, bias = _MODEL_FACTOR * evidence.model_px, _BIAS * evidence.residual_px
    return float(np.sqrt(fit**2 + model**2 + bias**2 + _FLOOR_PX**2))


def hints(log10_false_alarms: float) -> bool:
    """Whether a consensus is more than unrelated pictures give, and not yet all that there is to find.

    Where no chance explains it and still no verdict is clear, the pictures share a caption, or are no plane: a harder
    look would find the same again.
    """
    return _ALL_THERE_IS < log10_false_alarms < _HINT


_FLOOR_PX = 0.002
_MODEL_FACTOR = 2.0  # true over seen error of scenes that are no plane (scripts/calibrate.py)
_BIAS = 0.15  # share of the scatter that no number of pairs averages out, on views with other gradation, blur and noise
_HINT = -1.0  # true pairs that a harder attempt saved had -3.4 and less
_ALL_THERE_IS = -150.0  # and those had -86 and more
_TOO_FEW = 5  # keypoints, of which no transform can be checked


def _rejected(reason: str, advice: str) -> Verdict:
    return Verdict(status="rejected", reason=reason, advice=advice, expected_error_px=None)


def nothing_found(fixed_keypoints: int, moving_keypoints: int, matches: int) -> Verdict:
    """The verdict where no transform was found: for want of keypoints in one of the pictures, or of matches."""
    count, role = min((fixed_keypoints, "fixed"), (moving_keypoints, "moving"))
    if count < _TOO_FEW:
        return _rejected(
            f"the {role} picture has {count} keypoint{'' if count == 1 else 's'} to find it by",
            "it is flat, tiny, masked or very blurred",
        )
    return _rejected(
        f"{matches} matches, and no transform that more than a handful of them agree on",
        "the pictures may show different things, or too little structure",
    )


def set_aside(known: Chance) -> Verdict:
    """The verdict on a consensus that was not looked into, because another one says more."""
    return Verdict(
        status="doubtful",
        reason=f"{_agree(known)} ({_chance(known.log10_false_alarms)} by chance); another attempt found more",
        advice="",
        expected_error_px=None,
    )


def judge(evidence: Evidence, options: VerdictOptions, sizes: Sizes) -> Verdict:
    """The verdict on the evidence."""
    for failed, advice in _rejections(evidence, options):
        return _rejected(failed, advice)
    error = expected_error(evidence)
    for failed, advice in _doubts(evidence, error, options, sizes.fixed):
        return Verdict(status="doubtful", reason=failed, advice=advice, expected_error_px=error)
    return Verdict(status="aligned", reason=_praise(evidence), advice="", expected_error_px=error)


def _agree(evidence: Chance) -> str:
    return f"{evidence.independent_inliers} of {evidence.independent_matches} independent matches agree"


def _chance(log10_false_alarms: float) -> str:
    return f"1 in 10^{-log10_false_alarms:.0f}" if log10_false_alarms < 0 else "certain"


def _blocks(evidence: Evidence) -> str:
    return f"{evidence.agreement.agreeing} of {evidence.agreement.blocks} blocks of the overlap agree"


def _rejections(evidence: Evidence, options: VerdictOptions) -> list[tuple[str, str]]:
    """Every reason to reject, the plainest first, each with what would help."""
    least, greatest = evidence.stretch
    found = []
    if evidence.log10_false_alarms > options.max_log10_false_alarms:
        found.append(
            (
                f"{_agree(evidence)}, which chance explains ({_chance(evidence.log10_false_alarms)}; "
                f"{_chance(options.max_log10_false_alarms)} needed)",
                "the pictures may show different things; --effort max looks harder",
            )
        )
    if (
        evidence.anisotropy > options.max_anisotropy
        or greatest > options.max_stretch
        or least < 1 / options.max_stretch
    ):
        found.append(
            (
                f"{_agree(evidence)}, but on a transform that no camera makes (scales {least:.2g} to {greatest:.2g})",
                "a simpler --model may hold",
            )
        )
    if evidence.overlap < options.min_overlap:
        found.append((f"{_agree(evidence)}, but the pictures overlap by only {evidence.overlap:.1%}", ""))
    if evidence.agreement.share < options.min_agreement:
        found.append(
            (
                f"{_agree(evidence)}, but only {_blocks(evidence)}: they share a small part, as a caption or logo is",
                "mask what the pictures share but do not show (--fixed-mask, --moving-mask)",
            )
        )
    return found


def error_limit(options: VerdictOptions, fixed_size: tuple[int, int]) -> float:
    """Expected error in px above which a pair is doubtful; `fixed_size` is (w, h)."""
    return max(options.max_expected_error_px, options.max_expected_error_share * float(np.hypot(*fixed_size)))


def _doubts(
    evidence: Evidence, error: float, options: VerdictOptions, fixed_size: tuple[int, int]
) -> list[tuple[str, str]]:
    """Every reason to doubt a pair that is not rejected."""
    limit = error_limit(options, fixed_size)
    found = []
    if evidence.log10_false_alarms > options.sure_log10_false_alarms and evidence.agreement.share < 0.6:
        found.append((f"{_agree(evidence)}, few for a verdict, and {_blocks(evidence)}", "look at the overlay"))
    if evidence.agreement.core < options.min_agreement <= evidence.agreement.share:
        found.append(
            (
                f"{_agree(evidence)}, but hardly a block in the middle of the overlap: they may share a frame only",
                "look at the overlay; mask a frame that the pictures share (--fixed-mask, --moving-mask)",
            )
        )
    if evidence.agreement.share < options.sure_agreement:
        found.append((f"{_agree(evidence)}, but only {_blocks(evidence)}", "look at the overlay"))
    if error > limit:
        found.append(
            (
                f"{_agree(evidence)}, but they leave the transform open to {error:.1f} px",
                "look at the overlay; a simpler --model is steadier far from the matches",
            )
        )
    return found


def _praise(evidence: Evidence) -> str:
    return f"{_agree(evidence)} ({_chance(evidence.log10_false_alarms)} by chance), {_blocks(evidence)}"


def unfit_points(reason: str) -> Verdict:
    """The verdict on typed points that fix no transform."""
    return _rejected(reason, "type more points, spread")


def judge_typed(
    model: ModelName, transform: Array, pairs: Correspondences, options: VerdictOptions, sizes: Sizes
) -> Verdict:
    """The verdict on a transform of `model` fitted to points that a person typed: how well it fits all of them.

    As many points as fix the model fit exactly and say nothing of the error.
    """
    there, _ = project(transform, pairs.src)
    error = _root_mean_square(np.linalg.norm(there - pairs.dst, axis=1))
    anisotropy = _shape(transform, overlap_points(transform, sizes.moving, sizes.fixed))[1]
    limit = error_limit(options, sizes.fixed)
    if not np.isfinite(anisotropy):
        return unfit_points(
            f"the {len(pairs)} typed points give a transform that folds or mirrors the picture, or misses it"
        )
    if len(pairs) == MODELS[model].sample_size:
        reason = f"fitted to {len(pairs)} typed points, which fix the {model} and leave none to check it"
        return Verdict(status="aligned", reason=reason, advice="", expected_error_px=None)
    if error > limit:
        reason = f"the {len(pairs)} typed points are off their transform by {error:.1f} px (root mean square)"
        return Verdict(status="doubtful", reason=reason, advice="look for a mistyped point", expected_error_px=error)
    reason = f"fitted to {len(pairs)} typed points, {error:.2g} px off (root mean square)"
    return Verdict(status="aligned", reason=reason, advice="", expected_error_px=error)
