"""The coordinator: what is done once, what is done again, and what a killed batch leaves for the next run."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

import autoalign as aa
from autoalign.batch.engine import InlineEngine
from autoalign.batch.jobs import Job, JobOptions
from autoalign.batch.ledger import FILE_NAME, Entry, Ledger, LedgerReader
from autoalign.batch.run import STORE_NAME, PlanOptions, align_batch, carry_out, feature_store, planned
from autoalign.batch.slot import Casualty, Outcome
from autoalign.batch.sources import Selection, onto_reference, pictures
from autoalign.batch.telling import RECORDING, REPORT
from autoalign.batch.work import Done
from autoalign.errors import ImageWriteError
from autoalign.files.row import Row
from autoalign.files.write import TEMPORARY
from autoalign.registration.alignment import AlignOptions
from rows import ALIGNED


def jobs_of(folder: Path, out: Path, options: JobOptions | None = None) -> list[Job]:
    names = pictures(folder, Selection())
    return onto_reference(folder, names, folder / "frame1.png", out, options or JobOptions())


def run(jobs: list[Job], out: Path, engine=None, **options: bool) -> list[Row]:
    """Rows of what was done in this run."""
    fail_fast = options.pop("fail_fast", False)
    out.mkdir(exist_ok=True)
    with Ledger(out) as ledger, feature_store(out, None) as store:
        plan = planned(jobs, out, ledger, store, PlanOptions(**options))
        assert plan.done + len(plan.tasks) == len(jobs)
        return list(carry_out(plan, ledger, engine or InlineEngine(), fail_fast=fail_fast))


def contents(out: Path) -> dict[str, bytes]:
    """All results by name: not the ledger, in which times are kept, nor the reports, which say what was run."""
    return {
        path.relative_to(out).as_posix(): path.read_bytes()
        for path in sorted(out.rglob("*"))
        if path.is_file() and not path.name.startswith((".", FILE_NAME, REPORT, RECORDING))
    }


def test_one_bad_file_stops_nothing_and_a_second_run_does_nothing(folder, tmp_path):
    out = tmp_path / "out"
    rows = {row.name: row for row in run(jobs_of(folder, out), out)}
    assert {name: row.status for name, row in rows.items()} == {
        "damaged.png": "failed",
        "frame2.png": "aligned",
        "frame10.png": "aligned",
        "stranger.png": "rejected",
    }
    assert set(contents(out)) == {
        "frame2.png",
        "frame2.png.autoalign.json",
        "frame10.png",
        "frame10.png.autoalign.json",
        "stranger.png.autoalign.json",
    }
    assert not (out / STORE_NAME).exists()
    before = contents(out)
    assert run(jobs_of(folder, out), out) == []
    assert contents(out) == before


def test_only_what_changed_or_is_gone_or_failed_is_done_again(folder, tmp_path):
    out = tmp_path / "out"
    run(jobs_of(folder, out), out)
    (out / "frame2.png").unlink()
    assert [row.name for row in run(jobs_of(folder, out), out)] == ["frame2.png"]
    assert [row.name for row in run(jobs_of(folder, out), out, retry=True)] == ["damaged.png"]
    (folder / "damaged.png").write_bytes((folder / "frame2.png").read_bytes())
    assert [(row.name, row.status) for row in run(jobs_of(folder, out), out)] == [("damaged.png", "aligned")]
    aa.write_picture(folder / "frame3.png", aa.read_picture(folder / "frame2.png").pixels)
    assert [row.name for row in run(jobs_of(folder, out), out)] == ["frame3.png"]
    other = JobOptions(align=AlignOptions(model="translation"))
    assert len(run(jobs_of(folder, out, other), out)) == 5
    with LedgerReader(out) as ledger:
        assert len(list(ledger.rows())) == 5
        assert ledger.pending() == []


def test_pictures_that_are_away_cost_no_earlier_result(folder, tmp_path):
    out = tmp_path / "out"
    jobs = jobs_of(folder, out)
    run(jobs, out)
    before, source = contents(out), folder / "frame2.png"
    away = source.rename(tmp_path / "away.png")
    (row,) = run(jobs, out)
    assert (row.name, row.status, row.output) == ("frame2.png", "failed", None)
    assert row.advice == "the result of an earlier run was left as it is"
    assert contents(out) == before
    away.rename(source)
    assert [(row.name, row.status) for row in run(jobs, out)] == [("frame2.png", "aligned")]
    assert contents(out) == before


def test_fail_fast_leaves_the_rest_for_another_time(folder, tmp_path):
    out = tmp_path / "out"
    assert [row.name for row in run(jobs_of(folder, out), out, fail_fast=True)] == ["damaged.png"]
    assert len(run(jobs_of(folder, out), out)) == 3


def test_nothing_that_is_no_result_is_overwritten(folder, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "frame2.png").write_text("precious")
    with pytest.raises(ImageWriteError, match=rf"exists already, and is no result of this batch: {out}/frame2.png"):
        run(jobs_of(folder, out), out)
    assert (out / "frame2.png").read_text() == "precious"
    assert len(run(jobs_of(folder, out), out, overwrite=True)) == 4
    with pytest.raises(ValueError, match="is an input, and a result would overwrite it"):
        run(jobs_of(folder, folder), folder, overwrite=True)
    one = jobs_of(folder, out)[1]
    with pytest.raises(ValueError, match="same name"):
        run([one, replace(one, moving=one.fixed)], out)


def test_what_writers_that_were_killed_left_is_swept(folder, tmp_path):
    out = tmp_path / "out"
    run(jobs_of(folder, out), out)
    left = out / TEMPORARY.format("0123")
    left.write_text("half a pict")
    run(jobs_of(folder, out), out)
    assert not left.exists()


@dataclass(frozen=True)
class Losing(InlineEngine):
    """Loses, and kills, one job each."""

    def run(self, function, jobs):
        for outcome in super().run(function, jobs):
            name = outcome.job.job.name
            if name == "frame2.png":
                yield Outcome(job=outcome.job, result=None, casualty=Casualty(cause="lost", reason="gone"), seconds=0)
            elif name == "frame10.png":
                casualty = Casualty(cause="timeout", reason="took more than 3 s")
                yield Outcome(job=outcome.job, result=None, casualty=casualty, seconds=3)
            else:
                yield outcome


def test_a_job_that_is_its_workers_end_is_a_row_and_one_that_is_lost_stays_to_be_done(folder, tmp_path):
    out = tmp_path / "out"
    rows = {row.name: row for row in run(jobs_of(folder, out), out, Losing())}
    assert (rows["frame10.png"].status, rows["frame10.png"].reason) == ("failed", "took more than 3 s")
    assert not (out / "frame10.png").exists()
    assert "frame2.png" not in rows
    assert [row.name for row in run(jobs_of(folder, out), out)] == ["frame2.png"]


def test_the_library_yields_rows_without_a_ledger(folder, tmp_path):
    rows = list(align_batch(jobs_of(folder, tmp_path / "out"), InlineEngine()))
    assert sorted(row.status for row in rows) == ["aligned", "aligned", "failed", "rejected"]
    assert not (tmp_path / "out" / FILE_NAME).exists()


def test_what_arrives_costs_the_ledger_the_same_however_much_it_holds(folder, tmp_path):
    long_ago = 1e9  # so that all hashes are remembered
    for name in ("frame1.png", "frame2.png"):
        os.utime(folder / name, (long_ago, long_ago))
    work = [work_of_one_arrival(folder, tmp_path / str(before), before) for before in (10, 2000)]
    assert work[0] == work[1] > 100


def work_of_one_arrival(folder: Path, out: Path, before: int) -> int:
    """Instructions that SQLite carries out from the plan to the row, on top of so many jobs that are done."""
    out.mkdir()
    done = [replace(ALIGNED, name=f"before{k}.png") for k in range(before)]
    (job,) = onto_reference(folder, ["frame2.png"], folder / "frame1.png", out, JobOptions())
    arrived = replace(ALIGNED, name=job.name)
    steps = 0

    def count() -> None:
        nonlocal steps
        steps += 1

    with Ledger(out) as ledger, feature_store(out, None) as store:
        ledger.plan(Entry(key=row.name, name=row.name, fixed=row.fixed, moving=row.moving) for row in done)
        for row in done:
            ledger.keep(row.name, row)
        ledger._database.set_progress_handler(count, 1)
        plan = planned([job], out, ledger, store, PlanOptions(more=True))
        assert list(carry_out(plan, ledger, InlineEngine(), function=lambda task: Done(row=arrived))) == [arrived]
        ledger._database.set_progress_handler(None, 1)
        assert len(list(ledger.rows())) == before + 1
    return steps


def many(folder: Path, count: int) -> None:
    """So many pictures of one scene, of which each goes onto the first."""
    rng = np.random.default_rng(0)
    scene = rng.integers(0, 256, (90, 120), np.uint8).repeat(3, 0).repeat(3, 1)
    for k in range(count):
        x, y = rng.integers(0, 40, 2)
        aa.write_picture(folder / f"p{k}.png", np.ascontiguousarray(scene[y : y + 180, x : x + 240]))


def command(folder: Path, out: Path) -> subprocess.Popen[bytes]:
    words = ["batch", str(folder), "--reference", str(folder / "p0.png"), "--out-dir", str(out), "--workers", "2"]
    return subprocess.Popen(
        [sys.executable, "-m", "autoalign.cli.main", *words], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )


@pytest.mark.skipif(not hasattr(os, "fork"), reason="signals of its own")
def test_a_batch_that_is_killed_goes_on_and_leaves_what_an_undisturbed_one_does(tmp_path):
    folder = tmp_path / "in"
    folder.mkdir()
    many(folder, 24)
    undisturbed = tmp_path / "undisturbed"
    assert command(folder, undisturbed).wait(120) == 0
    expected = contents(undisturbed)
    assert len(expected) == 2 * 23  # pictures and sidecars
    killed, moments = tmp_path / "killed", np.random.default_rng(1).uniform(0.05, 0.8, 3)
    for moment in moments:
        process = command(folder, killed)
        while not (killed / FILE_NAME).exists():  # until work begins
            time.sleep(0.01)
        time.sleep(moment)
        process.send_signal(signal.SIGKILL)
        process.wait(10)
        with LedgerReader(killed) as ledger:
            for row in ledger.rows():
                assert row.status == "aligned"
                assert (killed / row.output).read_bytes() == expected[row.output]
    assert command(folder, killed).wait(120) == 0
    assert contents(killed) == expected
    with LedgerReader(killed) as first, LedgerReader(undisturbed) as second:
        assert list(first.rows()) == list(second.rows())
        assert len({row.name for row in first.rows()}) == len(list(first.rows())) == 23
