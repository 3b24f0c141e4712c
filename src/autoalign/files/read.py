"""A file to a picture: bytes read here, size checked before anything is decoded, then one strict decoder.

The extension is not believed, the first bytes are.
"""

from __future__ import annotations

import hashlib
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from autoalign.errors import ImageReadError
from autoalign.files.codec import Decoder, Header, Refused, one_line
from autoalign.files.formats import HEAD_BYTES, Format, decoder_for, of_bytes
from autoalign.files.metadata import MAX_METADATA, Metadata, describing, turned
from autoalign.picture.pixels import Picture, size_of


@dataclass(frozen=True, kw_only=True)
class LoadedPicture:
    """A picture as it is to be seen, and what came with it."""

    pixels: Picture  # (h, w) or (h, w, c): grey or RGB, with or without alpha; upright
    metadata: Metadata  # true for these pixels: orientation 1
    sha256: str  # of the file's bytes, 64 hexadecimal digits
    format: str  # "JPEG", "PNG", ...: what the bytes are, whatever the extension says
    path: Path
    remark: str | None = None  # what of the file was overlooked, a sentence


@dataclass(frozen=True, kw_only=True)
class ReadOptions:
    """What is taken of a file."""

    max_pixels: float | None = None
    """pixels that a picture may have; by default 300 million, or 2^30 where a TIFF can be read by its tiles"""
    lenient: bool = False
    """take what can be had of a damaged JPEG, PNG, TIFF or BMP, and say so; by default it is refused"""


MAX_PIXELS = 300e6
MAX_BYTES_PER_PIXEL = 16  # four channels of float32, not compressed


def read_picture(path: str | Path, options: ReadOptions = ReadOptions(), *, page: int = 0) -> LoadedPicture:
    """Read a picture in any of the `FORMATS`; uint8, uint16 or float32 as the file has it.

    The EXIF orientation is applied to the pixels. `page`, from 0, selects one of a TIFF. Raises ImageReadError, one
    line with the path last, if there is no such file, it is no picture, has more pixels than are allowed (found from
    the header, before anything is decoded), is damaged, or of a kind that autoalign does not take.
    """
    path = Path(path)
    with opened(path) as file:
        _format(file.read(HEAD_BYTES), path, str(path))  # before all of it is read
        check_length(file.seek(0, os.SEEK_END), options, str(path))
        file.seek(0)
        data = file.read()
    return decode_picture(data, path, str(path), options, page=page)


def decode_picture(
    data: bytes, path: Path, address: str, options: ReadOptions = ReadOptions(), *, page: int = 0
) -> LoadedPicture:
    """As `read_picture`, of bytes from a file that `path` names; errors end with `address`, which says where it is."""
    format = _format(data[:HEAD_BYTES], path, address)
    header, pixels, remark = _decoded(data, format, page, options, address)
    return LoadedPicture(
        pixels=pixels,
        metadata=describing(turned(header.metadata, header.orientation), pixels),
        sha256=hashlib.sha256(data).hexdigest(),
        format=format.name,
        path=path,
        remark=remark,
    )


def check_length(length: int, options: ReadOptions, address: str) -> None:
    """Raise ImageReadError, `address` last, for more bytes than a picture as large as allowed can have."""
    most = int(MAX_BYTES_PER_PIXEL * (options.max_pixels or MAX_PIXELS)) + MAX_METADATA
    if length > most:
        size = f"{most / 1e9:,.1f} GB"
        raise ImageReadError(f"is larger than the {size} that a picture as large as allowed takes: {address}")


def read_text(path: Path, *, max_bytes: int) -> str:
    """A small UTF-8 file as text, with or without a byte order mark; line ends become newlines.

    Raises ImageReadError if it cannot be read, is larger than `max_bytes` or no UTF-8.
    """
    with opened(path) as file:
        data = file.read(max_bytes + 1)
    if len(data) > max_bytes:
        raise ImageReadError(f"is larger than the {max_bytes:,} bytes allowed: {path}")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise ImageReadError(f"is not UTF-8 text: {path}") from None
    return text.replace("\r\n", "\n").replace("\r", "\n")


