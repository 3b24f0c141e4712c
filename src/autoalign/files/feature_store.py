"""Features of pictures on disk, so that they are found once for all processes, and once for all runs that keep them."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import cv2
import numpy as np

from autoalign import __version__
from autoalign.errors import ImageWriteError
from autoalign.files.write import write_bytes_atomically
from autoalign.registration.features import FeatureOptions, Features
from autoalign.registration.prepared import Recall


def recall_from(folder: Path, identity: str) -> Recall:
    """A memory in `folder` of one picture's features; `identity` is the hash of the picture and its mask.

    Two processes that want the same features at once find them once. What cannot be read there is found again, and what
    cannot be written is not kept: a memory that fails costs time, never a result.
    """

    def recall(options: FeatureOptions, find: Callable[[], Features]) -> Features:
        path = folder / f"{_name(identity, options)}.npz"
        known = _read(path)
        if known is not None:
            return known
        with _claimed(path.with_suffix(".lock")):
            known = _read(path)  # another process may have found them while this one waited
            return known if known is not None else _kept(path, find())

    return recall


def _name(identity: str, options: FeatureOptions) -> str:
    """Equal exactly where picture, options, and the code that finds features are."""
    words = [identity, repr(sorted(asdict(options).items())), __version__, cv2.__version__]
    return hashlib.sha256("\0".join(words).encode()).hexdigest()


def _read(path: Path) -> Features | None:
    """The features in a file; None if there are none, or the file is no good."""
    try:
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as arrays:
            values = {field.name: arrays[field.name] for field in fields(Features)}
    except (OSError, ValueError, KeyError, EOFError, BadZipFile):
        return None
    return Features(**(values | {"detector": values["detector"].item()}))


def _kept(path: Path, found: Features) -> Features:
    data = io.BytesIO()
    arrays: dict[str, Any] = {field.name: np.asarray(getattr(found, field.name)) for field in fields(found)}
    np.savez(data, **arrays)
    with suppress(ImageWriteError):
        write_bytes_atomically(path, data.getvalue(), overwrite=True)
    return found


@contextmanager
def _claimed(path: Path) -> Iterator[None]:
    """Nobody else is in here for the same path meanwhile; all are let in where there are no file locks (Windows)."""
    try:
        import fcntl

        lock = path.open("wb")
        fcntl.flock(lock, fcntl.LOCK_EX)
    except (ImportError, OSError):
        yield
        return
    with lock:
        try:
            yield
        finally:
            path.unlink(missing_ok=True)
