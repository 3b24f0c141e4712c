"""Points through transforms, and both DLTs, against OpenCV, scikit-image, NumPy and identities."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import skimage.transform

from autoalign.geometry.homography import (
    adjugate,
    apply,
    as_points,
    determinant,
    dlt,
    four_point,
    invert,
    jacobian,
    normalisation,
    project,
    scaling,
    shown,
    symmetric_transfer_error_squared,
    transfer_error_squared,
    translation,
    unit,
)

SIZE = np.array([1200.0, 700.0])  # (w, h), never square
VIEW = unit(np.array([[0.9, 0.2, 60.0], [-0.15, 1.05, 40.0], [1.5e-4, -1e-4, 1.0]]))
# Sends the origin to infinity: a road seen from above whose horizon goes through the picture's corner.
HORIZON_IN_ORIGIN = unit(np.array([[1.0, 0.2, 30.0], [0.1, 1.1, 50.0], [1e-3, 2e-3, 0.0]]))
CORNERS = np.array([[0.0, 0.0], [1199.0, 0.0], [1199.0, 699.0], [0.0, 699.0]])
# A double carries 16 digits and a picture's coordinates have 4; well-posed samples lose about 4 more.
EXACT_PX = 1e-8


def scattered(n, seed=0, size=SIZE):
    return np.random.default_rng(seed).uniform(0.0, 1.0, (n, 2)) * size


def quads(k, seed=0):
    """(k, 4, 2) corners of the picture moved by up to a fifth of its sides: what cameras see."""
    return CORNERS + np.random.default_rng(seed).uniform(-0.2, 0.2, (k, 4, 2)) * SIZE


def by_linear_system(src, dst):
    """The textbook's 8 x 8 system with h33 = 1."""
    rows, right = [], []
    for (x, y), (u, v) in zip(src, dst, strict=True):
        rows += [[x, y, 1, 0, 0, 0, -u * x, -u * y], [0, 0, 0, x, y, 1, -v * x, -v * y]]
        right += [u, v]
    return np.append(np.linalg.solve(rows, right), 1.0).reshape(3, 3)


# Applying and inverting


def test_points_go_where_opencv_puts_them():
    points = scattered(50)
    expected = cv2.perspectiveTransform(points[:, None], shown(VIEW))[:, 0]
    assert np.abs(apply(VIEW, points) - expected).max() < EXACT_PX


def test_a_stack_of_transforms_acts_as_each_of_them():
    stack, points = np.stack([VIEW, HORIZON_IN_ORIGIN, np.eye(3)]), scattered(20)
    projected, w = project(stack, points)
    assert projected.shape == (3, 20, 2)
    assert w.shape == (3, 20)
    for i, transform in enumerate(stack):
        alone, alone_w = project(transform, points)
        assert np.array_equal(projected[i], alone)
        assert np.array_equal(w[i], alone_w)


def test_a_point_on_the_horizon_is_at_infinity_without_a_warning():
    (place,), (w,) = project(HORIZON_IN_ORIGIN, np.zeros((1, 2)))
    assert w == 0.0
    assert not np.isfinite(place).any()


@pytest.mark.parametrize("transform", [VIEW, HORIZON_IN_ORIGIN, np.diag([-1.0, 1.0, 1.0]), translation(5e5, 5e6)])
def test_the_inverse_takes_points_back_in_front_of_the_camera(transform):
    points = scattered(50)
    there, w = project(transform, points)
    back, back_w = project(invert(transform), there)
    assert np.abs(back - points).max() < 1e-7 if np.abs(there).max() > 1e5 else np.abs(back - points).max() < EXACT_PX
    assert np.array_equal(np.sign(back_w), np.sign(w))
    assert np.linalg.norm(invert(transform)) == pytest.approx(1.0)


def test_adjugate_and_determinant_are_those_of_linear_algebra():
    many = np.random.default_rng(0).normal(size=(40, 3, 3))
    assert np.allclose(determinant(many), np.linalg.det(many), rtol=1e-10, atol=1e-12)
    product = many @ adjugate(many)
    assert np.allclose(product, determinant(many)[:, None, None] * np.eye(3), atol=1e-12)
    flat = np.outer([1.0, 2.0, 3.0], [4.0, 5.0, 6.0])
    assert not adjugate(flat).any()


