"""How probable it is that random matches would agree as well as these do (a-contrario model).

Source: Moisan, Moulon and Monasse, Automatic homographic registration of a pair of images, with a contrario elimination
of outliers, IPOL 2012.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from autoalign.geometry.homography import Array


def log10_false_alarms(chances: Array, sample_size: int) -> tuple[float, int]:
    """log10 of the expected number of sets of random matches that agree as well, and the size of the set that says so.

    `chances` (n,) are the probabilities that a random match would lie as near to the transform as each of these; the
    transform was fixed by `sample_size` of them. Far below 0: no chance; 0 and above: what noise gives.
    NFA(k) = (n - m) C(n, k) C(k, m) alpha_k^(k - m), at its least over k.
    """
    n, m = len(chances), sample_size
    if n <= m:
        return float(n > 0), 0
    alpha = np.log10(np.clip(np.sort(chances), 1e-300, 1.0))
    log_factorial = np.concatenate([[0.0], np.cumsum(np.log10(np.arange(1, n + 1)))])
    k = np.arange(m + 1, n + 1)
    of_n = log_factorial[n] - log_factorial[k] - log_factorial[n - k]
    of_k = log_factorial[k] - log_factorial[m] - log_factorial[k - m]
    log_nfa = np.log10(n - m) + of_n + of_k + (k - m) * alpha[k - 1]
    best = int(np.argmin(log_nfa))
    return float(log_nfa[best]), int(k[best])


def disc_chance(error_px: Array, size: tuple[int, int], floor_px: float) -> Array:
    """(n,) probability that a random point of a picture of `size` (w, h) lies within `error_px` of a given one.

    Errors under `floor_px` count as that: a few matches that agree by luck to a hundredth of a pixel prove nothing.
    """
    return np.asarray(np.minimum(np.pi * np.maximum(error_px, floor_px) ** 2 / (size[0] * size[1]), 1.0))


def first_in_each_cell(points: Array, cell_px: float) -> NDArray[np.int64]:
    """Indices, ascending, of the first of the points (n, 2) in each cell of a grid.

    Repeated matches of one spot are one observation, not many; points come best first.
    """
    cells = np.floor(points / cell_px).astype(np.int64)
    return np.sort(np.unique(cells, axis=0, return_index=True)[1])
