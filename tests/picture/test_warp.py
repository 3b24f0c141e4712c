"""The warper against a plain NumPy bilinear, against identities that need no oracle, and at its limits."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import skimage.transform
from hypothesis import given, settings
from hypothesis import strategies as st

from autoalign.geometry.homography import translation
from autoalign.picture.warp import RIM_PX, valid_mask, valid_runs, warp

DTYPES = (np.uint8, np.uint16, np.float32)
CHANNELS = (None, 1, 2, 3, 4)
PERSPECTIVE = np.linalg.inv([[0.9, 0.13, -7.3], [-0.11, 0.95, 9.7], [1e-3, -5e-4, 1.0]])
AFFINE = np.array([[0.8, 0.3, -9.2], [-0.25, 1.3, 4.4], [0.0, 0.0, 1.0]])


def picture(dtype, channels=None, size=(53, 37), seed=0):
    """Smooth enough to be a photograph, with noise on it; alpha, where there is one, is opaque."""
    w, h = size
    rng = np.random.default_rng(seed)
    shape = (h, w) if channels is None else (h, w, channels)
    values = rng.random(shape, np.float32)
    values = 0.2 * values + 0.8 * cv2.GaussianBlur(values, (0, 0), 2).reshape(shape)
    if channels in (2, 4):
        values[..., -1] = 1
    if dtype == np.float32:
        return values
    return np.rint(values * np.iinfo(dtype).max).astype(dtype)


def places(size, dst_from_src, src_size):
    """(h, w) x, y in the source and w of every output pixel."""
    transform = np.asarray(dst_from_src, float)
    centre = np.array([(src_size[0] - 1) / 2, (src_size[1] - 1) / 2, 1])
    src_from_dst = np.linalg.inv(transform * np.sign(transform[2] @ centre))
    x, y = np.meshgrid(np.arange(size[0], dtype=float), np.arange(size[1], dtype=float))
    sx, sy, w = np.moveaxis(np.stack([x, y, np.ones_like(x)], -1) @ src_from_dst.T, -1, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return sx / w, sy / w, w


def oracle(image, size, dst_from_src):
    """Plain bilinear in float64, and where it has all four neighbours."""
    h, w = image.shape[:2]
    x, y, depth = places(size, dst_from_src, (w, h))
    valid = (depth > 0) & (x >= -RIM_PX) & (x <= w - 1 + RIM_PX) & (y >= -RIM_PX) & (y <= h - 1 + RIM_PX)
    x, y = (np.clip(np.where(valid, v, 0), 0, most) for v, most in ((x, w - 1), (y, h - 1)))
    x0, y0 = (np.clip(np.floor(v).astype(int), 0, max(most, 0)) for v, most in ((x, w - 2), (y, h - 2)))
    x1, y1 = np.minimum(x0 + 1, w - 1), np.minimum(y0 + 1, h - 1)
    fx, fy = (v.reshape(*v.shape, *[1] * (image.ndim - 2)) for v in (x - x0, y - y0))
    values = image.astype(float)
    top = values[y0, x0] * (1 - fx) + values[y0, x1] * fx
    bottom = values[y1, x0] * (1 - fx) + values[y1, x1] * fx
    return top * (1 - fy) + bottom * fy, valid


@pytest.mark.parametrize(
    "transform", [PERSPECTIVE, AFFINE, -3 * PERSPECTIVE], ids=["perspective", "affine", "negative"]
)
@pytest.mark.parametrize("channels", CHANNELS)
@pytest.mark.parametrize("dtype", DTYPES)
def test_is_bilinear(dtype, channels, transform):
    image = picture(dtype, channels)
    result = warp(image, (61, 45), transform)
    expected, valid = oracle(image, (61, 45), transform)
    assert np.array_equal(result.valid, valid)
    assert 500 < valid.sum() < valid.size
    assert result.pixels.dtype == dtype
    assert result.pixels.shape == expected.shape
    error = np.abs(result.pixels - expected)[valid].max()
    # uint16: places in float32 are good to about 1e-5 px in a picture of this size, a hundredth of the rounding here.
    assert error <= {np.uint8: 0.501, np.uint16: 0.6, np.float32: 1e-5}[dtype]
    assert not result.pixels[~valid].any()


def test_agrees_with_scikit_image():
    image = picture(np.float32)
    ours = warp(image, (61, 45), PERSPECTIVE)
    theirs = skimage.transform.warp(image, np.linalg.inv(PERSPECTIVE), output_shape=(45, 61), order=1)
    assert np.abs(ours.pixels - theirs)[ours.valid].max() < 1e-5


@pytest.mark.parametrize("channels", CHANNELS)
@pytest.mark.parametrize("dtype", DTYPES)
def test_identity_changes_no_byte(dtype, channels):
    image = picture(dtype, channels)
    if channels in (2, 4):
        image[3:20, 5:30, -1] = 0
    result = warp(image, (53, 37), np.eye(3))
    assert np.array_equal(result.pixels, image)
    assert result.valid.all()


@pytest.mark.parametrize("turns", [1, 2, 3])
@pytest.mark.parametrize("dtype", DTYPES)
def test_quarter_turns_are_those_of_numpy(dtype, turns):
    image = picture(dtype, 3)
    h, w = image.shape[:2]
    quarter = [
        np.array([[0.0, 1, 0], [-1, 0, w - 1], [0, 0, 1]]),
        np.array([[-1.0, 0, w - 1], [0, -1, h - 1], [0, 0, 1]]),
        np.array([[0.0, -1, h - 1], [1, 0, 0], [0, 0, 1]]),
    ]
    expected = np.rot90(image, turns)
    result = warp(image, (expected.shape[1], expected.shape[0]), quarter[turns - 1])
    assert np.array_equal(result.pixels, expected)
    assert result.valid.all()


def test_whole_shift_copies_up_to_the_last_pixel_and_spreads_no_nan():
    image = picture(np.float32)
    image[10, 20] = np.nan
    result = warp(image, (80, 60), 0.3 * translation(5, -3), fill=-1)
    expected = np.full((60, 80), -1, np.float32)
    expected[: 37 - 3, 5 : 5 + 53] = image[3:]
    assert np.array_equal(result.pixels, expected, equal_nan=True)
    assert result.valid.sum() == 34 * 53


def test_nan_spreads_to_its_neighbours_and_no_further():
    image = picture(np.float32)
    image[10, 20] = np.nan
    result = warp(image, (53, 37), translation(0.25, 0.5))
    assert np.argwhere(np.isnan(result.pixels)).tolist() == [[10, 20], [10, 21], [11, 20], [11, 21]]


@pytest.mark.parametrize("src_size", [(1, 1), (1, 7), (7, 1), (2, 2)])
def test_smallest_pictures(src_size):
    image = picture(np.uint8, 3, src_size)
    result = warp(image, src_size, np.eye(3))
    assert np.array_equal(result.pixels, image)
    assert result.valid.all()
    assert not warp(image, src_size, translation(0.5, 0.5)).valid[0].any()


@pytest.mark.parametrize("channels", [None, 4])
@pytest.mark.parametrize("size", [(40_000, 8), (8, 40_000)])
def test_sides_too_long_for_opencv(size, channels):
    image = picture(np.uint8, channels, size)
    shift = translation(*(0.25 if side > 8 else 0.0 for side in size))
    result = warp(image, size, shift)
    expected, valid = oracle(image, size, shift)
    assert np.array_equal(result.valid, valid)
    assert np.abs(result.pixels - expected)[valid].max() <= 0.501


def test_a_source_too_long_for_opencv_made_short():
    image = np.linspace(0, 60_000, 40_000, dtype=np.float32)[None].repeat(8, axis=0)
    shorter = np.diag([1 / 400, 1.0, 1.0])
    result = warp(image, (100, 8), shorter)
    assert np.allclose(result.pixels, oracle(image, (100, 8), shorter)[0], rtol=1e-6, atol=1e-2)


@pytest.mark.parametrize("dtype", DTYPES)
def test_tiles_leave_no_trace(dtype):
    image = picture(dtype, 3, (230, 170))
    transform = np.linalg.inv([[0.9, 0.13, -7.3], [-0.11, 0.95, 9.7], [3e-4, -2e-4, 1.0]])
    whole = warp(image, (211, 190), transform, tile_px=2048)
    for tile_px in (64, 17):
        tiled = warp(image, (211, 190), transform, tile_px=tile_px)
        assert np.array_equal(tiled.valid, whole.valid)
        difference = np.abs(tiled.pixels.astype(float) - whole.pixels)
        assert difference.max() <= {np.uint8: 1, np.uint16: 2, np.float32: 1e-4}[dtype]
        assert (difference > 0).mean() < {np.uint8: 1e-3, np.uint16: 0.1, np.float32: 1.0}[dtype]


def test_tile_of_one_pixel():
    image = picture(np.uint8)
    assert np.array_equal(
        warp(image, (20, 10), PERSPECTIVE, tile_px=1).valid, valid_mask((53, 37), (20, 10), PERSPECTIVE)
    )


class Boxes:
    """A picture that gives its pixels only box by box, and remembers how large these were."""

    def __init__(self, pixels):
        self._pixels, self.shape, self.dtype, self.sizes = pixels, pixels.shape, pixels.dtype, []

    def __getitem__(self, box):
        part = self._pixels[box].copy()
        self.sizes.append(part.shape[0] * part.shape[1])
        return part


@pytest.mark.parametrize("channels", CHANNELS)
def test_a_source_is_asked_for_boxes_and_gives_the_same(channels):
    image = picture(np.uint16, channels, (230, 170))
    source = Boxes(image)
    drawn, expected = (warp(of, (211, 190), PERSPECTIVE, tile_px=32) for of in (source, image))
    assert np.array_equal(drawn.pixels, expected.pixels)
    assert np.array_equal(drawn.valid, expected.valid)
    assert len(source.sizes) > 10
    assert max(source.sizes) < image.shape[0] * image.shape[1] / 4


@pytest.mark.parametrize("dtype", DTYPES)
def test_same_bits_on_any_number_of_threads(dtype):
    image = picture(dtype, 3, (640, 480))
    threads = cv2.getNumThreads()
    results = []
    for number in (1, 2):
        cv2.setNumThreads(number)
        results.append(warp(image, (640, 480), PERSPECTIVE).pixels.tobytes())
    cv2.setNumThreads(threads)
    assert results[0] == results[1]


# The horizon runs down the output at x = 30; the picture's middle is on its right.
HORIZON = np.linalg.inv([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.05, 0.0, -1.5]])


def test_only_the_side_of_the_horizon_with_the_middle_is_drawn():
    image = picture(np.uint8, 3)
    result = warp(image, (120, 60), HORIZON, fill=7)
    expected, valid = oracle(image, (120, 60), HORIZON)
    _, _, depth = places((120, 60), HORIZON, (53, 37))
    assert depth.min() < 0 < depth.max()
    assert np.array_equal(result.valid, valid)
    assert valid.any()
    assert np.abs(result.pixels - expected)[valid].max() <= 0.51
    assert (result.pixels[~valid] == 7).all()


def test_the_anchor_chooses_the_side_of_a_horizon_that_crosses_the_picture():
    transform = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.05, 0.0, -1.0]])  # horizon at x = 20 in the picture
    image = np.full((37, 53), 125, np.uint8)
    image[:, :20], image[:, 21:] = 50, 200
    right = warp(image, (400, 300), transform)
    left = warp(image, (400, 300), translation(399, 299) @ transform, anchor=(5, 30))
    assert right.pixels[right.valid].min() >= 125
    assert right.pixels[right.valid].max() == 200
    assert left.pixels[left.valid].max() <= 125
    assert left.pixels[left.valid].min() == 50


def test_a_source_that_misses_the_canvas():
    result = warp(picture(np.uint16, 3), (40, 30), translation(1000, 0), fill=(1, 2, 3))
    assert not result.valid.any()
    assert (result.pixels == (1, 2, 3)).all()


@pytest.mark.parametrize("transform", [AFFINE, PERSPECTIVE])
def test_the_fill_never_mixes_in(transform):
    image = np.full((37, 53, 3), 100, np.uint8)
    result = warp(image, (61, 45), transform, fill=255)
    assert (result.pixels[result.valid] == 100).all()
    assert (result.pixels[~result.valid] == 255).all()


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("channels", [2, 4])
def test_transparent_pixels_do_not_bleed(dtype, channels):
    most = 1 if dtype == np.float32 else np.iinfo(dtype).max
    image = np.zeros((20, 30, channels), dtype)
    image[:, :15] = most  # white and opaque; the rest is black and transparent
    result = warp(image, (30, 20), translation(0.25, 0.5))
    seen = result.valid & (result.pixels[..., -1] > 0)
    assert np.allclose(result.pixels[seen][:, :-1], most, rtol=1e-5, atol=0)
    assert np.allclose(result.pixels[5, 15, -1], most / 4, rtol=0, atol=0.5 if most > 1 else 1e-6)


def test_colour_under_full_transparency_survives():
    image = picture(np.uint8, 4)
    image[..., 3] = 0
    image[0, 0, 3] = 255
    result = warp(image, (53, 37), translation(0.5, 0.0))
    expected, _ = oracle(image, (53, 37), translation(0.5, 0.0))
    assert np.abs(result.pixels - expected)[5:, 5:].max() <= 0.51


@pytest.mark.parametrize("channels", CHANNELS)
@pytest.mark.parametrize("dtype", DTYPES)
def test_nearest_takes_the_nearest(dtype, channels):
    image = picture(dtype, channels)
    if channels in (2, 4):
        image[3:20, 5:30, -1] = 0
    result = warp(image, (61, 45), PERSPECTIVE, interpolation="nearest")
    x, y, _ = places((61, 45), PERSPECTIVE, (53, 37))
    assert np.array_equal(result.valid, valid_mask((53, 37), (61, 45), PERSPECTIVE))
    column, row = np.rint(x[result.valid]).astype(int), np.rint(y[result.valid]).astype(int)
    assert np.array_equal(result.pixels[result.valid], image[row, column])


def test_the_place_of_a_sample_is_exact_far_from_the_origin():
    """A ramp shows where it was sampled: 20,000 px out, rounding to 1/32 px or float32 at the corner would show."""
    ramp = np.arange(30_000, dtype=np.float32)[None].repeat(4, axis=0)
    shift = translation(-20_000.3, 0)
    result = warp(ramp, (9_000, 4), shift)
    assert np.abs(result.pixels - (np.arange(9_000) + 20_000.3))[result.valid].max() < 4e-3  # one float32 step: 2e-3


number = st.floats(-1.0, 1.0, width=32)


@settings(max_examples=200, deadline=None)
@given(
    entries=st.tuples(*[number] * 9),
    tilt=st.sampled_from([0.0, 1e-3, 1e-1]),
    reach=st.sampled_from([1.0, 30.0, 1000.0]),
    src_size=st.tuples(st.integers(1, 60), st.integers(1, 60)),
    size=st.tuples(st.integers(1, 60), st.integers(1, 60)),
)
def test_valid_is_what_a_look_at_every_pixel_says(entries, tilt, reach, src_size, size):
    transform = np.array(entries, float).reshape(3, 3)
    transform[2, :2] *= tilt
    transform[:2, 2] *= reach
    centre = np.array([(src_size[0] - 1) / 2, (src_size[1] - 1) / 2, 1])
    if np.linalg.cond(transform) > 1e8 or abs(transform[2] @ centre) < 1e-6:
        return
    mask = valid_mask(src_size, size, transform)
    x, y, depth = places(size, transform, src_size)
    with np.errstate(invalid="ignore"):
        inside = np.minimum.reduce([x, src_size[0] - 1 - x, y, src_size[1] - 1 - y])
    assert mask[(depth > 0) & (inside > RIM_PX / 2)].all()
    assert not mask[(depth < 0) | (inside < -2 * RIM_PX)].any()
    starts, stops = valid_runs(src_size, size, transform)
    assert np.array_equal(mask.sum(axis=1), stops - starts)
    assert starts.min() >= 0
    assert stops.max() <= size[0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"image": np.zeros((3, 4), np.int32)}, "uint8, uint16 or float32"),
        ({"size": (0, 5)}, "must have pixels"),
        ({"dst_from_src": np.zeros((3, 3))}, "regular"),
        ({"dst_from_src": np.eye(2)}, "regular"),
        ({"dst_from_src": np.diag([1, 1, np.nan])}, "regular"),
        ({"interpolation": "cubic"}, "interpolation"),
        ({"tile_px": 0}, "tile_px"),
        ({"fill": 256}, "fill"),
        ({"fill": 0.5}, "fill"),
        ({"fill": (1, 2)}, "fill"),
    ],
)
def test_wrong_calls_say_what_is_wrong(change, message):
    call = {"image": picture(np.uint8, 3), "size": (5, 6), "dst_from_src": np.eye(3)} | change
    with pytest.raises(ValueError, match=message):
        warp(**call)
