"""Each way to fail and each doubt has its sentence with the numbers; only sound evidence is praised."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from autoalign.geometry.family import MODELS, fit
from autoalign.geometry.homography import IDENTITY, Array, apply, project, translation
from autoalign.geometry.least_squares import Correspondences, correspondences
from autoalign.geometry.ransac import Consensus, settle
from autoalign.registration.agreement import Agreement
from autoalign.registration.verdict import (
    Evidence,
    Sizes,
    VerdictOptions,
    chance,
    expected_error,
    hints,
    judge,
    nothing_found,
    set_aside,
    weigh,
)

OPTIONS = VerdictOptions()
SIZES = Sizes(fixed=(640, 480), moving=(600, 500))
GOOD = Agreement(blocks=200, agreeing=180, share=0.9, core=0.9, correlation=0.8)
EVIDENCE = Evidence(
    matches=500,
    independent_matches=300,
    independent_inliers=200,
    log10_false_alarms=-150.0,
    overlap=0.8,
    agreement=GOOD,
    stretch=(0.9, 1.1),
    anisotropy=1.1,
    halves_px=0.02,
    fit_px=0.01,
    residual_px=0.05,
    model_px=0.01,
)


def numbers(sentence: str) -> set[str]:
    return set(re.findall(r"\d+(?:\.\d+)?", sentence))


def test_sound_evidence_is_aligned_and_says_why():
    verdict = judge(EVIDENCE, OPTIONS, SIZES)
    assert verdict.status == "aligned"
    assert {"200", "300", "180"} <= numbers(verdict.reason)
    assert verdict.advice == ""
    assert verdict.expected_error_px == expected_error(EVIDENCE)


def bad_agreement(share: float) -> Agreement:
    return replace(GOOD, agreeing=round(200 * share), share=share, core=share)


@pytest.mark.parametrize(
    ("failing", "words", "figures"),
    [
        ({"log10_false_alarms": OPTIONS.max_log10_false_alarms + 1}, "chance explains", {"200", "300"}),
        ({"log10_false_alarms": 3.0}, "certain", {"200", "300"}),
        ({"stretch": (0.5, OPTIONS.max_stretch * 1.1)}, "no camera makes", {"200", "300", "0.5"}),
        ({"stretch": (0.9 / OPTIONS.max_stretch, 1.0)}, "no camera makes", {"200", "300"}),
        ({"anisotropy": OPTIONS.max_anisotropy * 1.1}, "no camera makes", {"200", "300"}),
        ({"anisotropy": float("inf")}, "no camera makes", {"200", "300"}),  # a fold or a mirror
        ({"overlap": OPTIONS.min_overlap / 2}, "overlap by only", {"200", "300"}),
        ({"agreement": bad_agreement(OPTIONS.min_agreement * 0.8)}, "caption or logo", {"200", "300"}),
    ],
)
def test_each_failure_is_rejected_with_its_sentence(failing, words, figures):
    verdict = judge(replace(EVIDENCE, **failing), OPTIONS, SIZES)
    assert verdict.status == "rejected"
    assert words in verdict.reason
    assert figures <= numbers(verdict.reason)
    assert verdict.expected_error_px is None


def test_a_rejection_by_pixels_says_how_many_of_them():
    verdict = judge(replace(EVIDENCE, agreement=bad_agreement(0.1)), OPTIONS, SIZES)
    assert "20 of 200 blocks" in verdict.reason
    assert "mask" in verdict.advice


@pytest.mark.parametrize(
    ("doubtful", "words"),
    [
        ({"agreement": bad_agreement((OPTIONS.min_agreement + OPTIONS.sure_agreement) / 2)}, "blocks of the overlap"),
        (
            {"log10_false_alarms": OPTIONS.sure_log10_false_alarms + 1, "agreement": bad_agreement(0.5)},
            "few for a verdict",
        ),
        ({"agreement": replace(GOOD, core=OPTIONS.min_agreement * 0.8)}, "share a frame"),
        ({"fit_px": 7.0}, "leave the transform open to 7.0 px"),
        ({"halves_px": 14.0}, "leave the transform open to 7.0 px"),  # halves differ by twice the error of the whole
        ({"model_px": 7.0}, "leave the transform open to"),
    ],
)
def test_each_doubt_has_its_sentence_and_keeps_the_error(doubtful, words):
    evidence = replace(EVIDENCE, **doubtful)
    verdict = judge(evidence, OPTIONS, SIZES)
    assert verdict.status == "doubtful"
    assert words in verdict.reason
    assert {"200", "300"} <= numbers(verdict.reason)
    assert verdict.advice
    assert verdict.expected_error_px == expected_error(evidence)


def test_few_matches_are_enough_where_the_pixels_agree_clearly():
    few = replace(EVIDENCE, log10_false_alarms=OPTIONS.sure_log10_false_alarms + 1)
    assert judge(few, OPTIONS, SIZES).status == "aligned"


def test_rejection_comes_before_doubt():
    bad = replace(EVIDENCE, fit_px=50.0, overlap=0.0)
    assert judge(bad, OPTIONS, SIZES).status == "rejected"


def test_the_error_allowed_grows_with_the_picture():
    """Half a per cent of the diagonal: 4 px are many on a thumbnail and few on 12 MP."""
    four = replace(EVIDENCE, fit_px=4.0)
    assert judge(four, OPTIONS, SIZES).status == "doubtful"
    assert judge(four, OPTIONS, Sizes(fixed=(4000, 3000), moving=(4000, 3000))).status == "aligned"


def test_the_expected_error_grows_with_each_of_its_parts():
    least = expected_error(replace(EVIDENCE, fit_px=0.0, halves_px=0.0, model_px=0.0, residual_px=0.0))
    assert 0 < least < 0.02  # a floor: nobody knows a transform exactly
    for part in ("fit_px", "halves_px", "model_px", "residual_px"):
        small, large = (expected_error(replace(EVIDENCE, **{part: px})) for px in (1.0, 2.0))
        assert expected_error(EVIDENCE) < small < large
    assert np.isfinite(expected_error(replace(EVIDENCE, halves_px=float("inf"))))  # too few to halve: the fit says it


@pytest.mark.parametrize(
    ("counts", "said"), [((0, 900), "fixed picture has 0 keypoints"), ((900, 1), "moving picture has 1 keypoint to")]
)
def test_a_picture_that_shows_nothing_is_named(counts, said):
    verdict = nothing_found(*counts, 7)
    assert verdict.status == "rejected"
    assert said in verdict.reason


def test_what_was_set_aside_says_what_it_found():
    verdict = set_aside(EVIDENCE)
    assert verdict.status == "doubtful"
    assert {"200", "300", "150"} <= numbers(verdict.reason)
    assert "another attempt found more" in verdict.reason
    assert verdict.expected_error_px is None


def test_nothing_found_says_how_many_matches_there_were():
    verdict = nothing_found(900, 900, 7)
    assert verdict.status == "rejected"
    assert numbers(verdict.reason) == {"7"}
    assert verdict.advice


def test_a_hint_is_between_chance_and_proof():
    """Chance gives 2 and more (trials on unrelated pictures); what no chance explains needs no harder look."""
    assert not hints(float("inf"))
    assert not hints(2.0)
    assert hints(OPTIONS.max_log10_false_alarms)
    assert not hints(-1000.0)


# Evidence weighed from correspondences


TRUTH = np.array([[1.02, 0.05, 10.0], [-0.04, 0.98, 7.5], [1e-4, -5e-5, 1.0]])


def matched(good: int, wrong: int, noise_px: float = 0.5, seed: int = 0) -> Correspondences:
    """`good` matches of a plane, the best ones, and `wrong` ones anywhere."""
    rng = np.random.default_rng(seed)
    src = rng.uniform((20, 20), (580, 440), (good + wrong, 2))
    dst = apply(TRUTH, src) + rng.normal(0, noise_px, src.shape)
    dst[good:] = rng.uniform((0, 0), SIZES.fixed, (wrong, 2))
    return correspondences(src=src, dst=dst)


def consensus(pairs: Correspondences, transform: Array = TRUTH) -> Consensus:
    found = settle(MODELS["homography"], transform, pairs, 3.0)
    assert found is not None
    return found


def weighed(pairs: Correspondences, found: Consensus | None = None) -> Evidence:
    found = found or consensus(pairs)
    known = chance(pairs, found, SIZES)
    return weigh("homography", found.dst_from_src, pairs[found.inliers], known, GOOD, SIZES)


def test_true_matches_weigh_and_random_ones_do_not():
    """The margin between them is what a verdict stands on: a hundred orders of magnitude apart."""
    true, random = matched(100, 100), matched(0, 200)
    some = fit("affine", random.src[:3], random.dst[:3])
    lucky = Consensus(
        model="homography",
        dst_from_src=some,
        inliers=np.arange(200) < 3,
        errors=np.where(np.arange(200) < 3, 0.0, np.inf),
        trials=1,
    )
    assert weighed(true).log10_false_alarms < -100
    assert weighed(random, lucky).log10_false_alarms > 0


def test_the_same_spot_matched_often_counts_once():
    """Twelve true matches; nine of them ten times over, with scatter that a keypoint's orientations have."""
    once = matched(12, 60)
    rng = np.random.default_rng(1)
    again = np.repeat(np.arange(9), 10)
    src, dst = (
        np.concatenate([points, points[again] + rng.uniform(-0.5, 0.5, (90, 2))]) for points in (once.src, once.dst)
    )
    often = correspondences(src=src, dst=dst)
    few, many = weighed(once), weighed(often)
    assert many.matches == few.matches + 90
    # A spot is a cell of a grid, so that scatter over its edges makes up to four of one.
    assert many.independent_inliers < 12 + 0.4 * 90
    assert few.independent_inliers >= 10
    all_count = weighed(matched(102, 60))
    assert abs(many.log10_false_alarms - few.log10_false_alarms) < 0.4 * abs(
        all_count.log10_false_alarms - few.log10_false_alarms
    )


