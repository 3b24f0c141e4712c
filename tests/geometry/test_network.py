"""Networks of ties against scipy on the same cost, the statistics of known noise, and the choice of the reference."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.optimize

from autoalign.geometry.family import MODEL_NAMES, MODELS
from autoalign.geometry.homography import apply, invert, normalisation, scaling, shown, translation, unit
from autoalign.geometry.least_squares import step
from autoalign.geometry.network import Ties, adjust, adjust_in_simplest
from autoalign.geometry.uncertainty import overlap_points, point_errors

SIZE = (800, 500)
GRID = overlap_points(np.eye(3), SIZE, SIZE, 8)
NORM = normalisation(GRID)
MOVING_MODELS = [name for name in MODEL_NAMES if name != "identity"]


def spans(n):
    """Neighbours, and spans of 2 and 4: every frame is held several times."""
    return [(i, i + span) for span in (1, 2, 4) for i in range(n - span)]


def truth_of(name, n, seed=0):
    """(n, 3, 3) transforms of the model onto frame 0: moves of up to a tenth of the picture."""
    rng = np.random.default_rng(seed)
    parameters = rng.uniform(-0.1, 0.1, (n, MODELS[name].degrees_of_freedom))
    parameters[0] = 0.0
    return step(MODELS[name], np.broadcast_to(unit(np.eye(3)), (n, 3, 3)), parameters, NORM)


def ties_of(truth, pairs, sigma=1e-5, seed=0, claimed=1.0):
    """Ties with noise of a random covariance, `sigma` of the picture's size, of which they claim a share."""
    rng = np.random.default_rng(seed + 1)
    fixed, moving = np.array(pairs).T
    roots = np.eye(8) + 0.25 * rng.normal(size=(len(pairs), 8, 8))
    covariance = sigma**2 * np.einsum("mij,mkj->mik", roots, roots)
    noise = sigma * np.einsum("mij,mj->mi", roots, rng.normal(size=(len(pairs), 8)))
    return Ties(
        fixed=fixed,
        moving=moving,
        fixed_from_moving=step(MODELS["homography"], invert(truth)[fixed] @ truth[moving], noise, NORM),
        norm=np.repeat(NORM[None], len(pairs), 0),
        covariance=claimed**2 * covariance,
        error_px=np.full(len(pairs), sigma / NORM[0, 0]),
    )


def chosen(ties, index):
    return replace(ties, **{name: getattr(ties, name)[index] for name in vars(ties)})


def solved(name, ties, n, reference=0, **options):
    return adjust(MODELS[name], reference, np.repeat(NORM[None], n, 0), ties, **options)


def spoilt(ties, index, px):
    """The ties with some of them that many pixels off, each another way."""
    transforms = ties.fixed_from_moving.copy()
    for k, tie in enumerate(index):
        transforms[tie] = unit(transforms[tie] @ translation(px * np.cos(k), px * np.sin(k)))
    return replace(ties, fixed_from_moving=transforms)


def distances(found, truth):
    """(n, points) how far each frame's points land from where they should."""
    return np.array(
        [np.linalg.norm(apply(a, GRID) - apply(b, GRID), axis=1) for a, b in zip(found, truth, strict=True)]
    )


@pytest.mark.parametrize("name", MOVING_MODELS)
def test_exact_ties_give_the_exact_transforms(name):
    truth = truth_of(name, 9)
    found = solved(name, ties_of(truth, spans(9), sigma=1e-12), 9)
    assert distances(found.reference_from_frame, truth).max() < 1e-8
    assert found.kept.all()


