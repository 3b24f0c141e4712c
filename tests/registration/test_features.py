"""Keypoints are where they say, whatever way the picture is turned, shrunken or looked at; and always the same."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import pytest
from exact_pairs import camera, photo, render
from scipy.spatial import cKDTree

from autoalign.geometry.homography import IDENTITY
from autoalign.registration.features import DETECTORS, FeatureOptions, Features, detect, with_reversed_contrast

ALL = 100_000  # more keypoints than there are: so that no choice among them hides anything


def options(detector: str, **others) -> FeatureOptions:
    return FeatureOptions(detector=detector, **({"max_features": ALL, "working_pixels": 1e9} | others))


@cache
def view(size: tuple[int, int]) -> np.ndarray:
    return camera(render("gravel.png", IDENTITY, size), seed=1)


def turned_points(points: np.ndarray, size: tuple[int, int], quarters: int) -> np.ndarray:
    """Where np.rot90 takes points of a picture of `size` (w, h)."""
    w, h = size
    if quarters == 2:
        return np.array([w - 1, h - 1]) - points
    return np.stack([points[:, 1], w - 1 - points[:, 0]], 1)


def offsets(image: np.ndarray, quarters: int, how: FeatureOptions) -> np.ndarray:
    """(n, 2) from where each keypoint should be in the turned picture to the nearest one of its size that is there.

    Keypoints without one within 2.5 px, which is more than any known bias, count as inf.
    """
    plain, turned = detect(image, how), detect(np.ascontiguousarray(np.rot90(image, quarters)), how)
    due = turned_points(plain.points, image.shape[::-1], quarters)
    tree = cKDTree(np.column_stack([turned.points, 1000 * np.log(turned.sizes)]))
    gap, at = tree.query(np.column_stack([due, 1000 * np.log(plain.sizes)]), distance_upper_bound=2.5)
    found = np.where(np.isfinite(gap), at, 0)
    return np.where(np.isfinite(gap)[:, None], turned.points[found] - due, np.inf)


@pytest.mark.parametrize("quarters", [1, 2])
@pytest.mark.parametrize(
    ("size", "working_pixels"),
    [
        ((351, 217), 1e9),
        ((342, 207), 1e9),  # 342 / 1.44 = 237.5: how the pyramid rounds a tie counts
        ((397, 301), 70_000),  # shrunken to 304 x 230: not an integer fraction, not the same in x and y
    ],
)
def test_orb_points_turn_with_the_picture(size, working_pixels, quarters):
    """FAST takes whole pixels of a level, so that the points are the same to cv2's float32 (2e-4 px)."""
    off = offsets(view(size), quarters, options("orb", working_pixels=working_pixels))
    assert len(off) > 1000
    lengths = np.linalg.norm(off, axis=1)
    # cv2.resize by area may round a grey level of the turned picture the other way, which moves few keypoints.
    assert np.mean(lengths < 1e-3) > 0.99


@pytest.mark.parametrize("quarters", [1, 2])
@pytest.mark.parametrize(("size", "working_pixels"), [((351, 207), 1e9), ((397, 301), 70_000)])
def test_sift_points_turn_with_the_picture(size, working_pixels, quarters):
    """Extrema are interpolated, and one in twenty is lost at its thresholds; those that stay must not be biased."""
    off = offsets(view(size), quarters, options("sift", working_pixels=working_pixels))
    assert len(off) > 1000
    there = np.isfinite(off[:, 0])
    assert there.mean() > 0.9
    lengths = np.linalg.norm(off[there], axis=1)
    assert np.quantile(lengths, 0.95) < 5e-3
    assert np.abs(np.median(off[there], axis=0)).max() < 1e-3  # OpenCV's own bias would be 0.25 to 0.5


@pytest.mark.parametrize("working_pixels", [1e9, 40_000])
def test_sift_finds_a_blob_at_its_centre(working_pixels):
    """Also through a shrink whose factors differ in x and y; its parabola is good to a twentieth of a pixel here."""
    x, y = np.meshgrid(np.arange(361), np.arange(283))
    image = 40 + 180 * np.exp(-((x - 170.3) ** 2 + (y - 141.8) ** 2) / (2 * 6.0**2))
    found = detect(np.rint(image).astype(np.uint8), options("sift", working_pixels=working_pixels))
    assert np.linalg.norm(found.points - [170.3, 141.8], axis=1).min() < 0.05


