"""The tables of the ledger, and how a Row lies in them: numbers and texts as they are, tuples as JSON."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import fields
from typing import Any, get_args, get_origin, get_type_hints

from autoalign.files.row import Row

APPLICATION_ID = int.from_bytes(b"aalg", "big")  # in the header of the file, where SQLite and `file` look for it
SCHEMA_VERSION = 1  # to be raised with every change of a table, and so of Row
TEXT = "CAST(? AS TEXT)"  # in place of a ?, for what `bound` made bytes of


def _holds(hint: Any, kind: type) -> bool:
    """Whether a value with this hint may be of the kind."""
    return any(kind in (part, get_origin(part)) for part in (hint, *get_args(hint)))


def _affinity(hint: Any) -> str:
    if _holds(hint, tuple):
        return "TEXT"
    return "INTEGER" if _holds(hint, int) else "REAL" if _holds(hint, float) else "TEXT"


HINTS = get_type_hints(Row)
NAMES = tuple(field.name for field in fields(Row))
TUPLES = tuple(name for name in NAMES if _holds(HINTS[name], tuple))
RESULT = tuple(name for name in NAMES if name not in ("name", "fixed", "moving"))  # these the plan knows already
AFFINITIES = {name: _affinity(HINTS[name]) for name in RESULT}

SCHEMA = (
    f"PRAGMA application_id = {APPLICATION_ID}",
    f"PRAGMA user_version = {SCHEMA_VERSION}",
    """CREATE TABLE job (
        name TEXT PRIMARY KEY, key TEXT NOT NULL UNIQUE, fixed TEXT NOT NULL, moving TEXT NOT NULL,
        place INTEGER, attempts INTEGER NOT NULL DEFAULT 0
    )""",
    "CREATE INDEX job_place ON job (place, name)",  # a ledger without it is read and kept as well, but slower
    f"""CREATE TABLE result (
        key TEXT PRIMARY KEY, finished REAL NOT NULL, seconds REAL NOT NULL,
        {", ".join(f"{name} {affinity}" for name, affinity in AFFINITIES.items())}
    )""",
    """CREATE TABLE thumbnails (
        key TEXT PRIMARY KEY REFERENCES result ON DELETE CASCADE,
        fixed_jpeg BLOB NOT NULL, before_jpeg BLOB NOT NULL, after_jpeg BLOB
    )""",
    """CREATE TABLE file (
        path TEXT PRIMARY KEY, size INTEGER NOT NULL, mtime_ns INTEGER NOT NULL, inode INTEGER NOT NULL,
        sha256 TEXT NOT NULL
    )""",
    "CREATE TABLE link (key TEXT PRIMARY KEY, data TEXT NOT NULL)",
    "CREATE TABLE run (started REAL NOT NULL, ended REAL, version TEXT NOT NULL, options TEXT NOT NULL)",
)
PLAN = f"""
    INSERT INTO job (name, key, fixed, moving, place) VALUES ({TEXT}, ?, {TEXT}, {TEXT}, ?)
    ON CONFLICT (name) DO UPDATE SET
        attempts = CASE key WHEN excluded.key THEN attempts ELSE 0 END,
        key = excluded.key, fixed = excluded.fixed, moving = excluded.moving, place = excluded.place
"""
# What became of the job of this name, if that had another key.
FORGET = f"DELETE FROM result WHERE key = (SELECT key FROM job WHERE name = {TEXT} AND key != ?)"
KEEP = f"""
    INSERT OR REPLACE INTO result (key, finished, seconds, {", ".join(RESULT)})
    VALUES (?, ?, ?, {", ".join(TEXT if affinity == "TEXT" else "?" for affinity in AFFINITIES.values())})
"""
SELECT_ROWS = f"SELECT {', '.join(NAMES)} FROM job JOIN result USING (key)"


def bound(value: Any) -> Any:
    """A value as SQLite takes it: text as bytes, because the names of files may hold what is no UTF-8."""
    return value.encode("utf-8", "surrogateescape") if isinstance(value, str) else value


def columns_of(row: Row) -> list[Any]:
    """The values for `KEEP`, after the key and the times."""
    values = (getattr(row, name) for name in RESULT)
    return [json.dumps(value) if isinstance(value, tuple) else bound(value) for value in values]


def row_of(values: Iterable[Any]) -> Row:
    """What `SELECT_ROWS` found."""
    named = dict(zip(NAMES, values, strict=True))
    for name in TUPLES:
        if named[name] is not None:
            named[name] = _tuples(json.loads(named[name]))
    return Row(**named)


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list) else value
