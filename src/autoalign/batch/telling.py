"""What a batch says of itself to people: the report and the recording, made from its ledger."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from autoalign.batch.ledger import LedgerReader
from autoalign.files.row import Row, Thumbnails
from autoalign.views.report import write_report

REPORT, RECORDING = "report.html", "batch.rrd"
SHARE = 0.1  # of the time, at most, for what takes the longer the more there is, and so may not come with every pair


def write_reports(
    out_dir: Path, ledger: LedgerReader, about: Mapping[str, str], *, sequence: bool = False, recorded: bool = False
) -> list[Path]:
    """Write the report of all that the ledger knows into the folder of the results, and the recording if it is wanted.

    Says where they are. Raises ImageWriteError if one cannot be written.
    """
    title, report, recording = out_dir.absolute().name, out_dir / REPORT, out_dir / RECORDING
    about = {"results": str(out_dir.absolute()), **about}
    write_report(report, title, _illustrated(ledger), about, sequence=sequence, overwrite=True)
    if not recorded:
        return [report]
    from autoalign.views.viewer_batch import write_batch_recording  # not above: it loads rerun

    took = ledger.seconds()
    write_batch_recording(recording, title, _illustrated(ledger), about, seconds=took.get, overwrite=True)
    return [report, recording]


class Telling:
    """The reports of a batch that goes on: up to date, but for what would take too much of the time of its work.

    The more the ledger holds, the longer it takes to write them. So the next ones are due after a while in proportion
    to that, however often something new is there.
    """

    def __init__(self, write: Callable[[], list[Path]], *, clock: Callable[[], float] = time.monotonic) -> None:
        self._write, self._clock = write, clock
        self._written: list[Path] = []
        self._is_new = False
        self._earliest = -math.inf  # in the clock's seconds

    def expect(self) -> None:
        """Note that there is something new to tell, or will be from now on."""
        self._is_new = True

    def due_s(self) -> float:
        """Seconds until there is something to write; none or less if that is now, inf if nothing is new."""
        return self._earliest - self._clock() if self._is_new else math.inf

    def keep_up(self) -> None:
        """Write what is due. Raises as `write` does."""
        if self.due_s() <= 0:
            self.finish()

    def finish(self) -> list[Path]:
        """Write what is new, due or not, and say where all is that was written. Raises as `write` does."""
        if self._is_new:
            begun = self._clock()
            self._written = self._write()
            self._is_new, self._earliest = False, next_turn(begun, self._clock())
        return self._written


def next_turn(begun: float, ended: float) -> float:
    """When that which took from `begun` to `ended` may come again and take no more than its share; all in seconds."""
    return begun + (ended - begun) / SHARE


def _illustrated(ledger: LedgerReader) -> Iterator[tuple[Row, Thumbnails | None]]:
    for row in ledger.rows():
        yield row, ledger.thumbnails(row.name)
