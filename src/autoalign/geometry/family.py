"""The family of models: identity, translation, rigid, similarity, affine, homography, each more general than the last.

Each is a group of transforms and a subgroup of the next, so one table says all there is to know of a model: how many
points fix it, how to solve it from points, and the directions (generators of its Lie algebra) in which it can move,
which is all that least squares and uncertainty need.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from autoalign.geometry.homography import (
    IDENTITY,
    Array,
    Mask,
    as_points,
    dlt,
    four_point,
    normalisation,
    project,
    unit,
)

ModelName = Literal["identity", "translation", "rigid", "similarity", "affine", "homography"]
MODEL_NAMES: tuple[ModelName, ...] = get_args(ModelName)

_Solver = Callable[[Array, Array, Array], Array]


@dataclass(frozen=True, kw_only=True)
class Model:
    """One member of the family."""

    name: ModelName
    sample_size: int  # points that fix it
    generators: Array  # (dof, 3, 3): small moves are identity + sum of parameter x generator
    solve: _Solver  # weighted least squares: src, dst (k, n, 2), weights (k, n) -> (k, 3, 3); nan where not fixed

    @property
    def degrees_of_freedom(self) -> int:
        return len(self.generators)


def _about_means(src: Array, dst: Array, weights: Array) -> tuple[Array, Array, Array, Array, Array]:
    """Weights (k, n, 1) that sum to 1, both weighted means (k, 2), and both point sets (k, n, 2) less their means."""
    w = (weights / weights.sum(-1, keepdims=True))[..., None]
    src_mean, dst_mean = (w * src).sum(-2), (w * dst).sum(-2)
    return w, src_mean, dst_mean, src - src_mean[..., None, :], dst - dst_mean[..., None, :]


def _assemble(linear: Array, src_mean: Array, dst_mean: Array) -> Array:
    """(k, 3, 3) from linear parts (k, 2, 2) and the means (k, 2) they are taken about."""
    out = np.zeros((*linear.shape[:-2], 3, 3))
    out[..., :2, :2] = linear
    out[..., :2, 2] = dst_mean - np.einsum("...ij,...j->...i", linear, src_mean)
    out[..., 2, 2] = 1.0
    return unit(out)


def _solve_identity(src: Array, dst: Array, weights: Array) -> Array:
    return np.array(np.broadcast_to(unit(np.eye(3)), (*src.shape[:-2], 3, 3)))


def _solve_translation(src: Array, dst: Array, weights: Array) -> Array:
    _, src_mean, dst_mean, _, _ = _about_means(src, dst, weights)
    return _assemble(np.broadcast_to(np.eye(2), (*src_mean.shape, 2)), src_mean, dst_mean)


def _turn_and_scale(src: Array, dst: Array, weights: Array, keep_scale: bool) -> Array:
    """Umeyama's similarity (1991) in the plane: the complex number that takes src to dst, of modulus 1 if rigid."""
    w, src_mean, dst_mean, s, d = _about_means(src, dst, weights)
    real = (w[..., 0] * (s * d).sum(-1)).sum(-1)
    imaginary = (w[..., 0] * (s[..., 0] * d[..., 1] - s[..., 1] * d[..., 0])).sum(-1)
    size = np.hypot(real, imaginary) if keep_scale else (w[..., 0] * (s**2).sum(-1)).sum(-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = real / size, imaginary / size
    return _assemble(np.stack([np.stack([a, -b], -1), np.stack([b, a], -1)], -2), src_mean, dst_mean)


def _solve_rigid(src: Array, dst: Array, weights: Array) -> Array:
    return _turn_and_scale(src, dst, weights, keep_scale=True)


def _solve_similarity(src: Array, dst: Array, weights: Array) -> Array:
    return _turn_and_scale(src, dst, weights, keep_scale=False)


def _solve_affine(src: Array, dst: Array, weights: Array) -> Array:
    w, src_mean, dst_mean, s, d = _about_means(src, dst, weights)
    cross = np.einsum("...ni,...nj->...ij", w * d, s)
    scatter = np.einsum("...ni,...nj->...ij", w * s, s)
    inverse = np.linalg.inv(np.where(_singular(scatter), np.eye(2), scatter))
    linear = np.einsum("...ij,...jk->...ik", cross, inverse)
    return _assemble(np.where(_singular(scatter) | _singular(linear), np.nan, linear), src_mean, dst_mean)


def _singular(matrix: Array) -> Mask:
    """(..., 1, 1) True where a (..., 2, 2) matrix flattens the plane to a line, but for rounding."""
    a, b, c, d = np.moveaxis(matrix.reshape(*matrix.shape[:-2], 4), -1, 0)
    return np.asarray(np.abs(a * d - b * c) <= 1e-12 * (a**2 + b**2 + c**2 + d**2))[..., None, None]


def _solve_homography(src: Array, dst: Array, weights: Array) -> Array:
    if src.shape[-2] == 4:
        transforms, sound = four_point(src, dst)
        transforms[~sound] = np.nan
        return transforms
    return np.stack([dlt(*sample) for sample in zip(src, dst, weights, strict=True)])


def _generator(*entries: tuple[int, int, float]) -> Array:
    out = np.zeros((3, 3))
    for row, column, value in entries:
        out[row, column] = value
    return out


_MOVE_X, _MOVE_Y = _generator((0, 2, 1.0)), _generator((1, 2, 1.0))
_TURN = _generator((0, 1, -1.0), (1, 0, 1.0))
_GROW = _generator((0, 0, 1.0), (1, 1, 1.0))
_STRETCH, _SHEAR = _generator((0, 0, 1.0), (1, 1, -1.0)), _generator((0, 1, 1.0), (1, 0, 1.0))
_TILT_X, _TILT_Y = _generator((2, 0, 1.0)), _generator((2, 1, 1.0))

MODELS: dict[ModelName, Model] = {
    model.name: model
    for model in (
        Model(name="identity", sample_size=0, generators=np.zeros((0, 3, 3)), solve=_solve_identity),
        Model(name="translation", sample_size=1, generators=np.stack([_MOVE_X, _MOVE_Y]), solve=_solve_translation),
        Model(name="rigid", sample_size=2, generators=np.stack([_MOVE_X, _MOVE_Y, _TURN]), solve=_solve_rigid),
        Model(
            name="similarity",
            sample_size=2,
            generators=np.stack([_MOVE_X, _MOVE_Y, _TURN, _GROW]),
            solve=_solve_similarity,
        ),
        Model(
            name="affine",
            sample_size=3,
            generators=np.stack([_MOVE_X, _MOVE_Y, _TURN, _GROW, _STRETCH, _SHEAR]),
            solve=_solve_affine,
        ),
        Model(
            name="homography",
            sample_size=4,
            generators=np.stack([_MOVE_X, _MOVE_Y, _TURN, _GROW, _STRETCH, _SHEAR, _TILT_X, _TILT_Y]),
            solve=_solve_homography,
        ),
    )
}


def solve_samples(model: Model, src: Array, dst: Array, min_area: float = 1e-9) -> tuple[Array, Mask]:
    """A model through each of k minimal samples (k, m, 2): (k, 3, 3) and (k,) sound, False for degenerate samples."""
    if model.name == "homography":
        return four_point(src, dst, min_area)
    transforms = model.solve(src, dst, np.ones(src.shape[:-1]))
    sound = _spread(src, min_area) & _spread(dst, min_area) & np.isfinite(transforms).all((-2, -1))
    transforms[~sound] = unit(IDENTITY)
    return transforms, sound


def _spread(points: Array, min_area: float) -> Mask:
    """(k,) False where two of up to three points (k, m, 2) repeat, or three are nearly collinear, as in four_point."""
    p = points * normalisation(points)[:, :1, :1]
    if p.shape[1] < 3:
        return np.asarray((p[:, 1:] != p[:, :1]).any(-1).all(-1))
    u, v = np.moveaxis(p[:, 1:] - p[:, :1], (1, 2), (0, 1))
    return np.asarray(np.abs(u[0] * v[1] - u[1] * v[0]) >= min_area)


def fit(model: ModelName, src: ArrayLike, dst: ArrayLike, weights: ArrayLike | None = None) -> Array:
    """The model that takes (n, 2) src to (n, 2) dst with the least weighted squared error: (3, 3) of unit norm.

    For a homography the error is the algebraic one of the DLT. Raises ValueError where the points do not fix the model,
    and for a model that there is not.
    """
    src, dst = as_points(src, "src"), as_points(dst, "dst")
    if model not in MODELS:
        raise ValueError(f"{model!r} is none of the models {', '.join(MODEL_NAMES)}")
    member = MODELS[model]
    if len(src) != len(dst) or len(src) < member.sample_size:
        raise ValueError(f"{model} needs {member.sample_size} or more pairs of points, not {len(src)} and {len(dst)}")
    w = np.ones(len(src)) if weights is None else np.asarray(weights, np.float64)
    transform: Array = member.solve(src[None], dst[None], w[None])[0]
    if not np.isfinite(transform).all() or not (project(transform, src)[1] > 0).any():
        order = ", or go round in another order" if model == "homography" else ""
        raise ValueError(f"the points do not fix the model {model}: too many of them are collinear or repeat{order}")
    return transform
