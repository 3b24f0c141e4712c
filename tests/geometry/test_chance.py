"""The a-contrario count against binomials of the library, brute force, and what noise and truth must give."""

from __future__ import annotations

from math import comb, log10, pi

import numpy as np
import pytest

from autoalign.geometry.chance import disc_chance, first_in_each_cell, log10_false_alarms
from autoalign.geometry.homography import apply, transfer_error_squared
from autoalign.geometry.least_squares import correspondences
from autoalign.geometry.ransac import RansacOptions, ransac

SIZE = (1200, 700)
VIEW = np.array([[0.9, 0.2, 60.0], [-0.15, 1.05, 40.0], [1.5e-4, -1e-4, 1.0]])


def by_whole_numbers(chances, m):
    """NFA(k) = (n - m) C(n, k) C(k, m) alpha_k^(k - m) with exact binomials, at its least."""
    n, ordered = len(chances), sorted(chances)
    found = {
        k: log10(n - m) + log10(comb(n, k)) + log10(comb(k, m)) + (k - m) * log10(ordered[k - 1])
        for k in range(m + 1, n + 1)
    }
    best = min(found, key=found.__getitem__)
    return found[best], best


@pytest.mark.parametrize("m", [0, 1, 4])
@pytest.mark.parametrize("n", [5, 30, 400])
def test_the_count_is_the_formulas(n, m):
    chances = np.random.default_rng(n).uniform(1e-6, 1.0, n) ** 2
    expected, k = by_whole_numbers(chances.tolist(), m)
    found, found_k = log10_false_alarms(chances, m)
    assert found == pytest.approx(expected, abs=1e-9)
    assert found_k == k


def test_the_order_of_the_matches_does_not_matter():
    chances = np.random.default_rng(0).uniform(1e-6, 1.0, 50) ** 3
    assert log10_false_alarms(chances, 4) == log10_false_alarms(chances[::-1], 4)


def test_no_more_matches_than_the_sample_prove_nothing():
    for n in range(5):
        assert log10_false_alarms(np.full(n, 1e-9), 4)[0] >= 0


def test_chances_of_nought_and_one_are_allowed():
    assert log10_false_alarms(np.ones(20), 4)[0] >= 0
    found, k = log10_false_alarms(np.zeros(20), 4)
    assert np.isfinite(found)
    assert found < -1000
    assert k == 20


def chances_of(pairs, transform):
    error = np.sqrt(transfer_error_squared(transform, pairs.src, pairs.dst))
    return disc_chance(error, SIZE, 1.0)


def test_noise_gives_no_alarm_and_truth_gives_one_far_below():
    """The expected number of alarms under 10^0 is at most 1 per trial of independent transforms, and RANSAC searches
    fewer than all; that under 10^-2 at most 0.01, so that of 30 trials not one is to be expected."""
    rng = np.random.default_rng(0)
    below, far_below = 0, 0
    for _ in range(30):
        src, dst = rng.uniform(0, 1, (2, 50, 2)) * SIZE
        pairs = correspondences(src, dst)
        consensus = ransac(pairs, options=RansacOptions(max_trials=1000))
        if consensus is not None:
            found, _ = log10_false_alarms(chances_of(pairs, consensus.dst_from_src), 4)
            below += found < 0
            far_below += found < -2
    assert below <= 15
    assert far_below == 0
    for _ in range(10):
        src, dst = rng.uniform(0, 1, (2, 50, 2)) * SIZE
        dst[:20] = apply(VIEW, src[:20]) + rng.normal(0, 0.5, (20, 2))
        pairs = correspondences(src, dst)
        # 16 beyond the sample, each within about 1.5 px of 840,000: 16 x -5.1, less 47 and 4 digits of combinations.
        assert log10_false_alarms(chances_of(pairs, VIEW), 4)[0] < -40


def test_the_disc_is_a_share_of_the_picture_between_the_floor_and_all():
    chance = disc_chance(np.array([0.0, 2.0, 10.0, 1e9, np.inf]), SIZE, 2.0)
    area = SIZE[0] * SIZE[1]
    assert chance.tolist() == pytest.approx([pi * 4 / area, pi * 4 / area, pi * 100 / area, 1.0, 1.0])


def test_the_disc_is_how_often_random_points_fall_that_near():
    points = np.random.default_rng(0).uniform(0, 1, (200_000, 2)) * SIZE
    near = (np.linalg.norm(points - [600, 350], axis=1) < 50).mean()
    # Of 200,000 about 1,870 fall there, give or take 43.
    assert disc_chance(np.array([50.0]), SIZE, 1.0)[0] == pytest.approx(near, rel=4 * 43 / 1870)


def test_the_first_of_each_cell_stays():
    rng = np.random.default_rng(0)
    points = rng.uniform(-30, 60, (300, 2))
    seen, expected = set(), []
    for i, (x, y) in enumerate(points):
        if (cell := (x // 7.0, y // 7.0)) not in seen:
            seen.add(cell)
            expected.append(i)
    assert first_in_each_cell(points, 7.0).tolist() == expected
    assert first_in_each_cell(np.zeros((0, 2)), 7.0).tolist() == []
