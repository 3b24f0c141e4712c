"""Borders against SciPy's exact distance transform, and against what they must leave alone."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from autoalign.picture.border import BORDERS, bordered, like_bordered
from autoalign.picture.pixels import has_alpha
from autoalign.picture.warp import Warped, warp

TURN = np.array([[0.8, -0.35, 15.0], [0.4, 0.9, -4.0], [4e-4, 1e-3, 1.0]])


def drawn(dtype: type = np.uint8, channels: int | None = 3) -> Warped:
    shape = (40, 57) if channels is None else (40, 57, channels)
    values = np.random.default_rng(3).random(shape)
    image = (values * (1 if dtype == np.float32 else np.iinfo(dtype).max)).astype(dtype)
    return warp(image, (71, 58), TURN)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("channels", [None, 1, 3])
def test_transparent_is_a_channel_that_is_the_mask(dtype, channels):
    warped = drawn(dtype, channels)
    pixels = bordered(warped, "transparent")
    assert pixels.dtype == dtype
    assert pixels.shape == (58, 71, (channels or 1) + 1)
    assert np.array_equal(pixels[..., :-1], warped.pixels.reshape(58, 71, -1))
    assert set(np.unique(pixels[..., -1])) == {0, 1 if dtype == np.float32 else np.iinfo(dtype).max}
    assert np.array_equal(pixels[..., -1] > 0, warped.valid)


def test_alpha_that_is_there_stays():
    warped = drawn(channels=4)
    assert bordered(warped, "transparent") is warped.pixels
    assert not warped.pixels[~warped.valid].any()


def test_constant_is_what_the_warper_filled():
    warped = drawn()
    assert bordered(warped, "constant") is warped.pixels


@pytest.mark.parametrize("channels", [None, 1, 2, 3, 4])
def test_replicate_repeats_the_nearest_pixel(channels):
    warped = drawn(channels=channels)
    pixels = bordered(warped, "replicate")
    distance = ndimage.distance_transform_edt(~warped.valid)
    assert np.array_equal(pixels[warped.valid], warped.pixels[warped.valid])
    # A chamfer distance may choose another than the true one; it must have data, and hardly be further away.
    valid_rows, valid_columns = np.nonzero(warped.valid)
    for row, column in np.argwhere(~warped.valid)[::7]:
        same = warped.pixels[valid_rows, valid_columns] == pixels[row, column]
        places = same if same.ndim == 1 else same.all(axis=1)
        away = np.hypot(valid_rows[places] - row, valid_columns[places] - column).min()
        assert away <= 1.03 * distance[row, column] + 1e-9


def test_replicate_of_nothing_is_nothing():
    empty = Warped(pixels=np.full((4, 7), 9, np.uint8), valid=np.zeros((4, 7), bool))
    assert bordered(empty, "replicate") is empty.pixels


@pytest.mark.parametrize("border", BORDERS)
@pytest.mark.parametrize("channels", [None, 1, 2, 3, 4])
def test_what_it_will_be_like_is_known_before(border, channels):
    warped = drawn(np.uint16, channels)
    like, pixels = like_bordered(warped.pixels, border), bordered(warped, border)
    assert (like.shape, like.dtype, has_alpha(like)) == (pixels.shape, pixels.dtype, has_alpha(pixels))


def test_an_unknown_border_is_a_wrong_call():
    with pytest.raises(ValueError, match="border must be one of transparent, constant, replicate"):
        bordered(drawn(), "mirror")