@pytest.mark.parametrize("name", ["rigid", "homography"])
def test_the_minimum_is_that_of_scipy(name):
    """Numerical derivatives, dense, and the misfit by the matrix logarithm's first term, spelled out."""
    n, model = 4, MODELS[name]
    truth = truth_of(name, n)
    ties = ties_of(truth, spans(n), sigma=1e-3)
    information = np.linalg.cholesky(np.linalg.inv(ties.covariance))

    def transforms(parameters):
        rows = np.concatenate([np.zeros((1, model.degrees_of_freedom)), parameters.reshape(n - 1, -1)])
        return step(model, truth, rows, np.repeat(NORM[None], n, 0))

    def misfits(parameters):
        frames = transforms(parameters)
        out = []
        for k, (f, m) in enumerate(zip(ties.fixed, ties.moving, strict=True)):
            left = np.linalg.inv(ties.fixed_from_moving[k]) @ np.linalg.inv(frames[f]) @ frames[m]
            a = shown(NORM @ left @ np.linalg.inv(NORM))
            grow, stretch = (a[0, 0] + a[1, 1]) / 2 - 1, (a[0, 0] - a[1, 1]) / 2
            turned, shear = (a[1, 0] - a[0, 1]) / 2, (a[1, 0] + a[0, 1]) / 2
            moved = np.array([a[0, 2], a[1, 2], turned, grow, stretch, shear, a[2, 0], a[2, 1]])
            out.append(information[k].T @ moved)
        return np.concatenate(out)

    start = np.zeros((n - 1) * model.degrees_of_freedom)
    best = transforms(scipy.optimize.least_squares(misfits, start, xtol=1e-14, ftol=1e-14, gtol=1e-14).x)
    found = solved(name, ties, n, threshold=100.0)
    assert found.kept.all()
    assert distances(found.reference_from_frame, best).max() < 1e-5
    assert distances(found.reference_from_frame, truth).max() > 0.05, "the noise is there"


@pytest.mark.parametrize("name", ["translation", "similarity", "homography"])
def test_the_expected_error_is_the_error_of_known_noise(name):
    n, true, expected = 12, [], []
    for seed in range(12):
        truth = truth_of(name, n, seed)
        found = solved(name, ties_of(truth, spans(n), seed=seed), n)
        true.append(distances(found.reference_from_frame, truth).mean(1))
        model = MODELS[name]
        frames = range(n)
        expected.append(
            [point_errors(model, found.reference_from_frame[i], found.known(i), GRID).mean() for i in frames]
        )
        assert found.unit_sigma == pytest.approx(1.0, abs=0.3)
    assert np.all(np.array(expected)[:, 0] == 0), "the reference is where it is"
    ratio = np.mean(true, 0)[1:] / np.mean(expected, 0)[1:]
    assert ratio.mean() == pytest.approx(1.0, abs=0.15)
    assert np.abs(ratio - 1).max() < 0.6


def test_errors_larger_than_claimed_are_noticed():
    truth = truth_of("similarity", 30)
    honest, bold = (solved("similarity", ties_of(truth, spans(30), claimed=c), 30) for c in (1.0, 0.25))
    assert bold.unit_sigma == pytest.approx(4 * honest.unit_sigma, rel=1e-3)
    np.testing.assert_allclose(bold.covariance, min(honest.unit_sigma, 1.0) ** 2 * honest.covariance, rtol=1e-3)


def test_more_ties_drift_less_than_a_chain():
    truth = truth_of("similarity", 40)
    ties = ties_of(truth, spans(40))
    chain = chosen(ties, np.arange(39))
    all_tied, chained = (
        distances(solved("similarity", given, 40).reference_from_frame, truth) for given in (ties, chain)
    )
    assert all_tied[1:].mean() < 0.6 * chained[1:].mean()


@pytest.mark.parametrize("px", [0.5, 5.0, 500.0])
def test_a_wrong_tie_is_overruled(px):
    truth = truth_of("homography", 12)
    ties = ties_of(truth, spans(12))
    for wrong in (0, 7, 20):  # a neighbour of the reference, one in the midst, a wide span
        found = solved("homography", spoilt(ties, [wrong], px), 12)
        without = solved("homography", chosen(ties, np.arange(len(ties)) != wrong), 12)
        assert np.flatnonzero(~found.kept).tolist() == [wrong]
        assert distances(found.reference_from_frame, without.reference_from_frame).max() < 1e-3


