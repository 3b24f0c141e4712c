"""Sequences: which links, what travels of them, honest verdicts, and a rendered time-lapse beside plain chaining."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from math import log2

import numpy as np
import pytest
from exact_pairs import camera, pair, turn
from exact_sequence import time_lapse
from scipy.sparse import coo_array
from scipy.sparse.csgraph import shortest_path

from autoalign.geometry.family import MODELS
from autoalign.geometry.homography import apply, invert, normalisation, shown, translation, unit
from autoalign.geometry.least_squares import step
from autoalign.geometry.uncertainty import overlap_points
from autoalign.registration.align import align
from autoalign.registration.alignment import AlignOptions
from autoalign.registration.sequence import Link, SequenceOptions, link_of, links, solve_sequence

SIZE = (640, 400)
GRID = overlap_points(np.eye(3), SIZE, SIZE, 8)
NORM = normalisation(GRID)


def truth_of(n):
    """(n, 3, 3) similarities that drift and shake; the first is the identity."""
    i = np.arange(n)
    moves = 0.02 * np.stack([i, np.sin(3 * i), np.sin(5 * i), np.sin(7 * i)], 1)
    return step(MODELS["similarity"], np.broadcast_to(unit(np.eye(3)), (n, 3, 3)), moves, NORM)


def rows(matrix):
    return tuple(tuple(row) for row in matrix.tolist())


def made(truth, fixed, moving, status="aligned", *, off_px=0.0, sigma=1e-5):
    """A link between two frames that is off by so much, and by noise of which it knows."""
    noise = sigma * np.random.default_rng([fixed, moving]).normal(size=8)
    exact = invert(truth[fixed]) @ truth[moving] @ translation(off_px, 0.0)
    return Link(
        fixed=fixed,
        moving=moving,
        status=status,
        model="similarity",
        fixed_from_moving=rows(step(MODELS["homography"], exact, noise, NORM)),
        norm=rows(NORM),
        covariance=rows(sigma**2 * np.eye(8)),
        expected_error_px=sigma / NORM[0, 0],
    )


def solved(n, found, reference=0):
    return solve_sequence(n, reference, found, [SIZE] * n)


def off_px(frame, truth):
    return float(np.linalg.norm(apply(frame.reference_from_frame, GRID) - apply(truth, GRID), axis=1).mean())


def without(found, pairs, status=None):
    """The links without those between some frames, or with these links' status changed."""
    chosen = [link for link in found if (link.fixed, link.moving) not in pairs]
    changed = [link for link in found if (link.fixed, link.moving) in pairs]
    return chosen + ([replace(link, status=status) for link in changed] if status else [])


@pytest.mark.parametrize(("n", "reference"), [(1, 0), (2, 1), (7, 0), (100, 0), (100, 37), (1000, 999)])
def test_links_are_few_and_join_any_frames_in_few_steps(n, reference):
    found = links(n, reference)
    assert len(set(found)) == len(found) <= 3 * n
    assert all(abs(f - reference) < abs(m - reference) and 0 <= min(f, m) <= max(f, m) < n for f, m in found)
    assert {(min(i, j), max(i, j)) for i, j in found} >= {(i, i + 1) for i in range(n - 1)}
    assert {m for f, m in found if f == reference} == set(range(n)) - {reference}
    some = [pair for pair in found if pair[0] != reference]
    if some:  # where nothing overlaps the reference any more
        fixed, moving = np.array(some).T
        steps = shortest_path(coo_array((np.ones(len(some)), (fixed, moving)), shape=(n, n)), directed=False)
        assert steps[np.isfinite(steps)].max() <= 4 * log2(n)


def test_a_reference_that_is_not_there_is_refused():
    for n, reference in ((3, 3), (3, -1), (0, 0)):
        with pytest.raises(ValueError, match="cannot be the reference"):
            links(n, reference)
    with pytest.raises(ValueError, match="sizes"):
        solve_sequence(3, 0, [], [SIZE] * 2)
    with pytest.raises(ValueError, match="not among"):
        solved(2, [made(truth_of(3), 0, 2)])


