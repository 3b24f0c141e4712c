"""Covariance of a fitted transform, and the error in pixels to expect from it over an overlap.

The covariance lives in the tangent space of the model (its generators), where it has full rank for every model.
Source: Hartley and Zisserman, chapter 5 (covariance by back-propagation, equation 5.10, and forward to points).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autoalign.geometry.family import Model
from autoalign.geometry.homography import Array, invert, jacobian, normalisation, project, project_and_slope
from autoalign.geometry.least_squares import Correspondences, tukey_weights, velocities

_MEAN_OF_LENGTH = 0.886  # mean length of a 2-D normal error over its root-mean-square length: sqrt(pi) / 2
# What Tukey's weights w make of a normal 2-D error, by integration over t = error^2 / (2 sigma^2).
_VARIANCE_LEFT = 0.821  # mean of w t over the mean of w: the variance of the weighted residuals
_COVARIANCE_LEFT = 0.898  # mean of w times the variance of the fit, over that of plain least squares
_MODEL_CELLS = 6  # cells per side of the grid on which residuals are looked at for a pattern


@dataclass(frozen=True, kw_only=True)
class Uncertainty:
    """What is known of the error of a transform that was fitted to correspondences."""

    covariance: Array  # (dof, dof) of the tangent parameters, in the frame that `norm` makes of the src plane
    norm: Array  # (3, 3)
    residual_px: float  # standard deviation of one coordinate of a residual, dst px
    model_px: float  # root-mean-square systematic residual in dst px: what the model cannot follow


def uncertainty(model: Model, dst_from_src: Array, pairs: Correspondences) -> Uncertainty:
    """The uncertainty of a transform that least squares fitted to `pairs`, its inliers.

    One-way residuals are used, since those of the two directions are the same noise seen twice; their variance holds
    the noise of both pictures.
    """
    norm = normalisation(pairs.src)
    projected, by_place = project_and_slope(dst_from_src, pairs.src)
    residuals = pairs.dst - projected.T
    squared = (residuals**2).sum(1)
    sigma = max(float(np.sqrt(np.median(squared))) / 1.1774, 1e-6)
    weights = tukey_weights(squared, sigma)
    slope = np.einsum("ijn,njg->nig", by_place, velocities(model, pairs.src, norm))
    normal = np.einsum("nig,nih->gh", slope * weights[:, None, None], slope)
    freedom = max(2.0 * weights.sum() - model.degrees_of_freedom, 1.0)
    variance = float((weights * squared).sum() / freedom) / _VARIANCE_LEFT
    counted = weights > 0  # weights that fall with the residual would hide the pattern itself
    times_seen = pairs[counted].times_seen()
    pattern = _pattern(pairs.src[counted], residuals[counted], times_seen)
    # What neighbours share moves the fit as a few errors would, not as many.
    spread = times_seen * _COVARIANCE_LEFT * variance + pattern.sharing * 0.5 * pattern.px**2
    return Uncertainty(
        covariance=spread * np.linalg.pinv(normal, hermitian=True),
        norm=norm,
        residual_px=float(np.sqrt(variance)),
        model_px=pattern.px,
    )


@dataclass(frozen=True, kw_only=True)
class _Pattern:
    """The part of the residuals that neighbours share."""

    px: float  # root-mean-square of it
    sharing: float  # neighbours that share it


def _pattern(points: Array, residuals: Array, times_seen: float) -> _Pattern:
    """What neighbours share of the residuals beyond what noise alone, seen so many times, would give.

    The mean residual of a cell of a grid has the variance of the noise over its count, if there is only noise.
    """
    low, high = points.min(0), points.max(0)
    cell = np.minimum((points - low) / np.maximum(high - low, 1e-9) * _MODEL_CELLS, _MODEL_CELLS - 1).astype(int)
    index = cell[:, 1] * _MODEL_CELLS + cell[:, 0]
    cells = _MODEL_CELLS**2
    count = np.bincount(index, minlength=cells)
    mean = np.stack([np.bincount(index, r, cells) for r in residuals.T], 1) / np.maximum(count, 1)[:, None]
    full = count >= 3
    if full.sum() < 3:
        return _Pattern(px=0.0, sharing=0.0)
    within = ((residuals - mean[index]) ** 2).sum(1)
    noise = within[full[index]].sum() / (count[full].sum() - full.sum())
    excess = (mean[full] ** 2).sum(1) - times_seen * noise / count[full]
    squared = float(np.average(excess, weights=count[full]))
    return _Pattern(px=float(np.sqrt(max(squared, 0.0))), sharing=float(np.average(count[full], weights=count[full])))


def point_errors(model: Model, dst_from_src: Array, known: Uncertainty, points: Array) -> Array:
    """(n,) mean distance in dst px by which projections of src `points` (n, 2) are off, from the covariance alone."""
    slope = np.einsum("nij,njg->nig", jacobian(dst_from_src, points), velocities(model, points, known.norm))
    variance = np.einsum("nig,gh,nih->n", slope, known.covariance, slope)
    return np.asarray(_MEAN_OF_LENGTH * np.sqrt(np.maximum(variance, 0.0)))


def overlap_points(dst_from_src: Array, src_size: tuple[int, int], dst_size: tuple[int, int], count: int = 32) -> Array:
    """(n, 2) points of a grid over the src picture (w, h) that land in the dst picture; empty if none does."""
    grid = np.stack(np.meshgrid(*(np.linspace(0, s - 1, count) for s in src_size)), -1).reshape(-1, 2)
    there, w = project(dst_from_src, grid)
    inside = (w > 0) & (there >= -0.5).all(1) & (there <= np.array(dst_size) - 0.5).all(1)
    return grid[inside]


def overlap_share(dst_from_src: Array, src_size: tuple[int, int], dst_size: tuple[int, int]) -> float:
    """Share of the dst picture that the src picture covers, 0 to 1."""
    grid = overlap_points(invert(dst_from_src), dst_size, src_size)
    return len(grid) / 32**2
