"""What a summary of a batch says of all its rows, counted as they come."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field
from statistics import median

from autoalign.files.row import Row, RowStatus


@dataclass(frozen=True, kw_only=True)
class Extreme:
    """The row that has the largest expected error."""

    number: int  # of the row, from 1 on
    name: str
    error_px: float


@dataclass(kw_only=True)
class Tally:
    """Grows by a number per row. Errors are those expected of the pairs that have a transform."""

    counts: Counter[RowStatus] = field(default_factory=Counter)
    errors_px: dict[RowStatus, list[float]] = field(default_factory=lambda: {"aligned": [], "doubtful": []})
    worst: Extreme | None = None  # of the aligned

    def add(self, row: Row) -> None:
        self.counts[row.status] += 1
        error = row.expected_error_px
        if error is None or not math.isfinite(error) or row.status not in self.errors_px:
            return
        self.errors_px[row.status].append(error)
        if row.status == "aligned" and (self.worst is None or error > self.worst.error_px):
            self.worst = Extreme(number=self.total, name=row.name, error_px=error)

    @property
    def total(self) -> int:
        return self.counts.total()

    @property
    def median_px(self) -> float:
        """Of the aligned. Raises statistics.StatisticsError if there are none, and so no worst."""
        return median(self.errors_px["aligned"])
