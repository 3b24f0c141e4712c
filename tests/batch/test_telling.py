"""The reports of a batch that goes on: written when something is new, and never for much of the time."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from autoalign.batch.telling import SHARE, Telling

REPORTS = [Path("report.html")]


class Desk:
    """Where reports are written, and its clock: every report takes so long."""

    def __init__(self, takes_s: float) -> None:
        self.takes_s, self.now_s, self.written = takes_s, 0.0, 0

    def clock(self) -> float:
        return self.now_s

    def write(self) -> list[Path]:
        self.now_s += self.takes_s
        self.written += 1
        return REPORTS


def test_nothing_is_written_where_nothing_is_new() -> None:
    desk = Desk(1.0)
    telling = Telling(desk.write, clock=desk.clock)
    assert telling.due_s() == math.inf
    telling.keep_up()
    assert (telling.finish(), desk.written) == ([], 0)
    telling.expect()
    telling.keep_up()
    assert (telling.finish(), desk.written) == (REPORTS, 1)


@pytest.mark.parametrize("takes_s", [0.01, 3.0, 40.0])
def test_where_something_comes_all_the_time_a_share_of_it_goes_into_reports(takes_s: float) -> None:
    desk = Desk(takes_s)
    telling = Telling(desk.write, clock=desk.clock)
    while desk.now_s < 10_000:
        telling.expect()
        telling.keep_up()
        desk.now_s += 1.0
    spent = desk.written * takes_s / desk.now_s
    assert spent <= SHARE + takes_s / desk.now_s  # the last one may just have been written
    assert spent > 0.8 * min(SHARE, takes_s)  # and not much less than it may: one a second would be takes_s


def test_what_is_new_is_told_when_it_is_due_and_in_the_end_at_once() -> None:
    desk = Desk(2.0)
    telling = Telling(desk.write, clock=desk.clock)
    telling.expect()
    telling.keep_up()
    telling.expect()
    telling.keep_up()
    assert desk.written == 1
    assert telling.due_s() == pytest.approx(2.0 / SHARE - 2.0)
    desk.now_s += telling.due_s()
    telling.keep_up()
    assert desk.written == 2
    telling.expect()
    assert telling.finish() == REPORTS
    assert desk.written == 3


def test_a_report_that_broke_off_is_written_again() -> None:
    desk = Desk(2.0)

    def interrupted() -> list[Path]:
        if desk.write() and desk.written == 1:
            raise KeyboardInterrupt
        return REPORTS

    telling = Telling(interrupted, clock=desk.clock)
    telling.expect()
    with pytest.raises(KeyboardInterrupt):
        telling.keep_up()
    assert (telling.finish(), desk.written) == (REPORTS, 2)
