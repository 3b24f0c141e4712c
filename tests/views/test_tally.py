"""Counts and errors are held to those of the rows."""

from __future__ import annotations

import statistics

import pytest

from autoalign.files.row import Row, RowStatus
from autoalign.views.tally import Extreme, Tally


def row(name: str, status: RowStatus, error_px: float | None = None) -> Row:
    return Row(name=name, fixed="f", moving="m", status=status, reason="r", expected_error_px=error_px)


def test_rows_are_counted_and_the_worst_is_known() -> None:
    tally = Tally()
    for each in (
        row("a", "aligned", 0.2),
        row("b", "failed"),
        row("c", "doubtful", 9.0),  # the largest, but not of one that is aligned
        row("d", "aligned", 0.7),
        row("e", "aligned", float("inf")),
        row("f", "rejected", 50.0),
        row("g", "aligned", 0.7),
    ):
        tally.add(each)
    assert tally.counts == {"aligned": 4, "failed": 1, "doubtful": 1, "rejected": 1}
    assert tally.total == 7
    assert tally.errors_px == {"aligned": [0.2, 0.7, 0.7], "doubtful": [9.0]}
    assert tally.worst == Extreme(number=4, name="d", error_px=0.7)  # the first of equals
    assert tally.median_px == 0.7


def test_nothing_is_worst_where_nothing_is_aligned() -> None:
    tally = Tally()
    tally.add(row("a", "doubtful", 1.0))
    assert tally.worst is None
    with pytest.raises(statistics.StatisticsError):
        _ = tally.median_px