@pytest.mark.parametrize("reference", [0, 5])
def test_agreeing_links_align_every_frame(reference):
    n, truth = 12, truth_of(12)
    frames = solved(n, [made(truth, f, m) for f, m in links(n, reference)], reference)
    assert {frame.status for frame in frames} == {"aligned"}
    assert {frame.model for frame in frames} == {"similarity"}
    np.testing.assert_array_equal(frames[reference].reference_from_frame, np.eye(3))
    assert frames[reference].expected_error_px == 0
    error = np.array(
        [off_px(frame, shown(invert(truth[reference]) @ t)) for frame, t in zip(frames, truth, strict=True)]
    )
    expected = np.array([frame.expected_error_px for frame in frames])
    assert 0.3 < error.sum() / expected.sum() < 1.7
    assert not any(frame.overruled for frame in frames)
    assert sum(len(frame.used) for frame in frames) == 2 * len(links(n, reference))


def test_links_survive_json_and_come_in_any_order():
    n, truth = 9, truth_of(9)
    found = [made(truth, f, m) for f, m in links(n, 4)]
    through_json = [Link(**json.loads(json.dumps(asdict(link)))) for link in reversed(found)]
    for a, b in zip(solved(n, found, 4), solved(n, through_json, 4), strict=True):
        np.testing.assert_array_equal(a.reference_from_frame, b.reference_from_frame)
        assert replace(a, reference_from_frame=None) == replace(b, reference_from_frame=None)


def test_a_wrong_link_is_overruled_and_named():
    n, truth = 12, truth_of(12)
    wrong = [made(truth, f, m, off_px=60.0 if (f, m) == (4, 8) else 0.0) for f, m in links(n, 0)]
    frames = solved(n, wrong)
    assert {frame.status for frame in frames} == {"aligned"}
    assert max(off_px(frame, t) for frame, t in zip(frames, truth, strict=True)) < 0.05
    assert [i for i, frame in enumerate(frames) if frame.overruled] == [4, 8]
    assert frames[8].overruled == ((4, 8),)
    assert "1 overruled" in frames[8].reason


def test_frames_that_no_link_holds_are_rejected_and_the_rest_goes_on():
    n, truth = 8, truth_of(8)
    found = [made(truth, f, m, "aligned" if max(f, m) < 5 or min(f, m) >= 5 else "rejected") for f, m in links(n, 0)]
    frames = solved(n, found)
    assert [frame.status for frame in frames] == ["aligned"] * 5 + ["rejected"] * 3
    assert frames[6].reference_from_frame is None
    assert frames[6].expected_error_px is None
    assert frames[6].reason.startswith("not connected to the reference: ")
    assert max(off_px(frame, t) for frame, t in zip(frames[:5], truth, strict=False)) < 0.05


def test_no_links_at_all_leave_the_reference():
    assert [frame.status for frame in solved(3, [], 1)] == ["rejected", "aligned", "rejected"]
    (only,) = solve_sequence(1, 0, [], [SIZE])
    np.testing.assert_array_equal(only.reference_from_frame, np.eye(3))


def test_what_hangs_on_a_doubtful_link_is_doubtful():
    n, truth = 8, truth_of(8)
    across = {(f, m) for f, m in links(n, 0) if f < 5 <= m}
    found = without([made(truth, f, m) for f, m in links(n, 0)], across, "doubtful")
    frames = solved(n, found)
    assert [frame.status for frame in frames] == ["aligned"] * 5 + ["doubtful"] * 3
    assert "doubtful link" in frames[7].reason
    assert max(off_px(frame, t) for frame, t in zip(frames, truth, strict=True)) < 0.05


def test_a_doubtful_link_has_no_say_where_aligned_ones_hold():
    n, truth = 8, truth_of(8)
    found = [made(truth, f, m) for f, m in links(n, 0)]
    chosen = without(found, {(2, 4)})
    with_doubt = [*chosen, made(truth, 2, 4, "doubtful", off_px=0.2)]
    for a, b in zip(solved(n, chosen), solved(n, with_doubt), strict=True):
        np.testing.assert_array_equal(a.reference_from_frame, b.reference_from_frame)
        assert (a.status, a.used, a.overruled) == (b.status, b.used, b.overruled)


def test_one_link_against_one_is_no_verdict():
    """Frames 3 to 5 hang on two links that contradict each other: neither can be believed."""
    truth = truth_of(6)
    inner = [made(truth, f, m) for f, m in ((0, 1), (1, 2), (0, 2), (3, 4), (4, 5), (3, 5))]
    frames = solved(6, [*inner, made(truth, 2, 3), made(truth, 1, 4, off_px=40.0)])
    assert [frame.status for frame in frames[:3]] == ["aligned"] * 3
    assert all(frame.status != "aligned" for frame in frames[3:])


