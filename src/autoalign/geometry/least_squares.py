"""Robust Levenberg-Marquardt on the symmetric transfer error, for any model of the family.

The transform moves along the generators of its model, H <- H exp(sum a_i G_i), so that it never leaves the model, needs
no gauge and gives its inverse for swapped pictures. A generator is a velocity field V(p) over the src plane: the
projected src moves by J_H V(src), and dst taken back moves by -V there, which is all the derivative there is.

Source: Hartley and Zisserman, 4.3 and appendix 6; iteratively reweighted with Tukey's biweight.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from autoalign.geometry.family import Model
from autoalign.geometry.homography import Array, invert, normalisation, project, project_and_slope, unit

TUKEY = 4.685  # 95 % efficiency at a normal distribution
_SAMPLED = 200  # pairs that are enough to see how far supports overlap
_CONVERGED = 1e-7  # step, in coordinates where the points are about 1 from their mean: 1e-4 px of any picture


@dataclass(frozen=True, kw_only=True)
class Correspondences:
    """Pairs of points, and how far each may be off.

    Pairs share noise where the squares of dst that they were measured on, their supports, overlap.
    """

    src: Array  # (n, 2)
    dst: Array  # (n, 2)
    src_sigma: Array  # (n,) expected error of a point, px of its picture
    dst_sigma: Array  # (n,)
    support_px: float = 0.0  # side of a support, dst px

    def __len__(self) -> int:
        return len(self.src)

    def __getitem__(self, index: object) -> Correspondences:
        """The pairs chosen by a mask or by indices."""
        chosen = np.asarray(index)
        return Correspondences(
            src=self.src[chosen],
            dst=self.dst[chosen],
            src_sigma=self.src_sigma[chosen],
            dst_sigma=self.dst_sigma[chosen],
            support_px=self.support_px,
        )

    def times_seen(self) -> float:
        """How many times the same noise is counted among the pairs, in the mean: 1 where no supports overlap.

        The design effect (Kish 1965): the mean of n such errors has the variance of n / times_seen independent ones.
        """
        if not self.support_px or not len(self):
            return 1.0
        some = self.dst[:: max(1, len(self) // _SAMPLED)]
        apart = np.abs(some[:, None] - self.dst) / self.support_px
        return float(np.maximum(1.0 - apart, 0.0).prod(2).sum(1).mean())


def correspondences(src: Array, dst: Array, src_sigma: float = 1.0, dst_sigma: float = 1.0) -> Correspondences:
    """Pairs that are all equally good."""
    n = len(src)
    return Correspondences(src=src, dst=dst, src_sigma=np.full(n, src_sigma), dst_sigma=np.full(n, dst_sigma))


def joined_pairs(parts: Sequence[Correspondences]) -> Correspondences:
    """The pairs of all parts, in their order."""
    return Correspondences(
        src=np.concatenate([part.src for part in parts]),
        dst=np.concatenate([part.dst for part in parts]),
        src_sigma=np.concatenate([part.src_sigma for part in parts]),
        dst_sigma=np.concatenate([part.dst_sigma for part in parts]),
        support_px=max(part.support_px for part in parts),
    )


def velocities(model: Model, points: Array, norm: Array) -> Array:
    """(n, 2, dof) velocity of points (n, 2) under each generator, taken in coordinates normalised by `norm` (3, 3).

    The normalisation is a similarity, which maps every model of the family onto itself; it only conditions the numbers.
    """
    # Points last in memory, (dof, 2, n), is what makes the sums over them fast.
    u = np.ones((3, len(points)))
    u[:2] = points.T * norm[0, 0] + norm[:2, 2:]
    moved = np.einsum("gij,jn->gin", model.generators, u)
    return np.asarray((moved[:, :2] - u[:2] * moved[:, 2:]) / norm[0, 0]).T


def step(model: Model, transform: Array, parameters: Array, norm: Array) -> Array:
    """H exp(sum a_i G_i) of unit norm, the generators taken in the normalised frame.

    Leading axes are batches: (..., 3, 3) transforms, (..., dof) parameters, (..., 3, 3) norms -> (..., 3, 3).
    """
    generator = np.einsum("...g,gij->...ij", parameters, model.generators)
    largest = max(float(np.abs(generator).max(initial=0.0)), 1e-300)
    halvings = max(0, int(np.ceil(np.log2(largest / 0.1))))
    scaled = generator / 2**halvings
    exponential, term = np.eye(3), np.eye(3)
    for k in range(1, 12):  # 0.3**12 / 12! is far under the rounding of a double
        term = term @ scaled / k
        exponential = exponential + term
    for _ in range(halvings):
        exponential = exponential @ exponential
    inverse_norm = np.linalg.inv(norm)
    return unit(transform @ inverse_norm @ exponential @ norm)


@dataclass(frozen=True, kw_only=True)
class _Linearised:
    """Residuals and their derivatives; points last in memory, so that sums over them are fast."""

    residual: Array  # (4, n) in sigmas: forward x and y, backward x and y
    slope: Array  # (dof, 4, n) of what the residuals are taken from: the projected src, dst taken back

    @property
    def error_squared(self) -> Array:
        return np.asarray(0.5 * (self.residual**2).sum(0))


@np.errstate(divide="ignore", invalid="ignore", over="ignore")  # points at infinity; polish() looks for them
def _linearise(model: Model, transform: Array, pairs: Correspondences, norm: Array, src_velocity: Array) -> _Linearised:
    there, (by_x, by_y) = _forward(transform, pairs)
    back = project(invert(transform), pairs.dst)[0]
    slope = np.empty((len(src_velocity), 4, len(pairs)))
    np.add(by_x * src_velocity[:, :1], by_y * src_velocity[:, 1:], out=slope[:, :2])
    np.divide(velocities(model, back, norm).T, -pairs.src_sigma, out=slope[:, 2:])
    return _Linearised(
        residual=np.concatenate([(pairs.dst.T - there) / pairs.dst_sigma, (pairs.src - back).T / pairs.src_sigma]),
        slope=slope,
    )


def _forward(transform: Array, pairs: Correspondences) -> tuple[Array, Array]:
    """Projected src (2, n), and its derivative by x and by y of src (2, 2, n), in sigmas of dst."""
    there, slope = project_and_slope(transform, pairs.src)
    return there, (slope / pairs.dst_sigma).swapaxes(0, 1)


def robust_scale(error_squared: Array, floor: float) -> float:
    """Sigma of a coordinate from the median of squared 2-D errors (Rayleigh: 1.1774 sigma), never under `floor`."""
    return max(float(np.sqrt(np.median(error_squared))) / 1.1774, floor)


def tukey_weights(error_squared: Array, sigma: float) -> Array:
    """(n,) Tukey biweights of squared 2-D errors."""
    ratio = np.minimum(error_squared / (TUKEY * sigma) ** 2, 1.0)
    return np.asarray((1.0 - ratio) ** 2)


def _tukey_cost(error_squared: Array, sigma: float) -> float:
    return float((1.0 - (1.0 - np.minimum(error_squared / (TUKEY * sigma) ** 2, 1.0)) ** 3).sum())


def _normal_equations(at: _Linearised, weights: Array) -> tuple[Array, Array]:
    """(dof, dof) and (dof,): einsum without BLAS, so that the bits do not depend on the number of threads."""
    slope, weighted = (a.reshape(len(at.slope), -1) for a in (at.slope, at.slope * weights))
    return np.einsum("gk,hk->gh", weighted, slope), np.einsum("gk,k->g", weighted, at.residual.ravel())


def polish(
    model: Model, transform: Array, pairs: Correspondences, *, sigma_floor: float = 0.1, max_steps: int = 30
) -> Array:
    """The transform of the model that minimises Tukey's biweight of the symmetric transfer error, from a near one.

    `pairs` are the inliers of a consensus, at least as many as fix the model; the scale of the biweight is re-estimated
    as the fit improves, and never below `sigma_floor` sigmas. Returns (3, 3) of unit norm; `transform` itself where no
    step improves it.
    """
    if not model.degrees_of_freedom:
        return transform
    norm = normalisation(pairs.src)
    damping = 1e-3
    src_velocity = velocities(model, pairs.src, norm).T
    at = _linearise(model, transform, pairs, norm, src_velocity)
    for _ in range(max_steps):
        error = at.error_squared
        if not np.isfinite(error).all():
            return transform
        sigma = robust_scale(error, sigma_floor)
        cost = _tukey_cost(error, sigma)
        normal, right = _normal_equations(at, tukey_weights(error, sigma))
        normal[np.diag_indices_from(normal)] *= 1.0 + damping
        try:
            parameters = np.asarray(np.linalg.solve(normal, right), np.float64)
        except np.linalg.LinAlgError:
            return transform
        candidate = step(model, transform, parameters, norm)
        then = _linearise(model, candidate, pairs, norm, src_velocity)
        if _tukey_cost(then.error_squared, sigma) > cost or not np.isfinite(then.error_squared).all():
            damping *= 10.0
            if damping > 1e6:
                return transform
            continue
        transform, at, damping = candidate, then, max(damping * 0.1, 1e-9)
        if np.abs(parameters).max() < _CONVERGED:
            return transform
    return transform
