"""`autoalign batch` and `autoalign watch` as people call them."""

from __future__ import annotations

import io
import json
import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest

import autoalign as aa
from autoalign.batch.run import carry_out
from autoalign.batch.sources import Selection
from autoalign.cli import watch
from autoalign.cli.progress import clock, following, tally
from autoalign.cli.running import in_words
from autoalign.registration.alignment import AlignOptions


@pytest.fixture
def shots(pictures: Path) -> Path:
    """in/ with the examples and a picture that is none; the working folder is the one above."""
    (pictures / "in").mkdir()
    for name in ("fixed.jpg", "moving.jpg"):
        (pictures / name).rename(pictures / "in" / name)
    (pictures / "in" / "torn.jpg").write_bytes((pictures / "in" / "moving.jpg").read_bytes()[:9000])
    return pictures


def test_a_folder_onto_a_reference(shots, run):
    words = ("batch", "in", "--reference", "in/fixed.jpg", "--out-dir", "out", "--workers", "1")
    first = run(*words)
    assert first.code == 3  # torn.jpg
    assert first.out.startswith("2 pairs: 1 aligned, 1 failed (0:")
    assert "failed torn.jpg: is damaged" in first.err
    assert "wrote out/report.html, out/batch.rrd" in first.err
    assert json.loads((shots / "out" / "moving.jpg.autoalign.json").read_text())["status"] == "aligned"
    assert aa.read_picture(shots / "out" / "moving.jpg").pixels.shape == aa.read_picture("in/fixed.jpg").pixels.shape
    assert "torn.jpg" in (shots / "out" / "report.html").read_text()
    assert (shots / "out" / "batch.rrd").read_bytes().startswith(b"RRF")
    second = run(*words, "--exclude", "torn*")
    assert (second.code, second.err.count("\n")) == (0, 1)
    assert second.out.startswith("1 pair: 1 aligned, 1 of them done before (0:")


def test_a_plan_does_nothing(shots, run):
    planned = run("batch", "in", "--reference", "in/fixed.jpg", "--out-dir", "out", "--plan")
    assert planned.code == 0
    assert "in/moving.jpg -> in/fixed.jpg: out/moving.jpg\n" in planned.out
    assert planned.out.endswith("2 pairs; none done before\n")
    assert not (shots / "out").exists()
    chained = run("batch", "in", "--sequence", "--out-dir", "out", "--plan")
    assert "3 pairs, after 3 links between frames; none done before" in chained.out


def test_what_is_in_no_group_is_told(shots, run):
    planned = run("batch", "in", "--pattern", "(i)[xn]", "--out-dir", "out", "--plan")
    assert planned.out.startswith("in/moving.jpg -> in/fixed.jpg: ")
    assert planned.err == "1 of 3 pictures have no other in their group, as: in/torn.jpg\n"
    alone = run("batch", "in", "--pattern", "(fix|mov)", "--out-dir", "out", "--plan")
    assert (alone.code, alone.out) == (2, "")
    assert "holds no two pictures that go together: in" in alone.err


def test_a_manifest_from_standard_input(shots, run, monkeypatch):
    monkeypatch.setattr("sys.stdin", io.StringIO("fixed,moving,name\nin/fixed.jpg,in/moving.jpg,here/it.png\n"))
    outcome = run("batch", "-", "--out-dir", "out", "-q")
    assert (outcome.code, outcome.out, outcome.err) == (0, "", "")
    assert aa.read_picture(shots / "out" / "here" / "it.png").format == "PNG"


def test_a_sequence_goes_onto_one_frame_which_is_among_the_results(folder, run):
    (folder / "in").mkdir()
    scene = np.random.default_rng(0).integers(0, 256, (80, 100), np.uint8).repeat(4, 0).repeat(4, 1)
    for k in range(4):
        aa.write_picture(
            folder / "in" / f"f{k}.png", np.ascontiguousarray(scene[3 * k : 3 * k + 240, 7 * k :][:, :320])
        )
    outcome = run("batch", "in", "--sequence", "--out-dir", "out", "--workers", "1")
    assert outcome.code == 0
    assert outcome.out.startswith("4 pairs: 4 aligned")
    for k in range(4):
        kept = aa.read_sidecar(folder / "out" / f"f{k}.png.autoalign.json")
        shift = np.array(kept.fixed_from_moving)
        assert np.allclose(shift, [[1, 0, 7 * k], [0, 1, 3 * k], [0, 0, 1]], atol=0.03)
    assert np.array_equal(aa.read_picture("out/f0.png").pixels, aa.read_picture("in/f0.png").pixels)
    again = run("batch", "in", "--sequence", "--out-dir", "out", "--workers", "1")
    assert "4 of them done before" in again.out


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (("in",), 2, "needs --reference FILE, --sequence or --pattern for a folder: in"),
        (("in", "--sequence", "--pattern", "x"), 2, "--sequence and --pattern exclude each other"),
        (("in", "--sequence", "--reference", "elsewhere.jpg"), 2, "is none of the frames of in: elsewhere.jpg"),
        (("in", "--sequence", "--save-rrd", "all"), 2, "--save-rrd is for pairs"),
        (("list.csv", "--recursive"), 2, "--recursive is for folders, and this is none: list.csv"),
        (("nowhere", "--reference", "in/fixed.jpg"), 3, "does not exist: nowhere"),
        (("in", "--reference", "nowhere.jpg"), 3, "does not exist: nowhere.jpg"),
        (("in", "--reference", "in/torn.jpg"), 3, "is damaged"),
        (("in", "--reference", "in/fixed.jpg", "--include", "fixed*"), 2, "holds no two pictures that go together: in"),
        (("list.csv",), 3, "is no manifest (lacks the column moving): list.csv"),
        (("nowhere.csv",), 3, "does not exist: nowhere.csv"),
        (("in", "--reference", "in/fixed.jpg", "--max-memory", "-1"), 2, "memory limit"),
        (("in", "--reference", "in/fixed.jpg", "--workers", "0"), 2, "worker"),
    ],
)
def test_what_cannot_be_done_is_said_in_one_line(shots, run, words, code, message):
    (shots / "list.csv").write_text("fixed\na.png\n")
    outcome = run("batch", *words, "--out-dir", "out")
    assert (outcome.code, outcome.err.count("\n")) == (code, 1)
    assert message in outcome.err


