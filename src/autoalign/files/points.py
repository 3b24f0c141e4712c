"""Points typed or measured by people, as CSV: one row a point, named columns, comments and blank lines allowed."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from autoalign.errors import ImageReadError
from autoalign.files.read import read_text
from autoalign.files.write import write_bytes_atomically

CORRESPONDENCES = ("fixed_x", "fixed_y", "moving_x", "moving_y")
PLANE_POINTS = ("world_x", "world_y", "image_x", "image_y")
POSITIONS = ("x", "y")

MAX_BYTES = 1 << 28
MAX_COORDINATE = 1e12  # no picture and no map has more; beyond it, squares and products lose their meaning


def read_points(path: str | Path, columns: Sequence[str]) -> NDArray[np.float64]:
    """(n, k) numbers of the k named columns, in the order of `columns`; n may be 0.

    The first line that is neither blank nor a comment (#) names the columns, in any order, upper or lower case; columns
    not asked for are not looked at. Raises ImageReadError, with the line's number and the path last, if the file cannot
    be read, a column is missing or named twice, or a row has too few or too many fields or no plain finite number.
    """
    path = Path(path)
    rows = _rows(path)
    line, names = next(rows, (1, []))
    names = [name.lower() for name in names]
    wrong = [column for column in columns if names.count(column) != 1]
    if wrong:
        problem = "names twice" if wrong[0] in names else "lacks"
        raise ImageReadError(f"line {line} {problem} the column {wrong[0]} (needed: {','.join(columns)}): {path}")
    wanted = [names.index(column) for column in columns]
    points = [_numbers(fields, wanted, len(names), line, path) for line, fields in rows]
    return np.array(points, dtype=np.float64).reshape(-1, len(columns))


def write_points(path: str | Path, points: ArrayLike, columns: Sequence[str], overwrite: bool = False) -> None:
    """Write (n, k) points as CSV with a header; reading gives the same numbers back to the last bit.

    Raises ValueError if the shape is another or a number is not finite, ImageWriteError if the file cannot be written.
    """
    values = np.asarray(points, dtype=np.float64)
    if values.ndim != 2 or values.shape[1] != len(columns):
        raise ValueError(f"points must have shape (n, {len(columns)}), not {values.shape}")
    if not np.isfinite(values).all():
        raise ValueError("points must be finite numbers")
    lines = [",".join(columns), *(",".join(map(repr, row)) for row in values.tolist())]
    write_bytes_atomically(path, ("\n".join(lines) + "\n").encode(), overwrite)


def _rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    """(number, fields) of the lines that say something; lines count from 1."""
    for number, line in enumerate(read_text(path, max_bytes=MAX_BYTES).split("\n"), 1):
        if line.strip() and not line.lstrip().startswith("#"):
            try:
                yield number, [field.strip() for field in next(csv.reader([line]))]
            except csv.Error as error:
                raise ImageReadError(f"line {number} is no CSV ({error}): {path}") from None


def _numbers(fields: list[str], wanted: list[int], width: int, line: int, path: Path) -> list[float]:
    if len(fields) != width:
        raise ImageReadError(f"line {line} has {len(fields)} fields, the header has {width}: {path}")
    try:
        numbers = [float(fields[column]) for column in wanted]
    except ValueError as error:
        raise ImageReadError(f"line {line}: {error}: {path}") from None
    if not all(abs(number) <= MAX_COORDINATE for number in numbers):  # false for NaN as well
        raise ImageReadError(f"line {line} has a number that is not finite or too large: {path}")
    return numbers
