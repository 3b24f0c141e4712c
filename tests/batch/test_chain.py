"""A sequence as a batch: links found once, frames that cannot be read, and where all of them together go."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

import autoalign as aa
from autoalign.batch.chain import link_up, place
from autoalign.batch.engine import InlineEngine
from autoalign.batch.jobs import Job, JobOptions, key
from autoalign.batch.ledger import Ledger
from autoalign.batch.slot import Casualty, Outcome
from autoalign.batch.work import Task, do_task
from autoalign.registration.drawing import Drawing


@dataclass(frozen=True)
class Counting(InlineEngine):
    """Counts its jobs; the one with this number is the end of its worker."""

    fatal: int | None = None
    done: list[object] = field(default_factory=list)

    def run(self, function, jobs):
        for outcome in super().run(function, jobs):
            self.done.append(outcome.job)
            if len(self.done) - 1 == self.fatal:
                casualty = Casualty(cause="crashed", reason="gone")
                yield Outcome(job=outcome.job, result=None, casualty=casualty, seconds=0)
            else:
                yield outcome


@pytest.fixture
def frames(tmp_path: Path) -> list[Job]:
    """Five frames, each 6 px to the right of and 2 px below the one before."""
    scene = np.random.default_rng(0).integers(0, 256, (60, 80), np.uint8).repeat(4, 0).repeat(4, 1)
    names = [f"f{k}.png" for k in range(5)]
    for k, name in enumerate(names):
        aa.write_picture(tmp_path / name, np.ascontiguousarray(scene[2 * k : 2 * k + 180, 6 * k : 6 * k + 240]))
    return [
        Job(name=name, fixed=str(tmp_path / "f0.png"), moving=str(tmp_path / name), out_dir=str(tmp_path / "out"))
        for name in names
    ]


def linked(frames: list[Job], folder: Path, engine: InlineEngine):
    folder.mkdir(exist_ok=True)
    with Ledger(folder) as ledger:
        return list(link_up(frames, 0, ledger, engine, folder))


def test_links_are_found_once_and_tell_the_same_again(frames, tmp_path):
    first, second, changed = Counting(), Counting(), Counting()
    found = linked(frames, tmp_path / "out", first)
    assert len(first.done) == len(found) > 4
    again = linked(frames, tmp_path / "out", second)
    assert second.done == []
    assert place(frames, 0, again)[3].placed is not None
    for one, other in zip(place(frames, 0, found), place(frames, 0, again), strict=True):
        assert key(one, str) == key(other, str)
    drawn = [Job(**(vars_of(job) | {"options": JobOptions(drawing=Drawing(canvas="union"))})) for job in frames]
    linked(drawn, tmp_path / "out", changed)
    assert changed.done == []  # how frames are drawn has no part in how they are linked


def vars_of(job: Job) -> dict[str, object]:
    return {name: getattr(job, name) for name in ("name", "fixed", "moving", "out_dir")}


def test_frames_go_where_they_belong(frames, tmp_path):
    placed = place(frames, 0, linked(frames, tmp_path / "out", Counting()))
    for k, job in enumerate(placed):
        assert job.placed is not None
        assert job.placed.status == "aligned"
        expected = [[1, 0, 6 * k], [0, 1, 2 * k], [0, 0, 1]]
        assert np.allclose(job.placed.reference_from_frame, expected, atol=0.02)
        row = do_task(Task(job=job, key="")).row
        assert (row.status, row.output) == ("aligned", job.name)
        assert np.array_equal(row.fixed_from_moving, job.placed.reference_from_frame)


def test_a_frame_that_cannot_be_read_fails_and_the_rest_goes_on(frames, tmp_path):
    Path(frames[2].moving).write_text("no picture")
    placed = place(frames, 0, linked(frames, tmp_path / "out", Counting()))
    rows = [do_task(Task(job=job, key="")).row for job in placed]
    assert [row.status for row in rows] == ["aligned", "aligned", "failed", "aligned", "aligned"]
    assert "is not a picture" in rows[2].reason


def test_a_link_that_is_its_workers_end_is_no_link_and_is_tried_again(frames, tmp_path):
    deadly = Counting(fatal=0)
    found = linked(frames, tmp_path / "out", deadly)
    assert [one.link.status for one in found].count("rejected") == 1
    assert all(job.placed is not None and job.placed.status == "aligned" for job in place(frames, 0, found))
    again = Counting()
    linked(frames, tmp_path / "out", again)
    assert len(again.done) == 1