def test_pictures_by_url_and_results_to_one(shots, run, server):
    for name in ("fixed.jpg", "moving.jpg"):
        server.files[f"/{name}"] = (shots / "in" / name).read_bytes()
    (shots / "list.csv").write_text(f"fixed,moving\n{server.url}/fixed.jpg,{server.url}/moving.jpg?sig=secret\n")
    words = ("batch", "list.csv", "--out-dir", "out", "--upload", f"file://{shots}/up", "--workers", "1")
    plan = run(*words, "--plan")
    assert plan.out.startswith(f"{server.url}/moving.jpg -> {server.url}/fixed.jpg: out/moving.jpg\n")
    assert run(*words).code == 0
    for name in ("moving.jpg", "moving.jpg.autoalign.json", "report.html", "batch.rrd"):
        assert (shots / "up" / name).read_bytes() == (shots / "out" / name).read_bytes()
    assert "1 of them done before" in run(*words).out


@pytest.mark.parametrize("words", [("batch", "in"), ("watch", "in", "--until-idle", "0.1")])
@pytest.mark.parametrize(("url", "message"), [("https://h/up", "not https"), ("s3://b?key=secret", "has a # or ?")])
def test_where_nothing_can_be_uploaded(shots, run, words, url, message):
    outcome = run(*words, "--reference", "in/fixed.jpg", "--out-dir", "out", "--upload", url)
    assert (outcome.code, outcome.err.count("\n")) == (2, 1)
    assert message in outcome.err
    assert "secret" not in outcome.err
    assert not (shots / "out").exists()


def test_a_folder_for_results_that_cannot_be(shots, run):
    (shots / "out").write_text("a file")
    outcome = run("batch", "in", "--reference", "in/fixed.jpg", "--out-dir", "out")
    assert (outcome.code, outcome.err.count("\n")) == (3, 1)
    assert "cannot be made a folder for the results" in outcome.err


def test_watching_until_nothing_comes(shots, run):
    words = ("--reference", "in/fixed.jpg", "--out-dir", "out", "--until-idle", "0.1", "--workers", "1")
    first = run("watch", "in", *words, "--upload", f"file://{shots}/up")
    assert first.code == 1
    assert "aligned moving.jpg:" in first.out
    assert "failed torn.jpg: is damaged" in first.out
    assert first.out.endswith("2 pairs: 1 aligned, 1 failed\n")
    assert (shots / "out" / "report.html").read_bytes() == (shots / "up" / "report.html").read_bytes()
    assert (shots / "out" / "moving.jpg").read_bytes() == (shots / "up" / "moving.jpg").read_bytes()
    second = run("watch", "in", *words, "--upload", f"file://{shots}/up")
    assert (second.code, second.out) == (0, "nothing new arrived\n")
    assert run("watch", "in", *words, "-q").out == ""
    assert run("watch", "nowhere", *words).code == run("watch", "in", *("--reference", "x.png", *words[2:])).code == 3


@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGTERM])
def test_a_watch_that_is_told_to_end_reports_what_it_has_done(shots, run, monkeypatch, end):
    def told_to_end(*words):
        for row in carry_out(*words):
            yield row
            signal.raise_signal(end)

    monkeypatch.setattr(watch, "carry_out", told_to_end)
    outcome = run("watch", "in", "--reference", "in/fixed.jpg", "--out-dir", "out", "--workers", "1")
    assert (outcome.code, outcome.out.splitlines()[-1]) == (0, "1 pair: 1 aligned")
    report = (shots / "out" / "report.html").read_text()
    assert "moving.jpg" in report
    assert "torn.jpg" not in report


def test_a_folder_is_looked_at_when_the_caller_asks_although_nothing_came(shots):
    for path in Path("in").iterdir():
        os.utime(path, (1e9, 1e9))  # whole
    files = watch.WatchFiles(reference=Path("in/fixed.jpg"), out_dir=Path("out"), rescan=30.0)
    looks = watch._arriving(Path("in"), Selection(), files, lambda: 0.01)
    started = time.monotonic()
    assert [next(looks), next(looks)] == [["fixed.jpg", "moving.jpg", "torn.jpg"], []]
    assert time.monotonic() - started < 20
    looks.close()


def test_plain_lines_where_there_is_no_terminal(capsys):
    with following("pairs", 2, quiet=False) as follow:
        follow("aligned")
        follow("rejected")
    assert capsys.readouterr().err.startswith("pairs 2 of 2: 1 aligned, 1 rejected, ")
    with following("pairs", 1, quiet=True) as follow:
        follow("aligned")
    assert capsys.readouterr().err == ""


def test_words():
    options = in_words(Selection(recursive=True, exclude=("*.txt", "*.md")), AlignOptions(model="rigid"))
    assert options == {"--recursive": "yes", "--exclude": "*.txt, *.md", "--model": "rigid"}
    assert tally({"rejected": 1200, "aligned": 3, "doubtful": 0}) == "3 aligned, 1,200 rejected"
    assert [clock(seconds) for seconds in (0.4, 61, 3599.7, 3661)] == ["0:00", "1:01", "1:00:00", "1:01:01"]
