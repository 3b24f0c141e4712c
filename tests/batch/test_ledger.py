"""The ledger: what is planned, kept and resumed, whatever comes between."""

from __future__ import annotations

import hashlib
import os
import random
import signal
import sqlite3
import subprocess
import sys
import time
from dataclasses import fields, replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from autoalign.batch import ledger as ledger_module
from autoalign.batch.ledger import FILE_NAME, LOCAL_FILE_SYSTEMS, Entry, Ledger, LedgerReader
from autoalign.batch.schema import SCHEMA_VERSION, columns_of, row_of
from autoalign.errors import ImageReadError, ImageWriteError
from autoalign.files.row import ROW_STATUSES, Row, Thumbnails
from rows import ALIGNED, FAILED

THUMBNAILS = Thumbnails(fixed=b"\xff\xd8fixed", before=b"\xff\xd8before", after=None)


def entry(row: Row, key: str | None = None) -> Entry:
    return Entry(key=key or f"key of {row.name}", name=row.name, fixed=row.fixed, moving=row.moving)


def some(count: int) -> list[Row]:
    return [replace(ALIGNED, name=f"{number}.png", moving=f"in/{number}.png") for number in range(count)]


def test_rows_come_back_as_they_were_in_the_order_of_the_plan(tmp_path: Path) -> None:
    rows = [*some(20), ALIGNED, FAILED]
    with Ledger(tmp_path) as ledger:
        ledger.plan(map(entry, rows))
        for row in random.Random(1).sample(rows, len(rows)):
            ledger.keep(entry(row).key, row, seconds=0.5)
        assert list(ledger.rows()) == rows
        assert list(ledger.rows("failed")) == [FAILED]
    with LedgerReader(tmp_path) as reader:
        assert list(reader.rows()) == rows


texts = st.text(st.characters(exclude_categories=["Cs"])) | st.binary(max_size=9).map(os.fsdecode)  # any file's name
numbers = st.none() | st.floats(allow_nan=False)
sizes = st.none() | st.tuples(st.integers(1, 2**31), st.integers(1, 2**31))
lines = st.tuples(*[st.floats(allow_nan=False, allow_infinity=False)] * 3)


@given(
    row=st.builds(
        Row,
        name=texts,
        fixed=texts,
        moving=texts,
        status=st.sampled_from(ROW_STATUSES),
        reason=texts,
        expected_error_px=numbers,
        model=st.none() | texts,
        fixed_from_moving=st.none() | st.tuples(lines, lines, lines),
        fixed_size=sizes,
        moving_size=sizes,
        matches=st.integers(0, 2**40),
        overlap=st.floats(0, 1),
        output=st.none() | texts,
    )
)
def test_any_row_survives_the_tables(row: Row) -> None:
    with sqlite3.connect(":memory:") as database:
        database.text_factory = lambda data: data.decode("utf-8", "surrogateescape")
        for statement in ledger_module.SCHEMA:
            database.execute(statement)
        names = [value.encode("utf-8", "surrogateescape") for value in (row.name, row.fixed, row.moving)]
        database.execute(ledger_module.PLAN, (names[0], "key", names[1], names[2], 0))
        database.execute(ledger_module.KEEP, ("key", 0.0, 0.0, *columns_of(row)))
        (found,) = database.execute(ledger_module.SELECT_ROWS)
    database.close()
    assert row_of(found) == row


def test_a_second_run_does_what_is_new_or_changed(tmp_path: Path) -> None:
    rows = some(4)
    with Ledger(tmp_path) as ledger:
        ledger.plan(map(entry, rows[:3]))
        ledger.keep(entry(rows[0]).key, rows[0])
        ledger.keep(entry(rows[1]).key, rows[1], THUMBNAILS)
    with Ledger(tmp_path) as ledger:
        changed = entry(rows[1], "another key")
        ledger.plan([entry(rows[3]), entry(rows[0]), changed])

        assert ledger.pending() == [entry(rows[3]).key, "another key"]  # what waited and is not planned is forgotten
        assert list(ledger.rows()) == [rows[0]]
        assert ledger.thumbnails(rows[1].name) is None
        assert ledger.known([row.name for row in rows]) == {rows[3].name, rows[0].name, rows[1].name}


