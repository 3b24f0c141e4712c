"""Rows of a batch as CSV, JSON and Parquet, read back by others."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import asdict, fields, replace

import pyarrow.parquet as pq
import pytest

from autoalign.files.export import SCHEMA, as_csv, as_json, as_parquet
from autoalign.files.row import Row
from rows import ALIGNED, FAILED

ROWS = [replace(ALIGNED, name='a, "b"\nÅ.jpg'), FAILED]
NOT_UTF8 = replace(FAILED, name="\udcff.jpg")


def lists(row: Row) -> dict[str, object]:
    """The fields as formats without tuples give them back."""
    return json.loads(json.dumps(asdict(row)))


def test_csv_gives_back_every_value() -> None:
    header, *lines = csv.reader(io.StringIO(as_csv(ROWS).decode(), newline=""))
    assert header == [field.name for field in fields(Row)]
    for row, line in zip(ROWS, lines, strict=True):
        for (name, value), cell in zip(lists(row).items(), line, strict=True):
            if value is None:
                assert cell == "", name
            else:
                assert (cell if isinstance(value, str) else json.loads(cell)) == value, name


def test_json_gives_back_every_value() -> None:
    assert json.loads(as_json(ROWS)) == [lists(row) for row in ROWS]


def test_parquet_gives_back_every_value() -> None:
    assert pq.read_table(io.BytesIO(as_parquet(ROWS))).to_pylist() == [lists(row) for row in ROWS]


def test_parquet_columns_have_their_kinds_even_if_they_are_empty() -> None:
    for rows in ([], [FAILED], ROWS):
        assert pq.read_table(io.BytesIO(as_parquet(rows))).schema.equals(SCHEMA)
    assert SCHEMA.names == [field.name for field in fields(Row)]


@pytest.mark.parametrize("rows", [[], ROWS])
def test_the_same_rows_give_the_same_bytes(rows: list[Row]) -> None:
    for written in (as_csv, as_json, as_parquet):
        assert written(rows) == written(iter(rows))


def test_names_that_are_no_utf8_come_through() -> None:
    assert as_csv([NOT_UTF8]).split(b"\n")[1].startswith(b"\xff.jpg,")
    assert json.loads(as_json([NOT_UTF8]))[0]["name"] == NOT_UTF8.name
    assert pq.read_table(io.BytesIO(as_parquet([NOT_UTF8]))).column("name").to_pylist() == ["\\udcff.jpg"]
