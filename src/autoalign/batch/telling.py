"""What a batch says of itself to people: the report and the recording, made from its ledger."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

from autoalign.batch.ledger import LedgerReader
from autoalign.files.row import Row, Thumbnails
from autoalign.views.report import write_report

REPORT, RECORDING = "report.html", "batch.rrd"


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


def _illustrated(ledger: LedgerReader) -> Iterator[tuple[Row, Thumbnails | None]]:
    for row in ledger.rows():
        yield row, ledger.thumbnails(row.name)
