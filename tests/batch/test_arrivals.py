"""Pictures that arrive: taken when they are whole, once, and again when they have changed."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from autoalign.batch.arrivals import SETTLED_S, Arrivals, hints
from autoalign.batch.sources import Selection


class Clock:
    """Time that goes on when it is told to."""

    def __init__(self) -> None:
        self.now = 1e9

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def arrivals(tmp_path: Path, clock: Clock) -> Arrivals:
    return Arrivals(tmp_path, Selection(recursive=True), without=tmp_path / "out", clock=clock)


def write(path: Path, data: bytes, clock: Clock) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    os.utime(path, (clock.now, clock.now))


def test_a_file_is_taken_when_it_has_not_changed_for_a_while(tmp_path, arrivals, clock):
    write(tmp_path / "a.png", b"1", clock)
    assert arrivals.take() == []
    assert arrivals.waiting()
    clock.now += SETTLED_S / 2
    write(tmp_path / "a.png", b"12", clock)  # still being written
    clock.now += SETTLED_S * 0.75
    assert arrivals.take() == []
    clock.now += SETTLED_S * 0.5
    assert arrivals.take() == ["a.png"]
    assert not arrivals.waiting()
    clock.now += 100
    assert arrivals.take() == []


def test_what_was_there_long_before_is_taken_at_once(tmp_path, arrivals, clock):
    write(tmp_path / "b10.png", b"1", clock)
    write(tmp_path / "sub" / "b2.png", b"1", clock)
    write(tmp_path / "b9.png", b"1", clock)
    write(tmp_path / "out" / "b1.png", b"1", clock)
    write(tmp_path / "b3.png.part", b"1", clock)
    clock.now += 3600
    assert arrivals.take() == ["b9.png", "b10.png", "sub/b2.png"]


def test_a_file_that_was_closed_need_not_settle_and_one_that_changes_comes_again(tmp_path, arrivals, clock):
    write(tmp_path / "a.png", b"1", clock)
    arrivals.closed(str(tmp_path / "a.png"))
    assert arrivals.take() == ["a.png"]
    write(tmp_path / "a.png", b"another", clock)
    assert arrivals.take() == []
    clock.now += SETTLED_S
    assert arrivals.take() == ["a.png"]
    (tmp_path / "a.png").unlink()
    assert arrivals.take() == []
    write(tmp_path / "a.png", b"another", clock)
    clock.now += SETTLED_S
    assert arrivals.take() == ["a.png"]


def test_the_system_tells_of_files_that_are_closed_and_moved(tmp_path):
    arrivals = Arrivals(tmp_path, Selection())
    with hints(tmp_path, arrivals, recursive=False) as hint:
        (tmp_path / "a.png").write_bytes(b"1")
        assert hint.wait(10)
        assert arrivals.take() == ["a.png"]  # younger than SETTLED_S, but closed
        hint.clear()
        (tmp_path / "b.part").write_bytes(b"1")
        (tmp_path / "b.part").rename(tmp_path / "b.png")
        assert hint.wait(10)
        found = arrivals.take()
        while not found:  # the first hint was of b.part
            hint.clear()
            assert hint.wait(10)
            found = arrivals.take()
        assert found == ["b.png"]
