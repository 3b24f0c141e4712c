"""Robust least squares against scipy on the same cost, finite differences, and the swap of the pictures."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg
import scipy.optimize

from autoalign.geometry.family import MODEL_NAMES, MODELS, fit
from autoalign.geometry.homography import (
    apply,
    invert,
    normalisation,
    project,
    symmetric_transfer_error_squared,
    unit,
)
from autoalign.geometry.least_squares import (
    TUKEY,
    Correspondences,
    correspondences,
    polish,
    robust_scale,
    step,
    tukey_weights,
    velocities,
)

SIZE = np.array([1200.0, 700.0])
C, S = np.cos(0.4), np.sin(0.4)
TRUTHS = {
    "translation": np.array([[1.0, 0.0, 31.0], [0.0, 1.0, -17.0], [0.0, 0.0, 1.0]]),
    "rigid": np.array([[C, -S, 31.0], [S, C, -17.0], [0.0, 0.0, 1.0]]),
    "similarity": np.array([[1.3 * C, -1.3 * S, 31.0], [1.3 * S, 1.3 * C, -17.0], [0.0, 0.0, 1.0]]),
    "affine": np.array([[1.1, -0.3, 31.0], [0.2, 0.8, -17.0], [0.0, 0.0, 1.0]]),
    "homography": np.array([[1.1, -0.3, 31.0], [0.2, 0.8, -17.0], [2e-4, 1e-4, 1.0]]),
}
SOLVED = [name for name in MODEL_NAMES if name != "identity"]
# Tukey's cost of errors of a few px under this scale is the square, but for a millionth.
ALL_COUNT = 1e3


def scattered(n, seed=0):
    return np.random.default_rng(seed).uniform(0.0, 1.0, (n, 2)) * SIZE


def noisy(name, n=60, noise=1.0, seed=0):
    rng = np.random.default_rng(seed + 100)
    src = scattered(n, seed)
    dst = apply(TRUTHS[name], src) + rng.normal(0, noise, (n, 2))
    return correspondences(src + rng.normal(0, noise, (n, 2)), dst)


def swapped(pairs):
    return Correspondences(src=pairs.dst, dst=pairs.src, src_sigma=pairs.dst_sigma, dst_sigma=pairs.src_sigma)


def start(name, pairs):
    return fit(name, pairs.src, pairs.dst)


def nudged(name, transform, pairs, size=0.02):
    """A few pixels off, inside the model."""
    parameters = size * np.cos(np.arange(MODELS[name].degrees_of_freedom))
    return step(MODELS[name], transform, parameters, normalisation(pairs.src))


def apart(a, b):
    """Greatest distance between two transforms over the picture."""
    grid = scattered(40, 9)
    return np.linalg.norm(apply(a, grid) - apply(b, grid), axis=1).max()


def error_squared(transform, pairs):
    return symmetric_transfer_error_squared(transform, pairs.src, pairs.dst, pairs.src_sigma, pairs.dst_sigma)


def by_scipy(name, pairs, transform):
    """Least squares of both directions' residuals, by scipy and numerical derivatives."""
    norm = normalisation(pairs.src)

    def residuals(parameters):
        moved = step(MODELS[name], transform, parameters, norm)
        forward = (project(moved, pairs.src)[0] - pairs.dst) / pairs.dst_sigma[:, None]
        backward = (project(invert(moved), pairs.dst)[0] - pairs.src) / pairs.src_sigma[:, None]
        return np.concatenate([forward, backward]).ravel()

    zero = np.zeros(MODELS[name].degrees_of_freedom)
    found = scipy.optimize.least_squares(residuals, zero, jac="3-point", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    return step(MODELS[name], transform, found.x, norm)


# scipy stops where the cost no longer moves a double, at half of the digits: 1e-8 of 1e3 px.
SAME_PX = 1e-4


@pytest.mark.parametrize("name", SOLVED)
def test_the_minimum_is_the_one_scipy_finds(name):
    pairs = noisy(name)
    from_afar = nudged(name, start(name, pairs), pairs)
    assert apart(from_afar, start(name, pairs)) > 3
    polished = polish(MODELS[name], from_afar, pairs, sigma_floor=ALL_COUNT)
    assert apart(polished, by_scipy(name, pairs, start(name, pairs))) < SAME_PX
    assert np.linalg.norm(polished) == pytest.approx(1.0)


@pytest.mark.parametrize("name", ["similarity", "homography"])
def test_points_count_by_their_sigmas(name):
    pairs = noisy(name)
    rng = np.random.default_rng(1)
    uneven = Correspondences(
        src=pairs.src,
        dst=pairs.dst,
        src_sigma=rng.uniform(0.3, 3, len(pairs)),
        dst_sigma=rng.uniform(0.3, 3, len(pairs)),
    )
    polished = polish(MODELS[name], start(name, pairs), uneven, sigma_floor=ALL_COUNT)
    assert apart(polished, by_scipy(name, uneven, start(name, pairs))) < SAME_PX
    assert apart(polished, polish(MODELS[name], start(name, pairs), pairs, sigma_floor=ALL_COUNT)) > 0.05


@pytest.mark.parametrize("name", SOLVED)
def test_swapped_pictures_give_the_inverse(name):
    pairs = noisy(name)
    there = polish(MODELS[name], start(name, pairs), pairs)
    back = polish(MODELS[name], start(name, swapped(pairs)), swapped(pairs))
    # Each stops when a step is under 1e-9 of the picture, linear convergence leaves some times that.
    assert apart(there, invert(back)) < 1e-4


@pytest.mark.parametrize("name", SOLVED)
def test_it_ends_at_a_minimum_of_tukeys_cost(name):
    pairs = noisy(name)
    pairs.dst[:10] += 40.0
    found = polish(MODELS[name], start(name, pairs[np.arange(10, 60)]), pairs)
    sigma = robust_scale(error_squared(found, pairs), 0.1)

    def cost(parameters):
        moved = step(MODELS[name], found, parameters, normalisation(pairs.src))
        ratio = np.minimum(error_squared(moved, pairs) / (TUKEY * sigma) ** 2, 1.0)
        return (1 - (1 - ratio) ** 3).sum()

    best = cost(np.zeros(MODELS[name].degrees_of_freedom))
    for parameter in np.eye(MODELS[name].degrees_of_freedom):
        for far in (1e-5, 1e-4, 1e-3):  # of the picture: hundredths of a pixel to about a pixel
            assert cost(far * parameter) > best
            assert cost(-far * parameter) > best


@pytest.mark.parametrize("name", SOLVED)
def test_a_fifth_of_wild_points_moves_the_answer_less_than_the_noise_does(name):
    clean = noisy(name, 100)
    wild = noisy(name, 100)
    wild.dst[:20] += np.random.default_rng(3).uniform(20, 40, (20, 2))
    model = MODELS[name]
    reference = polish(model, start(name, clean), clean)
    robust = polish(model, start(name, clean), wild)
    # Leaving out a fifth of the points moves a fit of 8 parameters on 200 numbers of noise sqrt(2) by about
    # sqrt(2) x sqrt(8 / 200) x sqrt(0.2 / 0.8) = 0.14 px in the mean; the plain fit is carried off by 6 px.
    grid = scattered(40, 9)
    moved = np.linalg.norm(apply(robust, grid) - apply(reference, grid), axis=1).mean()
    plain = np.linalg.norm(apply(fit(name, wild.src, wild.dst), grid) - apply(reference, grid), axis=1).mean()
    assert moved < 0.5
    assert plain > 4


@pytest.mark.parametrize("name", SOLVED)
def test_exact_points_stay_exact(name):
    src = scattered(30)
    pairs = correspondences(src, apply(TRUTHS[name], src))
    assert apart(polish(MODELS[name], nudged(name, unit(TRUTHS[name]), pairs, 0.005), pairs), TRUTHS[name]) < 1e-6


def test_the_identity_has_nowhere_to_go():
    pairs = noisy("translation")
    assert np.array_equal(polish(MODELS["identity"], np.eye(3), pairs), np.eye(3))


def test_a_start_that_has_points_at_infinity_is_given_back():
    start_transform = unit(np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 0.0, -1.0]]))
    src = np.vstack([scattered(10), [[1.0, 5.0]]])  # the last lies on the horizon
    found = polish(MODELS["homography"], start_transform, correspondences(src, src))
    assert np.array_equal(found, start_transform)


