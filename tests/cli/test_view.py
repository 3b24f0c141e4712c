"""`autoalign view`, and the options of `pair` that record and show."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from autoalign.cli import view as view_module
from autoalign.cli.terminal import Exit
from autoalign.views.window import viewer_program


class Opened(list):
    """What would have been shown."""

    def __call__(self, recordings=(), recording=None) -> None:
        self.append(recording if recording is not None else list(recordings))


@pytest.fixture
def opened(monkeypatch) -> Opened:
    """A display, and a viewer that only remembers what it was asked to show."""
    calls = Opened()
    monkeypatch.setattr(view_module, "has_display", lambda: True)
    monkeypatch.setattr(view_module, "open_window", calls)
    return calls


@pytest.fixture
def blind(monkeypatch) -> None:
    """No display."""
    monkeypatch.setattr(view_module, "has_display", lambda: False)


def sound(path: Path) -> bool:
    return subprocess.run([viewer_program(), "rrd", "verify", path], capture_output=True, check=False).returncode == 0


def test_save_rrd_records_the_pair(run, pictures) -> None:
    outcome = run("pair", "fixed.jpg", "moving.jpg", "--save-rrd", "look.rrd")
    assert outcome.code == Exit.DONE
    assert "wrote look.rrd" in outcome.err
    assert sound(Path("look.rrd"))


def test_a_rejected_pair_is_recorded_too(run, pictures) -> None:
    words = ("--min-overlap", "0.99", "--effort", "fast", "--save-rrd", "look.rrd")
    assert run("pair", "fixed.jpg", "moving.jpg", *words).code == Exit.NOT_ALIGNED
    assert sound(Path("look.rrd"))


def test_rerun_opens_what_it_records(run, pictures, opened) -> None:
    outcome = run("pair", "fixed.jpg", "moving.jpg", "--rerun", "--save-rrd", "look.rrd")
    assert outcome.code == Exit.DONE
    assert opened == [Path("look.rrd").read_bytes()]


def test_rerun_alone_leaves_no_recording_behind(run, pictures, opened) -> None:
    assert run("pair", "fixed.jpg", "moving.jpg", "--rerun").code == Exit.DONE
    assert len(opened) == 1
    assert list(pictures.glob("*.rrd")) == []


def test_without_a_display_rerun_names_the_recording(run, pictures, blind) -> None:
    outcome = run("pair", "fixed.jpg", "moving.jpg", "--rerun", "--quiet")
    assert outcome.code == Exit.DONE
    assert "no display" in outcome.err
    assert outcome.err.rstrip().endswith("moving_aligned.autoalign.rrd")
    assert sound(Path("moving_aligned.autoalign.rrd"))


def test_a_viewer_that_does_not_start_costs_no_recording(run, pictures, opened, monkeypatch) -> None:
    def broken(**_) -> None:
        raise OSError("the viewer did not start")

    monkeypatch.setattr(view_module, "open_window", broken)
    outcome = run("pair", "fixed.jpg", "moving.jpg", "--rerun")
    assert outcome.code == Exit.DONE
    assert outcome.err.rstrip().endswith("moving_aligned.autoalign.rrd")
    assert sound(Path("moving_aligned.autoalign.rrd"))


def test_a_recording_is_not_replaced_unasked(run, pictures) -> None:
    Path("look.rrd").write_text("mine")
    outcome = run("pair", "fixed.jpg", "moving.jpg", "--save-rrd", "look.rrd")
    assert outcome.code == Exit.FILE
    assert Path("look.rrd").read_text() == "mine"
    assert not Path("moving_aligned.jpg").exists()


def test_a_viewer_that_is_not_there_is_told_before_any_work(run, pictures) -> None:
    words = ("--rerun-connect", "rerun+http://127.0.0.1:9/proxy")
    outcome = run("pair", "fixed.jpg", "moving.jpg", *words)
    assert outcome.code == Exit.FILE
    assert "no viewer listens" in outcome.err
    assert not Path("moving_aligned.jpg").exists()
    assert run("pair", "fixed.jpg", "moving.jpg", "--rerun-connect", "nonsense").code == Exit.USAGE


def test_view_opens_recordings_and_those_beside_sidecars(run, pictures, opened) -> None:
    run("pair", "fixed.jpg", "moving.jpg", "--save-rrd", "moving_aligned.autoalign.rrd", "--effort", "fast")
    Path("moving_aligned.autoalign.rrd").rename("other.rrd")
    assert run("view", "moving_aligned.autoalign.json").code == Exit.FILE
    Path("other.rrd").rename("moving_aligned.autoalign.rrd")
    outcome = run("view", "moving_aligned.autoalign.json", "moving_aligned.autoalign.rrd")
    assert outcome.code == Exit.DONE
    assert opened == [[Path("moving_aligned.autoalign.rrd")] * 2]


def test_view_names_the_recordings_it_cannot_show(run, pictures, blind) -> None:
    Path("a.rrd").write_bytes(b"RRF2...")
    outcome = run("view", "a.rrd")
    assert outcome.code == Exit.FILE
    assert outcome.err.rstrip().endswith("a.rrd")
    assert "no display" in outcome.err


def test_view_refuses_what_is_no_recording(run, pictures, opened) -> None:
    for words, reason in ((["fixed.jpg"], "no recording"), (["gone.rrd"], "cannot be read"), (["gone.json"], "exist")):
        outcome = run("view", *words)
        assert outcome.code == Exit.FILE
        assert reason in outcome.err
        assert outcome.err.rstrip().endswith(words[0])
    assert run("view").code == Exit.USAGE
    assert opened == []