def test_links_that_leave_a_frame_open_make_it_doubtful():
    truth = truth_of(3)
    loose = made(truth, 1, 2, sigma=0.03)
    frames = solved(3, [made(truth, 0, 1), loose])
    assert [frame.status for frame in frames] == ["aligned", "aligned", "doubtful"]
    assert "open to" in frames[2].reason


def test_a_threshold_of_nothing_is_refused():
    with pytest.raises(ValueError, match="out of range"):
        SequenceOptions(link_threshold=0.0)


def test_a_link_that_is_worse_than_the_others_but_as_good_as_it_claims_counts_less():
    """All links but one agree far better than they claim: it is not overruled, but hardly moves anything."""
    n, truth = 9, truth_of(9)
    found = [replace(made(truth, f, m), covariance=rows(1e-6 * np.eye(8))) for f, m in links(n, 0)]
    off = replace(made(truth, 0, 7, off_px=1.2), covariance=rows(1e-6 * np.eye(8)))
    frames = solved(n, [*without(found, {(0, 7)}), off])
    assert {frame.status for frame in frames} == {"aligned"}
    assert not any(frame.overruled for frame in frames)
    assert max(off_px(frame, t) for frame, t in zip(frames, truth, strict=True)) < 0.05


def test_two_links_that_differ_by_less_than_they_claim_hold_a_frame():
    n, truth = 9, truth_of(9)
    found = [replace(made(truth, f, m), covariance=rows(1e-6 * np.eye(8))) for f, m in links(n - 1, 0)]
    off = [replace(made(truth, f, 8, off_px=px), covariance=rows(1e-6 * np.eye(8))) for f, px in ((7, 0.0), (0, 1.2))]
    frames = solved(n, [*found, *off])
    assert frames[8].status == "aligned"
    assert len(frames[8].used) == 2


def test_what_travels_of_a_pair_is_small_and_true():
    of = pair("rocket.jpg", turn(170.0, 120.0, 3.0, 1.02) @ translation(9.0, -4.0), (340, 240))
    alignment = align(of.fixed, of.moving)
    link = link_of(alignment, 3, 5)
    assert (link.fixed, link.moving, link.status, link.model) == (3, 5, "aligned", alignment.model)
    assert link.expected_error_px == alignment.expected_error_px
    assert len(json.dumps(asdict(link))) < 3000
    grid = overlap_points(of.fixed_from_moving, (340, 240), (340, 240))
    found = apply(np.array(link.fixed_from_moving), grid)
    assert np.linalg.norm(found - apply(of.fixed_from_moving, grid), axis=1).mean() < 0.1
    assert (np.linalg.eigvalsh(link.covariance) > 0).all()


def test_a_rejected_pair_gives_a_rejected_link():
    noise = [camera(np.full((160, 200), 128.0), seed, noise=40.0) for seed in (1, 2)]
    assert link_of(align(*noise), 0, 1) == Link(fixed=0, moving=1, status="rejected")


def test_a_time_lapse_does_not_drift():
    """Twelve noisy frames that drift by half of their width: under a tenth of a pixel, where plain chaining is not."""
    n = 12
    lapse = time_lapse("hubble_deep_field.jpg", n, (340, 280), noise=12.0)
    fast = AlignOptions(effort="fast")
    alignments = {(f, m): align(lapse.frames[f], lapse.frames[m], fast) for f, m in links(n, 0)}
    frames = solve_sequence(n, 0, [link_of(a, *pair) for pair, a in alignments.items()], [lapse.size] * n)
    chained = [np.eye(3)]
    for i in range(1, n):
        chained.append(chained[-1] @ alignments[i - 1, i].fixed_from_moving)
    assert {frame.status for frame in frames} == {"aligned"}
    together = np.array([lapse.error_px(frame.reference_from_frame, i) for i, frame in enumerate(frames)])
    one_by_one = np.array([lapse.error_px(transform, i) for i, transform in enumerate(chained)])
    expected = np.array([frame.expected_error_px for frame in frames])
    print(f"last frame: {together[-1]:.4f} px together, {one_by_one[-1]:.4f} px chained, {expected[-1]:.4f} expected")
    assert together[-1] < 0.1
    assert together.mean() < 0.8 * one_by_one.mean()
    assert 0.3 < together.mean() / expected.mean() < 2.0  # as is asked of pairs