def test_the_evidence_of_an_exact_fit_is_finite_and_small():
    pairs = matched(80, 20, noise_px=0.0)
    evidence = weighed(pairs)
    assert evidence.fit_px < 1e-3
    assert evidence.model_px < 1e-3
    assert evidence.halves_px < 1e-3
    assert np.isfinite(evidence.log10_false_alarms)


def test_the_error_that_the_fit_leaves_is_what_repeated_trials_show():
    """Over 40 draws of the noise, the true mean error is within a third of the expected one on the whole."""
    grid = np.stack(np.meshgrid(np.linspace(0, 599, 20), np.linspace(0, 499, 20)), -1).reshape(-1, 2)
    due = project(TRUTH, grid)[0]
    inside = ((due >= 0) & (due <= np.array(SIZES.fixed) - 1)).all(1)
    true, told = [], []
    for seed in range(40):
        pairs = matched(150, 0, seed=seed)
        found = consensus(pairs)
        true.append(np.linalg.norm(project(found.dst_from_src, grid)[0] - due, axis=1)[inside].mean())
        told.append(expected_error(weighed(pairs, found)))
    assert 0.67 < np.mean(told) / np.mean(true) < 2.0  # never too sure; twice is allowed by the issue
    assert np.mean(np.array(true) < 2 * np.array(told)) >= 0.95


