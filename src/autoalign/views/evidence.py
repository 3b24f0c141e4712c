"""What of the evidence is drawn: residuals, colours, a legible choice of matches, outlines. All in full pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from autoalign.files.row import RowStatus
from autoalign.geometry.chance import first_in_each_cell
from autoalign.geometry.homography import Array, project
from autoalign.registration.alignment import Alignment, Attempt

Colours = NDArray[np.uint8]  # (n, 3)

LINES = 120  # more cannot be told apart
REJECTED_LINES = 40  # of matches that do not agree, where others do
BINS = 40
STATUS_COLOUR: dict[RowStatus, tuple[int, int, int]] = {
    "aligned": (63, 201, 107),
    "doubtful": (245, 180, 40),
    "rejected": (240, 70, 60),
    "failed": (167, 139, 230),
}
_GREEN_TO_RED = np.array([(63, 201, 107), (235, 215, 50), (240, 70, 60)], np.float64)
_GREEN_TO_ORANGE = np.array([(63, 201, 107), (215, 220, 60), (255, 150, 30)], np.float64)  # red is for what is rejected
_POOR, _GOOD = 0.2, 0.95  # correlations of patches that are drawn red and green
_EDGE_STEPS = 48
_FAR = 8.0  # picture sides that an outline may leave the picture by


@dataclass(frozen=True, kw_only=True)
class MatchesSeen:
    """The matches of one attempt, and how far each is off."""

    moving: Array  # (n, 2) px of the moving picture, best first
    fixed: Array  # (n, 2) px of the fixed picture
    landed: Array  # (n, 2) where the transform takes the moving point, px of the fixed picture; nan without one
    inliers: NDArray[np.bool_]  # (n,)
    residuals_px: Array  # (n,) distance from fixed to landed; nan without a transform, inf beyond the horizon
    colours: Colours  # (n, 3) green over yellow to orange by residual
    limit_px: float  # the residual that is drawn orange: about what an inlier may have

    def __len__(self) -> int:
        return len(self.fixed)


@dataclass(frozen=True, kw_only=True)
class Histogram:
    """Counts (n,) in bins of equal width around `middles` (n,)."""

    counts: NDArray[np.int64]
    middles: Array
    width: float


def matches_seen(alignment: Alignment, attempt: Attempt) -> MatchesSeen:
    """The matches of an attempt under its own transform; typed points all count as inliers."""
    pairs, consensus = attempt.pairs, attempt.consensus
    transform = attempt.fixed_from_moving
    landed = np.full((len(pairs), 2), np.nan)
    residuals = np.full(len(pairs), np.nan)
    if transform is not None:
        landed, w = project(transform, pairs.src)
        with np.errstate(invalid="ignore"):
            residuals = np.where(w > 0, np.linalg.norm(landed - pairs.dst, axis=1), np.inf)
    typed = attempt.fixed_features is None and transform is not None
    inliers = consensus.inliers if consensus is not None else np.full(len(pairs), typed)
    sigma = float(np.median(pairs.dst_sigma)) if len(pairs) else 1.0
    limit_px = alignment.options.ransac.threshold * sigma
    return MatchesSeen(
        moving=pairs.src,
        fixed=pairs.dst,
        landed=landed,
        inliers=inliers,
        residuals_px=residuals,
        colours=_between(_GREEN_TO_ORANGE, np.nan_to_num(residuals / limit_px, nan=1.0, posinf=1.0)),
        limit_px=limit_px,
    )


def _between(colours: Array, share: Array) -> Colours:
    """(n, 3) from the first of three colours at 0 over the second to the third at 1 and beyond."""
    return np.stack([np.interp(share, (0.0, 0.5, 1.0), channel) for channel in colours.T], 1).astype(np.uint8)


def patch_colours(correlation: Array) -> Colours:
    """(n, 3) green where patches of both pictures look alike, red where they do not."""
    return _between(_GREEN_TO_RED, (_GOOD - correlation) / (_GOOD - _POOR))


def legible(points: Array, chosen: NDArray[np.bool_], size: tuple[int, int], count: int) -> NDArray[np.int64]:
    """Indices of at most `count` of the chosen points (n, 2), the best of each part of the picture of `size` (w, h)."""
    index = np.flatnonzero(chosen)
    if len(index) <= count:
        return index
    return index[first_in_each_cell(points[index], (size[0] * size[1] / count) ** 0.5)][:count]


def outline(size: tuple[int, int], dst_from_src: Array, dst_size: tuple[int, int]) -> list[Array]:
    """The edges of a picture of `size` (w, h) where a transform takes them, as open lines (k, 2) in dst pixels.

    What lies beyond the horizon, or absurdly far from the dst picture, is left out. 0.5: edges, not centres, of the
    corner pixels.
    """
    right, bottom = size[0] - 0.5, size[1] - 0.5
    corners = np.array([[-0.5, -0.5], [right, -0.5], [right, bottom], [-0.5, bottom], [-0.5, -0.5]])
    along = np.linspace(0.0, 4.0, 4 * _EDGE_STEPS + 1)
    border = np.stack([np.interp(along, np.arange(5), corners[:, axis]) for axis in (0, 1)], 1)
    there, w = project(dst_from_src, border)
    with np.errstate(invalid="ignore"):
        near = (w > 0) & (np.abs(there) < _FAR * max(dst_size)).all(1)
    runs = np.split(np.arange(len(border)), np.flatnonzero(np.diff(near)) + 1)
    return [there[run] for run in runs if near[run[0]] and len(run) > 1]


def residual_histogram(seen: MatchesSeen) -> Histogram | None:
    """Of the inliers' residuals; None where there are none."""
    residuals = seen.residuals_px[seen.inliers]
    residuals = residuals[np.isfinite(residuals)]
    if not len(residuals):
        return None
    # A few stragglers would press all others into one bar: they are counted in the last one.
    top = max(min(float(residuals.max()), 4.0 * float(np.percentile(residuals, 90))), 1e-3)
    counts, edges = np.histogram(np.minimum(residuals, top), BINS, (0.0, top))
    return Histogram(counts=counts, middles=(edges[1:] + edges[:-1]) / 2, width=top / BINS)
