"""The jobs of a manifest: a CSV with a pair in every row, and options of its own where it wants them."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields, is_dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any, Literal, get_args, get_origin, get_type_hints

from autoalign.batch.jobs import Job, JobOptions
from autoalign.errors import ImageReadError
from autoalign.files.formats import of_name
from autoalign.files.remote import check_url, is_local, is_url, path_of

NEEDED = ("fixed", "moving")
PICTURES = (*NEEDED, "fixed_mask", "moving_mask")
OWN = (*PICTURES, "name")


def manifest_jobs(text: str, source: str, base: Path, out_dir: Path, options: JobOptions) -> list[Job]:
    """The rows of a CSV with the columns fixed, moving and, if wanted, name, fixed_mask, moving_mask and options.

    Paths are relative to `base`, and may be URLs. An option's column has the option's name, with - or _, and an empty
    cell leaves that option as `options` have it. A picture without a name is called by its path below the folder that
    the moving pictures share. Raises ImageReadError with the line, `source` last, for what cannot be understood; or
    with a URL last, where the package for it is missing.
    """
    try:
        rows = [(line, _located(line, row, base)) for line, row in _rows(text)]
        if not rows:
            raise ValueError("has no rows")
        names = _names([_path(row["moving"]) for _, row in rows])
        return [_job(line, row, name, out_dir, options) for (line, row), name in zip(rows, names, strict=True)]
    except (ValueError, csv.Error) as error:
        raise ImageReadError(f"is no manifest ({error}): {source}") from None


def _rows(text: str) -> Iterator[tuple[int, dict[str, str]]]:
    """(line, cells that are not empty by column) of the rows that say something."""
    reader = csv.reader(io.StringIO(text, newline=""), strict=True, skipinitialspace=True)
    columns: list[str] | None = None
    for cells in reader:
        cells = [cell.strip() for cell in cells]
        if not any(cells) or cells[0].startswith("#"):
            continue
        if columns is None:
            columns = _columns(cells)
        elif len(cells) != len(columns):
            raise ValueError(f"line {reader.line_num} has {len(cells)} cells, the first line {len(columns)}")
        else:
            yield reader.line_num, {column: cell for column, cell in zip(columns, cells, strict=True) if cell}


def _columns(names: Sequence[str]) -> list[str]:
    columns = [name.lower().replace("-", "_") for name in names]
    known = {*OWN, *_option_types(JobOptions)}
    for column in columns:
        if columns.count(column) > 1:
            raise ValueError(f"names the column {column} twice")
        if column not in known:
            raise ValueError(f"has the column {column}, which is no option")
    missing = [column for column in NEEDED if column not in columns]
    if missing:
        raise ValueError(f"lacks the column {missing[0]}")
    return columns


def _located(line: int, row: Mapping[str, str], base: Path) -> dict[str, str]:
    """The row with absolute paths, or URLs."""
    with _in_line(line):
        missing = [column for column in NEEDED if column not in row]
        if missing:
            raise ValueError(f"{missing[0]} is empty")
        return {column: _absolute(base, cell) if column in PICTURES else cell for column, cell in row.items()}


def _job(line: int, row: Mapping[str, str], name: str, out_dir: Path, options: JobOptions) -> Job:
    with _in_line(line):
        return Job(
            name=_inside(_with_extension(row.get("name", name), _path(row["moving"]))),
            fixed=row["fixed"],
            moving=row["moving"],
            out_dir=str(out_dir),
            options=with_cells(options, {key: cell for key, cell in row.items() if key not in OWN}),
            fixed_mask=row.get("fixed_mask"),
            moving_mask=row.get("moving_mask"),
        )


@contextmanager
def _in_line(line: int) -> Iterator[None]:
    """What is wrong there, with the number of the line."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"line {line}: {error}") from None


def _names(paths: Sequence[Path]) -> list[str]:
    """What pictures are called if the manifest does not say: their paths below the folder that they share."""
    shared = os.path.commonpath([path.parent for path in paths])
    return [path.relative_to(shared).as_posix() for path in paths]


def _absolute(base: Path, address: str) -> str:
    """Where a picture is. Raises ValueError for a URL that nothing can be fetched from."""
    if not is_url(address):
        return os.path.normpath(base / address)
    check_url(address)
    return str(path_of(address)) if is_local(address) else address


def _path(address: str) -> Path:
    """What names a picture from the root on, wherever it is."""
    return path_of(address) if is_url(address) else Path(address)


def _with_extension(name: str, moving: Path) -> str:
    """A result has the moving picture's format, unless its name says another."""
    return name if of_name(Path(name)) else name + moving.suffix


def _inside(name: str) -> str:
    """A name that stays in the batch's folder."""
    path = PurePosixPath(name.replace("\\", "/"))
    if path.is_absolute() or ".." in path.parts or not path.name or "\0" in name:
        raise ValueError(f"{name!r} is no name inside the folder of the results")
    return path.as_posix()


def with_cells(options: Any, cells: Mapping[str, str]) -> Any:
    """A dataclass, and those inside it, with the fields of these names read from text.

    Raises ValueError for a text that a field does not take.
    """
    types, changes = get_type_hints(type(options)), {}
    for field in fields(options):
        value = getattr(options, field.name)
        if is_dataclass(value):
            changes[field.name] = with_cells(value, cells)
        elif field.name in cells:
            changes[field.name] = _value(field.name, cells[field.name], types[field.name])
    return replace(options, **changes)


def _option_types(kind: Any) -> dict[str, Any]:
    """Name to type of all fields of a dataclass and of those inside it."""
    found: dict[str, Any] = {}
    for name, hint in get_type_hints(kind).items():
        found |= _option_types(hint) if is_dataclass(hint) else {name: hint}
    return found


def _value(name: str, text: str, hint: Any) -> Any:
    """A cell as the type that a field has."""
    if get_origin(hint) is Literal:
        if text not in get_args(hint):
            raise ValueError(f"{name} is one of {', '.join(get_args(hint))}, not {text}")
        return text
    kinds = [kind for kind in (get_args(hint) or (hint,)) if kind is not type(None)]
    if kinds[0] is bool:
        if text.lower() not in ("true", "false", "yes", "no", "1", "0"):
            raise ValueError(f"{name} is true or false, not {text}")
        return text.lower() in ("true", "yes", "1")
    try:
        return kinds[0](text)
    except ValueError:
        raise ValueError(f"{name} is a number, not {text}") from None