@pytest.mark.parametrize("tilts", [(2.0,), (1.5, 4.0)])
def test_what_is_found_in_tilted_views_is_where_it_is_in_the_picture(tilts):
    """Round blobs have one centre from all sides; a view that was half a pixel off would show it."""
    rng = np.random.default_rng(3)
    x, y = np.meshgrid(np.arange(400.0), np.arange(280.0))
    centres = np.array([(cx, cy) for cx in range(50, 360, 60) for cy in range(50, 240, 60)]) + rng.uniform(
        -5, 5, (24, 2)
    )
    image = 60 + sum(150 * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * 5.0**2)) for cx, cy in centres)
    image = np.clip(np.rint(image), 0, 255).astype(np.uint8)
    how = FeatureOptions(working_pixels=1e9, max_features=4000, tilts=tilts)
    plain, seen = detect(image, FeatureOptions(working_pixels=1e9, max_features=4000)), detect(image, how)
    tilted = seen.points[len(plain) :]
    gap, which = cKDTree(centres).query(tilted)
    on_blob = gap < 1.0
    assert set(which[on_blob]) == set(range(24))
    # Views are drawn by bilinear interpolation and SIFT is good to a few hundredths in them.
    off = (tilted - centres[which])[on_blob]
    assert np.abs(off.mean(0)).max() < 0.03
    assert np.median(np.linalg.norm(off, axis=1)) < 0.15


def test_sizes_and_sigmas_are_in_pixels_of_the_full_picture():
    image = view((480, 360))
    full, small = (detect(image, options("sift", working_pixels=p)) for p in (1e9, 480 * 360 / 4))
    assert set(full.sigmas) == {1.0}
    assert np.allclose(small.sigmas, 2.0)
    # SIFT's smallest keypoints are a fixed number of pixels of the picture that it sees.
    assert small.sizes.min() / full.sizes.min() == pytest.approx(2.0, rel=0.1)
    levels = np.unique(detect(image, options("orb")).sigmas)
    assert np.allclose(levels, 1.2 ** np.arange(len(levels)))


@pytest.mark.parametrize("detector", DETECTORS)
def test_descriptors_are_whole_numbers_whose_squared_distances_are_exact(detector):
    """So the matches cannot depend on the order in which a matrix product adds up."""
    a = detect(view((351, 207)), options(detector)).descriptors[:300]
    assert a.dtype == np.float32
    assert np.array_equal(a, np.rint(a))
    exact = a.astype(np.int64) @ a.astype(np.int64).T
    lengths = np.sort(np.diag(exact))
    assert lengths[-1] + lengths[-2] < 2**24  # no partial sum of |a|^2 + |b|^2 - 2 a b, in any order, is larger
    assert np.array_equal(a @ a.T, exact)
    assert np.array_equal(a[:, ::-1] @ a[:, ::-1].T, exact)


def test_root_sift_is_the_square_root_of_the_histograms():
    """Oracle: cv2's own descriptors at the same keypoints, Arandjelovic and Zisserman's two lines."""
    image = view((351, 207))
    root, plain = (detect(image, options("sift", root=r)).descriptors.astype(float) for r in (True, False))
    keypoints, raw = cv2.SIFT.create(2 * ALL, contrastThreshold=0.02, enable_precise_upscale=True).detectAndCompute(
        image, None
    )
    assert len(keypoints) == len(root)
    oracle = np.sqrt(raw / raw.sum(1, keepdims=True))
    raw = raw / np.linalg.norm(raw, axis=1, keepdims=True)
    for ours, theirs in ((root, oracle), (plain, raw)):
        ours = ours / np.linalg.norm(ours, axis=1, keepdims=True)
        # Rounding each of 128 numbers of a vector of length 4000 by up to a half turns it by 0.0014 at most.
        assert cKDTree(theirs).query(ours)[0].max() < 2e-3


@pytest.mark.parametrize("detector", DETECTORS)
@pytest.mark.parametrize("working_pixels", [1e9, 60_000])
@pytest.mark.parametrize("tilts", [(), (2.0,)])
def test_nothing_is_found_where_the_mask_says_no(detector, working_pixels, tilts):
    image = view((397, 301))
    valid = np.ones(image.shape, bool)
    valid[60:200, 100:300] = False
    how = options(detector, working_pixels=working_pixels, tilts=tilts, max_features=2000)
    hidden, all_of_it = detect(image, how, valid), detect(image, how)

    def inside(found: Features) -> int:
        # A keypoint is a position between pixels: one pixel of the level it was found on belongs to its place.
        rim = np.maximum(found.sigmas, 1.0) * (3.0 if tilts else 1.0)
        x, y = found.points.T
        return int(((x > 100 + rim) & (x < 299 - rim) & (y > 60 + rim) & (y < 199 - rim)).sum())

    assert inside(hidden) == 0
    assert inside(all_of_it) > 50
    assert len(hidden) > 100


@pytest.mark.parametrize("detector", DETECTORS)
def test_a_mask_that_hides_nothing_changes_nothing(detector):
    image = view((351, 207))
    how = options(detector, max_features=500)
    same(detect(image, how), detect(image, how, np.ones(image.shape, bool)))