def test_the_jacobian_is_the_slope_of_finite_differences():
    points, h = scattered(30), 1e-4
    for axis in range(2):
        nudge = np.eye(2)[axis] * h
        slope = (apply(VIEW, points + nudge) - apply(VIEW, points - nudge)) / (2 * h)
        # Central differences err by h^2 and by rounding over h, about 1e-9 both.
        assert np.abs(jacobian(VIEW, points)[:, :, axis] - slope).max() < 1e-7


def test_shown_refuses_a_transform_without_such_a_form():
    assert shown(VIEW)[2, 2] == 1.0
    with pytest.raises(ValueError, match="infinity"):
        shown(HORIZON_IN_ORIGIN)


def test_only_a_transform_of_three_by_three_is_applied():
    with pytest.raises(ValueError, match=r"\(3, 3\), not \(2, 2\)"):
        apply(np.eye(2), [[1.0, 2.0]])


@pytest.mark.parametrize("bad", [[1.0, 2.0], [[1.0, 2.0, 3.0]], [[np.nan, 0.0]], [[np.inf, 0.0]]])
def test_what_is_no_set_of_points_is_refused(bad):
    with pytest.raises(ValueError, match="here"):
        as_points(bad, "here")


def test_scaling_and_translation_are_what_they_say():
    assert apply(translation(3.0, -2.0) @ scaling(2.0, 5.0), [[1.0, 1.0]]).tolist() == [[5.0, 3.0]]


# Transfer error


def test_the_transfer_error_is_the_distance_and_infinite_behind_the_horizon():
    src, dst = scattered(30), scattered(30, 1)
    expected = [np.hypot(*(apply(VIEW, [s])[0] - d)) ** 2 for s, d in zip(src, dst, strict=True)]
    assert np.allclose(transfer_error_squared(VIEW, src, dst), expected, rtol=1e-12)
    assert np.isinf(transfer_error_squared(-VIEW, src, dst)).all()


def test_the_symmetric_error_is_the_mean_of_both_and_does_not_know_which_came_first():
    src, rng = scattered(30), np.random.default_rng(1)
    dst = apply(VIEW, src) + rng.normal(0, 3, (30, 2))
    src_sigma, dst_sigma = rng.uniform(0.5, 2, (2, 30))
    forward = transfer_error_squared(VIEW, src, dst) / dst_sigma**2
    backward = transfer_error_squared(invert(VIEW), dst, src) / src_sigma**2
    both = symmetric_transfer_error_squared(VIEW, src, dst, src_sigma, dst_sigma)
    assert np.allclose(both, (forward + backward) / 2, rtol=1e-12)
    swapped = symmetric_transfer_error_squared(invert(VIEW), dst, src, dst_sigma, src_sigma)
    assert np.allclose(both, swapped, rtol=1e-9)


def test_normalised_points_have_mean_zero_and_mean_distance_sqrt_two():
    points = scattered(50) + np.array([500_000.0, 5_000_000.0])
    normalised = apply(normalisation(points), points)
    assert np.abs(normalised.mean(0)).max() < 1e-8
    assert np.hypot(*normalised.T).mean() == pytest.approx(np.sqrt(2), rel=1e-9)
    assert np.isfinite(normalisation(np.ones((4, 2)))).all()


# Four points


def test_four_points_give_opencvs_transform():
    for src, dst in zip(np.rint(quads(20)), np.rint(quads(20, 1)), strict=True):  # whole: OpenCV takes float32
        transforms, sound = four_point(src[None], dst[None])
        expected = cv2.getPerspectiveTransform(src.astype(np.float32), dst.astype(np.float32))
        assert sound.all()
        assert determinant(transforms[0]) > 0
        # OpenCV solves the raw 8 x 8 system, whose condition of about 1e10 leaves 1e-6 of 1e3 px.
        assert np.abs(apply(transforms[0], scattered(20)) - apply(expected, scattered(20))).max() < 1e-5


