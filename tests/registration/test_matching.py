"""Matches against cv2's brute force, and what it does not know: twins, blocks of rows, ties."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from autoalign.registration import matching
from autoalign.registration.features import FeatureOptions, Features, detect
from autoalign.registration.matching import Matches, MatchOptions, match


def features(descriptors: np.ndarray, points: np.ndarray | None = None, sizes: float = 1.0) -> Features:
    n = len(descriptors)
    if points is None:
        points = np.stack([np.arange(n) * 10.0, np.zeros(n)], 1)
    return Features(
        points=np.asarray(points, np.float64).reshape(-1, 2),
        sizes=np.full(n, sizes),
        angles=np.zeros(n),
        sigmas=np.ones(n),
        descriptors=np.asarray(descriptors, np.float32),
        detector="sift",
    )


def related(n: int, m: int, shared: int, seed: int = 0) -> tuple[Features, Features]:
    """Whole-number descriptors like RootSIFT's; the first `shared` of either are alike, the rest are not."""
    rng = np.random.default_rng(seed)
    a, b = (np.floor(rng.gamma(0.5, 200, (k, 128))).astype(np.float32) for k in (n, m))
    b[:shared] = np.maximum(a[:shared] + np.rint(rng.normal(0, 60, (shared, 128))), 0)
    order = rng.permutation(m)
    return features(a), features(b[order])


def as_set(matches: Matches) -> set[tuple[int, int]]:
    return set(zip(matches.fixed_index.tolist(), matches.moving_index.tolist(), strict=True))


def oracle(fixed: Features, moving: Features, ratio: float) -> dict[tuple[int, int], float]:
    """Mutual nearest neighbours that pass the ratio test both ways, by cv2.BFMatcher."""
    ways = []
    for a, b in ((fixed, moving), (moving, fixed)):
        found = cv2.BFMatcher(cv2.NORM_L2).knnMatch(a.descriptors, b.descriptors, k=2)
        ways.append({first.queryIdx: (first.trainIdx, first.distance / second.distance) for first, second in found})
    there, back = ways
    return {
        (i, j): max(r, back[j][1])
        for i, (j, r) in there.items()
        if back[j][0] == i and r <= ratio and back[j][1] <= ratio
    }


