"""A line of a batch: what is kept of one pair for the ledger, the report, the recording and the exports."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from autoalign.files.sidecar import Matrix

RowStatus = Literal["aligned", "doubtful", "rejected", "failed"]
ROW_STATUSES: tuple[RowStatus, ...] = get_args(RowStatus)


@dataclass(frozen=True, kw_only=True)
class Row:
    """One pair of a batch, the same however often and wherever it was run; a pair that could not be tried is `failed`.

    Paths are as the plan named them; what was written is named relative to the folder of the batch.
    """

    name: str  # unique in its batch: the output's name, without which a row could not be found again
    fixed: str  # path or URL
    moving: str
    status: RowStatus
    reason: str  # one sentence with the numbers, or with the fault
    expected_error_px: float | None = None
    model: str | None = None
    fixed_from_moving: Matrix | None = None  # None if rejected or failed
    fixed_size: tuple[int, int] | None = None  # (w, h); None if failed
    moving_size: tuple[int, int] | None = None
    matches: int = 0
    inliers: int = 0
    overlap: float = 0.0  # share of the fixed picture that is covered
    rung: str | None = None  # of the ladder, that decided
    advice: str = ""  # what may help
    output: str | None = None  # None where no picture was written
    sidecar: str | None = None
    recording: str | None = None

    @property
    def is_matched(self) -> bool:
        """Whether it has matches of its own: a pair that failed has none, and a frame rests on links instead."""
        return self.rung is not None and self.status != "failed"


@dataclass(frozen=True, kw_only=True)
class Thumbnails:
    """Small JPEG files, all in the frame of the fixed picture, for the report and the recording of a batch."""

    fixed: bytes
    before: bytes  # the moving picture as it came, at the fixed picture's size
    after: bytes | None  # as the transform lays it; None where there is none
