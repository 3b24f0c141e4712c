"""Where options come from: the command line wins over AUTOALIGN_*, that over autoalign.toml, that over the default."""

from __future__ import annotations

import json

import pytest

TYPED = ("pair", "fixed.jpg", "moving.jpg", "--points", "typed.csv", "-o", "out.png", "--overwrite", "-q")


@pytest.fixture
def options(sidecar, run):
    """Run a quick pair with more words and return the options that its record names."""

    def options_of(*words: str):
        assert run(*TYPED, *words).code == 0
        return json.loads((sidecar.parent / "out.autoalign.json").read_text())["options"]

    return options_of


def test_the_nearest_source_wins(sidecar, options, monkeypatch):
    assert options()["ransac"]["seed"] == 0
    (sidecar.parent / "autoalign.toml").write_text("seed = 1\nthreshold = 2.5\n")
    assert options()["ransac"]["seed"] == 1
    monkeypatch.setenv("AUTOALIGN_SEED", "2")
    assert options()["ransac"]["seed"] == 2
    assert options("--seed", "3")["ransac"]["seed"] == 3
    assert options()["ransac"]["threshold"] == 2.5


def test_the_file_may_lie_in_a_folder_above_and_name_options_with_either_dash(sidecar, options, monkeypatch):
    (sidecar.parent.parent / "autoalign.toml").write_text('max_trials = 77\nmax-shift = 1.5\ncanvas = "union"\n')
    try:
        found = options()
    finally:
        (sidecar.parent.parent / "autoalign.toml").unlink()
    assert (found["ransac"]["max_trials"], found["refine"]["max_shift"], found["canvas"]) == (77, 1.5, "union")


def test_a_flag_that_is_set_can_be_taken_back(sidecar, run, monkeypatch):
    monkeypatch.setenv("AUTOALIGN_OVERWRITE", "true")
    assert run("pair", "fixed.jpg", "moving.jpg", "--points", "typed.csv", "-o", "out.png").code == 0
    assert run("pair", "fixed.jpg", "moving.jpg", "--points", "typed.csv", "-o", "out.png").code == 0
    refused = run("pair", "fixed.jpg", "moving.jpg", "--points", "typed.csv", "-o", "out.png", "--overwrite=false")
    assert refused.code == 3


def test_each_command_takes_what_it_knows(sidecar, run):
    (sidecar.parent / "autoalign.toml").write_text('interpolation = "nearest"\nmodel = "affine"\nscale = 2\n')
    assert run("apply", sidecar, "moving.jpg").code == 0


@pytest.mark.parametrize(("text", "words"), [("seeed = 1", "seeed"), ("seed = ", "TOML"), ('seed = "x"', "seed")])
def test_a_fault_in_the_file_is_named(sidecar, run, text, words):
    (sidecar.parent / "autoalign.toml").write_text(text)
    outcome = run(*TYPED)
    assert outcome.code == 2
    assert words in outcome.err
    assert outcome.err.count("\n") == 1


def test_a_picture_is_never_taken_from_the_environment(pictures, run, monkeypatch):
    monkeypatch.setenv("AUTOALIGN_MOVING", "moving.jpg")
    assert run("pair", "fixed.jpg").code == 2