def test_matches_on_one_side_leave_the_other_open():
    pairs = matched(150, 0)
    near = pairs[(pairs.src < [250, 200]).all(1)]
    assert len(near) > 12
    assert expected_error(weighed(near)) > 4 * expected_error(weighed(pairs))


def test_what_the_model_cannot_follow_counts():
    """A bend of 2 px over the picture: all matches agree, no homography explains it."""
    pairs = matched(400, 0, noise_px=0.2)
    bent = replace(pairs, dst=pairs.dst + 2.0 * np.sin(pairs.dst[:, :1] / 100) * [0.0, 1.0])
    straight, curved = weighed(pairs), weighed(bent)
    assert straight.model_px < 0.1
    assert curved.model_px > 0.4
    assert expected_error(curved) > 0.4


@pytest.mark.parametrize(
    ("transform", "folds"),
    [
        (IDENTITY, False),
        (np.diag([-1.0, 1.0, 1.0]) + np.array([[0, 0, 599.0], [0, 0, 0], [0, 0, 0]]), True),
        (np.array([[1.0, 0, 0], [0, 1.0, 0], [-1 / 300, 0, 1.0]]), False),  # the horizon crosses; what is behind is out
    ],
)
def test_mirrors_are_infinitely_bad(transform, folds):
    pairs = matched(60, 0)
    found = Consensus(
        model="homography", dst_from_src=transform, inliers=np.ones(60, bool), errors=np.zeros(60), trials=1
    )
    evidence = weigh("homography", transform, pairs, chance(pairs, found, SIZES), GOOD, SIZES)
    assert np.isinf(evidence.anisotropy) == folds
    if folds:
        assert judge(replace(evidence, log10_false_alarms=-100.0), OPTIONS, SIZES).status == "rejected"


def test_no_overlap_is_rejected():
    pairs = matched(60, 0)
    away = translation(5000, 0)
    found = Consensus(model="translation", dst_from_src=away, inliers=np.ones(60, bool), errors=np.zeros(60), trials=1)
    evidence = weigh("translation", away, pairs, chance(pairs, found, SIZES), GOOD, SIZES)
    assert evidence.overlap == 0
    assert judge(replace(evidence, log10_false_alarms=-100.0), OPTIONS, SIZES).status == "rejected"


@pytest.mark.parametrize(
    "wrong", [{"max_expected_error_px": 0.0}, {"max_stretch": 1.0}, {"min_agreement": 1.5}, {"min_agreement": -0.1}]
)
def test_options_out_of_range_are_refused(wrong):
    with pytest.raises(ValueError, match="VerdictOptions"):
        VerdictOptions(**wrong)
