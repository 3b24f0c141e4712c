"""Refinement brings a transform that is off by a part of a pixel back to the pixels, or leaves it alone."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from exact_pairs import Pair, about, camera, mean_error_px, pair, photo, render, turn

from autoalign.geometry.family import MODELS, ModelName, fit
from autoalign.geometry.homography import IDENTITY, Array, apply, invert, project, shown, translation
from autoalign.geometry.least_squares import Correspondences
from autoalign.geometry.ransac import Consensus, settle
from autoalign.registration.refine import Refinement, RefineOptions, refine

TRUTH = np.array([[1.02, 0.05, 10.0], [-0.04, 0.98, 7.5], [1e-4, -5e-5, 1.0]])
SMALL = (320, 240)


@cache
def plane(name: str = "astronaut.png") -> Pair:
    return pair(name, TRUTH, SMALL)


def keypoints(
    of: Pair, spread_px: float, offset: tuple[float, float] = (0.0, 0.0), count: int = 150
) -> Correspondences:
    """Matches all over the overlap, scattered and all of them shifted: the consensus of a detector with errors."""
    rng = np.random.default_rng(7)
    h, w = of.fixed.shape[:2]
    dst = rng.uniform((20, 20), (w - 20, h - 20), (4 * count, 2))
    src = apply(invert(of.fixed_from_moving), dst)
    inside = ((src > 15) & (src < np.array(of.moving.shape[1::-1]) - 15)).all(1)
    src, dst = src[inside][:count], dst[inside][:count]
    zoom = float(np.sqrt(np.linalg.det(of.fixed_from_moving[:2, :2])))
    return Correspondences(
        src=src,
        dst=dst + rng.normal(0, spread_px, dst.shape) + offset,
        src_sigma=np.full(len(src), max(1.0, spread_px) / zoom),
        dst_sigma=np.full(len(src), max(1.0, spread_px)),
    )


def consensus(of: Pair, matched: Correspondences, model: ModelName = "homography") -> Consensus:
    found = settle(MODELS[model], fit(model, matched.src, matched.dst), matched, 3.0)
    assert found is not None
    return found


def sharpen(of: Pair, spread_px: float = 1.0, model: ModelName = "homography", **others) -> tuple[Refinement, float]:
    """The refinement of what matches of that spread say, and how far off they were."""
    matched = keypoints(of, spread_px)
    found = consensus(of, matched, model)
    return refine(of.fixed, of.moving, found, matched, RefineOptions(), **others), mean_error_px(found.dst_from_src, of)


# Trials on such pairs (8 bits, noise of 2 grey levels) leave 0.005 to 0.015 px; the issue asks for 0.02.
GOOD_PX = 0.02


@pytest.mark.parametrize("spread_px", [0.7, 2.0])
@pytest.mark.parametrize("name", ["astronaut.png", "gravel.png", "coffee.png"])
def test_a_consensus_off_by_a_part_of_a_pixel_comes_back_to_the_truth(name, spread_px):
    of = plane(name)
    result, before = sharpen(of, spread_px)
    assert result.sharpened
    assert 5 * GOOD_PX < before < 1.5
    assert mean_error_px(result.fixed_from_moving, of) < GOOD_PX


@pytest.mark.parametrize(("patches", "radius"), [(60, 12), (2500, 6)])
def test_any_number_of_patches_will_do(patches, radius):
    """With very few, the truth is a little less sharp: noise falls with the square root of their number."""
    of = pair("gravel.png", translation(6.3, 4.8), (496, 470))
    matched = keypoints(of, 1.0)
    result = refine(
        of.fixed, of.moving, consensus(of, matched, "affine"), matched, RefineOptions(patches=patches, radius=radius)
    )
    assert result.sharpened
    assert result.patches is not None
    assert len(result.patches.kept) > min(0.8 * patches, 2000)
    assert mean_error_px(result.fixed_from_moving, of) < GOOD_PX


def test_patches_keep_apart_so_that_their_errors_are_independent():
    """The choice of the model and the expected error count them so."""
    of = pair("gravel.png", translation(6.3, 4.8), (496, 470))
    matched = keypoints(of, 1.0)
    result = refine(of.fixed, of.moving, consensus(of, matched, "affine"), matched, RefineOptions(radius=10))
    at = result.pairs.dst
    distance = np.linalg.norm(at[:, None] - at[None], axis=2)[~np.eye(len(at), dtype=bool)]
    assert len(at) > 500
    assert distance.min() > 9  # of which the laying on whole pixels may take one


@pytest.mark.parametrize("offset", [(0.2, 0.0), (-0.15, 0.12)])
def test_what_all_keypoints_are_off_together_is_undone(offset):
    """ORB's corners are whole pixels: a shift by 5.25 is 5 to all of them. The pixels know better."""
    of = plane()
    matched = keypoints(of, 0.5, offset, count=800)
    result = refine(of.fixed, of.moving, consensus(of, matched), matched, RefineOptions())
    assert result.sharpened
    assert mean_error_px(result.fixed_from_moving, of) < GOOD_PX