def test_more_jobs_come_after_those_there_are(tmp_path: Path) -> None:
    rows = some(4)
    with Ledger(tmp_path) as ledger:
        ledger.plan(map(entry, rows[:2]))
        ledger.plan(map(entry, rows[2:]), more=True)
        assert ledger.pending() == [entry(row).key for row in rows]


def test_jobs_are_found_by_their_names_however_many(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ledger_module, "AT_ONCE", 7)
    rows = [*some(20), replace(FAILED, name="\udcff.png")]
    with Ledger(tmp_path) as ledger:
        ledger.plan(entry(row, str(place)) for place, row in enumerate([*rows, replace(ALIGNED, name="not asked for")]))
        for place, row in enumerate(rows):
            if place != 3:
                ledger.keep(str(place), row)
        asked = random.Random(1).sample(rows, len(rows))
        names = ["nobody", *(row.name for row in asked)]
        assert ledger.known(names) == {row.name for row in rows}
        assert ledger.rows_of(names) == [row for row in asked if row is not rows[3]]


def test_counts_name_every_state(tmp_path: Path) -> None:
    rows = [ALIGNED, FAILED, *some(3)]
    with Ledger(tmp_path) as ledger:
        ledger.plan(map(entry, rows))
        for row in rows[:2]:
            ledger.keep(entry(row).key, row)
        assert ledger.counts() == {"pending": 3, "aligned": 1, "doubtful": 0, "rejected": 0, "failed": 1}


def test_the_worst_are_those_that_need_a_person(tmp_path: Path) -> None:
    rows = [
        replace(row, status=status, expected_error_px=error)
        for row, (status, error) in zip(
            some(5),
            [("aligned", 0.1), ("failed", None), ("aligned", 0.9), ("rejected", None), ("doubtful", 3.0)],
            strict=True,
        )
    ]
    with Ledger(tmp_path) as ledger:
        ledger.plan(map(entry, rows))
        for row in rows:
            ledger.keep(entry(row).key, row)
        assert ledger.worst(4) == [rows[1], rows[3], rows[4], rows[2]]


def test_what_is_kept_again_replaces_what_was(tmp_path: Path) -> None:
    later = replace(ALIGNED, status="doubtful")
    with Ledger(tmp_path) as ledger:
        ledger.plan([entry(ALIGNED)])
        ledger.keep(entry(ALIGNED).key, ALIGNED, THUMBNAILS)
        assert ledger.thumbnails(ALIGNED.name) == THUMBNAILS
        ledger.keep(entry(ALIGNED).key, later)
        assert list(ledger.rows()) == [later]
        assert ledger.thumbnails(ALIGNED.name) is None


def test_what_is_reopened_waits_again(tmp_path: Path) -> None:
    with Ledger(tmp_path) as ledger:
        ledger.plan([entry(ALIGNED), entry(FAILED)])
        ledger.keep(entry(ALIGNED).key, ALIGNED)
        ledger.keep(entry(FAILED).key, FAILED)
        ledger.reopen(row.name for row in ledger.rows("failed"))
        assert (ledger.pending(), list(ledger.rows())) == ([entry(FAILED).key], [ALIGNED])


def test_wrong_calls(tmp_path: Path) -> None:
    with Ledger(tmp_path) as ledger:
        with pytest.raises(ValueError, match=r"the job a\.jpg is not planned"):
            ledger.keep("no key", ALIGNED)
        with pytest.raises(ValueError, match=r"two jobs of the batch have the name a\.jpg"):
            ledger.plan([entry(ALIGNED, "one"), entry(ALIGNED, "two")])
        assert ledger.known([ALIGNED.name]) == set()


