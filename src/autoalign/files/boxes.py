"""The boxes that JPEG 2000, JPEG XL and their relatives are made of: a length, four letters, and a body."""

from __future__ import annotations

import struct
import uuid
from collections.abc import Iterator

MAX_BOXES = 4096


def boxes(data: bytes, at: int = 0, end: int | None = None) -> Iterator[tuple[bytes, int, int]]:
    """(letters, where the body begins, where it ends) of the boxes that follow each other between `at` and `end`.

    Stops at the first one that does not fit in; ValueError if there is no end of them.
    """
    end = len(data) if end is None else end
    for _ in range(MAX_BOXES):
        if at + 8 > end:
            return
        length, letters = struct.unpack_from(">I4s", data, at)
        body = at + 8
        if length == 1 and at + 16 <= end:  # the length is a longer number, behind the letters
            (length,) = struct.unpack_from(">Q", data, body)
            body = at + 16
        elif length == 0:
            length = end - at
        if at + length > end or at + length < body:
            return
        yield letters, body, at + length
        at += length
    raise ValueError(f"more than {MAX_BOXES} boxes")


def bodies(data: bytes, letters: bytes, at: int = 0, end: int | None = None) -> Iterator[bytes]:
    """The bodies of the boxes with these letters."""
    return (data[start:stop] for found, start, stop in boxes(data, at, end) if found == letters)


def box(letters: bytes, body: bytes) -> bytes:
    """The box as bytes."""
    return struct.pack(">I4s", len(body) + 8, letters) + body


def uuid_body(data: bytes, name: uuid.UUID) -> bytes | None:
    """What the first `uuid` box of this name holds; None if there is none, or nothing in it."""
    found = (body for body in bodies(data, b"uuid") if body[:16] == name.bytes)
    return next(found, b"")[16:] or None


def uuid_box(name: uuid.UUID, body: bytes | None) -> bytes:
    """Such a box as bytes; none at all where there is nothing to put in."""
    return box(b"uuid", name.bytes + body) if body else b""
