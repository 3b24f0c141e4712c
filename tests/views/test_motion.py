"""Motions are held to the similarities and homographies they were made of."""

from __future__ import annotations

import math

import numpy as np
import pytest
from skimage.transform import ProjectiveTransform, SimilarityTransform

from autoalign.views.motion import motion

SIZE = (640, 401)
MIDDLE = np.array([319.5, 200.0])


@pytest.mark.parametrize(("turn", "scale"), [(0.3, 1.7), (-2.9, 0.2), (math.pi / 2, 1.0)])
def test_a_similarity_is_told_as_it_was_made(turn: float, scale: float) -> None:
    transform = SimilarityTransform(scale=scale, rotation=turn, translation=(12.5, -40.0))
    found = motion(transform.params * -3.0, SIZE)  # of any scale and sign
    assert found.turn_rad == pytest.approx(turn)
    assert found.scale == pytest.approx(scale)
    assert not found.mirrored
    np.testing.assert_allclose(found.shift_px, transform(MIDDLE)[0] - MIDDLE)


def test_a_homography_is_told_at_the_middle() -> None:
    transform = np.array([[1.1, 0.1, 5.0], [-0.2, 0.9, 30.0], [4e-4, -3e-4, 1.0]])
    found = motion(transform, SIZE)
    there = ProjectiveTransform(transform)
    steps = [(there(MIDDLE + step) - there(MIDDLE - step))[0] / 2e-4 for step in ((1e-4, 0.0), (0.0, 1e-4))]
    assert found.scale == pytest.approx(math.sqrt(np.linalg.det(np.array(steps))), rel=1e-6)
    np.testing.assert_allclose(found.shift_px, there(MIDDLE)[0] - MIDDLE)


def test_mirrors_are_told() -> None:
    found = motion(np.diag([-1.0, 1.0, 1.0]), SIZE)
    assert found.mirrored
    assert found.scale == pytest.approx(1.0)
