"""`autoalign status`: what it says of a batch, and the rows it writes."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest

from autoalign.batch.ledger import Entry, Ledger
from autoalign.files.row import Row


@pytest.fixture
def out(folder: Path) -> Path:
    """A batch of four, of which one is still to be done."""
    rows = [
        Row(name="a", fixed="f", moving="a", status="aligned", reason="good", expected_error_px=0.00125),
        Row(name="b", fixed="f", moving="b", status="rejected", reason="7 of 31 matches agree"),
        Row(name="c", fixed="f", moving="c", status="failed", reason="does not exist: c"),
    ]
    (folder / "out").mkdir()
    with Ledger(folder / "out") as ledger:
        ledger.begin_run({})
        ledger.plan(Entry(key=name, name=name, fixed="f", moving=name) for name in "abcd")
        for row in rows:
            ledger.keep(row.name, row, seconds=0.5)
    return folder / "out"


def test_counts_and_the_worst_first(out, run):
    said = run("status", out)
    assert (said.code, said.err) == (0, "")
    assert said.out.splitlines() == [
        "4 pairs: 1 aligned, 1 rejected, 1 failed, 1 to do",
        "failed c: does not exist: c",
        "rejected b: 7 of 31 matches agree",
        "aligned a (0.00125 px expected): good",
    ]
    assert len(run("status", out, "--worst", "1").out.splitlines()) == 2


def test_while_it_runs_the_rate_and_the_time_left(out, run):
    with Ledger(out) as ledger:
        ledger.begin_run({})
        assert run("status", out, "--worst", "0").out.splitlines()[1].startswith("3 in the last 1 s, 0:00 left")


def test_rows_as_files_and_on_stdout(out, folder, run):
    said = run("status", out, "--csv", "rows.csv", "--json", "rows.json", "--parquet", "rows.parquet", "-q")
    assert (said.code, said.out) == (0, "")
    with (folder / "rows.csv").open(newline="") as file:
        assert [row["status"] for row in csv.DictReader(file)] == ["aligned", "rejected", "failed"]
    assert [row["name"] for row in json.loads((folder / "rows.json").read_text())] == ["a", "b", "c"]
    assert (folder / "rows.parquet").read_bytes().startswith(b"PAR1")
    assert [row["name"] for row in json.loads(run("status", out, "--json", "-").out)] == ["a", "b", "c"]
    assert run("status", out, "--csv", "rows.csv").code == 3
    assert run("status", out, "--csv", "rows.csv", "--overwrite").code == 0


def test_no_batch_there(folder, run):
    said = run("status", folder)
    assert (said.code, said.err) == (3, f"autoalign: holds no batch: {folder}\n")
