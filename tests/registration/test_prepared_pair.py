"""Two pictures prepared for every attempt: grey, finite, and where each may be used."""

from __future__ import annotations

import numpy as np
import pytest

from autoalign.registration.pair import prepare

SHAPE = (5, 7)


def ramp(dtype=np.uint8, channels: int | None = None) -> np.ndarray:
    image = np.arange(35, dtype=dtype).reshape(SHAPE)
    return image if channels is None else np.repeat(image[..., None], channels, 2)


def test_grey_pictures_of_their_own_depth_and_no_masks():
    pair = prepare(ramp(np.uint16), ramp(np.float32, 3), None, None)
    assert pair.fixed.dtype == np.uint16
    assert pair.moving.dtype == np.float32
    assert pair.fixed.shape == pair.moving.shape == SHAPE
    assert pair.fixed_8_bit.dtype == pair.moving_8_bit.dtype == np.uint8
    assert pair.masks == (None, None)
    assert pair.sizes.fixed == pair.sizes.moving == (7, 5)


def test_what_is_masked_or_transparent_or_no_number_is_not_used():
    moving = ramp(np.float32, 4)
    moving[..., 3] = 1.0
    moving[0, 0, 3] = 0.0
    moving[1, 1, 0], moving[2, 2, 1] = np.nan, np.inf
    valid = np.ones(SHAPE, bool)
    valid[3, 3] = False
    mask = prepare(ramp(), moving, None, valid).masks[1]
    assert mask is not None
    assert {tuple(at) for at in np.argwhere(~mask).tolist()} == {(0, 0), (1, 1), (2, 2), (3, 3)}


def test_no_pixel_stays_without_a_number():
    moving = ramp(np.float32)
    moving[1, 1], moving[2, 2] = np.nan, -np.inf
    before = moving.copy()
    assert np.isfinite(prepare(ramp(), moving, None, None).moving).all()
    assert np.array_equal(moving, before, equal_nan=True)  # the caller's picture is left alone


def test_a_mask_of_numbers_counts_as_one():
    fixed_valid = np.ones(SHAPE, np.uint8)
    fixed_valid[0] = 0
    mask = prepare(ramp(), ramp(), fixed_valid, None).masks[0]
    assert mask is not None
    assert mask.dtype == bool
    assert mask.sum() == 28


def test_a_mask_that_hides_nothing_is_none():
    assert prepare(ramp(), ramp(np.uint8, 4), np.ones(SHAPE, bool), None).masks[0] is None


def test_mirrored_is_left_to_right_with_its_mask_and_back_again():
    valid = np.ones(SHAPE, bool)
    valid[2, 1] = False
    pair = prepare(ramp(), ramp(), None, valid)
    mirrored = pair.mirrored()
    assert np.array_equal(mirrored.moving, ramp()[:, ::-1])
    assert np.array_equal(mirrored.moving_8_bit, ramp()[:, ::-1])
    assert mirrored.masks[1] is not None
    assert np.argwhere(~mirrored.masks[1]).tolist() == [[2, 5]]
    assert np.array_equal(mirrored.fixed, pair.fixed)
    assert np.array_equal(mirrored.mirrored().moving, pair.moving)


@pytest.mark.parametrize("name", ["fixed", "moving"])
def test_wrong_calls_name_the_picture(name):
    pictures = {"fixed": ramp(), "moving": ramp()}
    with pytest.raises(ValueError, match=name):
        prepare(**(pictures | {name: np.zeros(SHAPE)}), fixed_valid=None, moving_valid=None)
    masks = {"fixed_valid": None, "moving_valid": None, f"{name}_valid": np.ones((7, 5), bool)}
    with pytest.raises(ValueError, match=rf"{name}_valid has shape \(7, 5\)"):
        prepare(**pictures, **masks)
