"""The transform of a pair as a file beside the output: JSON that people can read and `apply` can trust.

`fixed_from_moving` acts on columns (x, y, 1) of the moving picture, whose pixel centres are integers, and is scaled to
[2][2] == 1. The pictures are meant upright: EXIF orientations were applied before anything was measured.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from autoalign.errors import AlignmentError, ImageReadError
from autoalign.files.read import read_text
from autoalign.files.write import write_bytes_atomically

FORMAT = "autoalign sidecar 1"
MAX_BYTES = 1 << 24
MAX_NUMBER = 1e12  # in a matrix: far more than any picture or map has pixels
MAX_SIDE = 2**31 - 1
MAX_DEPTH = 20  # levels of nesting

Status = Literal["aligned", "doubtful", "rejected"]
Matrix = tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]


@dataclass(frozen=True, kw_only=True)
class PictureRecord:
    """Which picture it was."""

    name: str  # of the file, without its folder
    size: tuple[int, int]  # (w, h), upright
    sha256: str  # of the file's bytes


@dataclass(frozen=True, kw_only=True)
class Sidecar:
    """All that is kept of one alignment; in the file these fields follow `format` in this order, each dict sorted."""

    status: Status
    reason: str  # one sentence with the numbers
    fixed_from_moving: Matrix | None  # None if, and only if, the pair was rejected
    expected_error_px: float | None
    model: str | None  # the kind of transform, None where none was found
    fixed: PictureRecord
    moving: PictureRecord
    options: Mapping[str, Any]
    versions: Mapping[str, str]
    stages: Mapping[str, Any]  # counts of every stage
    evidence: Mapping[str, Any]  # the numbers behind the status
    timings_s: Mapping[str, float] | None = None  # only on request: they differ from run to run; absent where None


def default_sidecar(output_path: str | Path) -> Path:
    """`<output stem>.autoalign.json` beside the output."""
    path = Path(output_path)
    return path.with_name(f"{path.stem}.autoalign.json")


def as_shown(transform: ArrayLike) -> Matrix:
    """A (3, 3) transform of any scale as the rows that a sidecar shows, [2][2] == 1.

    Raises ValueError if it is not finite, or sends the origin to infinity and so has no such scale.
    """
    matrix = np.asarray(transform, dtype=np.float64)
    if matrix.shape != (3, 3):
        raise ValueError(f"the transform must have shape (3, 3), not {matrix.shape}")
    with np.errstate(all="ignore"):
        shown = matrix / matrix[2, 2]
    if not np.isfinite(shown).all():
        raise ValueError(f"the transform cannot be scaled to [2][2] == 1: {matrix.tolist()}")
    (a, b, c), (d, e, f), (g, h, _) = shown.tolist()
    return (a, b, c), (d, e, f), (g, h, 1.0)


def transform_of(sidecar: Sidecar) -> NDArray[np.float64]:
    """The (3, 3) `fixed_from_moving`, [2, 2] == 1; AlignmentError with the reason if the pair was rejected."""
    if sidecar.fixed_from_moving is None:
        raise AlignmentError(f"the pair was rejected: {sidecar.reason}")
    return np.array(sidecar.fixed_from_moving)


def write_sidecar(path: str | Path, sidecar: Sidecar, overwrite: bool = False) -> None:
    """Write the record as `sidecar_text` gives it, in ASCII.

    Raises ValueError as `sidecar_text` does, ImageWriteError if the file cannot be written.
    """
    write_bytes_atomically(path, sidecar_text(sidecar).encode("ascii"), overwrite)


def sidecar_text(sidecar: Sidecar) -> str:
    """The record as JSON. Equal records give equal texts, and what is read back is equal but for tuples turned lists.

    Raises ValueError if the record is not one that could be read again (a number that is not finite, a singular
    transform, a value that JSON has no word for).
    """
    record = {"format": FORMAT} | {field.name: _plain(getattr(sidecar, field.name)) for field in fields(sidecar)}
    if record["timings_s"] is None:
        del record["timings_s"]
    _sidecar(record)
    # ASCII, because a file's name may hold bytes that are no UTF-8, and these survive only as escapes.
    return json.dumps(record, indent=2, ensure_ascii=True, allow_nan=False) + "\n"


def read_sidecar(path: str | Path) -> Sidecar:
    """Read a record. Fields that this version does not know are passed over.

    Raises ImageReadError, one line with the path last, if there is no such file or anything in it is not as
    `write_sidecar` would have written it.
    """
    path = Path(path)
    text = read_text(path, max_bytes=MAX_BYTES)
    try:
        return _sidecar(json.loads(text))
    except RecursionError:
        raise ImageReadError(f"is no sidecar (nested too deeply): {path}") from None
    except json.JSONDecodeError as error:
        raise ImageReadError(f"is no JSON ({error}): {path}") from None
    except ValueError as error:
        raise ImageReadError(f"is no sidecar ({error}): {path}") from None


def _plain(value: Any) -> Any:
    """The value in the words of JSON, dicts sorted by key; ValueError where there are none.

    Dataclasses become dicts, tuples and arrays lists, NumPy numbers plain ones.
    """
    if hasattr(value, "__dataclass_fields__"):
        return {field.name: _plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, Mapping):
        if not all(isinstance(key, str) for key in value):
            raise ValueError(f"keys must be text: {list(value)}")
        return {key: _plain(value[key]) for key in sorted(value)}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return _plain(value.tolist())
    if value is None or isinstance(value, (str, bool, int, float)):
        return value
    raise ValueError(f"JSON has no word for {type(value).__name__}")


# What follows checks what came out of a JSON file, and raises ValueError with the name of what is wrong.


def _sidecar(record: Any) -> Sidecar:
    _object(record, "the file")
    if record.get("format") != FORMAT:
        raise ValueError(f'"format" is not "{FORMAT}"')
    missing = [field.name for field in fields(Sidecar) if field.name not in record and field.name != "timings_s"]
    if missing:
        raise ValueError(f'"{missing[0]}" is missing')
    _check_free(record, "the file", depth=0)
    status, matrix = record["status"], record["fixed_from_moving"]
    if status not in get_args(Status):
        raise ValueError(f'"status" is none of {", ".join(get_args(Status))}')
    if (matrix is None) != (status == "rejected"):
        raise ValueError(f'"fixed_from_moving" is {"missing" if matrix is None else "there"} but "status" is {status}')
    error_px, timings = record["expected_error_px"], record.get("timings_s")
    return Sidecar(
        status=status,
        reason=_text(record["reason"], "reason"),
        fixed_from_moving=None if matrix is None else _matrix(matrix),
        expected_error_px=None if error_px is None else _positive(error_px, "expected_error_px"),
        model=None if record["model"] is None else _text(record["model"], "model"),
        fixed=_picture(record["fixed"], "fixed"),
        moving=_picture(record["moving"], "moving"),
        options=_object(record["options"], "options"),
        versions={key: _text(v, "versions") for key, v in _object(record["versions"], "versions").items()},
        stages=_object(record["stages"], "stages"),
        evidence=_object(record["evidence"], "evidence"),
        timings_s=None if timings is None else _seconds(timings),
    )


def _matrix(rows: Any) -> Matrix:
    if not (isinstance(rows, list) and len(rows) == 3 and all(isinstance(row, list) and len(row) == 3 for row in rows)):
        raise ValueError('"fixed_from_moving" is not 3 rows of 3 numbers')
    matrix = np.array([[_number(value, "fixed_from_moving") for value in row] for row in rows])
    if np.abs(matrix).max() > MAX_NUMBER:
        raise ValueError(f'"fixed_from_moving" has a number over {MAX_NUMBER:g}')
    if matrix[2, 2] != 1:
        raise ValueError('"fixed_from_moving" does not have a 1 in its last place')
    if np.linalg.matrix_rank(matrix) < 3:
        raise ValueError('"fixed_from_moving" cannot be inverted')
    return as_shown(matrix)


def _picture(value: Any, name: str) -> PictureRecord:
    entries = _object(value, name)
    size, sha256 = entries.get("size"), entries.get("sha256")
    if not (isinstance(size, list) and len(size) == 2 and all(type(n) is int and 1 <= n <= MAX_SIDE for n in size)):
        raise ValueError(f'"size" of "{name}" is not [width, height]')
    if not (isinstance(sha256, str) and re.fullmatch("[0-9a-f]{64}", sha256)):
        raise ValueError(f'"sha256" of "{name}" is not 64 hexadecimal digits')
    return PictureRecord(name=_text(entries.get("name"), f"name of {name}"), size=(size[0], size[1]), sha256=sha256)


def _seconds(value: Any) -> dict[str, float]:
    return {key: _positive(seconds, f"timings_s.{key}") for key, seconds in _object(value, "timings_s").items()}


def _check_free(value: Any, name: str, depth: int) -> None:
    """Every number finite, and the nesting bearable."""
    if depth > MAX_DEPTH:
        raise ValueError(f"{name} is nested too deeply")
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"{name} has a number that is not finite")
    for key, item in value.items() if isinstance(value, dict) else ():
        _check_free(item, f'"{key}"', depth + 1)
    for item in value if isinstance(value, list) else ():
        _check_free(item, name, depth + 1)


def _object(value: Any, name: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ValueError(f'"{name}" is not an object')
    return value


def _text(value: Any, name: str) -> str:
    if not isinstance(value, str):
        raise ValueError(f'"{name}" is not text')
    return value


def _number(value: Any, name: str) -> float:
    # True is an int to Python, but no number to a reader; an int may be too long for a float.
    if type(value) not in (int, float) or abs(value) > 1e300:
        raise ValueError(f'"{name}" is not a number of bearable size')
    return float(value)


def _positive(value: Any, name: str) -> float:
    if _number(value, name) < 0:
        raise ValueError(f'"{name}" is below zero')
    return float(value)
