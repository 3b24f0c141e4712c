"""What the coordinator of a batch costs: many jobs planned, half done, dropped, planned again, and done to the end.

    python scripts/batch_scale.py [--jobs 100000] [--workers 2] [--folder FOLDER]

The work itself is a stub that returns a row at once; all else is real: files are hashed, jobs go to worker processes
and back, and every row is in the ledger before the next one comes. The pictures are files of a few bytes, made before
the clock starts. `peak` is the memory of the coordinator so far.
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from itertools import islice
from pathlib import Path

from autoalign.batch import run
from autoalign.batch.engine import LocalEngine
from autoalign.batch.jobs import Job
from autoalign.batch.ledger import Ledger
from autoalign.batch.work import Done, Task
from autoalign.files.row import Row


def stub(task: Task) -> Done:
    """A pair that is rejected, because then nothing has to be written."""
    job = task.job
    return Done(row=Row(name=job.name, fixed=job.fixed, moving=job.moving, status="rejected", reason="is a stub"))


def make_jobs(folder: Path, count: int) -> list[Job]:
    """A reference and `count` pictures, in folders of a thousand."""
    reference = folder / "reference.png"
    reference.write_bytes(b"reference")
    jobs = []
    for number in range(count):
        name = f"{number // 1000}/{number}.png"
        path = folder / "in" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(name.encode())
        jobs.append(Job(name=name, fixed=str(reference), moving=str(path), out_dir=str(folder / "out")))
    (folder / "out").mkdir()
    return jobs


@contextmanager
def timed(what: str) -> Iterator[None]:
    wall, processor = time.perf_counter(), time.process_time()
    yield
    wall, processor = time.perf_counter() - wall, time.process_time() - processor
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3  # kB on Linux
    print(f"{what:<16} {wall:6.1f} s, {processor:6.1f} s of them at work, peak {peak:5.0f} MB", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, default=100_000)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--folder", type=Path, help="where to work, and leave nothing; a temporary folder by default")
    given = parser.parse_args()
    run.do_task = stub  # type: ignore[assignment]
    engine = LocalEngine(workers=given.workers)
    with tempfile.TemporaryDirectory(dir=given.folder) as name:
        out = Path(name) / "out"
        jobs = make_jobs(Path(name), given.jobs)
        with timed("all"):
            for count in (given.jobs // 2, given.jobs):
                with Ledger(out) as ledger:
                    with timed("plan"):
                        plan = run.planned(jobs, out, ledger, out / "store")
                    with timed("do"), closing(run.carry_out(plan, ledger, engine)) as rows:
                        for _ in islice(rows, count):
                            pass
                    print(ledger.counts())


if __name__ == "__main__":
    main()
