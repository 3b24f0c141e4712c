"""`autoalign apply`: pictures, masks and points through a saved transform."""

from __future__ import annotations

import json

import numpy as np
import pytest

import autoalign as aa
from autoalign.files.points import POSITIONS


def test_the_same_picture_gives_what_pair_gave(sidecar, run):
    for canvas in ("fixed", "union"):
        run(
            "pair",
            "fixed.jpg",
            "moving.jpg",
            "--points",
            "typed.csv",
            "-o",
            "pair.png",
            "--canvas",
            canvas,
            "--overwrite",
        )
        assert run("apply", "pair.autoalign.json", "moving.jpg", "-o", "apply.png", "--overwrite").code == 0
        assert (sidecar.parent / "apply.png").read_bytes() == (sidecar.parent / "pair.png").read_bytes()
    assert run("apply", "pair.autoalign.json", "moving.jpg", "-o", "other.png", "--canvas", "fixed").code == 0
    assert aa.read_picture("other.png").pixels.shape == (400, 600, 3)


def test_border_and_mask_are_those_that_pair_was_told(sidecar, run):
    words = ("--border", "transparent", "--canvas", "union", "--save-mask")
    run("pair", "fixed.jpg", "moving.jpg", "--points", "typed.csv", "-o", "pair.png", *words, "pair_mask.png")
    outcome = run("apply", "pair.autoalign.json", "moving.jpg", "--save-mask", "mask.png")
    assert (outcome.code, outcome.err) == (0, "wrote moving_aligned.png, mask.png\n")  # no JPEG, which has no alpha
    folder = sidecar.parent
    assert (folder / "moving_aligned.png").read_bytes() == (folder / "pair.png").read_bytes()
    assert (folder / "mask.png").read_bytes() == (folder / "pair_mask.png").read_bytes()
    assert run("apply", "pair.autoalign.json", "moving.jpg", "-o", "black.jpg", "--border", "constant").code == 0
    refused = run("apply", "pair.autoalign.json", "moving.jpg", "-o", "clear.jpg")
    assert refused.code == 3
    assert "JPEG cannot hold" in refused.err
    assert run("apply", sidecar, "moving.jpg", "other.jpg", "--save-mask", "mask.png").code == 2


def test_labels_are_not_mixed(sidecar, run):
    labels = np.kron(np.random.default_rng(0).choice([0, 7, 200], (42, 48)), np.ones((10, 10))).astype(np.uint8)
    aa.write_picture("labels.png", labels)
    assert run("apply", sidecar, "labels.png", "--interpolation", "nearest").code == 0
    assert set(np.unique(aa.read_picture("labels_aligned.png").pixels)) == {0, 7, 200}


def test_several_pictures_go_into_a_folder_under_their_names(sidecar, run):
    (sidecar.parent / "done").mkdir()
    aa.write_picture("mask.png", np.zeros((420, 480), np.uint8))
    outcome = run("apply", sidecar, "moving.jpg", "mask.png", "--out-dir", "done")
    assert outcome.code == 0
    assert {path.name for path in (sidecar.parent / "done").iterdir()} == {"moving.jpg", "mask.png"}
    assert run("apply", sidecar, "moving.jpg", "--out-dir", "missing").code == 3


def test_one_bad_picture_does_not_stop_the_others(sidecar, run):
    outcome = run("apply", sidecar, "fixed.jpg", "missing.jpg", "moving.jpg")
    assert outcome.code == 3
    assert outcome.err.splitlines() == [
        "autoalign: is 600 x 400, and a picture of 480 x 420 is needed: fixed.jpg",
        "autoalign: does not exist: missing.jpg",
        "wrote moving_aligned.jpg",
    ]


def test_points_go_both_ways(sidecar, run):
    points = np.array([[0.0, 0.0], [479.0, 419.0], [100.25, 33.0]])
    aa.write_points("spots.csv", points, POSITIONS)
    assert run("apply", sidecar, "--points", "spots.csv").code == 0
    there = aa.read_points("spots_on_fixed.csv", POSITIONS)
    assert there[:2] == pytest.approx(np.array([[262.0, 14.0], [360.0, 380.0]]), abs=1e-6)
    assert run("apply", sidecar, "--points", "spots_on_fixed.csv", "--inverse", "-o", "back.csv").code == 0
    assert aa.read_points("back.csv", POSITIONS) == pytest.approx(points, abs=1e-9)


def test_points_beyond_the_horizon_are_refused(sidecar, run):
    aa.write_points("spots.csv", [[-1e6, -1e6]], POSITIONS)
    outcome = run("apply", sidecar, "--points", "spots.csv")
    assert outcome.code == 2
    assert "beyond the horizon" in outcome.err


def test_a_rejected_pair_has_nothing_to_apply(sidecar, run):
    record = json.loads(sidecar.read_text())
    record |= {"status": "rejected", "fixed_from_moving": None, "reason": "they differ"}
    sidecar.write_text(json.dumps(record))
    outcome = run("apply", sidecar, "moving.jpg")
    assert outcome.code == 1
    assert outcome.err == "autoalign: the pair was rejected: they differ\n"
