"""Every style on arrays small enough to work out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from autoalign.picture.compose import STYLES, compose

FIXED = np.array([[10, 20, 30, 40]], np.uint8)
MOVING = np.array([[20, 20, 50, 60]], np.uint8)
NOT_FIRST = np.array([[False, True, True, True]])
NOT_LAST = np.array([[True, True, True, False]])


def rgb(grey, *gains):
    return np.stack([grey * gain for gain in gains], axis=-1).astype(np.uint8)


def test_mean_where_both_have_data_else_the_one_that_has():
    assert compose("mean", FIXED, MOVING, NOT_FIRST, NOT_LAST).tolist() == [[20, 20, 40, 40]]
    assert compose("mean", FIXED, MOVING).tolist() == [[15, 20, 40, 50]]


def test_what_neither_has_is_black():
    none = np.zeros((1, 4), bool)
    for style in STYLES:
        assert not compose(style, FIXED, MOVING, none, none).any()


def test_checkerboard_takes_turns_in_twelve_cells():
    fixed, moving = np.full((24, 36), 1, np.uint8), np.full((24, 36), 2, np.uint8)
    board = compose("checkerboard", fixed, moving)
    assert board[0].tolist() == [1, 1, 1, 2, 2, 2] * 6
    assert board[:, 0].tolist() == [1, 1, 1, 2, 2, 2] * 4
    assert board[3, 3] == 1


def test_checkerboard_cells_fit_the_overlap_and_the_rest_is_drawn_by_whoever_has_it():
    fixed, moving = np.full((24, 200), 1, np.uint8), np.full((24, 200), 2, np.uint8)
    columns = np.arange(200)[None].repeat(24, axis=0)
    board = compose("checkerboard", fixed, moving, columns < 124, columns >= 100)
    assert (board[:, :100] == 1).all()
    assert board[0, 100:124].tolist() == [1, 1, 2, 2] * 6
    assert (board[:, 124:] == 2).all()


def test_difference_is_brightened_at_most_four_times():
    assert compose("difference", FIXED, MOVING, NOT_FIRST, NOT_LAST).tolist() == [[0, 0, 80, 0]]
    assert compose("difference", FIXED, 200 + FIXED).tolist() == [[255, 255, 255, 255]]
    assert compose("difference", FIXED, 100 + FIXED).max() == 255


def test_red_cyan_is_grey_where_they_agree():
    same = compose("red-cyan", FIXED, FIXED)
    assert np.array_equal(same, rgb(FIXED, 1, 1, 1))
    apart = compose("red-cyan", FIXED, FIXED, NOT_FIRST, NOT_LAST)
    assert apart[0, 0].tolist() == [0, 10, 10]
    assert apart[0, 3].tolist() == [40, 0, 0]


def test_red_cyan_does_not_mind_the_exposure():
    assert np.array_equal(compose("red-cyan", FIXED, 3 * FIXED + 50), rgb(FIXED, 1, 1, 1))


def test_side_by_side():
    assert compose("side-by-side", FIXED, MOVING, NOT_FIRST).tolist() == [[0, 20, 30, 40, 20, 20, 50, 60]]


@pytest.mark.parametrize("style", sorted(STYLES))
def test_rgb_if_either_is(style):
    colour = rgb(FIXED, 1, 2, 3)
    for fixed, moving in ((colour, MOVING), (MOVING, colour), (colour, colour)):
        result = compose(style, fixed, moving)
        assert result.shape == (1, 8 if style == "side-by-side" else 4, 3)
        assert result.dtype == np.uint8
    assert compose(style, FIXED[..., None], MOVING).shape[2:] == ((3,) if style == "red-cyan" else ())


def test_alpha_hides():
    fixed = np.stack([FIXED, np.array([[0, 255, 255, 1]], np.uint8)], axis=-1)
    moving = np.concatenate([rgb(MOVING, 1, 1, 1), 255 * NOT_LAST[..., None].astype(np.uint8)], axis=-1)
    assert compose("mean", fixed, moving)[..., 0].tolist() == [[20, 20, 40, 40]]
    assert compose("mean", fixed, moving, ~NOT_FIRST)[..., 0].tolist() == [[20, 20, 50, 0]]


@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_other_depths_are_stretched_by_their_data_and_keep_their_colour(dtype):
    ramp = np.arange(0, 10_001, 10, dtype=dtype)[None]
    image = np.stack([ramp, ramp / 2, ramp / 4], axis=-1).astype(dtype)
    image[0, 0] = 60_000  # the fill
    valid = np.ones(ramp.shape, bool)
    valid[0, 0] = False
    shown = compose("side-by-side", image, image, valid, valid)[0, : ramp.size]
    assert shown[0].tolist() == [0, 0, 0]
    assert np.abs(shown[1:].astype(float) - image[0, 1:] * (255 / 10_000)).max() < 2  # the tails cost one


def test_what_is_not_finite_does_no_harm():
    image = np.linspace(0, 1, 1000, dtype=np.float32)[None].copy()
    image[0, :3] = np.nan, np.inf, -np.inf
    assert compose("mean", image, image)[0, :3].tolist() == [0, 255, 0]
    assert not compose("mean", image * np.float32("nan"), image * np.float32("nan")).any()


def test_inputs_are_left_alone():
    fixed, moving = FIXED.copy(), MOVING.copy()
    for style in STYLES:
        compose(style, fixed, moving, NOT_FIRST, NOT_LAST)
    assert np.array_equal(fixed, FIXED)
    assert np.array_equal(moving, MOVING)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (("blink", FIXED, MOVING), "style must be one of mean, checkerboard, difference, red-cyan, side-by-side"),
        (("mean", FIXED, MOVING.T), "one frame"),
        (("mean", FIXED, MOVING, NOT_FIRST.T), "mask"),
        (("mean", FIXED.astype(int), MOVING), "fixed must be"),
    ],
)
def test_wrong_calls_say_what_is_wrong(call, message):
    with pytest.raises(ValueError, match=message):
        compose(*call)
