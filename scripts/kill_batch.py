"""Kill a batch at random moments, its coordinator and its workers, and compare what is left in the end, byte for byte.

    python scripts/kill_batch.py --pairs 200 --kills 30

A batch of made-up pictures runs once undisturbed. Then the same batch is started over and over, and each time its
coordinator is killed (SIGKILL) after a random while, until it has been killed so often; then once more, to the end.
A third time it runs through, and its workers are killed at random moments instead. Outputs and sidecars must be those
of the undisturbed run to the byte, every pair must be in the ledger once, and no pair may be lost.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import psutil

import autoalign as aa
from autoalign.batch.ledger import FILE_NAME, LedgerReader
from autoalign.batch.telling import RECORDING, REPORT

SIZE, MARGIN = (320, 240), 60  # px


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=200)
    parser.add_argument("--kills", type=int, default=30, help="of the coordinator, and as many of workers")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        make_pictures(folder / "in", options.pairs, rng)
        started = time.monotonic()
        finish(folder, "undisturbed", options.workers)
        seconds = time.monotonic() - started
        expected = results(folder / "undisturbed")
        print(f"undisturbed: {len(expected)} files of {options.pairs} pairs in {seconds:.0f} s", flush=True)
        kill_coordinators(folder, options, seconds, rng)
        good = told("coordinators", folder / "coordinators", expected, options.pairs)
        kill_workers(folder, options, seconds, rng)
        good &= told("workers", folder / "workers", expected, options.pairs)
    return 0 if good else 1


def make_pictures(folder: Path, count: int, rng: np.random.Generator) -> None:
    """A reference, and `count` shifted pictures of the same scene."""
    folder.mkdir()
    w, h = SIZE
    scene = rng.integers(0, 256, (h // 4 + MARGIN, w // 4 + MARGIN), np.uint8).repeat(4, 0).repeat(4, 1)
    for k in range(count + 1):
        x, y = rng.integers(0, MARGIN, 2) if k else (0, 0)
        aa.write_picture(folder / f"p{k}.png", np.ascontiguousarray(scene[y : y + h, x : x + w]))


def start(folder: Path, name: str, workers: int, *more: str) -> subprocess.Popen[bytes]:
    words = ["batch", "in", "--reference", "in/p0.png", "--out-dir", name, "--workers", str(workers), "--quiet", *more]
    return subprocess.Popen([sys.executable, "-m", "autoalign.cli.main", *words], cwd=folder, stderr=subprocess.DEVNULL)


def finish(folder: Path, name: str, workers: int) -> int:
    return start(folder, name, workers).wait()


def kill_coordinators(folder: Path, options: argparse.Namespace, seconds: float, rng: np.random.Generator) -> None:
    """So many runs that end early; each is long enough to do its share."""
    out = folder / "coordinators"
    for _ in range(options.kills):
        before = counted(out)
        process = start(folder, out.name, options.workers)
        while process.poll() is None and counted(out) <= before:  # it should get somewhere,
            time.sleep(0.01)
        time.sleep(rng.uniform(0, 1.5 * seconds / options.kills))  # and then no one knows how far
        process.kill()
        process.wait()
    finish(folder, out.name, options.workers)


def kill_workers(folder: Path, options: argparse.Namespace, seconds: float, rng: np.random.Generator) -> None:
    """One run, whose workers are killed; the pairs that they had become failures, which a second run does again."""
    process, killed = start(folder, "workers", options.workers), 0
    while process.poll() is None and killed < options.kills:
        time.sleep(rng.uniform(0, seconds / options.kills))
        workers = [child for child in descendants(process.pid) if child.cpu_times().user > 0]
        if workers:
            workers[int(rng.integers(len(workers)))].kill()
            killed += 1
    process.wait()
    print(f"workers killed: {killed}", flush=True)
    start(folder, "workers", options.workers, "--retry", "failed").wait()


def descendants(pid: int) -> list[psutil.Process]:
    """The workers: what the server that bears them has for children."""
    try:
        servers = psutil.Process(pid).children()
        return [child for server in servers for child in server.children()]
    except psutil.Error:
        return []


def counted(out: Path) -> int:
    """How many pairs the ledger holds as done."""
    if not (out / FILE_NAME).exists():
        return 0
    try:
        with LedgerReader(out) as ledger:
            return sum(count for state, count in ledger.counts().items() if state != "pending")
    except aa.ImageReadError:  # it is being made
        return 0


def results(out: Path) -> dict[str, bytes]:
    """All files but the ledger, in which times are kept, and the reports made of it."""
    skipped = (".", FILE_NAME, REPORT, RECORDING)
    return {path.name: path.read_bytes() for path in out.iterdir() if not path.name.startswith(skipped)}


def told(name: str, out: Path, expected: dict[str, bytes], pairs: int) -> bool:
    found = results(out)
    left = [path.name for path in out.iterdir() if path.name.endswith(".tmp")]
    different = sorted(key for key in expected.keys() | found.keys() if expected.get(key) != found.get(key))
    with LedgerReader(out) as ledger:
        names = [row.name for row in ledger.rows()]
        runs, pending = len(ledger.runs()), len(ledger.pending())
    good = not different and not left and not pending and len(names) == len(set(names)) == pairs
    print(
        f"{name} killed: {runs} runs; {len(names)} pairs in the ledger, {len(names) - len(set(names))} twice,"
        f" {pending} pending; {len(different)} of {len(expected)} files differ, {len(left)} left over:"
        f" {'as it should be' if good else 'WRONG'}",
        flush=True,
    )
    return good


if __name__ == "__main__":
    sys.exit(main())
