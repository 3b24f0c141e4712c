"""Correspondences, best first -> the transform most of them agree on, and who agrees. Seeded and vectorised.

The loop draws minimal samples in batches, lets the good matches speak first (PROSAC), drops impossible samples before
they cost anything (oriented constraint), scores with MSAC on the symmetric transfer error, and improves each new best
by least squares on its inliers (local optimisation). It ends when a better consensus has become improbable.

Sources: Fischler and Bolles 1981; Chum and Matas, PROSAC, 2005; Torr and Zisserman, MSAC, 2000; Chum, Matas and
Kittler, LO-RANSAC, 2003; Lebeda, Matas and Chum, LO+, 2012.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, comb, factorial, log

import numpy as np
from numpy.typing import NDArray

from autoalign.geometry.family import MODELS, Model, ModelName, solve_samples
from autoalign.geometry.homography import (
    IDENTITY,
    Array,
    Mask,
    determinant,
    symmetric_transfer_error_squared,
    transfer_error_squared,
    turn,
    unit,
)
from autoalign.geometry.least_squares import Correspondences, polish

_GROWTH = 200_000  # draws after which PROSAC has become plain RANSAC, at most (T_N in the paper)
_FIRST_BATCH = 100  # samples; a good pair needs no more
_LOCAL_STEPS = 2  # of least squares per threshold: settle() goes on to the minimum
_FEW = 10  # hypotheses of a batch that are judged both ways
_CACHED = 16_384  # errors computed at once: more would leave the processor's cache


@dataclass(frozen=True, kw_only=True)
class RansacOptions:
    """How the consensus is searched."""

    threshold: float = 3.0
    """a match agrees if its symmetric transfer error is under so many sigmas"""
    confidence: float = 0.999
    """stop when a larger consensus is this improbable to have been missed"""
    max_trials: int = 40_000
    """samples drawn, at most"""
    batch: int = 2_000
    """samples drawn and judged together, at most: each batch is as large as all before it"""
    seed: int = 0
    """seed of the one random generator"""

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
    if member.sample_size == 0:
        return settle(member, unit(IDENTITY), pairs, options.threshold)
    found, trials = _search(member, pairs, options)
    return None if found is None else settle(member, found, pairs, options.threshold, trials)


def settle(
    model: Model, transform: Array, pairs: Correspondences, threshold: float, trials: int = 0, max_rounds: int = 10
) -> Consensus | None:
    """Refit by least squares until the inliers stop changing; None where no more agree than fix the model."""
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
    n, m, limit = len(pairs), model.sample_size, options.threshold**2
    most = min(options.max_trials, _trials_to_draw_all(n, m, options.confidence))
    tops, growing = _prosac_order(n, m, most)
    best, best_cost = None, n * limit
    drawn, needed = 0, most
    while drawn < needed:
        batch = slice(drawn, drawn + min(max(drawn, _FIRST_BATCH), options.batch))
        drawn = min(batch.stop, most)
        samples = _draw(rng, tops[batch], growing[batch], m)
        candidate, cost = _best_of(_hypotheses(model, pairs, samples), pairs, limit)
        if candidate is None or cost >= best_cost:
            continue
        best, best_cost = _optimise_locally(model, candidate, cost, pairs, options.threshold)
        inliers = _errors_squared(best, pairs) < limit
        needed = min(needed, _trials_needed(inliers, tops, m, options.confidence))
    return best, drawn


def _trials_to_draw_all(n: int, m: int, confidence: float) -> int:
    """Draws of m out of n, with repeats, that leave out a given sample with a chance under 1 - confidence."""
    return ceil(-log(1 - confidence) * float(n) ** m / factorial(m))


def _prosac_order(n: int, m: int, trials: int) -> tuple[NDArray[np.int64], Mask]:
    """(trials,) how many of the best matches each draw may use, and whether it must use the last of these.

    The growth function of PROSAC in closed form: T_k, the draws after which the set has k members, is T_n x C(k, m) /
    C(n, m), and the set for draw t is the smallest k with T_k >= t. T_n is no more than the number of samples there
    are, else few matches would be drawn from their first few for ever. Once all matches are in, draws are free.
    """
    k = np.arange(m, n + 1)
    reached = np.full(len(k), float(min(_GROWTH, comb(n, m))))
    for i in range(m):
        reached *= (k - i) / (n - i)
    # Each size gets at least one draw (T'_{k+1} = T'_k + ceil(T_{k+1} - T_k) in the paper; a hair less for rounding).
    steps = np.concatenate([[1.0], np.ceil(np.diff(reached) - 1e-9)])
    growth = np.minimum(np.cumsum(steps), trials).astype(np.int64)
    tops = np.full(trials, n)
    tops[: growth[-1]] = np.repeat(k, np.diff(growth, prepend=0))
    return tops, np.arange(trials) < growth[-1]


def _draw(rng: np.random.Generator, tops: NDArray[np.int64], growing: Mask, m: int) -> NDArray[np.int64]:
    """(k, m) distinct indices per row among the top matches, the last of them always one where the set is growing."""
    samples = (rng.random((len(tops), m)) * (tops - growing)[:, None]).astype(np.int64)
    samples[growing, 0] = tops[growing] - 1
    ordered = np.sort(samples, axis=1)
    return np.asarray(samples[(ordered[:, 1:] != ordered[:, :-1]).all(1)])


def _hypotheses(model: Model, pairs: Correspondences, samples: NDArray[np.int64]) -> Array:
    """(k, 3, 3) the transforms of the sound samples that do not mirror."""
    src, dst = (np.take(points, samples, axis=0) for points in (pairs.src, pairs.dst))
    if model.sample_size >= 3:
        # A triangle that turns over spares the solving of half of the random samples.
        kept = turn(*np.moveaxis(src[:, :3], 1, 0)) * turn(*np.moveaxis(dst[:, :3], 1, 0)) > 0
        src, dst = src[kept], dst[kept]
    transforms, sound = solve_samples(model, src, dst, min_area=1e-3)
    return transforms[sound & (determinant(transforms) > 0)]


def _best_of(hypotheses: Array, pairs: Correspondences, limit: float) -> tuple[Array | None, float]:
    """The hypothesis of least MSAC cost: all are judged one way, the best few both ways."""
    if not len(hypotheses):
        return None, np.inf
    parts = np.array_split(hypotheses, len(hypotheses) * len(pairs) // _CACHED + 1)
    rough = np.concatenate([_one_way_cost(part, pairs, limit) for part in parts])
    few = hypotheses[np.argsort(rough, kind="stable")[:_FEW]]
    costs = np.minimum(_errors_squared(few, pairs), limit).sum(-1)
    chosen = int(np.argmin(costs))
    return few[chosen], float(costs[chosen])


def _one_way_cost(hypotheses: Array, pairs: Correspondences, limit: float) -> Array:
    error = transfer_error_squared(hypotheses, pairs.src, pairs.dst) / pairs.dst_sigma**2
    return np.asarray(np.minimum(error, limit).sum(-1))


def _optimise_locally(
    model: Model, transform: Array, cost: float, pairs: Correspondences, threshold: float
) -> tuple[Array, float]:
    """Least squares on the inliers of a threshold that shrinks from three times to once; the best of what it passes."""
    best, best_cost = transform, cost
    for factor in (3.0, 1.5, 1.0):
        inliers = _errors_squared(transform, pairs) < (factor * threshold) ** 2
        if inliers.sum() <= model.sample_size:
            break
        transform = polish(model, transform, pairs[inliers], max_steps=_LOCAL_STEPS)
        now = float(np.minimum(_errors_squared(transform, pairs), threshold**2).sum())
        if now < best_cost:
            best, best_cost = transform, now
    return best, best_cost


def _trials_needed(inliers: Mask, tops: NDArray[np.int64], m: int, confidence: float) -> int:
    """Draws after which a sample of inliers only has been missed with a chance under 1 - confidence.

    The draws were spent on growing sets of the best matches, so each draw counts with the inlier share of its own set.
    The sample that gave the transform agrees with it whatever it is, so it does not count.
    """
    share = np.maximum(np.cumsum(inliers) - m, 0) / np.arange(1, len(inliers) + 1)
    unlikely = -np.log1p(-np.clip(share**m, 1e-12, 1 - 1e-12))
    return int(np.searchsorted(np.cumsum(unlikely[tops - 1]), -np.log(1 - confidence))) + 1