def test_a_tenth_of_wrong_ties_is_overruled():
    truth = truth_of("similarity", 60)
    ties = ties_of(truth, spans(60))
    wrong = np.sort(np.random.default_rng(3).choice(len(ties), len(ties) // 10, replace=False))
    found = solved("similarity", spoilt(ties, wrong, 80.0), 60)
    assert np.flatnonzero(~found.kept).tolist() == wrong.tolist()
    assert distances(found.reference_from_frame, truth).max() < 0.1


def test_the_reference_only_names_the_frame():
    truth = truth_of("homography", 10)
    ties = ties_of(truth, spans(10))
    first, fifth = (solved("homography", ties, 10, reference=r).reference_from_frame for r in (0, 5))
    assert distances(invert(first[5]) @ first, fifth).max() < 1e-6
    np.testing.assert_array_equal(fifth[5], unit(np.eye(3)))


def test_the_order_of_frames_and_ties_does_not_matter():
    n, rng = 10, np.random.default_rng(0)
    ties = ties_of(truth_of("affine", n), spans(n))
    number, order = rng.permutation(n), rng.permutation(len(ties))
    renamed = replace(chosen(ties, order), fixed=number[ties.fixed[order]], moving=number[ties.moving[order]])
    found = solved("affine", ties, n).reference_from_frame
    other = solved("affine", renamed, n, reference=number[0]).reference_from_frame
    assert distances(other[number], found).max() < 1e-6


def test_a_tie_turned_round_says_the_same():
    """The covariance goes along: moved = inverse(T) of the other end's noise, to first order for small noise."""
    truth = truth_of("similarity", 8)
    ties = ties_of(truth, spans(8), sigma=1e-6)
    there = NORM @ ties.fixed_from_moving @ np.linalg.inv(NORM)
    generators = MODELS["homography"].generators
    along = generators / np.square(generators).sum((1, 2), keepdims=True)
    moved = there[:, None] @ generators @ np.linalg.inv(there)[:, None]
    moved = moved - moved[..., 2:, 2:] * np.eye(3)
    turned = -np.einsum("gij,mhij->mgh", along, moved)
    back = replace(
        ties,
        fixed=ties.moving,
        moving=ties.fixed,
        fixed_from_moving=invert(ties.fixed_from_moving),
        covariance=turned @ ties.covariance @ np.swapaxes(turned, 1, 2),
    )
    a, b = (solved("similarity", given, 8).reference_from_frame for given in (ties, back))
    assert distances(a, b).max() < 1e-6


def test_frames_that_nothing_holds_stay_as_they_are():
    truth = truth_of("rigid", 7)
    found = solved("rigid", ties_of(truth, [(0, 1), (1, 2), (0, 2), (4, 5), (5, 6)]), 7)
    assert distances(found.reference_from_frame[:3], truth[:3]).max() < 0.1
    np.testing.assert_array_equal(found.reference_from_frame[3:], np.broadcast_to(unit(np.eye(3)), (4, 3, 3)))
    assert not found.covariance[3:].any()


def test_no_ties_at_all():
    nothing = chosen(ties_of(truth_of("rigid", 2), [(0, 1)]), slice(0, 0))
    found = solved("rigid", nothing, 3)
    np.testing.assert_array_equal(found.reference_from_frame, np.broadcast_to(unit(np.eye(3)), (3, 3, 3)))
    assert found.kept.shape == (0,)


def test_ties_that_say_nothing_of_the_tilt_serve_models_without_it():
    truth = truth_of("affine", 6)
    ties = ties_of(truth, spans(6))
    deaf = np.linalg.inv(ties.covariance)
    deaf[:, 6:], deaf[:, :, 6:] = 0.0, 0.0
    found = solved("affine", replace(ties, covariance=np.linalg.pinv(deaf, hermitian=True)), 6)
    assert found.kept.all()
    assert 0 < distances(found.reference_from_frame, truth).max() < 0.1


def test_the_simplest_model_that_the_ties_agree_on_is_taken():
    n, models = 12, [MODELS[name] for name in ("rigid", "similarity", "affine", "homography")]
    for name in ("rigid", "similarity", "homography"):
        ties = ties_of(truth_of(name, n), spans(n), claimed=5.0)
        model, _ = adjust_in_simplest(models, 0, np.repeat(NORM[None], n, 0), ties)
        assert model.name == name


def test_one_frame_that_needs_it_gives_all_the_general_model():
    n, models = 12, [MODELS[name] for name in ("similarity", "affine", "homography")]
    truth = truth_of("similarity", n)
    truth[6] = unit(truth[6] @ invert(NORM) @ (np.eye(3) + 0.05 * MODELS["homography"].generators[6]) @ NORM)
    model, found = adjust_in_simplest(models, 0, np.repeat(NORM[None], n, 0), ties_of(truth, spans(n)))
    assert model.name == "homography"
    assert found.kept.all()


def test_sizes_of_frames_only_condition_the_numbers():
    truth = truth_of("homography", 6)
    ties = ties_of(truth, spans(6))
    norms = np.stack([scaling(s, s) @ NORM for s in np.linspace(0.3, 3.0, 6)])
    a, b = (
        adjust(MODELS["homography"], 0, given, ties).reference_from_frame
        for given in (norms, np.repeat(NORM[None], 6, 0))
    )
    assert distances(a, b).max() < 1e-6
