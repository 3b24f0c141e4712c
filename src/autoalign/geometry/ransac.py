"""Correspondences, best first -> the transform most of them agree on, and who agrees. Seeded and vectorised.

The loop draws minimal samples in batches, lets the good matches speak first (PROSAC), drops impossible samples before
they cost anything (oriented constraint), scores with MSAC on the symmetric transfer error, and improves each new best
by least squares on its inliers (local optimisation). It ends when a better consensus has become improbable.

Sources: Fischler and Bolles 1981; Chum and Matas, PROSAC, 2005; Torr and Zisserman, MSAC, 2000; Chum, Matas and Kittler,
LO-RANSAC, 2003; Lebeda, Matas and Chum, LO+, 2012.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from autoalign.geometry.family import MODELS, Model, ModelName, solve_samples
from autoalign.geometry.homography import Array, Mask, determinant, project, symmetric_transfer_error_squared
from autoalign.geometry.least_squares import Correspondences, polish

_GROWTH = 200_000  # draws after which PROSAC has become plain RANSAC (T_N in the paper)
_GLANCE = 100  # matches that a hypothesis is first judged by


@dataclass(frozen=True, kw_only=True)
class RansacOptions:
    """How the consensus is searched."""

    threshold: float = 3.0
    """a match agrees if its symmetric transfer error is under so many sigmas"""
    confidence: float = 0.999
    """stop when a larger consensus is this improbable to have been missed"""
    max_trials: int = 20_000
    """samples at most"""
    batch: int = 500
    """samples drawn and judged together"""
    seed: int = 0
    """of the one random generator"""

    def __post_init__(self) -> None:
        if not (self.threshold > 0 and 0 < self.confidence < 1 and self.max_trials > 0 and self.batch > 0):
            raise ValueError(f"RansacOptions out of range: {self}")


@dataclass(frozen=True, kw_only=True)
class Consensus:
    """A transform and the matches that agree on it."""

    model: ModelName
    dst_from_src: Array  # (3, 3) of unit norm, w > 0 over the inliers
    inliers: Mask  # (n,)
    errors: Array  # (n,) symmetric transfer error in sigmas; inf behind the horizon
    trials: int  # samples drawn

    @property
    def count(self) -> int:
        return int(self.inliers.sum())


def ransac(
    pairs: Correspondences, model: ModelName = "homography", options: RansacOptions | None = None
) -> Consensus | None:
    """The consensus of `pairs`, which come best first; None where no transform has more support than its own sample.

    A transform that mirrors is never returned. The same pairs, model and options give the same bits.
    """
    options = options or RansacOptions()
    member = MODELS[model]
    if len(pairs) <= member.sample_size:
        return None
    found, trials = _search(member, pairs, options)
    return None if found is None else settle(member, found, pairs, options.threshold, trials)


def settle(
    model: Model, transform: Array, pairs: Correspondences, threshold: float, trials: int = 0, max_rounds: int = 10
) -> Consensus | None:
    """Refit by least squares until the inliers stop changing; None where fewer agree than fix the model, and one more."""
    inliers = _errors_squared(transform, pairs) < threshold**2
    for _ in range(max_rounds):
        if inliers.sum() <= model.sample_size:
            return None
        transform = polish(model, transform, pairs[inliers])
        before, inliers = inliers, _errors_squared(transform, pairs) < threshold**2
        if (before == inliers).all():
            break
    if inliers.sum() <= model.sample_size:
        return None
    errors = np.sqrt(_errors_squared(transform, pairs))
    return Consensus(model=model.name, dst_from_src=transform, inliers=inliers, errors=errors, trials=trials)


def _errors_squared(transform: Array, pairs: Correspondences) -> Array:
    return symmetric_transfer_error_squared(transform, pairs.src, pairs.dst, pairs.src_sigma, pairs.dst_sigma)


def _search(model: Model, pairs: Correspondences, options: RansacOptions) -> tuple[Array | None, int]:
    """The best transform found, and the number of samples drawn."""
    rng = np.random.default_rng(options.seed)
    n, limit = len(pairs), options.threshold**2
    glance = rng.permutation(n)[:_GLANCE]
    tops = _prosac_tops(n, model.sample_size, options.max_trials)
    best, best_cost = None, n * limit
    drawn, needed = 0, options.max_trials
    while drawn < needed:
        samples = _draw(rng, tops[drawn : drawn + options.batch], model.sample_size)
        drawn += options.batch
        candidate, cost = _best_of(_hypotheses(model, pairs, samples), pairs, glance, limit)
        if candidate is None or cost >= best_cost:
            continue
        best, best_cost = _optimise_locally(model, candidate, cost, pairs, options.threshold)
        inliers = _errors_squared(best, pairs) < limit
        needed = min(needed, _trials_needed(inliers, tops, model.sample_size, options.confidence))
    return best, min(drawn, options.max_trials)


def _prosac_tops(n: int, m: int, trials: int) -> NDArray[np.int64]:
    """(trials,) how many of the best matches each draw may use: the growth function of PROSAC, in closed form.

    T_k, the draws after which the set has k members, is _GROWTH x C(k, m) / C(n, m); the set for draw t is the smallest k
    with T_k >= t.
    """
    k = np.arange(m, n + 1)
    growth = np.ones(len(k))
    for i in range(m):
        growth *= (k - i) / (n - i)
    # Each size gets at least one draw (T'_{k+1} = T'_k + ceil(T_{k+1} - T_k) in the paper).
    steps = np.concatenate([[1.0], np.ceil(np.diff(growth * _GROWTH))])
    return np.asarray(k[np.minimum(np.searchsorted(np.cumsum(steps), np.arange(1, trials + 1)), len(k) - 1)])


def _draw(rng: np.random.Generator, tops: NDArray[np.int64], m: int) -> NDArray[np.int64]:
    """(k, m) distinct indices per row: the last of the top matches, and m - 1 of those before it."""
    samples = np.empty((len(tops), m), np.int64)
    samples[:, 0] = tops - 1
    samples[:, 1:] = (rng.random((len(tops), m - 1)) * (tops - 1)[:, None]).astype(np.int64)
    ordered = np.sort(samples, axis=1)
    return np.asarray(samples[(ordered[:, 1:] != ordered[:, :-1]).all(1)])


def _hypotheses(model: Model, pairs: Correspondences, samples: NDArray[np.int64]) -> Array:
    """(k, 3, 3) the transforms of the sound samples that do not mirror."""
    transforms, sound = solve_samples(model, pairs.src[samples], pairs.dst[samples], min_area=1e-3)
    return transforms[sound & (determinant(transforms) > 0)]


def _best_of(
    hypotheses: Array, pairs: Correspondences, glance: NDArray[np.int64], limit: float
) -> tuple[Array | None, float]:
    """The hypothesis of least MSAC cost. All are judged one way on a few matches, the best tenth both ways on all."""
    if not len(hypotheses):
        return None, np.inf
    if len(pairs) > len(glance):
        rough = _one_way_cost(hypotheses, pairs[glance], limit)
        hypotheses = hypotheses[np.argsort(rough, kind="stable")[: max(10, len(hypotheses) // 10)]]
    costs = np.minimum(_errors_squared(hypotheses, pairs), limit).sum(-1)
    chosen = int(np.argmin(costs))
    return hypotheses[chosen], float(costs[chosen])


def _one_way_cost(hypotheses: Array, pairs: Correspondences, limit: float) -> Array:
    projected, w = project(hypotheses, pairs.src)
    with np.errstate(invalid="ignore", over="ignore"):
        error = ((projected - pairs.dst) ** 2).sum(-1) / pairs.dst_sigma**2
    return np.asarray(np.where(w > 0, np.fmin(error, limit), limit).sum(-1))


def _optimise_locally(
    model: Model, transform: Array, cost: float, pairs: Correspondences, threshold: float
) -> tuple[Array, float]:
    """Least squares on the inliers of a threshold that shrinks from three times to once; the best of what it passes."""
    best, best_cost = transform, cost
    for factor in (3.0, 1.5, 1.0):
        inliers = _errors_squared(transform, pairs) < (factor * threshold) ** 2
        if inliers.sum() <= model.sample_size:
            break
        transform = polish(model, transform, pairs[inliers], max_steps=5)
        now = float(np.minimum(_errors_squared(transform, pairs), threshold**2).sum())
        if now < best_cost:
            best, best_cost = transform, now
    return best, best_cost


def _trials_needed(inliers: Mask, tops: NDArray[np.int64], m: int, confidence: float) -> int:
    """Draws after which a sample of inliers only has been missed with a chance under 1 - confidence.

    The draws were spent on growing sets of the best matches, so each draw counts with the inlier share of its own set.
    The sample that gave the transform agrees with it whatever it is, so it does not count.
    """
    share = np.maximum(np.cumsum(inliers)[tops - 1] - m, 0) / tops
    chance = np.clip(share**m, 1e-12, 1 - 1e-12)
    missed = np.cumsum(np.log1p(-chance))
    return int(np.searchsorted(-missed, -np.log(1 - confidence))) + 1
