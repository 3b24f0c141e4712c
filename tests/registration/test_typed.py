"""Points that a person typed: fitted exactly, checked where there are more than needed, refused with a reason."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from autoalign.errors import AlignmentError
from autoalign.geometry.homography import apply
from autoalign.registration.alignment import AlignOptions
from autoalign.registration.typed import align_points

TRUTH = np.array([[1.1, 0.08, 20.0], [-0.05, 0.95, 12.0], [1e-4, -2e-4, 1.0]])
MOVING = np.array([[40.0, 30.0], [540.0, 60.0], [500.0, 430.0], [70.0, 400.0]])
FIXED_SIZE, MOVING_SIZE = (700, 560), (600, 480)


def typed(moving: np.ndarray = MOVING, fixed: np.ndarray | None = None, **options):
    due = apply(TRUTH, moving) if fixed is None else fixed
    return align_points(due, moving, FIXED_SIZE, MOVING_SIZE, AlignOptions(**options))


def test_four_points_give_what_cv2_gives():
    found = typed()
    oracle = cv2.getPerspectiveTransform(MOVING.astype(np.float32), apply(TRUTH, MOVING).astype(np.float32))
    assert found.status == "aligned"
    assert found.model == "homography"
    assert np.allclose(found.fixed_from_moving, TRUTH, atol=1e-9)
    assert np.allclose(found.fixed_from_moving, oracle, rtol=1e-3, atol=1e-6)  # cv2 takes them in single precision


@pytest.mark.parametrize(
    ("count", "model"), [(1, "translation"), (2, "similarity"), (3, "affine"), (4, "homography"), (7, "homography")]
)
def test_auto_takes_the_most_general_model_that_so_many_points_fix(count, model):
    moving = np.vstack([MOVING, [[300.0, 200.0], [200.0, 330.0], [420.0, 120.0]]])[:count]
    found = typed(moving)
    assert found.status == "aligned"
    assert found.model == model
    assert np.allclose(apply(found.fixed_from_moving, moving), apply(TRUTH, moving), atol=1e-6)


@pytest.mark.parametrize("model", ["translation", "rigid", "similarity", "affine", "homography"])
def test_a_chosen_model_is_kept(model):
    assert typed(model=model).model == model


@pytest.mark.parametrize(("model", "count"), [("homography", 3), ("affine", 2), ("similarity", 1), ("translation", 0)])
def test_too_few_points_for_the_model_are_rejected_and_said(model, count):
    found = typed(MOVING[:count], model=model)
    assert found.status == "rejected"
    assert str(count) in found.reason
    assert model in found.reason
    with pytest.raises(AlignmentError, match="rejected"):
        _ = found.fixed_from_moving


LINE = np.array([[10.0, 10.0], [110.3, 60.15], [210.7, 110.35], [330.1, 170.05]])  # on y = x / 2 + 5


@pytest.mark.parametrize(
    "moving",
    [LINE, np.vstack([LINE[:3], [[500.0, 30.0]]]), LINE[:3], np.repeat(MOVING[:2], 2, axis=0), MOVING[[0, 0]]],
    ids=["all on a line", "three on a line", "three for an affine", "two, twice", "one, twice"],
)
def test_points_that_fix_nothing_are_rejected_with_the_reason(moving):
    found = typed(moving)
    assert found.status == "rejected"
    assert "collinear or repeat" in found.reason
    assert found.verdict.advice
    assert found.expected_error_px is None


def test_a_mistyped_point_among_many_is_doubtful_and_the_numbers_say_so():
    moving = np.vstack([MOVING, [[300.0, 200.0], [200.0, 330.0]]])
    fixed = apply(TRUTH, moving)
    fixed[4, 0] += 90  # one wrong digit
    found = typed(moving, fixed)
    assert found.status == "doubtful"
    assert "6 typed points" in found.reason
    assert "mistyped" in found.verdict.advice
    assert found.expected_error_px is not None
    assert found.expected_error_px > 3.0


def test_points_typed_in_another_order_are_rejected():
    """Swapped neighbours cross the quadrilateral: no camera sees that."""
    found = typed(MOVING, apply(TRUTH, MOVING)[[1, 0, 2, 3]])
    assert found.status == "rejected"


def test_a_mirror_is_rejected_and_said():
    found = typed(MOVING, [700.0, 0.0] + apply(TRUTH, MOVING) * [-1.0, 1.0])
    assert found.status == "rejected"
    assert "mirrors" in found.reason


def test_points_that_a_hand_typed_are_fitted_by_least_squares():
    """A px of scatter over 30 points leaves a third of a px."""
    rng = np.random.default_rng(0)
    moving = rng.uniform((20, 20), (580, 460), (30, 2))
    found = typed(moving, apply(TRUTH, moving) + rng.normal(0, 1.0, (30, 2)))
    assert found.status == "aligned"
    assert np.linalg.norm(apply(found.fixed_from_moving, MOVING) - apply(TRUTH, MOVING), axis=1).mean() < 1.0
    assert found.expected_error_px is not None
    assert 0.5 < found.expected_error_px < 2.5  # what the points are off


@pytest.mark.parametrize(
    ("fixed", "moving", "message"),
    [
        (MOVING[:3], MOVING, "3 points in fixed, but 4 in moving"),
        (MOVING[:, :1], MOVING, r"fixed_points must have shape \(n, 2\)"),
        (MOVING, np.where(MOVING == 30, np.nan, MOVING), "moving_points holds a number that is not finite"),
    ],
)
def test_wrong_calls_are_value_errors(fixed, moving, message):
    with pytest.raises(ValueError, match=message):
        align_points(fixed, moving, FIXED_SIZE, MOVING_SIZE)
