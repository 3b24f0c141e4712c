"""The transforms of many frames at once, from the transforms that were measured between pairs of them.

A tie says `fixed_from_moving` of two frames, with a covariance. Sought is `reference_from_frame` of every frame, so
that for every tie, up to its covariance, `reference_from_fixed @ fixed_from_moving == reference_from_moving`. What is
left of a tie, `moving_from_fixed @ fixed_from_reference @ reference_from_moving`, is measured along the generators of
the homography, whatever model the frames move in: so a tie needs no more than its own transform and covariance, and
nothing of what its points knew is lost.

Wrong ties are overruled by those that agree: the loss is Geman and McClure's, and begins so wide that it is convex.

Sources: Triggs, McLauchlan, Hartley and Fitzgibbon, Bundle adjustment, 2000; Yang, Antonante, Tzoumas and Carlone,
Graduated non-convexity, 2020; the variance of unit weight is that of geodetic networks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse
import scipy.sparse.linalg

from autoalign.geometry.family import MODELS, Model, fit
from autoalign.geometry.graph import Indices, cheapest_tree
from autoalign.geometry.homography import IDENTITY, Array, Mask, apply, invert, unit
from autoalign.geometry.least_squares import step
from autoalign.geometry.uncertainty import Uncertainty

_DIRECTIONS = MODELS["homography"].generators  # (8, 3, 3), orthogonal to each other
_ALONG = _DIRECTIONS / np.square(_DIRECTIONS).sum((1, 2), keepdims=True)
_MEDIAN_SQUARE = 7.344  # median of a chi-square of eight degrees of freedom
_SQUARE = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
_BEST = 0.2  # the least share of what ties claim that is believed to be their error, however well they agree
_NARROWING = 4.0  # of the loss, per step
_WIDEST = 4.0**20  # squared misfit; a tie that is further off takes no part from the beginning
_SAMPLES = 128  # of the error of all frames together: their covariance is known to 12 %, its root to 6 %


@dataclass(frozen=True, kw_only=True)
class Ties:
    """What was measured between pairs of frames."""

    fixed: Indices  # (m,) numbers of frames
    moving: Indices  # (m,)
    fixed_from_moving: Array  # (m, 3, 3)
    norm: Array  # (m, 3, 3) of the moving frame's plane, as in Uncertainty
    covariance: Array  # (m, 8, 8) along the generators of the homography
    error_px: Array  # (m,) error to expect

    def __len__(self) -> int:
        return len(self.fixed)


@dataclass(frozen=True, kw_only=True)
class Adjustment:
    """The network after least squares."""

    reference_from_frame: Array  # (n, 3, 3) of unit norm; the identity for frames that no tie kept holds
    covariance: Array  # (n, dof, dof) of the tangent parameters, in the frame's own `norm`; zero for the reference
    norm: Array  # (n, 3, 3)
    kept: Mask  # (m,) False: overruled by the others
    misfit: Array  # (m,) in standard deviations, 1 on the average where the ties are as good as they claim
    unit_sigma: float  # how many times larger than claimed the errors of the ties are, as their misfits show

    def known(self, frame: int) -> Uncertainty:
        """The uncertainty of `reference_from_frame[frame]`, for the functions that take it to points."""
        return Uncertainty(covariance=self.covariance[frame], norm=self.norm[frame], residual_px=0.0, model_px=0.0)


def adjust(
    model: Model, reference: int, norm: Array, ties: Ties, *, threshold: float = 3.0, max_steps: int = 60
) -> Adjustment:
    """All `reference_from_frame` of the model together; the reference keeps the identity.

    `norm` (n, 3, 3) brings the points of each frame to mean 0 and size 1. A tie is overruled where its misfit is over
    `threshold` standard deviations, as it claims them, or as the ties show them where these are larger.
    """
    if not len(ties):
        return _untied(model, norm)
    network = _Network(model=model, reference=reference, norm=norm, ties=ties, whitening=_whitening(ties.covariance))
    transforms = _graduated(network, _along_tree(network), threshold, max_steps)
    return _settled(network, transforms, threshold, max_steps)


def _untied(model: Model, norm: Array) -> Adjustment:
    nothing = np.zeros(0)
    return Adjustment(
        reference_from_frame=np.array(np.broadcast_to(unit(IDENTITY), norm.shape)),
        covariance=np.zeros((len(norm), model.degrees_of_freedom, model.degrees_of_freedom)),
        norm=norm,
        kept=nothing.astype(np.bool_),
        misfit=nothing,
        unit_sigma=1.0,
    )


def adjust_in_simplest(
    models: Sequence[Model], reference: int, norm: Array, ties: Ties, *, threshold: float = 3.0
) -> tuple[Model, Adjustment]:
    """The simplest of the models, given from simple to general, in which the ties agree as in the most general one.

    That is the one of least BIC (Schwarz 1978) among those that leave no tie of these off by `threshold` standard
    deviations. The scale is that of the errors that the ties claim, or show where these are larger: nothing finer is
    read out of them.
    """
    general = adjust(models[-1], reference, norm, ties, threshold=threshold)
    best, chosen = np.inf, (models[-1], general)
    for model in models:
        adjusted = general if model is models[-1] else adjust(model, reference, norm, ties, threshold=threshold)
        misfit = adjusted.misfit[general.kept] / max(general.unit_sigma, 1.0)
        if (misfit <= threshold).all():
            parameters = model.degrees_of_freedom * len(norm)
            criterion = 8.0 * float(np.square(misfit).sum()) + parameters * np.log(max(8 * len(misfit), 1))
            if criterion < best:
                best, chosen = criterion, (model, adjusted)
    return chosen


@dataclass(frozen=True, kw_only=True)
class _Network:
    """What does not change while the frames move."""

    model: Model
    reference: int
    norm: Array  # (n, 3, 3)
    ties: Ties
    whitening: Array  # (m, 8, 8) makes a misfit one of unit covariance

    def held(self, kept: Mask) -> Indices:
        """The frames that the ties kept hold to the reference, without it."""
        ties, chosen = self.ties, np.flatnonzero(kept)
        cost = ties.error_px[chosen]
        order = cheapest_tree(len(self.norm), self.reference, ties.fixed[chosen], ties.moving[chosen], cost).order
        return np.sort(order[1:])


def _whitening(covariance: Array) -> Array:
    """(m, 8, 8) square roots of the information; a variance of zero stands for none, as in a pseudo-inverse."""
    variance, axes = np.linalg.eigh(covariance)
    known = variance > 1e-15 * variance[:, -1:]
    return np.asarray(np.where(known, variance, np.inf)[..., None] ** -0.5 * np.swapaxes(axes, 1, 2))


def _along_tree(network: _Network) -> Array:
    """(n, 3, 3) the transforms along the most precise path of ties; the identity where there is none."""
    ties = network.ties
    tree = cheapest_tree(len(network.norm), network.reference, ties.fixed, ties.moving, ties.error_px**2)
    transforms = np.array(np.broadcast_to(unit(IDENTITY), network.norm.shape))
    for frame in tree.order[1:]:
        parent, tie = tree.parent[frame], tree.edge[frame]
        fixed_from_moving = _inside(network.model, ties.fixed_from_moving[tie], ties.norm[tie])
        parent_from_frame = fixed_from_moving if ties.fixed[tie] == parent else invert(fixed_from_moving)
        transforms[frame] = unit(transforms[parent] @ parent_from_frame)
    return transforms


def _inside(model: Model, dst_from_src: Array, norm: Array) -> Array:
    """The transform of the model that is nearest to a homography where `norm` (3, 3) says that src is."""
    src = apply(invert(norm), _SQUARE)
    return fit(model.name, src, apply(dst_from_src, src))


@dataclass(frozen=True, kw_only=True)
class _Linearised:
    """The misfits of all ties in standard deviations, and their derivatives by the tangents of both frames."""

    residual: Array  # (m, 8)
    by_fixed: Array  # (m, 8, dof)
    by_moving: Array  # (m, 8, dof)

    @property
    def squared(self) -> Array:
        return np.asarray((self.residual**2).sum(1))


def _linearise(network: _Network, transforms: Array) -> _Linearised:
    """What is left of every tie, and how it changes as the frames move along their generators."""
    ties, generators = network.ties, network.model.generators
    normalised_from_fixed = ties.norm @ invert(ties.fixed_from_moving)
    left = normalised_from_fixed @ invert(transforms)[ties.fixed] @ transforms[ties.moving] @ np.linalg.inv(ties.norm)
    # Seen from the tie's own normalised plane, the frames' generators act on the left and on the right of it.
    of_fixed = _seen_from(normalised_from_fixed @ np.linalg.inv(network.norm)[ties.fixed], generators)
    of_moving = _seen_from(ties.norm @ np.linalg.inv(network.norm)[ties.moving], generators)
    return _Linearised(
        residual=np.einsum("mij,mj->mi", network.whitening, _coordinates(left)),
        by_fixed=network.whitening @ _slope(left, -of_fixed @ left[:, None]),
        by_moving=network.whitening @ _slope(left, left[:, None] @ of_moving),
    )


def _seen_from(change: Array, generators: Array) -> Array:
    """(m, dof, 3, 3) generators after changes of coordinates (m, 3, 3)."""
    return np.asarray(change[:, None] @ generators @ np.linalg.inv(change)[:, None])


def _coordinates(transforms: Array) -> Array:
    """(m, 8) coordinates of transforms (m, 3, 3) near the identity along the generators of the homography.

    The last entry of no generator is other than zero, so it fixes the scale.
    """
    return np.asarray(np.einsum("gij,mij->mg", _ALONG, transforms / transforms[:, 2:, 2:] - IDENTITY))


def _slope(transforms: Array, velocity: Array) -> Array:
    """(m, 8, dof) derivative of the coordinates of transforms (m, 3, 3) that move by `velocity` (m, dof, 3, 3)."""
    scale = transforms[:, None, 2:, 2:]
    change = velocity / scale - transforms[:, None] * velocity[..., 2:, 2:] / scale**2
    return np.asarray(np.einsum("gij,mdij->mgd", _ALONG, change))


def _graduated(network: _Network, transforms: Array, threshold: float, max_steps: int) -> Array:
    """The transforms of least robust cost: the loss is so wide at first that no tie is left out, and narrows."""
    everyone = network.held(np.ones(len(network.ties), np.bool_))
    width, narrowest = _WIDEST, _limit(threshold, 1.0)
    for _ in range(max_steps):
        at = _linearise(network, transforms)
        width = max(min(width / _NARROWING, 2.0 * float(at.squared.max())), narrowest)
        transforms, moved = _moved(network, transforms, at, (width / (width + at.squared)) ** 2, everyone)
        if width == narrowest and moved < 1e-9:
            break
    return transforms


def _settled(network: _Network, transforms: Array, threshold: float, max_steps: int) -> Adjustment:
    """Least squares on the ties that are not overruled, until nothing changes.

    Where ties agree better than they claim, those that do not count less, by the scale that the others show; but they
    contradict nothing, and may be all that holds a frame.
    """
    kept = np.ones(len(network.ties), np.bool_)
    for _ in range(max_steps):
        at = _linearise(network, transforms)
        unit_variance = _unit_variance(network, at.squared[kept], len(network.held(kept)))
        before, kept = kept, at.squared <= _limit(threshold, max(unit_variance, 1.0))
        held = network.held(kept)
        shown = _limit(threshold, max(unit_variance, _BEST**2))
        weights = kept * np.minimum(shown / np.maximum(at.squared, 1e-300), 1.0) ** 2
        transforms, moved = _moved(network, transforms, at, weights, held)
        if moved < 1e-9 and (kept == before).all():
            break
    loose = np.setdiff1d(np.arange(len(transforms)), [network.reference, *held])
    transforms[loose] = unit(IDENTITY)
    return Adjustment(
        reference_from_frame=transforms,
        covariance=max(unit_variance, 1.0) * _covariance(network, at, weights, held),
        norm=network.norm,
        kept=kept,
        misfit=np.sqrt(at.squared / 8.0),
        unit_sigma=float(np.sqrt(unit_variance)),
    )


def _unit_variance(network: _Network, squared: Array, held: int) -> float:
    """Variance of misfits that claim to be 1, from their median square; least squares hides a part of it."""
    shown = 8 * len(squared) - network.model.degrees_of_freedom * held
    if shown <= 0:
        return 1.0
    return float(np.median(squared)) / _MEDIAN_SQUARE * 8 * len(squared) / shown


def _limit(threshold: float, unit_variance: float) -> float:
    """The squared misfit from which a tie is overruled."""
    return 8.0 * threshold**2 * unit_variance


def _moved(network: _Network, transforms: Array, at: _Linearised, weights: Array, held: Indices) -> tuple[Array, float]:
    """The transforms after a Gauss-Newton step of the frames held, and the largest parameter of it."""
    if not len(held):
        return transforms, 0.0
    slope = _stacked(network, at, weights, held)
    right = slope.T @ (np.sqrt(weights)[:, None] * at.residual).ravel()
    parameters = -_factored(slope).solve(right).reshape(len(held), -1)
    moved = transforms.copy()
    moved[held] = step(network.model, transforms[held], parameters, network.norm[held])
    return moved, float(np.abs(parameters).max())


def _stacked(network: _Network, at: _Linearised, weights: Array, held: Indices) -> scipy.sparse.csr_array:
    """(8 m, dof x held) weighted derivatives of all misfits."""
    dof, place = network.model.degrees_of_freedom, np.full(len(network.norm), -1)
    place[held] = np.arange(len(held))
    rows, columns, values = [], [], []
    for frames, slope in ((network.ties.fixed, at.by_fixed), (network.ties.moving, at.by_moving)):
        there = np.flatnonzero((place[frames] >= 0) & (weights > 0))
        block = np.broadcast_to(np.arange(8)[:, None], (8, dof)), np.broadcast_to(np.arange(dof), (8, dof))
        rows.append((8 * there[:, None, None] + block[0]).ravel())
        columns.append((dof * place[frames[there]][:, None, None] + block[1]).ravel())
        values.append((np.sqrt(weights[there])[:, None, None] * slope[there]).ravel())
    return scipy.sparse.csr_array(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))),
        shape=(8 * len(weights), dof * len(held)),
    )


def _factored(slope: scipy.sparse.csr_array) -> scipy.sparse.linalg.SuperLU:
    """The normal equations, ready to solve.

    Along directions that no tie knows anything of, a frame is held as if known to its own size: an identity is added.
    """
    normal = slope.T @ slope + scipy.sparse.eye_array(slope.shape[1])
    return scipy.sparse.linalg.splu(
        normal.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
    )


def _covariance(network: _Network, at: _Linearised, weights: Array, held: Indices) -> Array:
    """(n, dof, dof) covariances of the frames, from samples of the ties' errors taken through the solution.

    The exact blocks of the inverse would cost a solution for every frame.
    """
    dof = network.model.degrees_of_freedom
    covariance = np.zeros((len(network.norm), dof, dof))
    if len(held):
        slope = _stacked(network, at, weights, held)
        noise = np.random.default_rng(0).normal(size=(slope.shape[0], _SAMPLES))
        errors = _factored(slope).solve(slope.T @ noise).reshape(len(held), dof, _SAMPLES)
        covariance[held] = np.einsum("fgs,fhs->fgh", errors, errors) / _SAMPLES
    return covariance
