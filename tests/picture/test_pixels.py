"""What a picture is, and where its pixels go when it gets smaller."""

from __future__ import annotations

import numpy as np
import pytest

from autoalign.geometry.homography import apply, invert
from autoalign.picture import pixels as pixels_module
from autoalign.picture.pixels import (
    check_picture,
    grey,
    halve,
    has_alpha,
    in_colour,
    opaque,
    resize_map,
    shrink,
    size_of,
    to_8_bit,
    working_copy,
)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("shape", [(3, 5), (3, 5, 1), (3, 5, 2), (3, 5, 3), (3, 5, 4)])
def test_what_a_picture_is(dtype, shape):
    image = np.ones(shape, dtype)
    check_picture(image)
    assert size_of(image) == (5, 3)
    assert has_alpha(image) == (shape[2:] in ((2,), (4,)))
    assert grey(image).shape == (3, 5)
    assert grey(image).dtype == dtype


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((3, 5)), "not float64"),
        ([[1, 2]], "not <class 'list'>"),
        (np.zeros((3, 5, 5), np.uint8), r"not \(3, 5, 5\)"),
        (np.zeros(5, np.uint8), r"not \(5,\)"),
        (np.zeros((0, 5), np.uint8), "no pixels"),
    ],
)
def test_what_it_is_not(image, message):
    with pytest.raises(ValueError, match=f"mine .*{message}"):
        check_picture(image, "mine")


def test_opaque_is_where_alpha_is_not_zero():
    image = np.zeros((1, 3, 4), np.uint16)
    image[0, :, 3] = 0, 1, 65535
    assert opaque(image).tolist() == [[False, True, True]]
    assert opaque(image[..., :3]) is None


@pytest.mark.parametrize(("dtype", "most"), [(np.uint8, 200), (np.uint16, 60_000), (np.float32, 0.8)])
def test_grey_is_the_luminance_of_bt_601(dtype, most):
    for channel, weight in enumerate((0.299, 0.587, 0.114)):
        image = np.zeros((2, 3, 4), dtype)
        image[..., channel] = most
        assert np.allclose(grey(image), weight * most, rtol=1e-4, atol=0 if dtype == np.float32 else 0.51)


def test_grey_of_grey_with_alpha_is_the_grey():
    image = np.arange(12, dtype=np.uint8).reshape(2, 3, 2)
    assert np.array_equal(grey(image), image[..., 0])


def test_8_bit_stays_8_bit():
    image = np.arange(12, dtype=np.uint8).reshape(3, 4)
    assert to_8_bit(image) is image


@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_other_depths_are_stretched_between_percentiles(dtype):
    image = np.arange(1000, 11_000, dtype=dtype).reshape(100, 100)
    image[0, 0], image[-1, -1] = 0, 60_000  # outliers must not decide
    stretched = to_8_bit(image)
    assert stretched.dtype == np.uint8
    assert stretched[0, 0] == stretched[0, 5] == 0
    assert stretched[-1, -1] == stretched[-1, -5] == 255
    assert abs(int(stretched[50, 0]) - 127.5) <= 1


def test_what_is_not_finite_is_dark_and_a_flat_picture_no_trouble():
    image = np.linspace(0, 1, 10_000, dtype=np.float32).reshape(100, 100)
    image[5, 5:8] = np.nan, np.inf, -np.inf
    assert to_8_bit(image)[5, 5:8].tolist() == [0, 0, 0]
    assert not to_8_bit(np.full((3, 4), 7, np.uint16)).any()


def test_resize_map_takes_edges_to_edges():
    full_from_small = resize_map((600, 400), (150, 80))
    assert np.allclose(apply(full_from_small, [[-0.5, -0.5], [149.5, 79.5]]), [[-0.5, -0.5], [599.5, 399.5]])


def test_shrink_leaves_a_small_picture_alone():
    image = np.zeros((30, 50), np.uint8)
    shrunken = shrink(image, 1500)
    assert shrunken.pixels is image
    assert np.array_equal(shrunken.full_from_small, np.eye(3))