@pytest.mark.parametrize("fraction", [0.0, 0.25, 0.5])
@pytest.mark.parametrize("name", ["gravel.png", "page.png"])
def test_a_fraction_of_a_pixel_that_is_the_same_all_over_leaves_no_bias(name, fraction):
    """Bilinear interpolation between pixels does: 0.011 px in gravel and 0.026 px in print at a quarter of a pixel."""
    of = pair(name, translation(5.0 + fraction, 7.0 + fraction), SMALL, gain=1.0, bias=0.0)
    matched = keypoints(of, 1.0)
    result = refine(of.fixed, of.moving, consensus(of, matched, "translation"), matched, RefineOptions())
    assert result.sharpened
    assert mean_error_px(result.fixed_from_moving, of) < 0.01


def darker(image: np.ndarray) -> np.ndarray:
    return np.rint(image * 0.5 + 5).astype(np.uint8)


def gamma(image: np.ndarray) -> np.ndarray:
    return np.rint(255 * (image / 255) ** 1.8).astype(np.uint8)


def lit_from_one_side(image: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(image * np.linspace(0.5, 1.1, image.shape[1])), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("light", [darker, gamma, lit_from_one_side])
def test_other_light_is_tolerated(light):
    """A curve moves the middle of an edge a little; it stays under what unsharpened keypoints leave (0.07 px)."""
    of = plane()
    result, _ = sharpen(Pair(fixed=of.fixed, moving=light(of.moving), fixed_from_moving=of.fixed_from_moving))
    assert result.sharpened
    assert mean_error_px(result.fixed_from_moving, of) < (0.05 if light is gamma else GOOD_PX)


@pytest.mark.parametrize("zoom", [0.4, 2.5])
def test_pictures_of_other_resolution_are_compared_at_the_coarser_one(zoom):
    size = (360, 280)
    moving_size = (size[0], size[1]) if zoom < 1 else (size[0] // 2, size[1] // 2)
    of = pair("gravel.png", turn(180, 140, 5, zoom), size, moving_size)
    matched = keypoints(of, max(1.0, zoom))
    found = consensus(of, matched, "similarity")
    result = refine(of.fixed, of.moving, found, matched, RefineOptions())
    assert result.sharpened
    assert mean_error_px(result.fixed_from_moving, of) < GOOD_PX * max(1.0, zoom)  # in pixels of the coarser picture


@pytest.mark.parametrize(
    ("dtype", "scale"), [(np.uint16, 257.0), (np.uint16, 8.0), (np.float32, 1.0 / 255), (np.float32, 1e5)]
)
def test_every_depth_is_as_good(dtype, scale):
    of = plane()
    deep = Pair(
        fixed=(of.fixed * scale).astype(dtype),
        moving=(of.moving * scale).astype(dtype),
        fixed_from_moving=of.fixed_from_moving,
    )
    result, _ = sharpen(deep)
    assert result.sharpened
    assert mean_error_px(result.fixed_from_moving, of) < GOOD_PX


def test_the_unit_of_a_float_picture_does_not_matter():
    """Reflectances of a thousandth are as good as grey levels."""
    of = plane()
    faint = Pair(
        fixed=of.fixed.astype(np.float32) * np.float32(1e-6),
        moving=of.moving.astype(np.float32) * np.float32(1e-6),
        fixed_from_moving=of.fixed_from_moving,
    )
    result, _ = sharpen(faint)
    assert result.sharpened
    assert mean_error_px(result.fixed_from_moving, of) < GOOD_PX


def two_planes(apart_px: float) -> Pair:
    """The left half moves by (4, 2), the right half by `apart_px` more: no one homography holds."""
    left, right = translation(4.0, 2.0), translation(4.0 + apart_px, 2.0)
    scene = translation(60, 60)
    w = SMALL[0]
    fixed = render("gravel.png", scene, SMALL)
    moving = np.where(
        np.arange(w) < w / 2, render("gravel.png", scene @ left, SMALL), render("gravel.png", scene @ right, SMALL)
    )
    return Pair(fixed=camera(fixed, 1), moving=camera(moving, 2), fixed_from_moving=left)


def test_a_scene_that_is_no_plane_is_not_harmed():
    """Patches crowd on the half that has texture; keypoints on both halves deny the transform of one of them."""
    of = two_planes(3.0)
    fixed = of.fixed.astype(float)
    fixed[:, 175:] = 128 + (fixed[:, 175:] - 128) * 0.12
    rng = np.random.default_rng(3)
    src = rng.uniform((10, 10), (300, 225), (200, 2))
    on_right = src[:, 0] > 160
    step = np.where(on_right[:, None], (7.0, 2.0), (4.0, 2.0))
    dst = src + step + rng.normal(0, 0.5, src.shape)
    matched = Correspondences(src=src, dst=dst, src_sigma=np.ones(200), dst_sigma=np.ones(200))
    found = settle(MODELS["translation"], translation(5.5, 2.0), matched, 3.0)
    assert found is not None
    assert found.inliers[on_right].any()
    assert found.inliers[~on_right].any()
    faint = np.clip(np.rint(fixed), 0, 255).astype(np.uint8)
    result = refine(faint, of.moving, found, matched, RefineOptions())

    def misfit(transform: Array) -> float:
        there, _ = project(transform, src[found.inliers])
        return float(np.linalg.norm(there - dst[found.inliers], axis=1).mean())

    # No worse for its keypoints than their own fit, to a tenth of the noise that they have.
    assert misfit(result.fixed_from_moving) < misfit(found.dst_from_src) + 0.05


def test_keypoints_deny_what_a_caption_says():
    """All texture is a caption that sits 1.5 px off the rest: the patches agree on it, the keypoints do not."""
    of = plane()
    caption = photo("text.png")[40:100, 20:260]
    fixed, moving = (128 + (image.astype(float) - 128) * 0.02 for image in (of.fixed, of.moving))
    same = Pair(fixed=fixed, moving=moving, fixed_from_moving=IDENTITY)
    same.fixed[90:150, 40:280], same.moving[90:150, 41:281] = caption, caption
    flat = Pair(
        fixed=np.rint(same.fixed).astype(np.uint8),
        moving=np.rint(same.moving).astype(np.uint8),
        fixed_from_moving=IDENTITY,
    )
    matched = keypoints(flat, 0.2)
    found = consensus(flat, matched, "translation")
    result = refine(flat.fixed, flat.moving, found, matched, RefineOptions())
    assert not result.sharpened
    assert np.array_equal(result.fixed_from_moving, found.dst_from_src)
    assert result.patches is not None  # what was measured stays on the record
    assert np.median(result.patches.after) >= np.median(result.patches.before)


def around(mask: np.ndarray, column: np.ndarray, row: np.ndarray, reach: int) -> list[np.ndarray]:
    """The part of the mask so many pixels to every side of each place."""
    return [
        mask[max(y - reach, 0) : y + reach + 1, max(x - reach, 0) : x + reach + 1]
        for x, y in zip(column, row, strict=True)
    ]


@pytest.mark.parametrize("side", ["fixed", "moving"])
def test_what_a_mask_hides_has_no_say(side):
    """A caption is burnt into both pictures at one place. Masked in either picture, it does not matter."""
    of = plane()
    w, h = SMALL
    caption = photo("text.png")[40:100, 20:260]
    fixed, moving, valid = of.fixed.copy(), of.moving.copy(), np.ones((h, w), bool)
    for image in (fixed, moving):
        image[150:210, 40:280] = caption
    valid[150:210, 40:280] = False
    burnt = Pair(fixed=fixed, moving=moving, fixed_from_moving=of.fixed_from_moving)
    masks = (valid, None) if side == "fixed" else (None, valid)
    result, _ = sharpen(burnt, masks=masks)
    assert result.sharpened
    assert mean_error_px(result.fixed_from_moving, burnt) < 2 * GOOD_PX  # a third of the picture has to be extrapolated
    pairs = result.pairs
    points = pairs.dst if side == "fixed" else pairs.src
    column, row = np.rint(points).astype(int).T
    # Not a pixel of a patch is hidden; ten of its twelve pixels to either side, for it is turned in the moving picture.
    assert not any(valid_around.size != valid_around.sum() for valid_around in around(valid, column, row, 10))


def test_moves_no_further_than_its_model():
    of = plane()
    for model in ("translation", "rigid", "similarity", "affine"):
        result, _ = sharpen(of, model=model)
        linear = shown(result.fixed_from_moving)[:2, :2]
        assert np.allclose(shown(result.fixed_from_moving)[2], [0, 0, 1], atol=1e-9), model
        if model == "translation":
            assert np.allclose(linear, np.eye(2), atol=1e-9)
        if model == "rigid":
            assert np.allclose(linear @ linear.T, np.eye(2), atol=1e-9)
        if model == "similarity":
            assert np.allclose(linear @ linear.T, np.linalg.det(linear) * np.eye(2), atol=1e-9)


@pytest.mark.parametrize(
    "others", [{"skip": True}, {"options": RefineOptions(patches=0)}, {"fixed": np.full((240, 320), 90, np.uint8)}]
)
def test_the_consensus_comes_back_as_it_was_where_nothing_can_be_done(others):
    of = plane()
    matched = keypoints(of, 1.0)
    found = consensus(of, matched)
    arguments = {"fixed": of.fixed, "options": RefineOptions()} | others
    result = refine(arguments.pop("fixed"), of.moving, found, matched, arguments.pop("options"), **arguments)
    assert not result.sharpened
    assert result.patches is None
    assert np.array_equal(result.fixed_from_moving, found.dst_from_src)
    assert len(result.pairs) == found.count


def test_the_record_holds_what_was_measured():
    of = plane()
    result, _ = sharpen(of)
    patches = result.patches
    assert patches is not None
    assert len(patches.pairs) == len(patches.before) == len(patches.after) == len(patches.kept)
    assert len(result.pairs) == patches.kept.sum()
    assert (np.abs(patches.after[patches.kept]) <= 1 + 1e-5).all()
    assert np.median(patches.after[patches.kept]) > np.median(patches.before[patches.kept])
    # A patch's own measurement is where the truth has it, within a few of the sigmas it claims for itself.
    off = np.linalg.norm(apply(of.fixed_from_moving, result.pairs.src) - result.pairs.dst, axis=1)
    assert np.median(off / result.pairs.dst_sigma) < 3.0


def test_swapped_roles_give_the_inverse():
    """To the noise of two refinements: both look at the same pixels, on the other's grid."""
    of = pair("gravel.png", about(160, 120, [[1.05, 0.1], [-0.08, 0.97]]), SMALL)
    swapped = Pair(fixed=of.moving, moving=of.fixed, fixed_from_moving=shown(invert(of.fixed_from_moving)))
    (there, _), (back, _) = (sharpen(p, model="affine") for p in (of, swapped))
    round_trip = Pair(fixed=of.fixed, moving=of.fixed, fixed_from_moving=IDENTITY)
    assert mean_error_px(there.fixed_from_moving @ back.fixed_from_moving, round_trip) < 0.01


@pytest.mark.parametrize("wrong", [{"patches": -1}, {"radius": 2}, {"min_correlation": 1.0}])
def test_options_out_of_range_are_refused(wrong):
    with pytest.raises(ValueError, match="RefineOptions"):
        RefineOptions(**wrong)


@pytest.mark.parametrize("name", ["astronaut.png", "moon.png", "cell.png"])
def test_a_consensus_that_is_good_in_one_corner_only_is_led_to_the_truth_everywhere(name):
    """Far from its keypoints it is off by several pixels, which is where to begin: faint structure cannot follow."""
    of = pair(name, TRUTH, (480, 400), noise=4.0)
    everywhere = keypoints(of, 1.0, count=150)
    matched = everywhere[(everywhere.src < np.array(of.moving.shape[1::-1]) * 0.4).all(1)]
    found = consensus(of, matched)
    start = mean_error_px(found.dst_from_src, of)
    result = refine(of.fixed, of.moving, found, matched, RefineOptions())
    assert start > 5.0
    assert result.sharpened
    assert mean_error_px(result.fixed_from_moving, of) < 0.1  # 1 to 6 px are left where all begins at full size
