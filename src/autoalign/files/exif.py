"""Directories of tags, as EXIF blocks and TIFF files hold them: taken apart, put together, changed where they stand.

An EXIF block is a small TIFF file: a byte order, and a directory whose tags describe camera, time and author, with
directories of its own for the exposure (0x8769) and the place (0x8825).
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import Literal, Union

import numpy as np

Order = Literal["<", ">"]
"""Little and big endian, as `struct` writes them."""

ORIENTATION, EXIF_IFD, GPS_IFD, INTEROPERABILITY_IFD, MAKER_NOTE = 0x0112, 0x8769, 0x8825, 0xA005, 0x927C
POINTERS = (EXIF_IFD, GPS_IFD, INTEROPERABILITY_IFD)
"""Tags whose value is where another directory stands."""
WIDTH_TAGS, HEIGHT_TAGS = (0x0100, 0xA002), (0x0101, 0xA003)  # in the main directory and in the EXIF directory
X_RESOLUTION, Y_RESOLUTION, RESOLUTION_UNIT = 0x011A, 0x011B, 0x0128
INCH, INCHES_PER_UNIT = 2, {2: 1.0, 3: 1 / 2.54}  # RESOLUTION_UNIT; 1 is an aspect ratio
DESCRIPTION = 0x010E
DESCRIPTIVE = (
    *(0x010D, DESCRIPTION, 0x010F, 0x0110, ORIENTATION),  # document, description, make, model
    *(0x011D, 0x0131, 0x0132, 0x013B, 0x013C),  # page, software, date, artist, computer
    *(0x4746, 0x4749, 0x8298, 0x83BB),  # rating, rating in per cent, copyright, IPTC
    *range(0x9C9B, 0x9CA0),  # title, comment, author, keywords, subject, as Windows writes them
    *POINTERS,
)
"""Tags of a main directory that speak of the picture, and not of how its pixels are stored."""

BYTE, ASCII, SHORT, LONG, RATIONAL, DOUBLE, LONG8 = 1, 2, 3, 4, 5, 12, 16
# Type code to the NumPy type of what a value is made of; a rational is two whole numbers.
WORDS = {BYTE: "u1", ASCII: "u1", SHORT: "u2", LONG: "u4", RATIONAL: "u4", 6: "u1", 7: "u1", 8: "u2", 9: "u4"}
WORDS |= {10: "u4", 11: "u4", DOUBLE: "u8", 13: "u4", LONG8: "u8", 17: "u8", 18: "u8"}
WORDS_PER_VALUE = {RATIONAL: 2, 10: 2}
PREFIX = b"Exif\0\0"  # JPEG puts it before the block, and some writers of other formats do so too
MAX_TAGS = 4096  # in one directory
MAX_DEPTH = 3  # main, EXIF, interoperability
MAX_DENOMINATOR = 1_000_000


@dataclass(frozen=True, kw_only=True)
class Tag:
    """One value of a directory."""

    type: int  # as TIFF counts its types
    data: bytes  # little-endian, whatever the file has

    @property
    def count(self) -> int:
        """How many numbers or letters it holds."""
        return len(self.data) // _size(self.type)

    @property
    def text(self) -> str:
        """The letters of a text, without the zeros that end it."""
        return self.data.decode("utf-8", "replace").rstrip("\0") if self.type in (BYTE, ASCII) else ""

    def in_order(self, order: str) -> bytes:
        """The value as a file of this byte order holds it."""
        return _ordered(self.type, self.data, order)


Directory = Mapping[int, Union[Tag, "Directory"]]
"""Tag code to its value; the codes of `POINTERS` to directories."""


@dataclass(frozen=True, kw_only=True)
class Layout:
    """How numbers stand in a file: byte order as `struct` writes it, and offsets of 8 bytes (BigTIFF) or 4."""

    order: Order
    big: bool = False

    @property
    def offset(self) -> str:
        return self.order + ("Q" if self.big else "I")

    @property
    def count(self) -> str:
        return self.order + ("Q" if self.big else "H")

    @property
    def entry_size(self) -> int:
        """Bytes of a code, a type, a count, and a value or where it stands."""
        return 20 if self.big else 12


def read_directory(data: bytes, at: int, layout: Layout, depth: int = 1) -> Directory:
    """The directory that stands at `at`, with those it points to; what does not lie in `data` is passed over."""
    found: dict[int, Tag | Directory] = {}
    try:
        (count,) = struct.unpack_from(layout.count, data, at)
        start = at + struct.calcsize(layout.count)
        for entry in range(start, start + layout.entry_size * min(count, MAX_TAGS), layout.entry_size):
            code, type, values = struct.unpack_from(layout.order + "HH" + layout.offset[1], data, entry)
            value_at = entry + 4 + struct.calcsize(layout.offset)
            if code in POINTERS:
                (there,) = struct.unpack_from(layout.offset, data, value_at)
                if depth < MAX_DEPTH and (inner := read_directory(data, there, layout, depth + 1)):
                    found[code] = inner
            elif (tag := _read_tag(data, type, values, value_at, layout)) is not None:
                found[code] = tag
    except struct.error:  # the file ends before the directory does
        pass
    return found


def pack_directory(directory: Directory, layout: Layout, at: int) -> bytes:
    """The directory and those in it, as bytes that are to stand at `at`; a link to no further one is part of it."""
    offset_size = struct.calcsize(layout.offset)
    entries = struct.pack(layout.count, len(directory))
    values_at = at + len(entries) + len(directory) * layout.entry_size + offset_size
    values = b""
    for code, item in sorted(directory.items(), key=lambda pair: pair[0]):
        here = struct.pack(layout.offset, values_at + len(values))
        if isinstance(item, Tag):
            type, count, body = item.type, item.count, item.in_order(layout.order)
            if len(body) <= offset_size:
                here = body.ljust(offset_size, b"\0")
            else:
                values += body + bytes(len(body) % 2)
        else:
            type, count = (LONG8 if layout.big else LONG), 1
            values += pack_directory(item, layout, values_at + len(values))
        entries += struct.pack(layout.order + "HH" + layout.offset[1], code, type, count) + here
    return entries + bytes(offset_size) + values


def block_of(directory: Directory, order: Order = "<") -> bytes | None:
    """The directory as an EXIF block; None if it is empty."""
    if not directory:
        return None
    mark = (b"II" if order == "<" else b"MM") + struct.pack(order + "HI", 42, 8)
    return mark + pack_directory(directory, Layout(order=order), len(mark))


def directory_of(block: bytes | None) -> Directory:
    """The main directory of an EXIF block; empty if there is none or it makes no sense."""
    try:
        order = byte_order(block or b"")
        start = _pointer(block or b"", 4, order)
    except struct.error:
        return {}
    return read_directory(block or b"", start, Layout(order=order))


def described(directory: Directory) -> Directory:
    """The part of a main directory that describes the picture, not how it is stored."""
    return {code: item for code, item in directory.items() if code in DESCRIPTIVE}


def byte_order(block: bytes) -> Order:
    """The byte order as `struct` writes it; struct.error if the block is none."""
    orders: dict[bytes, Order] = {b"II*\0": "<", b"MM\0*": ">"}
    if block[:4] not in orders:
        raise struct.error("no EXIF block")
    return orders[block[:4]]


def without_prefix(exif: bytes | None) -> bytes | None:
    """The EXIF block without the "Exif" mark that some containers put before it; None if nothing is left."""
    return exif.removeprefix(PREFIX) or None if exif else None


def exif_orientation(exif: bytes | None) -> int:
    """The EXIF orientation, 1 to 8; 1 where there is none or it makes no sense."""
    tag = directory_of(exif).get(ORIENTATION)
    value = int.from_bytes(tag.data[:2], "little") if isinstance(tag, Tag) else 1
    return value if 1 <= value <= 8 else 1


def exif_dpi(directory: Directory) -> tuple[float, float] | None:
    """Pixels per inch along x and y as the tags of a main directory say; None where they do not."""
    x, y = (_rational(directory.get(code)) for code in (X_RESOLUTION, Y_RESOLUTION))
    unit = directory.get(RESOLUTION_UNIT)
    inches = INCHES_PER_UNIT.get(int.from_bytes(unit.data[:2], "little") if isinstance(unit, Tag) else INCH)
    return (x / inches, y / inches) if inches and x > 0 and y > 0 else None


def with_resolution(exif: bytes | None, dpi: tuple[float, float] | None) -> bytes | None:
    """The block with a resolution in pixels per inch along x and y, if it is known; made where there is no block.

    One with maker notes stays as it is: they may count from the start of the block, and must not be moved.
    """
    directory = directory_of(exif)
    detail = directory.get(EXIF_IFD, {})
    if dpi is None or X_RESOLUTION in directory or (not isinstance(detail, Tag) and MAKER_NOTE in detail):
        return exif
    x, y = (Tag(type=RATIONAL, data=_ratio(dots, "<")) for dots in dpi)
    unit = Tag(type=SHORT, data=struct.pack("<H", INCH))
    tags: Directory = {**directory, X_RESOLUTION: x, Y_RESOLUTION: y, RESOLUTION_UNIT: unit}
    return block_of(tags, ">" if exif and exif.startswith(b"MM") else "<")


def entry_places(data: bytes, start: int, layout: Layout) -> tuple[dict[int, int], int]:
    """Where the entry of each tag stands in the directory that stands at `start`, and where its link stands.

    Raises struct.error if the directory does not lie in `data`.
    """
    (count,) = struct.unpack_from(layout.count, data, start)
    start += struct.calcsize(layout.count)
    end = start + layout.entry_size * count
    if end > len(data):
        raise struct.error("the directory leaves the file")
    places = range(start, end, layout.entry_size)
    return {struct.unpack_from(layout.order + "H", data, place)[0]: place for place in places}, end


def describing_exif(exif: bytes, size: tuple[int, int], dpi: tuple[float, float] | None) -> bytes:
    """The block with orientation 1, this size (w, h), this resolution where it has one, and no thumbnail.

    Values are changed where they stand: nothing moves, so that offsets inside maker notes stay right.
    """
    block = bytearray(exif)
    try:
        order = byte_order(exif)
        layout = Layout(order=order)
        main, link = entry_places(exif, _pointer(exif, 4, order), layout)
        inner = EXIF_IFD in main
        detail = entry_places(exif, _pointer(exif, main[EXIF_IFD] + 8, order), layout)[0] if inner else {}
    except struct.error:
        return exif
    if ORIENTATION in main:
        struct.pack_into(order + "HIHH", block, main[ORIENTATION] + 2, SHORT, 1, 1, 0)
    for tags, side in zip((WIDTH_TAGS, HEIGHT_TAGS), size, strict=True):
        for tag, entries in zip(tags, (main, detail), strict=True):
            if tag in entries:
                struct.pack_into(order + "HII", block, entries[tag] + 2, LONG, 1, side)
    if dpi:
        _put_resolution(block, order, main, dpi)
    if link + 4 <= len(block):
        struct.pack_into(order + "I", block, link, 0)
    return bytes(block)


def _pointer(block: bytes, at: int, order: Order) -> int:
    (start,) = struct.unpack_from(order + "I", block, at)
    return int(start)


def _put_resolution(block: bytearray, order: str, main: dict[int, int], dpi: tuple[float, float]) -> None:
    if RESOLUTION_UNIT in main:
        struct.pack_into(order + "HIHH", block, main[RESOLUTION_UNIT] + 2, SHORT, 1, INCH, 0)
    for code, dots in zip((X_RESOLUTION, Y_RESOLUTION), dpi, strict=True):
        type, count, at = struct.unpack_from(order + "HII", block, main[code] + 2) if code in main else (0, 0, 0)
        if (type, count) == (RATIONAL, 1) and at + 8 <= len(block):
            block[at : at + 8] = _ratio(dots, order)


def _read_tag(data: bytes, type: int, count: int, value_at: int, layout: Layout) -> Tag | None:
    """The value whose bytes, or where they stand, stand at `value_at`; None if they do not lie in `data`."""
    if type not in WORDS:
        return None
    length = count * _size(type)
    if length > struct.calcsize(layout.offset):
        (value_at,) = struct.unpack_from(layout.offset, data, value_at)
    if value_at + length > len(data):
        return None
    return Tag(type=type, data=_ordered(type, data[value_at : value_at + length], layout.order))


def _ordered(type: int, data: bytes, order: str) -> bytes:
    """Bytes of this type from this order to little-endian, or, which is the same, back."""
    return data if order == "<" else np.frombuffer(data, ">" + WORDS[type]).astype("<" + WORDS[type]).tobytes()


def _size(type: int) -> int:
    """Bytes of one value."""
    return int(WORDS[type][1]) * WORDS_PER_VALUE.get(type, 1)


def _rational(item: Tag | Directory | None) -> float:
    if not isinstance(item, Tag) or item.type != RATIONAL or item.count != 1:
        return 0.0
    top, bottom = struct.unpack("<II", item.data)
    return top / bottom if bottom else 0.0


def _ratio(value: float, order: str) -> bytes:
    """A positive number as the two whole numbers of a rational; one that is too large becomes the largest."""
    ratio = Fraction(min(value, 0xFFFFFFFF)).limit_denominator(min(MAX_DENOMINATOR, max(1, int(0xFFFFFFFF / value))))
    return struct.pack(order + "II", ratio.numerator, ratio.denominator)
