"""An attempt told in other pixels: it is still the same attempt."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from exact_pairs import pair

from autoalign.geometry.homography import apply, symmetric_transfer_error_squared, translation
from autoalign.registration.align import align
from autoalign.registration.frames import in_pixels_of, unmirrored

TRUTH = np.array([[1.02, 0.05, 10.0], [-0.04, 0.98, 7.5], [1e-4, -5e-5, 1.0]])
FIXED = np.array([[3.0, 0.0, 1.0], [0.0, 3.0, -4.0], [0.0, 0.0, 1.0]])
MOVING = np.array([[0.0, -2.0, 5.0], [2.0, 0.0, 1.0], [0.0, 0.0, 1.0]])


@pytest.fixture(scope="module")
def attempt():
    views = pair("astronaut.png", TRUTH, (320, 240))
    return align(views.fixed, views.moving).best


def errors(of, pairs):
    return np.sqrt(symmetric_transfer_error_squared(of, pairs.src, pairs.dst, pairs.src_sigma, pairs.dst_sigma))


def test_errors_in_sigmas_stay(attempt):
    told = in_pixels_of(attempt, FIXED, MOVING)
    for before, after in ((attempt.pairs, told.pairs), (attempt.refinement.pairs, told.refinement.pairs)):
        expected = errors(attempt.fixed_from_moving, before)
        assert np.allclose(errors(told.fixed_from_moving, after), expected, rtol=1e-6, atol=1e-9)
    expected = errors(attempt.consensus.dst_from_src, attempt.pairs)
    assert np.allclose(errors(told.consensus.dst_from_src, told.pairs), expected, rtol=1e-6, atol=1e-9)


def test_keypoints_turn_and_grow_with_the_picture(attempt):
    told = in_pixels_of(attempt, FIXED, MOVING)
    before, after = attempt.moving_features, told.moving_features
    assert np.allclose(after.points, apply(MOVING, before.points))
    assert np.allclose(after.sizes, 2 * before.sizes)
    assert np.allclose(np.exp(1j * (after.angles - before.angles)), 1j)  # a quarter turn
    assert np.allclose(told.fixed_features.sigmas, 3 * attempt.fixed_features.sigmas)
    assert np.allclose(np.exp(1j * (told.fixed_features.angles - attempt.fixed_features.angles)), 1)


def test_unmirrored_twice_is_as_it_was(attempt):
    once = unmirrored(attempt, (320, 240))
    assert once.rung == f"{attempt.rung}, mirrored"
    assert np.allclose(once.pairs.src[:, 0], 319 - attempt.pairs.src[:, 0])
    assert np.array_equal(once.pairs.dst, attempt.pairs.dst)
    twice = unmirrored(once, (320, 240))
    assert np.allclose(twice.fixed_from_moving, attempt.fixed_from_moving)
    assert np.allclose(twice.refinement.patches.pairs.src, attempt.refinement.patches.pairs.src)


def test_what_was_not_reached_stays_none(attempt):
    bare = replace(
        attempt, consensus=None, refinement=None, fixed_from_moving=None, fixed_features=None, moving_features=None
    )
    told = in_pixels_of(bare, FIXED, translation(1, 2))
    assert told.consensus is told.refinement is told.fixed_from_moving is told.fixed_features is None
