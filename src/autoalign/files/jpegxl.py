"""JPEG XL: decoding and lossless encoding by imagecodecs (libjxl), metadata in the boxes around the codestream.

The library gives no way to a colour profile, so that one is neither read nor written (of the others with wheels, one is
under the GPL and one knows uint8 alone). Of uint16 and float32 it says in the file that they are linear light.
"""

from __future__ import annotations

from dataclasses import dataclass

import imagecodecs
import numpy as np

from autoalign.files.boxes import bodies, box
from autoalign.files.codec import Decoder, Encoder, Header, Refused
from autoalign.files.exif import with_resolution
from autoalign.files.metadata import MAX_METADATA, Metadata
from autoalign.picture.pixels import Picture

CODESTREAM = b"\xff\x0a"
SIDE_BITS = (9, 13, 18, 30)  # the lengths that a side may have, by what two bits say
RATIOS = ((1, 1), (12, 10), (4, 3), (3, 2), (16, 9), (5, 4), (2, 1))  # width to height, by what three bits say
FAST = 1  # effort; a tenth of the time of the default for a third more bytes


def decoder() -> Decoder:
    """Grey or RGB, with or without alpha, uint8, uint16 or float32; the first picture of an animation."""
    return Decoder(read_header=_read_header, decode=_decode)


def encoder() -> Encoder:
    """Lossless: grey or RGB, with or without alpha, uint8, uint16 or float32."""

    def encode(pixels: Picture, metadata: Metadata) -> bytes:
        data = bytes(
            imagecodecs.jpegxl_encode(np.ascontiguousarray(pixels), lossless=True, effort=FAST, usecontainer=True)
        )
        exif = with_resolution(metadata.exif, metadata.dpi)
        if exif:
            data += box(b"Exif", bytes(4) + exif)  # four bytes say that the block begins at once
        return data + (box(b"xml ", metadata.xmp) if metadata.xmp else b"")

    return encode


def _read_header(data: bytes) -> Header:
    bits = _Bits(_first_of_codestream(data))
    size = _size(bits)
    # What follows is all as usual, or begins with the orientation if there is anything beyond the pixels to say.
    orientation = 1 if bits.take(1) or not bits.take(1) else 1 + bits.take(3)
    exif = _metadata_box(data, b"Exif")
    return Header(
        size=size,
        orientation=orientation,
        metadata=Metadata(
            exif=exif[4 + int.from_bytes(exif[:4], "big") :] or None if exif else None,
            xmp=_metadata_box(data, b"xml "),
        ),
    )


def _decode(data: bytes) -> Picture:
    pixels: Picture = imagecodecs.jpegxl_decode(data, index=0, keeporientation=True)
    if pixels.dtype not in (np.uint8, np.uint16, np.float32):
        raise Refused(f"holds {pixels.dtype} pixels; autoalign takes uint8, uint16 and float32")
    return pixels


def _metadata_box(data: bytes, letters: bytes) -> bytes | None:
    """What the first such box holds, plain or compressed; None if there is none or it is damaged."""
    if data.startswith(CODESTREAM):
        return None
    plain = next(bodies(data, letters), None)
    packed = next((body[4:] for body in bodies(data, b"brob") if body.startswith(letters)), None)
    if plain is not None or packed is None:
        return plain or None
    try:
        return bytes(imagecodecs.brotli_decode(packed, out=MAX_METADATA)) or None
    except RuntimeError:
        return None


def _first_of_codestream(data: bytes) -> bytes:
    if not data.startswith(CODESTREAM):
        data = next(bodies(data, b"jxlc"), None) or next(bodies(data, b"jxlp"), b"")[4:]  # one piece, or several
    if not data.startswith(CODESTREAM):
        raise ValueError("there is no codestream")
    return data[2:34]


@dataclass
class _Bits:
    """Bits in the order of the codestream: the lowest of a byte comes first."""

    data: bytes
    at: int = 0

    def take(self, count: int) -> int:
        value = int.from_bytes(self.data, "little") >> self.at & ((1 << count) - 1)
        self.at += count
        return value


def _size(bits: _Bits) -> tuple[int, int]:
    """(w, h): sides by eights or by ones, the width perhaps as a ratio to the height."""
    small = bits.take(1)

    def side() -> int:
        return (1 + bits.take(5)) * 8 if small else 1 + bits.take(SIDE_BITS[bits.take(2)])

    h = side()
    ratio = bits.take(3)
    if ratio == 0:
        return side(), h
    over, under = RATIOS[ratio - 1]
    return h * over // under, h