def test_four_points_land_exactly():
    src, dst = quads(200), quads(200, 1)
    transforms, sound = four_point(src, dst)
    assert sound.all()
    assert np.allclose(np.linalg.norm(transforms, axis=(1, 2)), 1.0)
    for transform, s, d in zip(transforms, src, dst, strict=True):
        there, w = project(transform, s)
        assert np.abs(there - d).max() < EXACT_PX
        assert (w > 0).all()


def test_a_plane_whose_horizon_goes_through_the_origin_is_found():
    transforms, sound = four_point(CORNERS[None] + 10.0, apply(HORIZON_IN_ORIGIN, CORNERS + 10.0)[None])
    assert sound.all()
    assert np.allclose(transforms[0], HORIZON_IN_ORIGIN, atol=1e-10)


def test_map_coordinates_lose_no_more_than_their_own_rounding():
    rng = np.random.default_rng(0)
    world = np.array([500_000.0, 5_000_000.0]) + CORNERS[:, ::-1] * [0.3, -0.4] + rng.uniform(-20, 20, (4, 2))
    there = np.stack([world, CORNERS])
    transforms, sound = four_point(there, there[::-1])
    assert sound.all()
    # Rounding of 5e6 is 1e-9; the transform holds entries that cancel down from 5e6 to 1e3, hence 1e-5.
    assert np.abs(apply(transforms[0], world) - CORNERS).max() < 1e-5
    assert np.abs(apply(transforms[1], CORNERS) - world).max() < 1e-7


def test_a_batch_is_its_members():
    src, dst = scattered(200).reshape(50, 4, 2), scattered(200, 1).reshape(50, 4, 2)
    transforms, sound = four_point(src, dst)
    assert 0 < sound.sum() < 50
    for i in range(50):
        alone, alone_sound = four_point(src[i : i + 1], dst[i : i + 1])
        assert np.array_equal(alone[0], transforms[i])
        assert alone_sound[0] == sound[i]


def test_a_sample_is_sound_exactly_if_all_four_points_are_in_front():
    src, dst = scattered(2000).reshape(500, 4, 2), scattered(2000, 1).reshape(500, 4, 2)
    _, sound = four_point(src, dst)
    for s, d, is_sound in zip(src, dst, sound, strict=True):
        w = project(by_linear_system(s, d), s)[1]
        assert is_sound == ((w > 0).all() or (w < 0).all())


def test_a_mirrored_picture_is_solved_and_shown_by_its_determinant():
    transforms, sound = four_point(CORNERS[None], (CORNERS * [-1.0, 1.0])[None])
    assert sound.all()
    assert determinant(transforms[0]) < 0
    assert np.abs(apply(transforms[0], scattered(20)) - scattered(20) * [-1.0, 1.0]).max() < EXACT_PX


DEGENERATE = {
    "three collinear": [[0.0, 0.0], [300.0, 100.0], [900.0, 300.0], [50.0, 600.0]],
    "all collinear": [[0.1, 0.1], [0.2, 0.2], [0.3, 0.3], [0.7, 0.7]],
    "one repeated": [[10.0, 20.0], [10.0, 20.0], [900.0, 300.0], [50.0, 600.0]],
    "all one": [[10.0, 20.0]] * 4,
}


@pytest.mark.parametrize("points", DEGENERATE.values(), ids=DEGENERATE)
def test_degenerate_samples_are_not_sound_wherever_they_are(points):
    for order in ([0, 1, 2, 3], [3, 0, 1, 2], [2, 3, 0, 1], [1, 2, 3, 0]):
        bad = np.array(points)[order]
        src, dst = np.stack([bad, CORNERS, CORNERS]), np.stack([CORNERS, bad, CORNERS])
        transforms, sound = four_point(src, dst)
        assert sound.tolist() == [False, False, True]
        assert np.isfinite(transforms).all()
        assert np.allclose(transforms[2], unit(np.eye(3)))


def test_nearly_collinear_is_a_matter_of_min_area():
    nearly = CORNERS.copy()
    nearly[2] = [600.0, 0.5]  # on the upper side but for half a pixel
    assert four_point(CORNERS[None], nearly[None], min_area=1e-9)[0].shape == (1, 3, 3)
    areas = [four_point(nearly[None], nearly[None], min_area=a)[1][0] for a in (1e-9, 1e-2)]
    assert areas == [True, False]