@pytest.mark.parametrize("max_pixels", [40_000, 25_000, 7_777])
def test_shrink_says_exactly_where_its_pixels_are(max_pixels):
    """The centre of mass of a blob is where the map says, to a hundredth of a pixel of the full picture."""
    x, y = np.meshgrid(np.arange(400), np.arange(300))
    blob = np.exp(-((x - 211.3) ** 2 + (y - 97.6) ** 2) / (2 * 20**2))
    shrunken = shrink(np.rint(255 * blob).astype(np.uint8), max_pixels)
    w, h = size_of(shrunken.pixels)
    assert w * h == pytest.approx(max_pixels, rel=0.02)
    mass = shrunken.pixels.astype(float)
    sx, sy = np.meshgrid(np.arange(w), np.arange(h))
    centre = np.array([[(sx * mass).sum(), (sy * mass).sum()]]) / mass.sum()
    assert np.allclose(centre, apply(invert(shrunken.full_from_small), [[211.3, 97.6]]), atol=0.01)


@pytest.mark.parametrize("size", [(5000, 1), (1, 5000)])
def test_shrink_never_loses_a_side(size):
    shrunken = shrink(np.full(size[::-1], 9, np.uint8), 100)
    assert min(size_of(shrunken.pixels)) == 1
    assert (shrunken.pixels == 9).all()


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_in_colour_keeps_alpha_and_its_grey(channels):
    image = np.random.default_rng(1).integers(0, 256, (5, 7, channels), np.uint8)
    coloured = in_colour(image[..., 0] if channels == 1 else image)
    assert coloured.shape == (5, 7, 4 if channels in (2, 4) else 3)
    np.testing.assert_array_equal(coloured[..., :3], image[..., :3] if channels > 2 else image[..., :1].repeat(3, 2))
    np.testing.assert_array_equal(coloured[..., 3:], image[..., 1:2] if channels == 2 else image[..., 3:])


@pytest.mark.parametrize("strip_pixels", [1, 40_000, 1 << 24])
@pytest.mark.parametrize("channels", [(), (3,)])
def test_a_working_copy_is_the_mean_of_whole_squares(monkeypatch, strip_pixels, channels):
    monkeypatch.setattr(pixels_module, "STRIP_PIXELS", strip_pixels)
    image = np.random.default_rng(4).random((211, 317, *channels), np.float32)
    copy = working_copy(image, 211 * 317 / 20)  # sides 5 times smaller: 42 and 63, and a rest
    expected = image[:210, :315].reshape(42, 5, 63, 5, *channels).mean((1, 3))
    assert np.allclose(copy.pixels, expected, atol=1e-6)
    assert np.allclose(apply(copy.full_from_small, [[0.0, 0.0], [62.0, 41.0]]), [[2.0, 2.0], [312.0, 207.0]])


def test_a_working_copy_of_a_small_picture_is_the_picture():
    image = np.random.default_rng(4).integers(0, 256, (21, 31, 3), np.uint8)
    copy = working_copy(image, 1e6)
    assert np.array_equal(copy.pixels, image)
    assert np.array_equal(copy.full_from_small, np.eye(3))
    assert working_copy(np.zeros((2, 1000), np.uint8), 10).pixels.shape == (1, 500)


def test_a_source_is_asked_for_every_pixel_once():
    image = np.random.default_rng(4).integers(0, 256, (300, 401), np.uint8)
    asked = np.zeros(image.shape, int)

    class Source:
        shape, dtype = image.shape, image.dtype

        def __getitem__(self, box):
            asked[box] += 1
            return image[box]

    working_copy(Source(), 5_000)
    assert (asked[:300, :400] == 1).all()


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("size", [(8, 6), (9, 7), (1, 6), (9, 1), (1, 1)])
def test_halve_is_the_mean_of_two_by_two_where_it_says(size, dtype):
    """A ramp tells where a mean was taken; a lone row or column stands for two."""
    x, y = np.meshgrid(*(np.arange(s) for s in size))
    half = halve((4 * x + 20 * y).astype(dtype))
    w, h = size_of(half.pixels)
    assert half.pixels.dtype == dtype
    assert (w, h) == tuple(max(s // 2, 1) for s in size)
    columns, rows = np.meshgrid(np.arange(w), np.arange(h))
    there = apply(half.full_from_small, np.stack([columns.ravel(), rows.ravel()], 1).astype(np.float64))
    assert np.allclose(half.pixels.ravel(), there @ (4, 20))
