"""The family of models against scikit-image, scipy and what makes each a group inside the next."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import scipy.optimize
import skimage.transform

from autoalign.geometry.family import MODEL_NAMES, MODELS, fit, solve_samples
from autoalign.geometry.homography import apply, determinant, normalisation, shown, unit
from autoalign.geometry.least_squares import step

SIZE = np.array([1200.0, 700.0])
ANGLE = 0.4
C, S = np.cos(ANGLE), np.sin(ANGLE)
TRUTHS = {
    "identity": np.eye(3),
    "translation": np.array([[1.0, 0.0, 31.0], [0.0, 1.0, -17.0], [0.0, 0.0, 1.0]]),
    "rigid": np.array([[C, -S, 31.0], [S, C, -17.0], [0.0, 0.0, 1.0]]),
    "similarity": np.array([[1.3 * C, -1.3 * S, 31.0], [1.3 * S, 1.3 * C, -17.0], [0.0, 0.0, 1.0]]),
    "affine": np.array([[1.1, -0.3, 31.0], [0.2, 0.8, -17.0], [0.0, 0.0, 1.0]]),
    "homography": np.array([[1.1, -0.3, 31.0], [0.2, 0.8, -17.0], [2e-4, 1e-4, 1.0]]),
}
SOLVED = [name for name in MODEL_NAMES if name != "identity"]
LEAST_SQUARES = [name for name in SOLVED if name != "homography"]


def scattered(n, seed=0):
    return np.random.default_rng(seed).uniform(0.0, 1.0, (n, 2)) * SIZE


def noisy(name, n=25, noise=3.0, seed=0):
    src = scattered(n, seed)
    return src, apply(TRUTHS[name], src) + np.random.default_rng(seed + 100).normal(0, noise, (n, 2))


@pytest.mark.parametrize("name", MODEL_NAMES)
def test_a_model_recovers_itself_from_its_fewest_points_and_from_many(name):
    for n in (max(MODELS[name].sample_size, 1), 30):
        src = scattered(n)
        assert np.allclose(shown(fit(name, src, apply(TRUTHS[name], src))), TRUTHS[name], atol=1e-8)


@pytest.mark.parametrize(("inner", "outer"), list(pairwise(MODEL_NAMES)))
def test_each_model_holds_the_one_before_it(inner, outer):
    src = scattered(30)
    assert np.allclose(shown(fit(outer, src, apply(TRUTHS[inner], src))), TRUTHS[inner], atol=1e-8)
    gained = MODELS[outer].degrees_of_freedom - MODELS[inner].degrees_of_freedom
    assert gained == {"translation": 2, "rigid": 1, "similarity": 1, "affine": 2, "homography": 2}[outer]
    assert 2 * MODELS[outer].sample_size >= MODELS[outer].degrees_of_freedom


@pytest.mark.parametrize(
    ("name", "oracle"),
    [("rigid", skimage.transform.EuclideanTransform), ("similarity", skimage.transform.SimilarityTransform)],
)
def test_noisy_points_give_scikit_images_answer(name, oracle):
    src, dst = noisy(name)
    assert np.allclose(shown(fit(name, src, dst)), oracle.from_estimate(src, dst).params, atol=1e-8)


def test_exact_points_give_scikit_images_affine():
    src = scattered(20)
    dst = apply(TRUTHS["affine"], src)
    expected = skimage.transform.AffineTransform.from_estimate(src, dst).params
    assert np.allclose(shown(fit("affine", src, dst)), expected, atol=1e-8)


def test_a_noisy_affine_is_linear_least_squares_with_weights():
    src, dst = noisy("affine")
    weights = np.random.default_rng(5).uniform(0.1, 4.0, len(src))
    root = np.sqrt(weights)[:, None]
    solution = np.linalg.lstsq(root * np.c_[src, np.ones(len(src))], root * dst, rcond=None)[0]
    assert np.allclose(shown(fit("affine", src, dst, weights))[:2], solution.T, atol=1e-8)


BUILD = {
    "translation": lambda p: np.array([[1, 0, p[0]], [0, 1, p[1]], [0, 0, 1]]),
    "rigid": lambda p: np.array([[np.cos(p[2]), -np.sin(p[2]), p[0]], [np.sin(p[2]), np.cos(p[2]), p[1]], [0, 0, 1]]),
    "similarity": lambda p: np.array([[p[2], -p[3], p[0]], [p[3], p[2], p[1]], [0, 0, 1]]),
}


@pytest.mark.parametrize("name", BUILD)
def test_weighted_fits_are_the_minimum_that_scipy_finds(name):
    src, dst = noisy(name)
    weights = np.random.default_rng(5).uniform(0.1, 4.0, len(src))

    def residuals(parameters):
        return (np.sqrt(weights)[:, None] * (apply(BUILD[name](parameters), src) - dst)).ravel()

    start = {"translation": [0, 0], "rigid": [0, 0, 0.3], "similarity": [0, 0, 1, 0]}[name]
    found = scipy.optimize.least_squares(residuals, start, x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-14)
    # scipy stops where the cost no longer moves a double: half of the digits of the parameters, 1e-8 of 1e3 px.
    assert np.abs(apply(fit(name, src, dst, weights), src) - apply(BUILD[name](found.x), src)).max() < 1e-4


@pytest.mark.parametrize("name", LEAST_SQUARES)
def test_a_weight_of_three_is_the_point_three_times(name):
    src, dst = noisy(name)
    times = np.random.default_rng(5).integers(1, 4, len(src))
    repeated = fit(name, np.repeat(src, times, 0), np.repeat(dst, times, 0))
    assert np.allclose(shown(fit(name, src, dst, times)), shown(repeated), atol=1e-8)


@pytest.mark.parametrize("name", SOLVED)
def test_moves_along_the_generators_stay_in_the_model(name):
    model, src = MODELS[name], scattered(30)
    parameters = np.random.default_rng(1).normal(0, 0.1, model.degrees_of_freedom)
    moved = step(model, unit(TRUTHS[name]), parameters, normalisation(src))
    refitted = fit(name, src, apply(moved, src))
    assert np.abs(apply(refitted, src) - apply(moved, src)).max() < 1e-7
    assert np.abs(apply(moved, src) - apply(TRUTHS[name], src)).max() > 1.0


@pytest.mark.parametrize("name", SOLVED)
def test_minimal_samples_are_solved_in_batches_exactly(name):
    m = MODELS[name].sample_size
    src = scattered(50 * m).reshape(50, m, 2)
    dst = np.stack([apply(TRUTHS[name], sample) for sample in src])
    transforms, sound = solve_samples(MODELS[name], src, dst, min_area=1e-2)
    assert sound.mean() > 0.8  # few random triples are collinear to a hundredth of their area
    for transform in transforms[sound]:
        # The smallest area allowed, 1e-2, costs at most its square of the digits.
        assert np.abs(apply(transform, src[0]) - apply(TRUTHS[name], src[0])).max() < 1e-5


@pytest.mark.parametrize("name", ["rigid", "similarity", "affine", "homography"])
def test_repeated_points_are_not_sound(name):
    m = MODELS[name].sample_size
    good, repeated = scattered(m), scattered(m)
    repeated[1] = repeated[0]
    src, dst = np.stack([repeated, good, good]), np.stack([good, repeated, good])
    transforms, sound = solve_samples(MODELS[name], src, dst)
    assert sound.tolist() == [False, False, True]
    assert np.isfinite(transforms).all()


def test_collinear_triples_are_not_sound_though_rounding_moves_them_off_the_line():
    x = np.random.default_rng(0).uniform(0, 1000, (500, 3))
    line = np.stack([x, 0.3 * x + 7.1], -1)
    other = scattered(1500).reshape(500, 3, 2)
    assert not solve_samples(MODELS["affine"], line, other)[1].any()
    assert not solve_samples(MODELS["affine"], other, line)[1].any()


@pytest.mark.parametrize("name", ["similarity", "affine", "homography"])
@pytest.mark.parametrize("scale", [1e-3, 1 / 40, 40.0, 1e3])
def test_soundness_does_not_depend_on_the_scale_between_the_pictures(name, scale):
    m = MODELS[name].sample_size
    src = scattered(200 * m).reshape(200, m, 2)
    alike = solve_samples(MODELS[name], src, src, min_area=1e-3)[1]
    scaled = solve_samples(MODELS[name], src, src * scale, min_area=1e-3)[1]
    assert np.array_equal(alike, scaled)
    assert alike.mean() > 0.9


@pytest.mark.parametrize("name", ["affine", "homography"])
def test_a_mirror_is_recognised_by_its_determinant(name):
    src = scattered(4)[None, : MODELS[name].sample_size]
    transforms, sound = solve_samples(MODELS[name], src, src * [1.0, -1.0])
    assert sound.all()
    assert determinant(transforms[0]) < 0


@pytest.mark.parametrize("name", ["rigid", "similarity"])
def test_a_mirrored_picture_never_makes_these_mirror(name):
    src = scattered(20)
    assert determinant(fit(name, src, src * [1.0, -1.0])) > 0


@pytest.mark.parametrize("name", SOLVED)
def test_too_few_points_are_refused_by_number(name):
    few = MODELS[name].sample_size - 1
    with pytest.raises(ValueError, match=f"{name} needs {few + 1} or more pairs of points, not {few} and {few}"):
        fit(name, scattered(few), scattered(few))


@pytest.mark.parametrize(
    ("name", "points"),
    [
        ("rigid", [[3.0, 4.0]] * 3),
        ("similarity", [[3.0, 4.0]] * 3),
        ("affine", [[0.1, 0.1], [0.2, 0.2], [0.3, 0.3], [0.7, 0.7]]),
        ("homography", [[0.1, 0.1], [0.2, 0.2], [0.3, 0.3], [0.7, 0.7]]),
        ("homography", [[0.1, 0.1], [0.2, 0.2], [0.3, 0.3], [0.7, 0.7], [0.9, 0.9]]),
    ],
)
def test_points_that_do_not_fix_the_model_are_refused(name, points):
    with pytest.raises(ValueError, match="do not fix"):
        fit(name, points, scattered(len(points)))
    if name in ("affine", "homography"):
        with pytest.raises(ValueError, match="do not fix"):
            fit(name, scattered(len(points)), points)


def test_four_corners_typed_in_another_order_are_refused_with_that_reason():
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    with pytest.raises(ValueError, match="another order"):
        fit("homography", corners, corners[[0, 2, 1, 3]])


def test_a_model_that_there_is_not_is_named():
    with pytest.raises(ValueError, match=r"'afine' is none of the models identity, .*, homography"):
        fit("afine", np.zeros((3, 2)), np.zeros((3, 2)))
