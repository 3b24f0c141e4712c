"""A picture prepared for every attempt and every partner: grey, finite, where it may be used, its features."""

from __future__ import annotations

import numpy as np
import pytest

from autoalign.registration.align import align
from autoalign.registration.features import FeatureOptions, detect
from autoalign.registration.prepared import Pair, prepare

SHAPE = (5, 7)


def ramp(dtype=np.uint8, channels: int | None = None) -> np.ndarray:
    image = np.arange(35, dtype=dtype).reshape(SHAPE)
    return image if channels is None else np.repeat(image[..., None], channels, 2)


def noise(shape=(120, 170), seed=0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, shape, np.uint8)


@pytest.mark.parametrize(("dtype", "channels"), [(np.uint8, None), (np.uint16, None), (np.float32, 3), (np.uint8, 4)])
def test_grey_of_its_own_depth_and_no_mask(dtype, channels):
    opaque = ramp(dtype, channels)
    if channels == 4:
        opaque[..., 3] = 255
    prepared = prepare(opaque)
    assert prepared.grey.dtype == dtype
    assert prepared.grey.shape == prepared.grey_8_bit.shape == SHAPE
    assert prepared.grey_8_bit.dtype == np.uint8
    assert prepared.usable is None
    assert prepared.size == (7, 5)


def test_what_is_masked_or_transparent_or_no_number_is_not_used():
    picture = ramp(np.float32, 4)
    picture[..., 3] = 1.0
    picture[0, 0, 3] = 0.0
    picture[1, 1, 0], picture[2, 2, 1] = np.nan, np.inf
    valid = np.ones(SHAPE, bool)
    valid[3, 3] = False
    usable = prepare(picture, valid).usable
    assert usable is not None
    assert {tuple(at) for at in np.argwhere(~usable).tolist()} == {(0, 0), (1, 1), (2, 2), (3, 3)}


def test_no_pixel_stays_without_a_number():
    picture = ramp(np.float32)
    picture[1, 1], picture[2, 2] = np.nan, -np.inf
    before = picture.copy()
    assert np.isfinite(prepare(picture).grey).all()
    assert np.array_equal(picture, before, equal_nan=True)  # the caller's picture is left alone


def test_a_mask_of_numbers_counts_as_one():
    valid = np.ones(SHAPE, np.uint8)
    valid[0] = 0
    usable = prepare(ramp(), valid).usable
    assert usable is not None
    assert usable.dtype == bool
    assert usable.sum() == 28


def test_a_mask_that_hides_nothing_is_none():
    assert prepare(ramp(), np.ones(SHAPE, bool)).usable is None


def test_mirrored_is_left_to_right_with_its_mask_and_back_again():
    valid = np.ones(SHAPE, bool)
    valid[2, 1] = False
    pair = Pair(fixed=prepare(ramp()), moving=prepare(ramp(), valid))
    mirrored = pair.mirrored()
    assert np.array_equal(mirrored.moving.grey, ramp()[:, ::-1])
    assert np.array_equal(mirrored.moving.grey_8_bit, ramp()[:, ::-1])
    assert mirrored.masks[1] is not None
    assert np.argwhere(~mirrored.masks[1]).tolist() == [[2, 5]]
    assert mirrored.fixed is pair.fixed
    assert np.array_equal(mirrored.mirrored().moving.grey, pair.moving.grey)


@pytest.mark.parametrize("name", ["fixed", "moving"])
def test_wrong_calls_name_the_picture(name):
    pictures = {"fixed": ramp(), "moving": ramp()}
    with pytest.raises(ValueError, match=name):
        align(**(pictures | {name: np.zeros(SHAPE)}))
    mask = {f"{name}_valid": np.ones((7, 5), bool)}
    with pytest.raises(ValueError, match=rf"{name}_valid has shape \(7, 5\)"):
        align(**pictures, **mask)
    with pytest.raises(ValueError, match=f"{name}_valid is given beside a picture that is prepared"):
        align(**(pictures | {name: prepare(ramp())}), **{f"{name}_valid": np.ones(SHAPE, bool)})


def test_features_are_found_once_and_are_those_of_detect():
    asked = []

    def recall(options, find):
        asked.append(options)
        return find()

    prepared, options = prepare(noise(), recall=recall), FeatureOptions(detector="orb")
    first = prepared.features(options)
    assert prepared.features(FeatureOptions(detector="orb")) is first
    assert asked == [options]
    expected = detect(noise(), options)
    assert len(first) == len(expected) > 100
    assert np.array_equal(first.descriptors, expected.descriptors)
    assert prepared.nbytes > noise().nbytes + first.descriptors.nbytes - 1


def test_a_prepared_picture_aligns_as_its_pixels_do():
    fixed, moving = noise((150, 210)), noise((150, 210))[10:, 7:]
    still = prepare(fixed)
    ready, plain = align(still, prepare(moving)), align(fixed, moving)
    assert ready.status == plain.status == "aligned"
    assert np.array_equal(ready.fixed_from_moving, plain.fixed_from_moving)
    assert ready.fixed_size == (210, 150)
    again = align(still, moving)  # with what is known of the fixed picture already
    assert np.array_equal(again.fixed_from_moving, plain.fixed_from_moving)