@pytest.mark.parametrize("ratio", [0.7, 0.85, 1.0])
@pytest.mark.parametrize(("n", "m"), [(300, 200), (50, 400), (2, 2)])
def test_the_same_as_brute_force(n, m, ratio):
    fixed, moving = related(n, m, min(n, m) // 2)
    due = oracle(fixed, moving, ratio)
    found = match(fixed, moving, MatchOptions(ratio=ratio, apart=0))
    assert as_set(found) == set(due)
    theirs = [due[pair] for pair in zip(found.fixed_index.tolist(), found.moving_index.tolist(), strict=True)]
    assert np.allclose(found.ratio, theirs, rtol=1e-4)  # cv2's distances are single precision


@pytest.mark.parametrize("detector", ["orb", "sift"])
def test_the_same_as_brute_force_on_a_picture(detector):
    """Up to pairs of keypoints at one pair of places, of which the first counts, and ties of ORB's few distances."""
    rng = np.random.default_rng(5)
    image = cv2.GaussianBlur(rng.integers(0, 256, (200, 260), dtype=np.uint8), (0, 0), 2)
    image = cv2.normalize(image, None, 0, 255, cv2.NORM_MINMAX)
    noisy = np.clip(image + rng.normal(0, 6, image.shape), 0, 255).astype(np.uint8)
    how = FeatureOptions(detector=detector, max_features=600)
    fixed, moving = detect(image, how), detect(noisy, how)
    found = match(fixed, moving, MatchOptions(ratio=0.85, apart=0))
    due = oracle(fixed, moving, 0.85)
    assert len(due) > 50
    assert as_set(found) <= set(due)

    def places(pairs: set[tuple[int, int]]) -> set[tuple[float, ...]]:
        return {tuple(np.rint(10 * np.concatenate([fixed.points[i], moving.points[j]]))) for i, j in pairs}

    missing = places(set(due)) - places(as_set(found))
    assert len(missing) <= (0.02 * len(due) if detector == "orb" else 0)


@pytest.mark.parametrize("rows", [1, 7, 100, 101])
def test_blocks_of_rows_change_nothing(rows, monkeypatch):
    fixed, moving = related(201, 130, 90)
    whole = match(fixed, moving)
    monkeypatch.setattr(matching, "_ROWS", rows)
    in_blocks = match(fixed, moving)
    for name in ("fixed_index", "moving_index", "ratio"):
        assert np.array_equal(getattr(whole, name), getattr(in_blocks, name))


def test_more_rows_than_a_block():
    n = matching._ROWS + 300
    fixed, moving = related(n, 500, 400)
    assert as_set(match(fixed, moving, MatchOptions(apart=0))) == set(oracle(fixed, moving, 0.85))
    assert as_set(match(moving, fixed, MatchOptions(apart=0))) == set(oracle(moving, fixed, 0.85))


def test_best_first_and_one_to_one():
    fixed, moving = related(300, 280, 200)
    found = match(fixed, moving, MatchOptions(ratio=1.0))
    assert len(found) > 100
    assert (np.diff(found.ratio) >= 0).all()
    assert found.ratio.max() <= 1.0
    assert len(set(found.fixed_index.tolist())) == len(set(found.moving_index.tolist())) == len(found)


@pytest.mark.parametrize("apart", [0.0, 0.5])
def test_swapped_roles_give_the_same_matches(apart):
    fixed, moving = related(150, 190, 100)
    how = MatchOptions(apart=apart)
    assert as_set(match(fixed, moving, how)) == {(i, j) for j, i in as_set(match(moving, fixed, how))}


def twins() -> tuple[Features, Features]:
    """Moving holds fixed's first keypoint twice: at (0, 0) and a little away, as two orientations of one corner do."""
    a = np.zeros((3, 8))
    a[0, 0] = a[1, 1] = a[2, 2] = 100
    b = np.vstack([a, a[:1]])
    b[0, 3], b[3, 4] = 10, 11
    return features(a), features(b, np.array([[0, 0], [50, 0], [100, 0], [2, 0]]), sizes=8.0)


def test_a_twin_is_a_rival_only_where_neighbours_are_asked_about_regardless_of_place():
    fixed, moving = twins()
    assert 0 not in match(fixed, moving, MatchOptions(apart=0)).fixed_index
    found = match(fixed, moving, MatchOptions(apart=0.5))
    assert (0, 0) in as_set(found)  # 2 px away is under half of 8 px, and the nearer of the two is taken
    far = replace(moving, points=np.array([[0.0, 0], [50, 0], [100, 0], [5, 0]]))
    assert 0 not in match(fixed, far, MatchOptions(apart=0.5)).fixed_index  # 5 px away is another corner


def test_many_twins_hide_the_true_rival_no_better_than_one():
    """The ratio is taken to the nearest descriptor that lies apart, however many lie near."""
    a = np.zeros((2, 8))
    a[0, 0], a[1, 1] = 100, 100
    b = np.zeros((6, 8))
    b[:4, 0], b[:4, 3] = 100, [10, 12, 14, 16]
    b[4, 0], b[4, 4] = 100, 20  # the rival, twice as far as the nearest, 60 px away
    b[5, 1] = 100
    places = np.array([[0, 0], [1, 0], [0, 1], [1, 1], [60, 0], [100, 0]])
    found = match(features(a), features(b, places, sizes=8.0), MatchOptions(ratio=0.85))
    assert (0, 0) in as_set(found)
    assert found.ratio[found.fixed_index == 0] == pytest.approx(0.5, rel=1e-6)
    assert 0 not in match(features(a), features(b, places, sizes=8.0), MatchOptions(ratio=0.45)).fixed_index


def test_equal_descriptors_share_no_partner():
    a = np.zeros((4, 8))
    a[0, 0] = a[1, 0] = 50  # a repeats itself, far apart: no way to tell which
    a[2, 1] = a[3, 2] = 50
    found = match(features(a), features(a), MatchOptions(ratio=0.9))
    assert as_set(found) == {(2, 2), (3, 3)}


def test_one_pair_of_places_counts_once():
    """Two orientations of one corner that both find their like are one match."""
    a = np.zeros((3, 8))
    a[0, 0] = a[1, 1] = a[2, 2] = 50
    places = np.array([[10.0, 10.0], [10.0, 10.0], [40.0, 40.0]])
    found = match(features(a, places, sizes=8.0), features(a, places + 5, sizes=8.0))
    assert len(found) == 2
    assert 2 in found.fixed_index


@pytest.mark.parametrize(("n", "m"), [(0, 0), (0, 5), (5, 0), (1, 5), (5, 1), (1, 1)])
def test_too_few_to_compare_give_no_matches(n, m):
    descriptors = np.eye(5, 128) * 100
    found = match(features(descriptors[:n]), features(descriptors[:m]))
    assert len(found) == 0
    assert found.fixed_index.dtype == found.moving_index.dtype == np.int64


def test_features_of_two_detectors_do_not_match():
    fixed, moving = related(5, 5, 5)
    with pytest.raises(ValueError, match="sift cannot match features of orb"):
        match(fixed, replace(moving, detector="orb"))


@pytest.mark.parametrize("wrong", [{"ratio": 0.0}, {"ratio": 1.1}, {"apart": -1.0}])
def test_options_out_of_range_are_refused(wrong):
    with pytest.raises(ValueError, match="MatchOptions"):
        MatchOptions(**wrong)
