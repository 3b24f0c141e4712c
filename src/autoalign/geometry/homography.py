"""Points through 3x3 transforms: apply, invert, transfer error, and the exact and the least-squares DLT.

Points are (n, 2) float64, (x, y); a transform acts on columns (x, y, 1) and is known up to scale. Inside the solvers it
has unit Frobenius norm, never h33 = 1 (which would lose the planes whose horizon goes through the origin), and the sign
that makes w positive at the points it was solved from. Leading axes are batches: a transform may be (..., 3, 3).

Source: Hartley and Zisserman, Multiple View Geometry, 2nd ed. (2004), chapter 4.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

IDENTITY: Array = np.eye(3)
IDENTITY.setflags(write=False)


def as_points(points: ArrayLike, name: str = "points") -> Array:
    """(n, 2) float64 copy-free view of `points`; ValueError for any other shape or a number that is not finite."""
    array = np.asarray(points, np.float64)
    if array.ndim != 2 or array.shape[1] != 2:
        raise ValueError(f"{name} must have shape (n, 2), not {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} holds a number that is not finite")
    return array


def translation(dx: float, dy: float) -> Array:
    """(3, 3) transform that moves by (dx, dy)."""
    return np.array([[1.0, 0.0, dx], [0.0, 1.0, dy], [0.0, 0.0, 1.0]])


def scaling(sx: float, sy: float) -> Array:
    """(3, 3) transform that multiplies x by sx and y by sy."""
    return np.diag([sx, sy, 1.0])


def unit(transform: Array) -> Array:
    """Scale to unit Frobenius norm; the sign is kept."""
    return np.asarray(transform / np.sqrt(np.square(transform).sum((-2, -1), keepdims=True)))


def shown(transform: Array) -> Array:
    """Scale to [2, 2] == 1, as people write it.

    Raises ValueError where [2, 2] is zero: such a transform sends the origin to infinity and has no such form.
    """
    if abs(transform[2, 2]) < 1e-12 * np.linalg.norm(transform):
        raise ValueError("this transform sends the point (0, 0) to infinity: it has no form with [2, 2] == 1")
    return np.asarray(transform / transform[2, 2])


def _entries(transform: Array) -> Array:
    """(9, ...) entries of (..., 3, 3), row by row: spelled-out formulas cost a tenth of np.cross on small batches."""
    return np.moveaxis(transform.reshape(*transform.shape[:-2], 9), -1, 0)


def adjugate(transform: Array) -> Array:
    """(..., 3, 3) adjugate, the inverse times the determinant: exact, and defined for singular matrices too."""
    a, b, c, d, e, f, g, h, i = _entries(transform)
    return np.stack(
        [
            *(e * i - f * h, c * h - b * i, b * f - c * e),
            *(f * g - d * i, a * i - c * g, c * d - a * f),
            *(d * h - e * g, b * g - a * h, a * e - b * d),
        ],
        axis=-1,
    ).reshape(transform.shape)


def determinant(transform: Array) -> Array:
    """(...) determinant; with w > 0 over a picture, its sign says whether the transform mirrors."""
    a, b, c, d, e, f, g, h, i = _entries(transform)
    return np.asarray(a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g))


def invert(transform: Array) -> Array:
    """(..., 3, 3) inverse of unit norm whose w is positive where that of `transform` is."""
    sign = np.where(determinant(transform) < 0, -1.0, 1.0)[..., None, None]
    return unit(adjugate(transform) * sign)


def _project(transform: Array, points: Array) -> tuple[Array, Array, Array]:
    """x, y, w (..., n) each of the projected points."""
    t = transform[..., None, :, :]
    x, y = points[..., 0], points[..., 1]
    # Sums spelled out, not a BLAS product: the bits must not depend on the number of threads.
    px, py, w = (t[..., i, 0] * x + t[..., i, 1] * y + t[..., i, 2] for i in range(3))
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        return px / w, py / w, w


def project(transform: Array, points: Array) -> tuple[Array, Array]:
    """Points (n, 2) through transforms (..., 3, 3): positions (..., n, 2) and their w (..., n).

    A position whose w is zero is at infinity: its numbers are inf or nan.
    """
    x, y, w = _project(transform, points)
    return np.stack([x, y], axis=-1), w


def apply(transform: Array, points: ArrayLike) -> Array:
    """(n, 2) points through one (3, 3) transform.

    Raises ValueError for a wrong shape or a point that is not finite.
    """
    transform = np.asarray(transform, np.float64)
    if transform.shape != (3, 3):
        raise ValueError(f"a transform is (3, 3), not {transform.shape}")
    return project(transform, as_points(points))[0]


def jacobian(transform: Array, points: Array) -> Array:
    """(n, 2, 2) derivative of the projected position by the position, at (n, 2) points; inf or nan where w is 0."""
    return np.asarray(project_and_slope(transform, points)[1].transpose(2, 0, 1))


def project_and_slope(transform: Array, points: Array) -> tuple[Array, Array]:
    """Points (n, 2) through one transform, as (2, n), and the derivative there as (2, 2, n), last by the position.

    Points last in memory is what makes sums over them fast.
    """
    x, y, w = _project(transform, points)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        slope = [(transform[i, j] - p * transform[2, j]) / w for i, p in ((0, x), (1, y)) for j in (0, 1)]
    return np.stack([x, y]), np.stack(slope).reshape(2, 2, -1)


def transfer_error_squared(dst_from_src: Array, src: Array, dst: Array) -> Array:
    """(..., n) squared distance, in dst pixels, of the projected src from dst; inf behind the horizon (w <= 0)."""
    x, y, w = _project(dst_from_src, src)
    with np.errstate(invalid="ignore", over="ignore"):
        return np.where(w > 0, (x - dst[..., 0]) ** 2 + (y - dst[..., 1]) ** 2, np.inf)


def symmetric_transfer_error_squared(
    dst_from_src: Array, src: Array, dst: Array, src_sigma: ArrayLike = 1.0, dst_sigma: ArrayLike = 1.0
) -> Array:
    """(..., n) mean of the squared transfer errors of both directions, each in sigmas of its own picture.

    Hartley and Zisserman, equation 4.7, halved so that it has the size of a one-way error. Behind the horizon: inf.
    """
    forward = transfer_error_squared(dst_from_src, src, dst) / np.square(dst_sigma)
    backward = transfer_error_squared(invert(dst_from_src), dst, src) / np.square(src_sigma)
    return np.asarray(0.5 * (forward + backward))


def normalisation(points: Array) -> Array:
    """(..., 3, 3) similarity that brings (..., n, 2) points to mean 0 and mean distance sqrt(2) (Hartley 1997)."""
    centre = points.mean(axis=-2)
    x, y = np.moveaxis(points - centre[..., None, :], -1, 0)
    distance = np.sqrt(x**2 + y**2).mean(axis=-1)
    scale = np.sqrt(2.0) / np.where(distance > 0, distance, 1.0)
    out = np.zeros((*points.shape[:-2], 3, 3))
    out[..., 0, 0] = out[..., 1, 1] = scale
    out[..., :2, 2] = -scale[..., None] * centre
    out[..., 2, 2] = 1.0
    return out


def _affine_apply(transform: Array, points: Array) -> Array:
    return points * transform[..., None, (0, 1), (0, 1)] + transform[..., None, :2, 2]


def turn(a: Array, b: Array, c: Array) -> Array:
    """(...) twice the signed area of triangles, corners (..., 2)."""
    u, v = b - a, c - a
    return np.asarray(u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0])


def _triple_areas(points: Array) -> Array:
    """(..., 4) turns [012], [312], [032], [013] of four points (..., 4, 2): the barycentric weights of point 3 in the
    triangle of the others are the last three over the first."""
    p0, p1, p2, p3 = np.moveaxis(points, -2, 0)
    return np.stack([turn(p0, p1, p2), turn(p3, p1, p2), turn(p0, p3, p2), turn(p0, p1, p3)], axis=-1)


def four_point(src: Array, dst: Array, min_area: float = 1e-9) -> tuple[Array, Mask]:
    """The homographies through four points each, exactly: (k, 4, 2), (k, 4, 2) -> (k, 3, 3), (k,) sound.

    The null vector of the textbook 8 x 9 system in closed form: with P = [p0 p1 p2] and m the barycentric weights of
    p3, the change of projective basis is P_dst diag(m_dst / m_src) inverse(P_src) (Hartley and Zisserman, 4.1.1; the
    basis change in Semple and Kneebone). h33 is free, so no plane is lost.

    A sample is not sound, and its matrix means nothing, where in either picture three points are collinear or two
    repeat (twice the area under `min_area`, for points of mean distance sqrt(2) from their mean), or where no camera
    could see both, because the horizon would pass between the points (the oriented constraint of Chum, Werner and
    Matas, 2004). Sound samples may mirror: then the determinant is negative.
    """
    src, dst = np.asarray(src, np.float64), np.asarray(dst, np.float64)
    transforms = np.array(np.broadcast_to(unit(IDENTITY), (*src.shape[:-2], 3, 3)))
    # Nine of ten random samples fail this, which costs least.
    sound = _seen_from_one_side(_triple_areas(src), _triple_areas(dst))
    transforms[sound], sound[sound] = _through_four(src[sound], dst[sound], min_area)
    return transforms, sound


def _seen_from_one_side(src_areas: Array, dst_areas: Array) -> Mask:
    """(...) True where the line through any two of the points has the others on the same sides in both pictures."""
    src_side, dst_side = (m[..., 1:] * m[..., :1] > 0 for m in (src_areas, dst_areas))
    return np.asarray((src_side == dst_side).all(-1), np.bool_)


def _through_four(src: Array, dst: Array, min_area: float) -> tuple[Array, Mask]:
    """The homographies (k, 3, 3), and (k,) whether no three points are nearly collinear."""
    src_norm, dst_norm = normalisation(src), normalisation(dst)
    src, dst = _affine_apply(src_norm, src), _affine_apply(dst_norm, dst)
    m_src, m_dst = _triple_areas(src), _triple_areas(dst)
    spread = ((np.abs(m_src) >= min_area) & (np.abs(m_dst) >= min_area)).all(-1)
    # diag(m_dst / m_src) without a division, and with w > 0 at the points: times the other two weights of src.
    weight = m_dst[..., 1:] * m_src[..., (2, 3, 1)] * m_src[..., (3, 1, 2)]
    weight = weight * np.sign(m_dst[..., :1] * m_src[..., 1:].prod(-1, keepdims=True))
    corners_src, corners_dst = (np.concatenate([p[:, :3], np.ones((len(p), 3, 1))], -1) for p in (src, dst))
    # The rows of the adjugate are the three lines through two corners each.
    lines = adjugate(np.swapaxes(corners_src, -1, -2))
    normalised = np.einsum("kia,kib->kab", corners_dst * weight[..., None], lines)
    normalised[~spread] = IDENTITY
    return unit(_undo_normalisation(normalised, src_norm, dst_norm)), np.asarray(spread)


def _undo_normalisation(normalised: Array, src_norm: Array, dst_norm: Array) -> Array:
    """dst_from_normalised_dst @ normalised @ normalised_src_from_src, up to scale: both are similarities that do not
    turn, which spares two products."""
    out = normalised.copy()
    out[..., :2, :] -= dst_norm[..., :2, 2:] * out[..., 2:, :]
    out[..., 2:, :] *= dst_norm[..., :1, :1]
    out[..., :, 2] += (out[..., :, :2] * src_norm[..., None, :2, 2]).sum(-1)
    out[..., :, :2] *= src_norm[..., :1, :1]
    return out


def dlt(src: ArrayLike, dst: ArrayLike, weights: ArrayLike | None = None) -> Array:
    """The homography of n >= 4 points by the normalised direct linear transform: (n, 2), (n, 2) -> (3, 3).

    Minimises the algebraic error, each point's two equations times its weight (n,). Hartley and Zisserman, algorithm
    4.2. Raises ValueError where the points do not fix a homography (too few, three of four collinear, repeated).
    """
    src, dst = as_points(src, "src"), as_points(dst, "dst")
    if len(src) != len(dst) or len(src) < 4:
        raise ValueError(f"a homography needs four or more pairs of points, not {len(src)} and {len(dst)}")
    src_norm, dst_norm = normalisation(src), normalisation(dst)
    (x, y), (u, v) = _affine_apply(src_norm, src).T, _affine_apply(dst_norm, dst).T
    zero, one = np.zeros_like(x), np.ones_like(x)
    rows = np.concatenate(
        [
            np.stack([-x, -y, -one, zero, zero, zero, u * x, u * y, u], 1),
            np.stack([zero, zero, zero, -x, -y, -one, v * x, v * y, v], 1),
        ]
    )
    if weights is not None:
        rows *= np.tile(np.asarray(weights, np.float64), 2)[:, None]
    singular, basis = np.linalg.svd(rows, full_matrices=len(src) == 4)[1:]
    normalised = basis[-1].reshape(3, 3)
    # The first where src is degenerate, the second where dst is.
    if singular[7] < 1e-9 * singular[0] or abs(determinant(normalised)) < 1e-9:
        raise ValueError("the points do not fix a homography: too many of them are collinear or repeat")
    transform = unit(_undo_normalisation(normalised, src_norm, dst_norm))
    return transform if np.median(project(transform, src)[1]) > 0 else -transform
