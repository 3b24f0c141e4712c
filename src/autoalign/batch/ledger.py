"""What a batch has to do and what it has done: one SQLite file beside the outputs, which survives every kind of end.

Only the coordinator writes; workers hand their results to it. So nothing ever waits for a lock, and the faults that
SQLite before 3.51.3 has where two connections write to one log cannot show. Anyone may read meanwhile.
"""

from __future__ import annotations

import hashlib
import json
import os
import sqlite3
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Self

import psutil

from autoalign import __version__
from autoalign.batch.schema import (
    APPLICATION_ID,
    FORGET,
    KEEP,
    PLAN,
    SCHEMA,
    SCHEMA_VERSION,
    SELECT_ROWS,
    TEXT,
    bound,
    columns_of,
    row_of,
)
from autoalign.errors import AutoalignError, ImageReadError, ImageWriteError
from autoalign.files.codec import one_line
from autoalign.files.read import state_of
from autoalign.files.remote import hash_of as hash_of_url
from autoalign.files.remote import is_url
from autoalign.files.row import ROW_STATUSES, Row, RowStatus, Thumbnails

FILE_NAME = "autoalign.sqlite"
LOCK_NAME = ".autoalign.lock"
PATIENCE_S = 10.0  # on disks where writer and readers take turns
SETTLED_NS = 2_000_000_000  # a file younger than this may change again without a change of its time stamp
HASHING_S = 1.0  # at most so much hashing is lost by a crash
AT_ONCE = 999  # values in a question; SQLite before 3.32 takes no more

# File systems whose locks and shared memory are those of one machine, as a write-ahead log needs them.
LOCAL_FILE_SYSTEMS = frozenset(
    ("apfs", "bcachefs", "btrfs", "ext2", "ext3", "ext4", "f2fs", "hfs", "ntfs", "overlay", "tmpfs", "xfs", "zfs")
)

State = RowStatus | Literal["pending"]
STATES: tuple[State, ...] = ("pending", *ROW_STATUSES)


@dataclass(frozen=True, kw_only=True)
class Entry:
    """A job as the ledger knows it."""

    key: str  # of its inputs, options and version: another key is another job, of which nothing is known
    name: str  # unique in its batch
    fixed: str
    moving: str


@dataclass(frozen=True, kw_only=True)
class Run:
    """One time that somebody worked on the batch; times in seconds since 1970."""

    started: float
    ended: float | None  # None while it runs, and for ever if it was killed
    version: str
    options: Mapping[str, Any]


