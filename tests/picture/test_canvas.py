"""Frames worked out by hand, and the frames that must be refused or cropped."""

from __future__ import annotations

import numpy as np
import pytest

from autoalign.errors import CanvasError
from autoalign.geometry.homography import apply, translation
from autoalign.picture.canvas import canvas, largest_inner_box, plane_canvas
from autoalign.picture.warp import valid_mask, valid_runs, warp

# A picture of a floor, 600 x 400, horizon at row 100, looked at from 2 m above: the world is in metres, y towards us.
FLOOR = np.array([[1.0, 0.0, -300.0], [0.0, 0.0, -500.0], [0.0, 0.005, -0.5]])
SIZE = (600, 400)
NEAR = (300.0, 300.0)


def test_fixed_is_the_fixed_pictures_own_frame():
    frame = canvas("fixed", (50, 30), (70, 90), translation(1000, 0))
    assert frame.size == (50, 30)
    assert np.array_equal(frame.canvas_from_fixed, np.eye(3))


@pytest.mark.parametrize(
    ("kind", "shift", "size", "offset"),
    [
        ("union", (0, 0), (70, 90), (0, 0)),
        ("union", (-10, 5), (70, 95), (10, 0)),
        ("union", (-10.25, 5.25), (71, 96), (11, 0)),
        ("union", (100, -20), (170, 90), (0, 20)),
        ("moving", (100, -20), (70, 90), (-100, 20)),
        ("moving", (0.5, -0.5), (71, 91), (0, 1)),
    ],
)
def test_bounds_of_a_shift(kind, shift, size, offset):
    frame = canvas(kind, (50, 30), (70, 90), -2 * translation(*shift))
    assert frame.size == size
    assert np.array_equal(frame.canvas_from_fixed, translation(*offset))


def test_a_turned_picture_fits_to_the_pixel():
    quarter = np.array([[0.0, 1, 0], [-1, 0, 69], [0, 0, 1]])
    frame = canvas("moving", (50, 30), (70, 90), quarter)
    assert frame.size == (90, 70)
    moving = np.full((90, 70), 9, np.uint8)
    assert warp(moving, frame.size, frame.canvas_from_fixed @ quarter).valid.all()


def test_fixed_pixels_are_copied_into_the_union():
    fixed = np.random.default_rng(1).integers(0, 256, (30, 50, 3), np.uint8)
    frame = canvas("union", (50, 30), (70, 90), translation(-10.3, -7.7))
    drawn = warp(fixed, frame.size, frame.canvas_from_fixed)
    assert np.array_equal(drawn.pixels[8 : 8 + 30, 11 : 11 + 50], fixed)
    assert drawn.valid.sum() == 30 * 50


@pytest.mark.parametrize("kind", ["union", "moving"])
def test_a_horizon_across_the_moving_picture_is_refused(kind):
    with pytest.raises(CanvasError, match="horizon crosses the moving picture"):
        canvas(kind, SIZE, SIZE, FLOOR)
    assert canvas("fixed", SIZE, SIZE, FLOOR).size == SIZE


def test_too_many_pixels_are_refused_with_their_number():
    with pytest.raises(CanvasError, match=r"100050 x 1030 = 103,051,500 pixels; 16,000,000 are allowed"):
        canvas("union", (50, 30), (50, 30), translation(100_000, 1000))
    with pytest.raises(CanvasError, match=r"1,499 are allowed"):
        canvas("fixed", (50, 30), (50, 30), np.eye(3), max_pixels=1_499)
    assert canvas("union", (4000, 3000), (4000, 3000), translation(4000, 3000)).size == (8000, 6000)


def test_an_unknown_kind_is_a_wrong_call():
    with pytest.raises(ValueError, match="kind must be one of fixed, union, intersection, inner, moving, not 'both'"):
        canvas("both", (5, 3), (5, 3), np.eye(3))


def random_overlap(seed):
    """A fixed size, a moving size and a tilted view that lies across the fixed picture's rim, now and then a sliver."""
    rng = np.random.default_rng(seed)
    fixed_size, moving_size = tuple(rng.integers(5, 30, 2).tolist()), tuple(rng.integers(2, 30, 2).tolist())
    turn = rng.uniform(-np.pi, np.pi)
    linear = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]) * rng.uniform(0.3, 1.5)
    transform = np.eye(3)
    transform[:2, :2] = linear
    transform[:2, 2] = np.array(fixed_size) * rng.uniform(-0.2, 1.0, 2)
    transform[2, :2] = rng.uniform(-0.02, 0.02, 2)
    return fixed_size, moving_size, transform


def largest_box_by_trying_all(mask):
    """Area of the largest box in which all of a mask (h, w) is True."""
    sums = np.pad(mask.astype(int).cumsum(0).cumsum(1), ((1, 0), (1, 0)))
    best = 0
    for y0 in range(mask.shape[0]):
        for x0 in range(mask.shape[1]):
            filled = sums[y0 + 1 :, x0 + 1 :] - sums[y0, x0 + 1 :] - sums[y0 + 1 :, x0][:, None] + sums[y0, x0]
            areas = np.outer(np.arange(1, mask.shape[0] - y0 + 1), np.arange(1, mask.shape[1] - x0 + 1))
            best = max(best, int(areas[filled == areas].max(initial=0)))
    return best


