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

_ROWS = 512  # descriptors compared at a time


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
    j, nearest, rival, least = _nearest(fixed.descriptors, moving, options.apart)
    # Mutual: no other row is nearer to the column. Then the rivals of the few pairs that are left, the other way round.
    i = np.flatnonzero((nearest == least[j]) & (nearest <= options.ratio**2 * rival))
    i = i[np.sort(np.unique(j[i], return_index=True)[1])]  # equal descriptors: the first keeps the partner
    j, nearest, rival = j[i], nearest[i], rival[i]
    rival = np.minimum(rival, _nearest(moving.descriptors[j], fixed, options.apart)[2])
    # Where both are zero, the same descriptor is there twice: no match is less distinctive.
    ratio = np.sqrt(np.where(rival > 0, nearest / np.maximum(rival, 1e-12), 1.0))
    good = np.flatnonzero(ratio <= options.ratio)
    order = good[np.lexsort((i[good], ratio[good]))]
    order = order[_first_at_its_place(fixed.points[i[order]], moving.points[j[order]])]
    return Matches(fixed_index=i[order], moving_index=j[order], ratio=ratio[order].astype(np.float64))


def _nearest(
    descriptors: NDArray[np.float32], others: Features, apart: float
) -> tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """For each of (n, d) descriptors the nearest of the others (n,), its squared distance (n,) and that of its nearest
    rival (n,); and for each of the m others the least squared distance to any descriptor (m,)."""
    n = len(descriptors)
    index, near, rival = np.empty(n, np.int64), np.empty(n, np.float32), np.empty(n, np.float32)
    least = np.full(len(others), np.inf, np.float32)
    # |a - b|^2 = (a, |a|^2, 1) . (-2 b, 1, |b|^2): one product, every partial sum of which is exact.
    columns = np.column_stack([-2 * others.descriptors, _ones(len(others)), _lengths(others.descriptors)])
    for start in range(0, n, _ROWS):  # blocks of rows bound the memory
        rows = slice(start, start + _ROWS)
        part = descriptors[rows]
        distance = np.column_stack([part, _lengths(part), _ones(len(part))]) @ columns.T
        np.minimum(least, distance.min(0), out=least)
        index[rows] = distance.argmin(1)
        near[rows] = distance[np.arange(len(distance)), index[rows]]
        rival[rows] = _second(distance, index[rows], others, apart)
    return index, near, rival, least


def _lengths(descriptors: NDArray[np.float32]) -> NDArray[np.float32]:
    """(n,) squared Euclidean lengths of (n, d)."""
    return np.asarray((descriptors * descriptors).sum(1))


def _ones(n: int) -> NDArray[np.float32]:
    return np.ones(n, np.float32)


def _second(
    distance: NDArray[np.float32], nearest: NDArray[np.int64], others: Features, apart: float
) -> NDArray[np.float32]:
    """(n,) distance of the nearest of `others` that is not the point `nearest` (n,) seen again; spoils `distance`.

    One point of the scene is often found twice, at two scales or with two orientations; such a twin is no rival.
    """
    rows = np.arange(len(distance))
    distance[rows, nearest] = np.inf
    rival = np.empty(len(distance), np.float32)
    reach = (apart * others.sizes[nearest]) ** 2
    second = distance.argmin(1)
    while len(rows):
        rival[rows] = distance[rows, second]
        gap = ((others.points[second] - others.points[nearest[rows]]) ** 2).sum(1)
        twin = (gap < reach[rows]) & np.isfinite(rival[rows])
        rows, second = rows[twin], second[twin]
        distance[rows, second] = np.inf
        second = distance[rows].argmin(1)
    return rival


def _first_at_its_place(fixed: Array, moving: Array) -> NDArray[np.int64]:
    """Indices of the rows that do not repeat an earlier row's points in both pictures, to a tenth of a pixel."""
    key = np.rint(np.concatenate([fixed, moving], axis=1) * 10)
    return np.sort(np.unique(key, axis=0, return_index=True)[1])
