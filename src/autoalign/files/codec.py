"""What a codec is to the rest of the program: two functions to read, one to write, and what they raise as one line."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from autoalign.files.metadata import Metadata
from autoalign.picture.pixels import Picture

MAX_REASON = 200  # characters of what a library says that still make one clear line


class Refused(Exception):  # noqa: N818 - no fault of the file, so not an error of its own
    """The file or the picture is sound, but this codec does not take it; the message is the whole reason."""


@dataclass(frozen=True, kw_only=True)
class Header:
    """What a file says before a pixel is decoded."""

    size: tuple[int, int]  # (w, h) as stored, before the orientation is applied
    orientation: int  # 1 to 8, as EXIF counts them
    metadata: Metadata
    remark: str | None = None  # what of the file is not taken, a sentence


@dataclass(frozen=True, kw_only=True)
class Decoder:
    """Both take the bytes of a file, and raise `Refused` with a reason, or on damaged bytes whatever they like."""

    read_header: Callable[[bytes], Header]  # allocates nothing that a lying header could make large
    decode: Callable[[bytes], Picture]  # as stored, not turned; called after the size was found bearable


Encoder = Callable[[Picture, Metadata], bytes]
"""Pixels that the format holds, and what is to travel with them, to the bytes of a file: the same bytes every time."""


def full_range(pixels: Picture, bits: int) -> Picture:
    """Whole numbers of this many bits stretched to all that their dtype has; what fills it comes back as it is."""
    top, stored_top = int(np.iinfo(pixels.dtype).max), 2**bits - 1
    if stored_top >= top:
        return pixels
    return np.asarray((pixels.astype(np.uint32) * top + stored_top // 2) // stored_top, dtype=pixels.dtype)


def one_line(error: BaseException) -> str:
    """What an error says, or else its kind, as one line of bearable length."""
    reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return " ".join(str(reason).split())[:MAX_REASON]
