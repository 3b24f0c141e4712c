"""The jobs of a folder: all pictures onto one reference, or those of each group onto one of them."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path

from autoalign.batch.jobs import Job, JobOptions
from autoalign.errors import ImageReadError
from autoalign.files.formats import FORMATS

EXTENSIONS = frozenset(extension for format in FORMATS for extension in format.extensions)


@dataclass(frozen=True, kw_only=True)
class Selection:
    """Which pictures of a folder take part."""

    recursive: bool = False
    """also take the pictures of all folders below"""
    include: tuple[str, ...] = ()
    """only pictures whose path below the folder matches one of these, such as '*.tif' or 'day?/*'"""
    exclude: tuple[str, ...] = ()
    """no pictures whose path below the folder matches one of these"""


def pictures(folder: Path, selection: Selection, *, without: Path | None = None) -> list[str]:
    """Paths of the pictures in a folder, relative to it, with slashes, in the order that people count in.

    A picture is what has the extension of one; hidden files, and the folder `without`, are passed over. Raises
    ValueError if there are none, ImageReadError if the folder cannot be read.
    """
    found = sorted(found_pictures(folder, selection, without=without), key=natural)
    if not found:
        raise ValueError(f"has no pictures{' that were asked for' if selection != Selection() else ''}: {folder}")
    return found


def found_pictures(folder: Path, selection: Selection, *, without: Path | None = None) -> Iterator[str]:
    """As `pictures`, but there may be none, and in no particular order."""
    without = without and without.resolve()

    def refuse(error: OSError) -> None:
        raise ImageReadError(f"cannot be read ({error.strerror or error}): {error.filename or folder}") from None

    for parent, below, files in os.walk(folder, onerror=refuse, followlinks=True):
        visible = [name for name in below if selection.recursive and not name.startswith(".")]
        below[:] = [name for name in visible if Path(parent, name).resolve() != without]
        inside = Path(parent).relative_to(folder).as_posix()
        for file in files:
            # No Path for each: a folder of a hundred thousand is looked at again and again.
            if not file.startswith(".") and os.path.splitext(file)[1].lower() in EXTENSIONS:
                name = file if inside == "." else f"{inside}/{file}"
                if _asked_for(name, selection):
                    yield name


def natural(text: str) -> list[tuple[int, int | str]]:
    """A key by which frame2 comes before frame10."""
    return [(0, int(part)) if part.isdigit() else (1, part.casefold()) for part in re.split(r"([0-9]+)", text)] + [
        (2, text)
    ]


def onto_reference(
    folder: Path, names: Sequence[str], reference: Path, out_dir: Path, options: JobOptions
) -> list[Job]:
    """Each picture of a folder onto one reference, which may be one of them."""
    same = reference.resolve()
    return [
        Job(name=name, fixed=str(reference), moving=str(folder / name), out_dir=str(out_dir), options=options)
        for name in names
        if (folder / name).resolve() != same
    ]


def in_groups(
    folder: Path, names: Sequence[str], pattern: str, reference: str, out_dir: Path, options: JobOptions
) -> list[Job]:
    """The pictures of each group onto its first or middle one.

    `pattern` is a regular expression; names in which it finds the same text for its first bracket (or, without one,
    for all of it) are a group, as brackets or bursts are. Raises ValueError for no regular expression, and for names
    that belong to no group.
    """
    try:
        rule = re.compile(pattern)
    except re.error as error:
        raise ValueError(f"--pattern is no regular expression ({error}): {pattern}") from None
    groups: dict[str, list[str]] = {}
    for name in names:
        found = rule.search(name)
        if found:
            groups.setdefault(found.group(1 if rule.groups else 0), []).append(name)
    if not groups:
        raise ValueError(f"--pattern is found in none of {len(names)} names: {pattern}")
    jobs = []
    for group in groups.values():
        fixed = folder / group[place_of_reference(reference, len(group))]
        jobs += onto_reference(folder, group, fixed, out_dir, options)
    return jobs


def place_of_reference(reference: str, count: int) -> int:
    """Index of "first" or "middle" among `count` pictures. Raises ValueError for another word."""
    if reference not in ("first", "middle"):
        raise ValueError(f"the reference of each group is its first or its middle picture, not: {reference}")
    return 0 if reference == "first" else count // 2


def _asked_for(name: str, selection: Selection) -> bool:
    included = not selection.include or any(fnmatch(name, pattern) for pattern in selection.include)
    return included and not any(fnmatch(name, pattern) for pattern in selection.exclude)
