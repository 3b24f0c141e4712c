"""What every command shares with the person before it: exit codes, the words on stdout and stderr, common flags."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import IntEnum
from typing import Annotated, TypeVar

from cyclopts import Group, Parameter

FILES, ALIGNMENT, GENERAL = Group("Files", sort_key=1), Group("Alignment", sort_key=2), Group("General", sort_key=4)


STYLE_OF = {"aligned": "bold green", "doubtful": "bold yellow", "rejected": "bold red", "failed": "bold magenta"}
"""Verdicts as the terminal shows them."""


T = TypeVar("T")


class Exit(IntEnum):
    """What the exit code of every command means."""

    DONE = 0  # all aligned, everything asked for was written
    NOT_ALIGNED = 1  # a pair was rejected or is doubtful, or no canvas can hold the result
    USAGE = 2  # a wrong option, or points that fix no transform
    FILE = 3  # a file could not be read or written
    BUG = 70  # a fault of autoalign's own; 70 is EX_SOFTWARE of sysexits.h
    INTERRUPTED = 130


@dataclass(frozen=True, kw_only=True)
class Common:
    """The flags that every command has."""

    overwrite: bool = False
    """replace files that exist; without it they are never touched"""
    verbose: Annotated[bool, Parameter(alias="-v")] = False
    """say on stderr what every stage found"""
    quiet: Annotated[bool, Parameter(alias="-q")] = False
    """say nothing but errors"""


def tell(text: str, *, style: str = "", to_stderr: bool = False) -> None:
    """One line for people, its first word in `style` where the terminal has colours."""
    from rich.console import Console
    from rich.text import Text

    first, blank, rest = text.partition(" ")
    console = Console(stderr=to_stderr, soft_wrap=True, highlight=False)
    console.print(Text.assemble((first, style), blank, rest))


def note(text: str, common: Common) -> None:
    """A line on stderr about what was done, unless -q."""
    if not common.quiet:
        tell(text, to_stderr=True)


def progress(what: str, common: Common) -> Callable[[Iterator[T], int], Iterator[T]]:
    """What passes on things one by one, of which there will be so many, and shows on a terminal how far it has come.

    Nothing is shown with -q, or where stderr is no terminal.
    """

    def watched(things: Iterator[T], total: int) -> Iterator[T]:
        from rich.console import Console
        from rich.progress import Progress

        console = Console(stderr=True)
        with Progress(console=console, transient=True, disable=common.quiet or not console.is_terminal) as bar:
            yield from bar.track(things, total=total, description=what)

    return watched


def complain(text: str) -> None:
    """An error: one line on stderr, whatever the text holds."""
    print("autoalign:", " ".join(text.split()), file=sys.stderr)