class LedgerReader:
    """The ledger of a folder, to look at, also while a batch writes it. For one thread."""

    def __init__(self, folder: str | Path) -> None:
        """Raises ImageReadError, the path last, if there is no ledger or none that this version can read."""
        self._path = Path(folder) / FILE_NAME
        if not self._path.is_file():
            raise ImageReadError(f"holds no batch: {folder}")
        with self._faults(ImageReadError):
            self._connect("ro")
            self._check_schema()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Let go of the file."""
        self._database.close()

    def counts(self) -> dict[State, int]:
        """How many jobs there are in each state, zeros included."""
        sql = "SELECT coalesce(status, 'pending'), count(*) FROM job LEFT JOIN result USING (key) GROUP BY 1"
        return dict.fromkeys(STATES, 0) | dict(self._found(sql))

    def pending(self) -> list[str]:
        """The keys of what is to be done, in the order of the plan."""
        return [key for (key,) in self._found(f"SELECT key FROM job WHERE {WAITS} ORDER BY place, name")]

    def known(self, names: Sequence[str]) -> set[str]:
        """Those of the names that jobs have, done or not."""
        return {name for (name,) in self._found_of(names, "SELECT name FROM job")}

    def rows(self, *statuses: RowStatus) -> Iterator[Row]:
        """What was done, or of it what has one of these statuses, in the order of the plan, whoever came first."""
        chosen = statuses or ROW_STATUSES
        places = ", ".join("?" * len(chosen))
        yield from map(row_of, self._found(f"{SELECT_ROWS} WHERE status IN ({places}) ORDER BY place, name", *chosen))

    def rows_of(self, names: Sequence[str]) -> list[Row]:
        """What was done of the jobs with these names, in their order; takes no longer where there are many others."""
        found = {row.name: row for row in map(row_of, self._found_of(names, SELECT_ROWS))}
        return [found[name] for name in names if name in found]

    def worst(self, count: int = 10) -> list[Row]:
        """Those that need a person first: failed, rejected, doubtful; then the largest expected errors."""
        rank = " ".join(f"WHEN '{status}' THEN {rank}" for rank, status in enumerate(ROW_STATUSES))
        order = f"ORDER BY CASE status {rank} END DESC, expected_error_px DESC, place, name LIMIT ?"
        return list(map(row_of, self._found(f"{SELECT_ROWS} {order}", count)))

    def thumbnails(self, name: str) -> Thumbnails | None:
        """Of one row; None where there are none."""
        sql = "SELECT fixed_jpeg, before_jpeg, after_jpeg FROM job JOIN thumbnails USING (key)"
        for fixed, before, after in self._found(f"{sql} WHERE name = {TEXT}", bound(name)):
            return Thumbnails(fixed=fixed, before=before, after=after)
        return None

    def link(self, key: str) -> str | None:
        """What `keep_link` was given; None if that is nothing."""
        return next((data for (data,) in self._found("SELECT data FROM link WHERE key = ?", key)), None)

    def seconds(self) -> dict[str, float]:
        """How long each job took, by name."""
        return dict(self._found("SELECT name, seconds FROM result JOIN job USING (key)"))

    def runs(self) -> list[Run]:
        """Oldest first."""
        found = self._found("SELECT started, ended, version, options FROM run ORDER BY rowid")
        return [
            Run(started=started, ended=ended, version=version, options=json.loads(options))
            for started, ended, version, options in found
        ]

    def finished_since(self, moment: float) -> int:
        """How many rows were kept from that moment on, in seconds since 1970."""
        return int(self._found("SELECT count(*) FROM result WHERE finished >= ?", moment)[0][0])

    def _found_of(self, names: Sequence[str], sql: str) -> Iterator[Any]:
        """Of the jobs with these names only, in any order."""
        for start in range(0, len(names), AT_ONCE):
            some = names[start : start + AT_ONCE]
            yield from self._found(f"{sql} WHERE name IN ({', '.join([TEXT] * len(some))})", *map(bound, some))

    def _found(self, sql: str, *values: Any) -> list[Any]:
        """All at once: a reader that takes its time would keep the writer waiting on disks where they take turns."""
        with self._faults(ImageReadError):
            return self._database.execute(sql, values).fetchall()

    def _connect(self, mode: Literal["ro", "rwc"]) -> None:
        # isolation_level None: transactions begin where this file says so, and not behind its back.
        address = f"{self._path.absolute().as_uri()}?mode={mode}"
        self._database = sqlite3.connect(address, PATIENCE_S, isolation_level=None, uri=True)
        self._database.text_factory = lambda data: data.decode("utf-8", "surrogateescape")

    def _check_schema(self) -> None:
        if self._number("application_id") != APPLICATION_ID:
            raise ImageReadError(f"is no ledger of autoalign: {self._path}")
        if (version := self._number("user_version")) != SCHEMA_VERSION:
            raise ImageReadError(
                f"was made by another version of autoalign (tables {version}, here {SCHEMA_VERSION}): {self._path}"
            )

    def _number(self, pragma: str) -> int:
        return int(self._database.execute(f"PRAGMA {pragma}").fetchone()[0])

    @contextmanager
    def _faults(self, kind: type[AutoalignError]) -> Iterator[None]:
        """What SQLite says as one line, the path last."""
        try:
            yield
        except sqlite3.Error as error:
            raise kind(f"the ledger cannot be used ({one_line(error)}): {self._path}") from error


class Ledger(LedgerReader):
    """The ledger of a folder, to keep. There is one at a time, and what it was given survives any end of this process.

    If the machine goes down, the last rows may be lost; then these jobs are pending and will be done again.
    """

    def __init__(self, folder: str | Path) -> None:
        """Open the ledger of a folder that is there, or make one.

        Raises ImageWriteError, the path last, if another process keeps it or it cannot be written, ImageReadError if it
        is none that this version can read.
        """
        self._path = Path(folder) / FILE_NAME
        self._run: int | None = None
        self._hashing_since = 0.0
        self._lock = _lock(Path(folder))
        try:
            with self._faults(ImageWriteError):
                self._connect("rwc")
                self._prepare()
        except BaseException:
            self._lock.close()
            raise

    def close(self) -> None:
        """Note that the run has ended, and leave one plain file, which may be copied and sent."""
        try:
            with self._writing() as database:
                database.execute("UPDATE run SET ended = ? WHERE rowid = ?", (time.time(), self._run))
            with suppress(sqlite3.Error):  # somebody reads: then the log stays for the time being
                self._database.execute("PRAGMA journal_mode = DELETE")
        finally:
            self._database.close()
            self._lock.close()

    def begin_run(self, options: Mapping[str, Any]) -> None:
        """Note that work begins, with options that JSON has words for; `close` notes its end."""
        values = time.time(), __version__, json.dumps(options, sort_keys=True)
        with self._writing() as database:
            sql = "INSERT INTO run (started, version, options) VALUES (?, ?, ?)"
            self._run = database.execute(sql, values).lastrowid

    def plan(self, entries: Iterable[Entry], *, more: bool = False) -> None:
        """Take these jobs in, in this order, and after those there are if they are `more`.

        A job whose key is known keeps its row; one whose name is known by another key loses it, since something in it
        has changed. What waits and is not among these is forgotten, unless they are `more`; what was done is not.
        Raises ValueError if two have one name.
        """
        with self._writing() as database:
            (last,) = database.execute("SELECT max(place) FROM job").fetchone()
            if not more:
                database.execute(f"UPDATE job SET place = NULL WHERE {WAITS}")
            values = list(_numbered(entries, last + 1 if more and last is not None else 0))
            database.executemany(FORGET, [(name, key) for name, key, *_ in values])
            database.executemany(PLAN, values)
            database.execute("DELETE FROM job WHERE place IS NULL")

    def keep(self, key: str, row: Row, thumbnails: Thumbnails | None = None, *, seconds: float = 0.0) -> None:
        """Keep what became of a planned job, and the seconds it took; what was kept of it before is replaced.

        Raises ValueError if it is not planned.
        """
        with self._writing() as database:
            if not database.execute("UPDATE job SET attempts = attempts + 1 WHERE key = ?", (key,)).rowcount:
                raise ValueError(f"the job {row.name} is not planned")
            database.execute(KEEP, (key, time.time(), seconds, *columns_of(row)))
            if thumbnails is not None:
                sql = "INSERT INTO thumbnails (key, fixed_jpeg, before_jpeg, after_jpeg) VALUES (?, ?, ?, ?)"
                database.execute(sql, (key, thumbnails.fixed, thumbnails.before, thumbnails.after))

    def keep_link(self, key: str, data: str) -> None:
        """Keep what was found of two frames of a sequence."""
        with self._writing() as database:
            database.execute("INSERT OR REPLACE INTO link (key, data) VALUES (?, ?)", (key, data))

    def reopen(self, names: Iterable[str]) -> None:
        """Forget what became of these, so that they wait again."""
        sql = f"DELETE FROM result WHERE key = (SELECT key FROM job WHERE name = {TEXT})"
        with self._writing() as database:
            database.executemany(sql, [(bound(name),) for name in names])

    def hash_of(self, path: str | Path) -> str:
        """SHA-256 of a file's bytes, in hexadecimal; from memory if neither size, time stamp nor inode have changed.

        Of a URL, the hash of what its server says of its version, if it does. Raises ImageReadError, the path last.
        """
        if is_url(str(path)):
            return hash_of_url(str(path))
        path = os.path.abspath(path)
        try:
            state = state_of(path)
            sql = f"SELECT sha256 FROM file WHERE path = {TEXT} AND (size, mtime_ns, inode) = (?, ?, ?)"
            for (known,) in self._found(sql, bound(path), *state):
                return str(known)
            with open(path, "rb") as file:
                sha256 = hashlib.file_digest(file, "sha256").hexdigest()
            if state == state_of(path) and time.time_ns() - state[1] > SETTLED_NS:
                self._remember(path, state, sha256)
        except OSError as error:
            raise ImageReadError(f"cannot be read ({one_line(error)}): {path}") from error
        return sha256

    def _remember(self, path: str, state: tuple[int, int, int], sha256: str) -> None:
        """In transactions of a second: one for each file might cost more than its hash."""
        sql = f"INSERT OR REPLACE INTO file (path, size, mtime_ns, inode, sha256) VALUES ({TEXT}, ?, ?, ?, ?)"
        with self._faults(ImageWriteError):
            if not self._database.in_transaction:
                self._database.execute("BEGIN IMMEDIATE")
                self._hashing_since = time.monotonic()
            self._database.execute(sql, (bound(path), *state, sha256))
            if time.monotonic() - self._hashing_since > HASHING_S:
                self._database.execute("COMMIT")

    @contextmanager
    def _writing(self) -> Iterator[sqlite3.Connection]:
        """All of what follows, or nothing."""
        with self._faults(ImageWriteError):
            if self._database.in_transaction:  # the one with hashes
                self._database.execute("COMMIT")
            self._database.execute("BEGIN IMMEDIATE")
            try:
                yield self._database
            except BaseException:
                self._database.execute("ROLLBACK")
                raise
            self._database.execute("COMMIT")

    def _prepare(self) -> None:
        """Make the tables, or see that they are ours before anything is changed."""
        if self._found("SELECT 1 FROM sqlite_master LIMIT 1") or self._number("application_id"):
            self._check_schema()
        else:
            with self._writing() as database:
                for statement in SCHEMA:
                    database.execute(statement)
        local = _file_system(self._path) in LOCAL_FILE_SYSTEMS
        self._database.execute(f"PRAGMA journal_mode = {'WAL' if local else 'TRUNCATE'}")
        self._database.execute(f"PRAGMA synchronous = {'NORMAL' if local else 'FULL'}")
        self._database.execute("PRAGMA foreign_keys = ON")


WAITS = "key NOT IN (SELECT key FROM result)"  # of a job


def _lock(folder: Path) -> sqlite3.Connection:
    """Held until it is closed or this process ends, however it ends: SQLite knows how to lock on every system."""
    try:
        lock = sqlite3.connect(folder / LOCK_NAME, timeout=0, isolation_level=None)
        lock.execute("BEGIN EXCLUSIVE")
    except sqlite3.Error as error:
        busy = error.sqlite_errorcode == sqlite3.SQLITE_BUSY
        reason = "another batch is at work in this folder" if busy else f"cannot be written ({one_line(error)})"
        raise ImageWriteError(f"{reason}: {folder}") from error
    return lock


def _file_system(path: Path) -> str:
    """Its name, in lower case; empty if it cannot be found out."""
    resolved = path.resolve()
    mounts = [mount for mount in psutil.disk_partitions(all=True) if resolved.is_relative_to(mount.mountpoint)]
    # The longest is the innermost; of two at one place, the later one hides the other.
    innermost = max(enumerate(mounts), key=lambda place: (len(place[1].mountpoint), place[0]), default=None)
    return "" if innermost is None else innermost[1].fstype.lower()


def _numbered(entries: Iterable[Entry], first: int) -> Iterator[tuple[Any, ...]]:
    """The values for `PLAN`."""
    names: set[str] = set()
    for place, entry in enumerate(entries, first):
        if entry.name in names:
            raise ValueError(f"two jobs of the batch have the name {entry.name}")
        names.add(entry.name)
        yield bound(entry.name), entry.key, bound(entry.fixed), bound(entry.moving), place
