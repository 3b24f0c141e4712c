"""Features x Features -> Matches, one to one and best first.

A match is a pair of keypoints that are each other's nearest descriptors, and nearer than the second neighbour of either
by a ratio. All distances come from one matrix product, which is exact nearest-neighbour search in both directions for
less than the price of an approximate one (and exact in every bit: see `features`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from autoalign.geometry.homography import Array
from autoalign.registration.features import Features


@dataclass(frozen=True, kw_only=True)
class MatchOptions:
    """Which pairs of descriptors count as a match."""

    ratio: float = 0.85
    """nearest over second nearest distance, at most"""
    apart: float = 0.5
    """neighbours nearer than this many keypoint diameters to the nearest one do not rival it"""

    def __post_init__(self) -> None:
        if not (0 < self.ratio <= 1 and self.apart >= 0):
            raise ValueError(f"MatchOptions out of range: {self}")


@dataclass(frozen=True, kw_only=True)
class Matches:
    """Pairs of keypoints, the most distinctive first."""

    fixed_index: NDArray[np.int64]  # (n,) into the fixed picture's features
    moving_index: NDArray[np.int64]  # (n,) into the moving picture's features
    ratio: Array  # (n,) nearest over second nearest distance, ascending

    def __len__(self) -> int:
        return len(self.ratio)


def match(fixed: Features, moving: Features, options: MatchOptions | None = None) -> Matches:
    """Mutual nearest neighbours that pass the ratio test in both directions (Lowe 2004; Mishkin's FGINN, 2015)."""
    options = options or MatchOptions()
    if fixed.detector != moving.detector:
        raise ValueError(f"features of {fixed.detector} cannot match features of {moving.detector}")
    if len(fixed) < 2 or len(moving) < 2:
        return Matches(fixed_index=np.zeros(0, np.int64), moving_index=np.zeros(0, np.int64), ratio=np.zeros(0))
    distance = _squared_distances(fixed.descriptors, moving.descriptors)
    i, j, nearest = _mutual(distance)
    rival = np.minimum(
        _second(distance[i], j, moving, options.apart), _second(distance[:, j].T, i, fixed, options.apart)
    )
    ratio = np.sqrt(nearest / np.maximum(rival, 1e-12))
    good = np.flatnonzero(ratio <= options.ratio)
    order = good[np.lexsort((i[good], ratio[good]))]
    order = order[_first_at_its_place(fixed.points[i[order]], moving.points[j[order]])]
    return Matches(fixed_index=i[order], moving_index=j[order], ratio=ratio[order].astype(np.float64))


def _squared_distances(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.float32]:
    """(n, m) squared Euclidean distances of (n, d) and (m, d)."""
    product = a @ b.T
    product *= -2
    product += (a * a).sum(1)[:, None]
    product += (b * b).sum(1)
    return np.asarray(np.maximum(product, 0, out=product))


def _mutual(distance: NDArray[np.float32]) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float32]]:
    """Rows, columns and distances of the mutual nearest neighbours."""
    column = distance.argmin(1)
    rows = np.arange(len(distance))
    nearest = distance[rows, column]
    mutual = nearest == distance.min(0)[column]
    i, j = rows[mutual], column[mutual]
    # Equal descriptors may give two rows to one column: the first keeps it.
    _, first = np.unique(j, return_index=True)
    return i[first], j[first], nearest[mutual][first]


def _second(
    distance: NDArray[np.float32], nearest: NDArray[np.int64], others: Features, apart: float
) -> NDArray[np.float32]:
    """(k,) distance of the nearest of `others` that is not the point `nearest` (k,) seen again; `distance` is (k, m).

    One point of the scene is often found twice, at two scales or with two orientations; such a twin is no rival.
    """
    distance = distance.copy()
    rows = np.arange(len(distance))
    distance[rows, nearest] = np.inf
    reach = (apart * others.sizes[nearest]) ** 2
    while True:
        second = distance.argmin(1)
        gap = ((others.points[second] - others.points[nearest]) ** 2).sum(1)
        twin = (gap < reach) & np.isfinite(distance[rows, second])
        if not twin.any():
            return np.asarray(distance[rows, second])
        distance[rows[twin], second[twin]] = np.inf


def _first_at_its_place(fixed: Array, moving: Array) -> NDArray[np.int64]:
    """Indices of the rows that do not repeat an earlier row's points in both pictures, to a tenth of a pixel."""
    key = np.rint(np.concatenate([fixed, moving], axis=1) * 10)
    return np.sort(np.unique(key, axis=0, return_index=True)[1])