def test_no_samples_give_no_transforms():
    transforms, sound = four_point(np.zeros((0, 4, 2)), np.zeros((0, 4, 2)))
    assert transforms.shape == (0, 3, 3)
    assert sound.shape == (0,)


# Many points


@pytest.mark.parametrize("truth", [VIEW, HORIZON_IN_ORIGIN], ids=["view", "horizon in origin"])
@pytest.mark.parametrize("n", [4, 5, 60])
def test_the_dlt_finds_the_truth_that_exact_points_obey(truth, n):
    src = scattered(n, 5) + 10.0
    assert np.allclose(dlt(src, apply(truth, src)), truth, atol=1e-9)


def test_the_dlt_agrees_with_opencv_and_scikit_image():
    src = scattered(40)
    dst = apply(VIEW, src)
    grid = scattered(30, 2)
    ours = apply(dlt(src, dst), grid)
    opencv, _ = cv2.findHomography(src, dst, method=0)
    scikit = skimage.transform.ProjectiveTransform.from_estimate(src, dst)
    assert np.abs(ours - apply(opencv, grid)).max() < 1e-3  # OpenCV cuts points to float32: 6e-5 px
    assert np.abs(ours - scikit(grid)).max() < EXACT_PX
    noisy = dst + np.random.default_rng(3).normal(0, 1, dst.shape)
    # OpenCV goes on from the algebraic error to the geometric one: both lie well within the noise of the fit, 1 px x
    # sqrt(8 / 80), of each other.
    refined, _ = cv2.findHomography(src, noisy, method=0)
    between = np.linalg.norm(apply(dlt(src, noisy), grid) - apply(refined, grid), axis=1)
    assert np.sqrt((between**2).mean()) < 0.3


def test_the_dlt_does_not_depend_on_the_frames_it_is_given():
    """Hartley's reason for normalising: a move, turn or scale of either picture changes nothing else."""
    src = scattered(30)
    dst = apply(VIEW, src) + np.random.default_rng(1).normal(0, 2, (30, 2))
    turn = np.array([[0.0, -7.0, 300.0], [7.0, 0.0, -90.0], [0.0, 0.0, 1.0]])
    grid = scattered(30, 2)
    moved = apply(turn, apply(dlt(src, dst), grid))
    assert np.abs(apply(dlt(src, apply(turn, dst)), grid) - moved).max() < 1e-6
    assert np.abs(apply(dlt(apply(turn, src), apply(turn, dst)), apply(turn, grid)) - moved).max() < 1e-6


def test_points_of_no_weight_have_no_say_and_the_size_of_weights_does_not_matter():
    src = scattered(30)
    dst = apply(VIEW, src)
    dst[:8] += 200.0
    weights = np.where(np.arange(30) < 8, 0.0, 3.0)
    assert np.allclose(dlt(src, dst, weights), VIEW, atol=1e-9)
    noisy = apply(VIEW, src) + np.random.default_rng(1).normal(0, 2, (30, 2))
    uneven = np.random.default_rng(2).uniform(0.1, 1, 30)
    assert np.allclose(dlt(src, noisy, uneven), dlt(src, noisy, 100 * uneven), atol=1e-9)


def test_a_half_turn_is_found():
    src = scattered(20)
    found = dlt(src, SIZE - 1 - src)
    assert np.allclose(shown(found), [[-1, 0, SIZE[0] - 1], [0, -1, SIZE[1] - 1], [0, 0, 1]], atol=1e-8)


@pytest.mark.parametrize("points", DEGENERATE.values(), ids=DEGENERATE)
def test_points_that_fix_no_homography_are_refused(points):
    for src, dst in ((points, CORNERS), (CORNERS, points)):
        with pytest.raises(ValueError, match="do not fix"):
            dlt(src, dst)


def test_too_few_or_unequal_points_are_refused():
    with pytest.raises(ValueError, match="not 3 and 3"):
        dlt(CORNERS[:3], CORNERS[:3])
    with pytest.raises(ValueError, match="not 4 and 5"):
        dlt(CORNERS, scattered(5))
    with pytest.raises(ValueError, match="do not fix"):
        dlt(scattered(9), scattered(9), weights=np.r_[np.ones(3), np.zeros(6)])