def test_collinear_points_do_not_break_it():
    x = np.linspace(0, 1000, 12)
    src = np.stack([x, 0.5 * x], 1)
    found = polish(MODELS["homography"], unit(np.eye(3)), correspondences(src, src + np.array([2.0, 1.0])))
    assert np.isfinite(found).all()
    assert np.abs(apply(found, src) - src - [2.0, 1.0]).max() < 0.01


@pytest.mark.parametrize("name", SOLVED)
def test_velocities_are_the_slope_of_small_steps(name):
    model, points = MODELS[name], scattered(20)
    norm, h = normalisation(points), 1e-5
    for i, parameter in enumerate(np.eye(model.degrees_of_freedom) * h):
        ahead, behind = (apply(step(model, np.eye(3), sign * parameter, norm), points) for sign in (1, -1))
        # Central differences err by h^2 of the picture and by rounding over h.
        assert np.abs(velocities(model, points, norm)[:, :, i] - (ahead - behind) / (2 * h)).max() < 1e-4


@pytest.mark.parametrize("size", [1e-6, 0.05, 1.0])
def test_a_step_is_the_matrix_exponential_and_undone_by_its_negative(size):
    model, norm = MODELS["homography"], normalisation(scattered(20))
    parameters = size * np.sin(np.arange(1, 9))
    generator = np.einsum("g,gij->ij", parameters, model.generators)
    expected = np.linalg.inv(norm) @ scipy.linalg.expm(generator) @ norm
    moved = step(model, np.eye(3), parameters, norm)
    assert np.allclose(moved, unit(expected), atol=1e-12)
    assert np.allclose(step(model, moved, -parameters, norm), unit(np.eye(3)), atol=1e-10)


def test_the_robust_scale_is_the_sigma_of_a_coordinate():
    errors = np.random.default_rng(0).normal(0, 2.5, (20_000, 2))
    squared = (errors**2).sum(1)
    # The median of n has a relative standard error of about 0.72 / sqrt(n) here: 0.5 %.
    assert robust_scale(squared, 0.1) == pytest.approx(2.5, rel=0.02)
    squared[:6000] = 1e6
    assert robust_scale(squared, 0.1) < 4
    assert robust_scale(np.zeros(5), 0.1) == 0.1


def test_tukeys_weights_fall_from_one_to_nothing():
    weights = tukey_weights(np.array([0.0, (TUKEY * 2 / 2) ** 2, (TUKEY * 2) ** 2, 1e9]), 2.0)
    assert weights.tolist() == pytest.approx([1.0, 0.75**2, 0.0, 0.0])


def test_pairs_are_chosen_by_mask_or_by_indices():
    pairs = noisy("affine", 6)
    mask = np.array([True, False, True, False, False, True])
    for chosen in (pairs[mask], pairs[np.array([0, 2, 5])]):
        assert len(chosen) == 3
        assert np.array_equal(chosen.src, pairs.src[[0, 2, 5]])
        assert np.array_equal(chosen.dst_sigma, pairs.dst_sigma[[0, 2, 5]])