@pytest.mark.parametrize("seed", range(60))
def test_the_overlap_and_the_largest_box_within_it(seed):
    fixed_size, moving_size, transform = random_overlap(seed)
    mask = valid_mask(moving_size, fixed_size, transform)
    if not mask.any():
        for kind in ("intersection", "inner"):
            with pytest.raises(CanvasError, match="do not overlap"):
                canvas(kind, fixed_size, moving_size, transform)
        return
    around = canvas("intersection", fixed_size, moving_size, transform)
    seen = valid_mask(moving_size, around.size, around.canvas_from_fixed @ transform)
    assert seen.sum() == mask.sum()
    assert seen.any(axis=0)[[0, -1]].all()
    assert seen.any(axis=1)[[0, -1]].all()
    within = canvas("inner", fixed_size, moving_size, transform)
    assert valid_mask(moving_size, within.size, within.canvas_from_fixed @ transform).all()
    assert within.size[0] * within.size[1] == largest_box_by_trying_all(mask)


def test_the_largest_box_of_a_large_square_on_its_corner_has_half_its_area():
    half = 3000
    diamond = np.array([[1.0, -1.0, half], [1.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    x0, y0, x1, y1 = largest_inner_box(*valid_runs((half + 1, half + 1), (2 * half + 1, 2 * half + 1), diamond))
    assert (x1 - x0) * (y1 - y0) == (half + 1) * (half + 1)


def test_a_plane_keeps_the_pictures_width():
    metres = np.array([[0.02, 0.0, 7.0], [0.0, 0.02, -3.0], [0.0, 0.0, 1.0]])
    frame = plane_canvas(SIZE, -metres)
    assert frame.size == SIZE
    assert frame.cropped is None
    assert np.allclose(frame.canvas_from_image / frame.canvas_from_image[2, 2], np.eye(3), atol=1e-9)
    assert frame.canvas_from_world[0, 0] == pytest.approx(50)
    assert np.allclose(apply(frame.canvas_from_world, [[7.0, -3.0]]), 0, atol=1e-9)


def test_a_plane_to_a_scale():
    metres = np.array([[0.02, 0.0, 7.0], [0.0, 0.02, -3.0], [0.0, 0.0, 1.0]])
    frame = plane_canvas(SIZE, metres, scale=25)
    assert frame.size == (300, 200)
    # The picture's upper left edge, not the centre of its first pixel, is the canvas's.
    assert np.allclose(apply(frame.canvas_from_image, [[-0.5, -0.5]]), -0.5)


def test_far_ground_is_cropped_before_the_horizon():
    frame = plane_canvas(SIZE, FLOOR, anchor=NEAR)
    # The horizon is at row 100, the anchor 200 rows below it: four times as far is 50 rows below.
    assert frame.cropped == (
        "38% of the picture left out: beyond the horizon or over 4 times as far as its point (300, 300)"
    )
    assert frame.size[0] == SIZE[0]
    x, y = apply(frame.canvas_from_image, [[300.0, 150.0]])[0]
    assert y == pytest.approx(-0.5)
    assert x == pytest.approx(frame.size[0] / 2, abs=2)
    bottom = apply(frame.canvas_from_image, [[300.0, 399.5]])[0][1]
    assert bottom == pytest.approx(frame.size[1] - 0.5, abs=1)


def test_cropping_less_makes_more_room():
    near, far = (plane_canvas(SIZE, FLOOR, 0.5, anchor=NEAR, max_distance=n) for n in (2, 8))
    assert far.size[0] == pytest.approx(4 * near.size[0], rel=0.01)


def test_what_is_drawn_is_on_the_anchors_side():
    image = np.zeros((400, 600), np.uint8)
    image[:90] = 255  # the sky
    frame = plane_canvas(SIZE, -FLOOR, anchor=NEAR)
    drawn = warp(image, frame.size, frame.canvas_from_image, anchor=frame.anchor)
    assert drawn.valid.any()
    assert not drawn.pixels.any()


def test_anchor_below_a_horizon_that_is_below_the_middle():
    low = FLOOR @ translation(0, -200)  # horizon at row 300
    frame = plane_canvas(SIZE, low, anchor=(300, 390))
    image = np.full((400, 600), 7, np.uint8)
    image[:290] = 255
    drawn = warp(image, frame.size, frame.canvas_from_image, anchor=frame.anchor)
    assert set(np.unique(drawn.pixels[drawn.valid])) == {7}


def test_without_cropping_the_horizon_is_refused():
    with pytest.raises(CanvasError, match="horizon crosses the picture"):
        plane_canvas(SIZE, FLOOR, anchor=NEAR, crop=False)
    lower = FLOOR @ translation(0, 101)  # the whole picture is ground now, to 2 rows below the horizon
    assert plane_canvas(SIZE, lower, crop=False).cropped is None
    assert "horizon" not in str(plane_canvas(SIZE, lower).cropped)


def test_a_plane_never_has_more_pixels_than_allowed():
    sliver = np.diag([1e-6, 1.0, 1.0])
    frame = plane_canvas(SIZE, sliver, max_pixels=100_000)
    assert frame.size[0] * frame.size[1] <= 100_000
    with pytest.raises(CanvasError, match="are allowed"):
        plane_canvas(SIZE, np.eye(3), scale=1000)


def test_an_anchor_on_the_horizon_is_refused():
    with pytest.raises(CanvasError, match="goes through the point"):
        plane_canvas(SIZE, FLOOR, anchor=(300, 100))


def test_a_flat_transform_is_a_wrong_call():
    with pytest.raises(ValueError, match="regular"):
        plane_canvas(SIZE, np.diag([1.0, 0.0, 1.0]))


@pytest.mark.parametrize("wrong", [{"scale": 0}, {"scale": np.inf}, {"max_distance": 1}, {"anchor": (600, 3)}])
def test_wrong_calls(wrong):
    with pytest.raises(ValueError, match="must"):
        plane_canvas(SIZE, np.eye(3), **wrong)