def test_links_are_kept(tmp_path: Path) -> None:
    with Ledger(tmp_path) as ledger:
        assert ledger.link("a") is None
        ledger.keep_link("a", '{"first": 1}')
        assert ledger.link("a") == '{"first": 1}'


def test_runs_and_times(tmp_path: Path) -> None:
    before = time.time()
    with Ledger(tmp_path) as ledger:
        ledger.begin_run({"effort": "auto"})
        ledger.plan([entry(ALIGNED)])
        ledger.keep(entry(ALIGNED).key, ALIGNED)
        with LedgerReader(tmp_path) as reader:
            assert [run.ended for run in reader.runs()] == [None]
    with LedgerReader(tmp_path) as reader:
        (run,) = reader.runs()
        assert run.ended is not None
        assert before <= run.started <= run.ended <= time.time()
        assert run.options == {"effort": "auto"}
        assert (reader.finished_since(before), reader.finished_since(time.time())) == (1, 0)


def test_anyone_may_read_while_it_is_written(tmp_path: Path) -> None:
    rows = some(3)
    with Ledger(tmp_path) as ledger:
        ledger.plan(map(entry, rows))
        with LedgerReader(tmp_path) as reader:
            for count, row in enumerate(rows):
                assert reader.counts()["aligned"] == count
                ledger.keep(entry(row).key, row)
            with pytest.raises(sqlite3.OperationalError, match="readonly"):
                reader._database.execute("DELETE FROM job")


def test_where_a_disk_is_not_this_machines_there_is_no_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ledger_module, "_file_system", lambda path: "nfs4")
    with Ledger(tmp_path) as ledger:
        ledger.plan([entry(ALIGNED)])
        with LedgerReader(tmp_path) as reader:
            ledger.keep(entry(ALIGNED).key, ALIGNED)
            assert list(reader.rows()) == [ALIGNED]
            assert not (tmp_path / f"{FILE_NAME}-wal").exists()


def test_this_disk_is_one_of_this_machine(tmp_path: Path) -> None:
    df = subprocess.run(["df", "--output=fstype", str(tmp_path)], capture_output=True, text=True, check=True)
    assert ledger_module._file_system(tmp_path) == df.stdout.split()[-1]
    assert {"ext4", "xfs", "btrfs", "tmpfs"} <= LOCAL_FILE_SYSTEMS


def test_one_plain_file_is_left(tmp_path: Path) -> None:
    with Ledger(tmp_path) as ledger:
        ledger.plan([entry(ALIGNED)])
    assert [path.name for path in tmp_path.iterdir() if not path.name.startswith(".")] == [FILE_NAME]


def test_a_second_keeper_is_refused(tmp_path: Path) -> None:
    with Ledger(tmp_path):
        with pytest.raises(ImageWriteError, match=f"^another batch is at work in this folder: {tmp_path}$"):
            Ledger(tmp_path)
        with LedgerReader(tmp_path) as reader:
            assert reader.counts()["pending"] == 0
    Ledger(tmp_path).close()


def make_strange(path: Path, kind: str) -> None:
    if kind == "text":
        path.write_text("no ledger " * 100)
        return
    database = sqlite3.connect(path)
    if kind == "another program":
        database.execute("CREATE TABLE job (name TEXT)")
    else:
        database.execute(f"PRAGMA application_id = {ledger_module.APPLICATION_ID}")
        database.execute(f"PRAGMA user_version = {SCHEMA_VERSION + 1}")
    database.commit()
    database.close()


