"""How batches grow: with workers, on a cluster, and with a hundred thousand jobs. Prints ratios and shares.

    python scripts/batch_scale.py --pairs 1000 --megapixels 1
    python scripts/batch_scale.py --pairs 1000 --megapixels 1 --cluster
    python scripts/batch_scale.py --jobs 100000

The first runs the same made-up pairs with one worker and with two, and compares rates, rows and outputs; the
coordinator's share is its own processor time over the time of the run. With --cluster they go through a Dask cluster of
two threads on this machine as well. The last plans, half does, and resumes jobs whose function does nothing.
"""

from __future__ import annotations

import argparse
import resource
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import psutil

import autoalign as aa
from autoalign.batch.engine import Engine, LocalEngine
from autoalign.batch.jobs import Job
from autoalign.batch.ledger import Ledger, LedgerReader
from autoalign.batch.run import carry_out, feature_store, planned
from autoalign.batch.work import Done, Task
from autoalign.files.row import Row

MB = 1e6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=0)
    parser.add_argument("--megapixels", type=float, default=1.0)
    parser.add_argument("--cluster", action="store_true")
    parser.add_argument("--jobs", type=int, default=0, help="of a function that does nothing")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        if options.pairs:
            real_pairs(Path(folder), options.pairs, options.megapixels, options.cluster)
        if options.jobs:
            empty_jobs(Path(folder), options.jobs)


def real_pairs(folder: Path, count: int, megapixels: float, cluster: bool) -> None:
    jobs = made_up(folder / "in", count, megapixels)
    one = batch(jobs, folder / "one", LocalEngine(workers=1), "1 worker")
    two = batch(jobs, folder / "two", LocalEngine(workers=2), "2 workers")
    print(f"2 workers do {one / two:.2f} times as many pairs a second as 1")
    same(folder / "one", folder / "two")
    if cluster:
        from autoalign.batch.cluster import DaskEngine

        with local_cluster() as scheduler:
            dask = batch(jobs, folder / "dask", DaskEngine(scheduler=scheduler), "2 threads of Dask")
        print(f"the cluster takes {dask / two:.2f} of the time of 2 workers")
        same(folder / "two", folder / "dask")


def made_up(folder: Path, count: int, megapixels: float) -> list[Job]:
    """Pictures of one scene in JPEG, shifted and turned a little, onto the first."""
    import cv2
    from skimage.data import retina

    folder.mkdir()
    rng = np.random.default_rng(0)
    w = round((megapixels * 1e6 * 4 / 3) ** 0.5)
    h = w * 3 // 4
    scale = 1.5 * w / 1411
    for k in range(count + 1):
        angle, (x, y) = (rng.normal(0, 0.02), rng.normal(0, 0.02 * w, 2)) if k else (0.0, (0.0, 0.0))
        c, s = scale * np.cos(angle), scale * np.sin(angle)
        shown = np.array([[c, -s, x - 0.25 * w], [s, c, y - 0.4 * w]])
        view = cv2.warpAffine(retina(), shown, (w, h), flags=cv2.INTER_CUBIC).astype(np.int16)
        view += rng.integers(-6, 7, view.shape, np.int16)
        aa.write_picture(folder / f"p{k}.jpg", np.clip(view, 0, 255).astype(np.uint8))
    return [
        Job(name=f"p{k}.jpg", fixed=str(folder / "p0.jpg"), moving=str(folder / f"p{k}.jpg"), out_dir="")
        for k in range(1, count + 1)
    ]


def batch(jobs: list[Job], out: Path, engine: Engine, name: str) -> float:
    """Seconds that it took."""
    out.mkdir()
    jobs = [replace(job, out_dir=str(out)) for job in jobs]
    me = psutil.Process()
    started, before, memory = time.perf_counter(), me.cpu_times(), []
    with Ledger(out) as ledger, feature_store(out, None) as store:
        for _ in carry_out(planned(jobs, out, ledger, store), ledger, engine):
            memory.append(me.memory_info().rss)
    seconds, after = time.perf_counter() - started, me.cpu_times()
    own = after.user + after.system - before.user - before.system
    grown = (memory[-1] - memory[len(memory) // 10]) / MB
    print(
        f"{name}: {len(jobs)} pairs, {len(jobs) / seconds:.2f} a second; the coordinator was busy for"
        f" {own / seconds:.1%} of it, and grew by {grown:.1f} MB after its first tenth",
        flush=True,
    )
    return seconds


def same(one: Path, other: Path) -> None:
    """Say whether rows, outputs and sidecars are equal."""
    rows = [sorted(of_ledger(out), key=lambda row: row.name) for out in (one, other)]
    files = [{path.name: path.read_bytes() for path in out.glob("p*")} for out in (one, other)]
    print(f"{one.name} and {other.name}: rows {rows[0] == rows[1]}, {len(files[0])} files {files[0] == files[1]}")


def of_ledger(out: Path) -> list[Row]:
    with LedgerReader(out) as ledger:
        return list(ledger.rows())


@contextmanager
def local_cluster() -> Iterator[str]:
    """The address of a Dask scheduler on this machine, whose one worker has two threads."""
    from distributed import LocalCluster

    with LocalCluster(
        n_workers=1,
        threads_per_worker=2,
        processes=False,
        protocol="tcp://",
        host="127.0.0.1",
        dashboard_address="127.0.0.1:0",
    ) as cluster:
        yield cluster.scheduler_address


def nothing(task: Task) -> Done:
    """The row of a pair that was aligned, without a look at it."""
    job = task.job
    return Done(row=Row(name=job.name, fixed=job.fixed, moving=job.moving, status="aligned", reason="not looked at"))


def empty_jobs(folder: Path, count: int) -> None:
    """Plan, do half, come back, do the rest."""
    source, out = folder / "many", folder / "out"
    source.mkdir()
    out.mkdir()
    for k in range(count + 1):
        (source / f"p{k}.png").write_bytes(b"%d" % k)
    reference = str(source / "p0.png")
    begun = time.perf_counter()
    for part in (count // 2, count):
        started = time.perf_counter()
        jobs = [
            Job(name=f"p{k}.png", fixed=reference, moving=str(source / f"p{k}.png"), out_dir=str(out))
            for k in range(1, count + 1)
        ]
        with Ledger(out) as ledger, feature_store(out, None) as store:
            plan = planned(jobs, out, ledger, store)
            ready = time.perf_counter()
            done = sum(1 for _ in islice(carry_out(plan, ledger, LocalEngine(), function=nothing), part))
        ended = time.perf_counter()
        print(f"{plan.done:,} done before, planned in {ready - started:.1f} s, {done:,} done in {ended - ready:.1f} s")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / MB
    with LedgerReader(out) as ledger:
        print(f"{ledger.counts()['aligned']:,} rows; {time.perf_counter() - begun:.1f} s in all, at most {peak:.0f} MB")


if __name__ == "__main__":
    sys.exit(main())
