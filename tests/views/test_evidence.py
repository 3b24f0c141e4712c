"""What is drawn of the evidence."""

from __future__ import annotations

import numpy as np
import pytest
from recordings import Case

import autoalign as aa
from autoalign.geometry.homography import IDENTITY, translation
from autoalign.views.evidence import legible, matches_seen, outline, patch_colours, residual_histogram


def test_lines_are_chosen_from_all_over_the_picture() -> None:
    rng = np.random.default_rng(0)
    crowd = rng.random((900, 2)) * 30  # the best matches, all in one corner
    spread = rng.random((100, 2)) * (400, 300)
    points = np.concatenate([crowd, spread])
    chosen = legible(points, np.ones(1000, bool), (400, 300), 50)
    assert len(chosen) <= 50
    assert (chosen >= 900).sum() > 25
    few = np.zeros(1000, bool)
    few[[3, 5, 8]] = True
    assert legible(points, few, (400, 300), 50).tolist() == [3, 5, 8]


def test_an_outline_goes_round_the_edges() -> None:
    (line,) = outline((30, 20), translation(5, 7), (100, 80))
    np.testing.assert_allclose([line.min(0), line.max(0)], [(4.5, 6.5), (34.5, 26.5)])
    np.testing.assert_allclose(line[0], line[-1])


def test_an_outline_ends_at_the_horizon() -> None:
    tilted = np.array([[1, 0, 0], [0, 1, 0], [0, -0.1, 1.0]])  # w is 0 in row 10
    lines = outline((30, 20), tilted, (100, 80))
    assert lines
    assert all(np.isfinite(line).all() for line in lines)
    assert np.abs(np.concatenate(lines)).max() < 1000


def test_residuals_are_those_of_the_transform_that_is_shown(aligned: Case) -> None:
    seen = matches_seen(aligned.alignment, aligned.alignment.best)
    assert seen.inliers.sum() == aligned.alignment.inliers
    assert np.median(seen.residuals_px[seen.inliers]) < 2 < np.median(seen.residuals_px[~seen.inliers])
    histogram = residual_histogram(seen)
    assert histogram is not None
    assert histogram.counts.sum() == aligned.alignment.inliers
    assert histogram.middles[0] == pytest.approx(histogram.width / 2)


def test_without_a_transform_there_are_no_residuals(nothing_found: Case) -> None:
    seen = matches_seen(nothing_found.alignment, nothing_found.alignment.best)
    assert residual_histogram(seen) is None


def test_typed_points_all_count() -> None:
    points = np.array([[0, 0], [90, 0], [90, 60], [0, 60], [40, 30]])
    alignment = aa.align_points(points, points, (100, 80), (100, 80))
    seen = matches_seen(alignment, alignment.best)
    assert seen.inliers.all()
    np.testing.assert_allclose(seen.residuals_px, 0, atol=1e-6)


def test_patches_are_green_or_red() -> None:
    good, bad = patch_colours(np.array([1.0, -0.5]))
    assert good[1] > good[0]
    assert bad[0] > bad[1]


def test_identity_keeps_its_corners() -> None:
    (line,) = outline((30, 20), IDENTITY, (30, 20))
    np.testing.assert_allclose(line.max(0), (29.5, 19.5))