@pytest.mark.parametrize(
    ("kind", "reason"),
    [
        ("text", "file is not a database"),
        ("another program", "is no ledger of autoalign"),
        ("another version", "was made by another version of autoalign"),
    ],
)
def test_a_strange_file_is_refused_and_left_alone(tmp_path: Path, kind: str, reason: str) -> None:
    path = tmp_path / FILE_NAME
    make_strange(path, kind)
    before = path.read_bytes()
    for opened in (Ledger, LedgerReader):
        with pytest.raises((ImageReadError, ImageWriteError), match=f"{reason}.*: {path}$"):
            opened(tmp_path)
    assert path.read_bytes() == before


def test_a_folder_without_a_batch(tmp_path: Path) -> None:
    with pytest.raises(ImageReadError, match=f"^holds no batch: {tmp_path}$"):
        LedgerReader(tmp_path)
    with pytest.raises(ImageWriteError, match=f"cannot be written .*: {tmp_path / 'none'}$"):
        Ledger(tmp_path / "none")


def test_tables_of_this_version() -> None:
    """A Row with other fields needs another SCHEMA_VERSION, or old ledgers would be read wrongly."""
    names = "name fixed moving status reason expected_error_px model fixed_from_moving fixed_size moving_size"
    names += " matches inliers overlap rung advice output sidecar recording"
    assert (SCHEMA_VERSION, " ".join(field.name for field in fields(Row))) == (1, names)


def test_hashes_are_remembered_until_the_file_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    picture = tmp_path / "picture.png"
    picture.write_bytes(b"pixels")
    long_ago = time.time_ns() - 10_000_000_000
    os.utime(picture, ns=(long_ago, long_ago))
    read = []
    digest = hashlib.file_digest
    monkeypatch.setattr(hashlib, "file_digest", lambda file, name: read.append(file.name) or digest(file, name))

    for _ in range(2):
        with Ledger(tmp_path) as ledger:
            for _ in range(2):
                assert ledger.hash_of(picture) == hashlib.sha256(b"pixels").hexdigest()
    assert len(read) == 1

    with Ledger(tmp_path) as ledger:
        picture.write_bytes(b"PIXELS")  # and this one is so young that it might change again, so it is not remembered
        for _ in range(2):
            assert ledger.hash_of(picture) == hashlib.sha256(b"PIXELS").hexdigest()
        assert len(read) == 3
        with pytest.raises(ImageReadError, match=f"cannot be read .*: {tmp_path / 'none'}$"):
            ledger.hash_of(tmp_path / "none")


KEEPER = """
import sys
from autoalign.batch.ledger import Entry, Ledger
from autoalign.files.row import Row, Thumbnails
row = Row(name="", fixed="f", moving="m", status="aligned", reason="31 of 40 matches agree")
thumbnails = Thumbnails(fixed=b"1" * 5000, before=b"2" * 5000, after=b"3" * 5000)
with Ledger(sys.argv[1]) as ledger:
    ledger.plan(Entry(key=str(place), name=str(place), fixed="f", moving="m") for place in range(3000))
    for key in ledger.pending():
        ledger.keep(key, row, thumbnails)
        print(key, flush=True)
"""


def test_a_keeper_may_be_killed_at_any_moment(tmp_path: Path) -> None:
    """Nothing that was kept is lost, the file is sound, the lock is free, and readers need nobody's help."""
    told: list[str] = []
    command = [sys.executable, "-c", KEEPER, str(tmp_path)]
    for moment in (5, 17, 40):
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as keeper:
            assert keeper.stdout is not None
            told.extend(keeper.stdout.readline().strip() for _ in range(moment))
            keeper.send_signal(signal.SIGKILL)
            told.extend(line.strip() for line in keeper.stdout if line.endswith("\n"))
        with LedgerReader(tmp_path) as reader:
            names = [row.name for row in reader.rows()]
            assert reader._database.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
        assert names[: len(told)] == told  # each once, though the last one may not have been told
        assert len(names) - len(told) <= 1
        told = names
    with Ledger(tmp_path) as ledger:
        assert ledger.counts()["pending"] == 3000 - len(told)
