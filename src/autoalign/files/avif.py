"""AVIF: Pillow reads what stands around the pixels and writes, imagecodecs decodes, both by libavif.

Pillow alone would make 8 bits of 10 and 12, and RGB of grey.
"""

from __future__ import annotations

import imagecodecs

from autoalign.files.boxes import bodies
from autoalign.files.codec import Decoder, Encoder, Header, Refused, full_range
from autoalign.files.exif import with_resolution
from autoalign.files.metadata import Metadata
from autoalign.files.pillow import avif_header, saved
from autoalign.picture.pixels import Picture

MAX_PIXELS = 2**27  # four times the largest frame of AV1; libavif enlarges a small picture to a size that was a lie
QUALITY, SPEED = 100, 8  # of 100, within 3 levels of 255; of 10, where less is ten times slower and no smaller


def decoder() -> Decoder:
    """Grey or RGB, with or without alpha: uint8, or uint16 for 10 and 12 bits; the first of a sequence."""
    return Decoder(read_header=_read_header, decode=_decode)


def encoder() -> Encoder:
    """At the best quality, colours at full resolution: RGB (grey becomes RGB), with or without alpha, uint8."""

    def encode(pixels: Picture, metadata: Metadata) -> bytes:
        blocks = {
            "icc_profile": metadata.icc,
            "xmp": metadata.xmp,
            "exif": with_resolution(metadata.exif, metadata.dpi),
        }
        present = {name: block for name, block in blocks.items() if block}
        return saved(pixels, "AVIF", quality=QUALITY, subsampling="4:4:4", speed=SPEED, **present)

    return encode


def _read_header(data: bytes) -> Header:
    header = avif_header(data)
    w, h = header.size
    if w * h > MAX_PIXELS:
        raise Refused(f"is larger than the {MAX_PIXELS / 1e6:.0f} megapixels that are read of this format")
    return header


def _decode(data: bytes) -> Picture:
    return full_range(imagecodecs.avif_decode(data, index=0), _bits(data))


def _bits(data: bytes) -> int:
    """Bits of a sample, from the configurations of the codec; 8, 10 or 12."""
    inside = data
    for letters, skipped in ((b"meta", 4), (b"iprp", 0), (b"ipco", 0)):
        inside = next(bodies(inside, letters), b"")[skipped:]
    flags = [body[2] for body in bodies(inside, b"av1C") if len(body) > 2]
    return max(((12 if flag & 0x20 else 10) if flag & 0x40 else 8 for flag in flags), default=8)