@pytest.mark.parametrize("detector", DETECTORS)
def test_keypoints_are_spread_over_the_picture(detector):
    """A part full of strong texture does not take all of them: the faint rest has its share."""
    image = view((480, 360)).astype(float)
    image[:, 160:] = 100 + (image[:, 160:] - 128) * 0.25
    image = image.astype(np.uint8)
    everything = detect(image, options(detector))
    # The detectors themselves drop the weakest beyond twice (SIFT) or three times (ORB) as many as are wanted.
    found = detect(image, options(detector, max_features=int(len(everything) / 1.9)))
    share, most = (np.mean(features.points[:, 0] > 165) for features in (found, everything))
    assert share > 0.9 * most  # the strongest of the whole picture would leave nearly none of them
    first = found.points[: len(found) // 4]
    assert np.mean(first[:, 0] > 165) > 0.9 * most  # any first part of the list is spread as well


def test_the_strongest_of_a_part_comes_first():
    x, y = np.meshgrid(np.arange(200.0), np.arange(140.0))
    image = 60 + sum(
        height * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * 5.0**2))
        for height, cx, cy in ((60, 40, 40), (150, 150, 90))
    )
    found = detect(np.rint(image).astype(np.uint8), options("sift", max_features=1))
    assert np.linalg.norm(found.points[0] - [150, 90]) < 1.0


def same(a: Features, b: Features) -> None:
    for name in ("points", "sizes", "angles", "sigmas", "descriptors"):
        assert np.array_equal(getattr(a, name), getattr(b, name)), name


@pytest.mark.parametrize("how", [options("orb", max_features=800), options("sift", max_features=800, tilts=(2.0,))])
def test_any_number_of_threads_gives_the_same_bits(how):
    image, threads = view((351, 207)), cv2.getNumThreads()
    try:
        found = []
        for count in (1, 2):
            cv2.setNumThreads(count)
            found.append(detect(image, how))
    finally:
        cv2.setNumThreads(threads)
    same(found[0], found[1])


@pytest.mark.parametrize("detector", DETECTORS)
@pytest.mark.parametrize("shape", [(1, 1), (1, 500), (500, 1), (7, 5), (63, 63), (64, 64), (64, 900), (900, 64)])
def test_pictures_of_any_shape_have_features_or_none(detector, shape):
    image = np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)
    found = detect(image, options(detector, tilts=(2.0,)))
    width = {"sift": 128, "orb": 256}[detector]
    assert found.descriptors.shape == (len(found), width)
    assert found.points.shape == (len(found), 2)
    # ORB of a small picture may find nothing; nothing may lie outside.
    assert ((found.points > -0.5) & (found.points < np.array(shape[::-1]) - 0.5)).all()


@pytest.mark.parametrize("detector", DETECTORS)
@pytest.mark.parametrize("level", [0, 128, 255])
def test_blank_pictures_have_none(detector, level):
    assert len(detect(np.full((120, 170), level, np.uint8), options(detector))) == 0


def test_a_working_size_bounds_the_work_not_the_place():
    """Points of the shrunken picture are found in the full one: most have a neighbour there within a small pixel."""
    image = photo("astronaut.png")[..., 1]
    small, full = (detect(image, options("sift", working_pixels=p)) for p in (512 * 512 / 2.7, 1e9))
    gap = cKDTree(full.points).query(small.points)[0]
    assert np.median(gap) < 0.2


@pytest.mark.parametrize("wrong", [{"detector": "surf"}, {"working_pixels": 0}, {"max_features": 0}, {"contrast": 0.0}])
def test_options_out_of_range_are_refused(wrong):
    with pytest.raises(ValueError, match="FeatureOptions"):
        FeatureOptions(**wrong)


def test_reversed_contrast_is_what_the_negative_shows():
    """Every keypoint of the negative is among those of the picture with their contrast reversed, at its place and with
    its descriptor: dark blobs become bright ones, gradients turn round."""
    image = view((351, 207))
    how = options("sift")
    plain, negative = detect(image, how), detect(255 - image, how)
    either = with_reversed_contrast(plain)
    assert len(either) == 2 * len(plain)
    same_place = cKDTree(either.points).query_ball_point(negative.points, 0.05)
    wanted = negative.descriptors / np.linalg.norm(negative.descriptors, axis=1, keepdims=True)
    offered = either.descriptors / np.linalg.norm(either.descriptors, axis=1, keepdims=True)
    # At least 1/8 of the length apart are the descriptors of different things; rounding leaves a hundredth.
    found = [
        bool(at) and np.linalg.norm(offered[at] - wanted[i], axis=1).min() < 0.05 for i, at in enumerate(same_place)
    ]
    assert np.mean(found) > 0.95
    before = [
        np.linalg.norm(offered[: len(plain)][near] - wanted[i], axis=1).min()
        for i, at in enumerate(same_place)
        if (near := [k for k in at if k < len(plain)])
    ]
    assert np.median(before) > 0.125  # without it, they are not alike


def test_only_sift_can_have_its_contrast_reversed():
    with pytest.raises(ValueError, match="orb"):
        with_reversed_contrast(detect(view((351, 207)), options("orb")))
