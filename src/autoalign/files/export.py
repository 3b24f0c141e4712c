"""The rows of a batch for those who analyse: CSV, JSON and Parquet, with the fields of Row as columns."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable
from dataclasses import asdict, fields
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from autoalign.files.row import Row

NAMES = tuple(field.name for field in fields(Row))

# Spelled out, because a column that happens to be empty has no kind to be guessed from.
SCHEMA = pa.schema(
    [
        pa.field(name, kind, nullable=nullable)
        for name, kind, nullable in (
            ("name", pa.string(), False),
            ("fixed", pa.string(), False),
            ("moving", pa.string(), False),
            ("status", pa.string(), False),
            ("reason", pa.string(), False),
            ("expected_error_px", pa.float64(), True),
            ("model", pa.string(), True),
            ("fixed_from_moving", pa.list_(pa.list_(pa.float64())), True),
            ("fixed_size", pa.list_(pa.int64()), True),
            ("moving_size", pa.list_(pa.int64()), True),
            ("matches", pa.int64(), False),
            ("inliers", pa.int64(), False),
            ("overlap", pa.float64(), False),
            ("rung", pa.string(), True),
            ("advice", pa.string(), False),
            ("output", pa.string(), True),
            ("sidecar", pa.string(), True),
            ("recording", pa.string(), True),
        )
    ]
)


def as_csv(rows: Iterable[Row]) -> bytes:
    """A header and a line a row; tuples as JSON, None as nothing. Names that are no UTF-8 keep their bytes."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(NAMES)
    writer.writerows([_cell(getattr(row, name)) for name in NAMES] for row in rows)
    return text.getvalue().encode("utf-8", "surrogateescape")


def as_json(rows: Iterable[Row]) -> bytes:
    """A list of objects, one a line, in ASCII; names that are no UTF-8 survive as escapes."""
    lines = ",\n".join(json.dumps(asdict(row), allow_nan=False) for row in rows)
    return f"[\n{lines}\n]\n".encode("ascii")


def as_parquet(rows: Iterable[Row]) -> bytes:
    """A table with typed columns; what is no UTF-8 in a name is written \\udcXX, for Parquet knows no other text."""
    columns: dict[str, list[Any]] = {name: [] for name in NAMES}
    for row in rows:
        for name, column in columns.items():
            column.append(_sound(getattr(row, name)))
    sink = io.BytesIO()
    pq.write_table(pa.table(columns, SCHEMA), sink)
    return sink.getvalue()


def _cell(value: Any) -> Any:
    return json.dumps(value) if isinstance(value, tuple) else value


def _sound(value: Any) -> Any:
    return value.encode("utf-8", "backslashreplace").decode() if isinstance(value, str) else value
