"""How a batch is followed: a live line in a terminal, plain lines from time to time elsewhere."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from autoalign.cli.terminal import STYLE_OF, tell

if TYPE_CHECKING:
    from rich.console import Console

LINE_EVERY_S = 10.0  # where there is no terminal


Follow = Callable[[str], None]
"""Takes the status of one thing after the other."""


@contextmanager
def following(what: str, total: int, quiet: bool) -> Iterator[Follow]:
    """Show how far it is, on stderr: done, of each status, rate, time left."""
    from rich.console import Console

    console = Console(stderr=True)
    if quiet or total == 0:
        yield lambda status: None
    elif console.is_terminal:
        with _live(what, total, console) as follow:
            yield follow
    else:
        yield _Lines(what, total)


def tally(counts: Mapping[Any, int]) -> str:
    """What there is of each status, in words, as "3 aligned, 1 rejected"."""
    return ", ".join(f"{counts[status]:,} {status}" for status in STYLE_OF if counts.get(status))


def clock(seconds: float) -> str:
    """Hours, minutes and seconds, as 1:02:03 or 2:03."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02}:{rest:02}" if minutes >= 60 else f"{minutes}:{rest:02}"


class _Lines:
    """A line every few seconds, and one when all is done."""

    def __init__(self, what: str, total: int) -> None:
        self._what, self._total, self._counts = what, total, Counter[str]()
        self._begun = self._told = time.monotonic()

    def __call__(self, status: str) -> None:
        self._counts[status] += 1
        now, done = time.monotonic(), self._counts.total()
        if now - self._told < LINE_EVERY_S and done < self._total:
            return
        self._told = now
        rate = done / max(now - self._begun, 1e-9)
        left = f", {clock((self._total - done) / rate)} left" if done < self._total else ""
        tell(f"{self._what} {done:,} of {self._total:,}: {tally(self._counts)}, {rate:.2g}/s{left}", to_stderr=True)


@contextmanager
def _live(what: str, total: int, console: Console) -> Iterator[Follow]:
    """A bar that fits 80 columns, with the counts in the colours of the verdicts below it."""
    from rich.console import Group
    from rich.live import Live
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
    from rich.text import Text

    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(bar_width=24),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(compact=True),
    )
    task = bar.add_task(what, total=total, rate="")
    counts, begun = Counter[str](), time.monotonic()

    def shown() -> Group:
        parts = [(f"{counts[status]:,} {status}  ", style) for status, style in STYLE_OF.items()]
        return Group(bar, Text.assemble(*parts))

    with Live(console=console, get_renderable=shown, refresh_per_second=4):

        def follow(status: str) -> None:
            counts[status] += 1
            bar.update(task, advance=1, rate=f"{counts.total() / max(time.monotonic() - begun, 1e-9):.2g}/s")

        yield follow