def upright(pixels: Picture, orientation: int) -> Picture:
    """Pixels (h, w) or (h, w, c) turned as the EXIF orientation, 1 to 8, asks; 5 to 8 swap height and width."""
    if orientation >= 5:
        pixels = pixels.swapaxes(0, 1)
    # What is left is to turn rows and columns round; after the swap, 6 is a quarter turn clockwise, 8 the other way.
    rows_reversed = orientation in (3, 4, 7, 8)
    columns_reversed = orientation in (2, 3, 6, 7)
    return np.ascontiguousarray(pixels[:: -1 if rows_reversed else 1, :: -1 if columns_reversed else 1])


def state_of(path: str | Path) -> tuple[int, int, int]:
    """Size, time of the last change in ns, and inode: what would be another if the content were. Raises OSError."""
    found = os.stat(path)
    return found.st_size, found.st_mtime_ns, found.st_ino


@contextmanager
def opened(path: Path) -> Iterator[BinaryIO]:
    """The file open for reading; every reason why it cannot be as an ImageReadError."""
    try:
        mode = path.stat().st_mode
        if stat.S_ISDIR(mode):
            raise ImageReadError(f"is a folder, not a file: {path}")
        if not stat.S_ISREG(mode):  # a pipe or a device may never end
            raise ImageReadError(f"is not a regular file: {path}")
        with path.open("rb") as file:
            yield file
    except FileNotFoundError:
        raise ImageReadError(f"does not exist: {path}") from None
    except PermissionError:
        raise ImageReadError(f"may not be read (permission denied): {path}") from None
    except (OSError, ValueError) as error:  # ValueError: a NUL in the path
        raise ImageReadError(f"cannot be read ({one_line(error)}): {path}") from error


def _format(head: bytes, path: Path, address: str) -> Format:
    if not head:
        raise ImageReadError(f"is empty: {address}")
    try:
        return of_bytes(head, path)
    except Refused as refusal:
        raise ImageReadError(f"{refusal}: {address}") from None


def _decoded(
    data: bytes, format: Format, page: int, options: ReadOptions, address: str
) -> tuple[Header, Picture, str | None]:
    """The header, the upright pixels and a remark; whatever a decoder raises as an ImageReadError."""
    max_pixels = options.max_pixels or MAX_PIXELS
    try:
        try:
            header, pixels = _decoded_by(decoder_for(format, page), data, max_pixels)
            return header, pixels, header.remark
        except Refused:
            raise
        except Exception as error:  # decoders raise what they like on damaged bytes: struct, zlib, memory, their own
            if not options.lenient or "lenient" not in format.told:
                raise
            remark = f"is damaged ({one_line(error)}), and what could be read of it was taken"
            return *_decoded_by(decoder_for(format, page, lenient=True), data, max_pixels), remark
    except Refused as refusal:
        raise ImageReadError(f"{refusal}: {address}") from refusal
    except Exception as error:
        reason = f"is damaged, or no {format.name} that can be read ({one_line(error)})"
        raise ImageReadError(f"{reason}: {address}") from error


def _decoded_by(decoder: Decoder, data: bytes, max_pixels: float) -> tuple[Header, Picture]:
    header = decoder.read_header(data)
    check_size(header.size, max_pixels)
    pixels = decoder.decode(data)
    if size_of(pixels) != header.size:
        raise ValueError(f"the header says {header.size}, the pixels are {size_of(pixels)}")
    return header, upright(pixels, header.orientation)


def check_size(size: tuple[int, int], max_pixels: float) -> None:
    """Raise Refused if a picture of `size` (w, h) has no pixels, or more than allowed."""
    w, h = size
    if w < 1 or h < 1:
        raise Refused(f"has no pixels ({w} x {h})")
    if w * h > max_pixels:
        raise Refused(f"has {w * h / 1e6:,.1f} megapixels ({w} x {h}), more than the {max_pixels / 1e6:,.1f} allowed")
