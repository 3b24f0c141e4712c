"""JPEG: strict decoding and encoding by simplejpeg, metadata in the segments before the scan."""

from __future__ import annotations

import struct
from collections.abc import Iterator

import numpy as np
import simplejpeg

from autoalign.files.codec import Decoder, Encoder, Header, Refused
from autoalign.files.metadata import CM_PER_INCH, EXIF_PREFIX, Metadata, exif_orientation, resolution, without_prefix
from autoalign.picture.pixels import Picture

APP0, APP1, APP2, END, SCAN = 0xE0, 0xE1, 0xE2, 0xD9, 0xDA
JFIF, XMP, ICC = b"JFIF\0", b"http://ns.adobe.com/xap/1.0/\0", b"ICC_PROFILE\0"
MAX_BODY = 0xFFFF - 2  # a segment's length field counts itself
INCHES_PER_UNIT = {1: 1.0, 2: 1 / CM_PER_INCH}  # JFIF's density units; 0 is an aspect ratio


def decoder() -> Decoder:
    """RGB or grey, uint8. CMYK is refused."""
    return Decoder(read_header=_read_header, decode=_decode)


def encoder(quality: int) -> Encoder:
    """Grey or RGB uint8, colours at full resolution (4:4:4), `quality` 1 to 100."""

    def encode(pixels: Picture, metadata: Metadata) -> bytes:
        grey = pixels.ndim == 2
        data: bytes = simplejpeg.encode_jpeg(
            np.ascontiguousarray(pixels[..., None] if grey else pixels),
            quality=quality,
            colorspace="GRAY" if grey else "RGB",
            colorsubsampling="Gray" if grey else "444",
        )
        (length,) = struct.unpack_from(">H", data, 4)  # the encoder opens with SOI and APP0, which ours replaces
        return data[:2] + _metadata_segments(metadata) + data[4 + length :]

    return encode


def _read_header(data: bytes) -> Header:
    h, w, colours, _ = simplejpeg.decode_jpeg_header(data)
    if colours in ("CMYK", "YCCK"):
        raise Refused("is a CMYK picture; convert it to RGB first")
    metadata = _read_metadata(data)
    return Header(size=(w, h), orientation=exif_orientation(metadata.exif), metadata=metadata)


def _decode(data: bytes) -> Picture:
    grey = simplejpeg.decode_jpeg_header(data)[2] == "Gray"
    pixels: Picture = simplejpeg.decode_jpeg(data, colorspace="GRAY" if grey else "RGB", strict=True)
    return pixels[..., 0] if grey else pixels


def _segments(data: bytes) -> Iterator[tuple[int, bytes]]:
    """(marker, body) of the segments before the scan; stops where the file stops making sense."""
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF and data[at + 1] not in (SCAN, END):
        if data[at + 1] == 0xFF:  # fill bytes may stand before a marker
            at += 1
            continue
        (length,) = struct.unpack_from(">H", data, at + 2)
        yield data[at + 1], data[at + 4 : at + 2 + length]
        at += 2 + max(length, 2)


def _read_metadata(data: bytes) -> Metadata:
    exif = xmp = dpi = None
    profile: dict[int, bytes] = {}
    profile_parts = 0
    for marker, body in _segments(data):
        if marker == APP0 and body.startswith(JFIF) and len(body) >= 12:
            unit, x, y = struct.unpack_from(">BHH", body, 7)
            dpi = resolution(x, y, INCHES_PER_UNIT[unit]) if unit in INCHES_PER_UNIT else None
        elif marker == APP1 and body.startswith(EXIF_PREFIX):
            exif = exif or without_prefix(body)
        elif marker == APP1 and body.startswith(XMP):
            xmp = xmp or body.removeprefix(XMP) or None
        elif marker == APP2 and body.startswith(ICC) and len(body) > len(ICC) + 2:
            number, profile_parts = body[len(ICC)], body[len(ICC) + 1]
            profile[number] = body[len(ICC) + 2 :]
    whole = sorted(profile) == list(range(1, profile_parts + 1))
    icc = b"".join(profile[number] for number in sorted(profile)) if whole else b""
    return Metadata(icc=icc or None, exif=exif, xmp=xmp, dpi=dpi)


def _metadata_segments(metadata: Metadata) -> bytes:
    """APP0 with the resolution, then what there is of EXIF, XMP and ICC; what is too long for a segment is left out."""
    unit, x, y = (1, *(min(max(round(dots), 1), 0xFFFF) for dots in metadata.dpi)) if metadata.dpi else (0, 1, 1)
    segments = [_segment(APP0, JFIF + struct.pack(">BBBHHBB", 1, 1, unit, x, y, 0, 0))]
    for mark, block in ((EXIF_PREFIX, metadata.exif), (XMP, metadata.xmp)):
        if block and len(mark + block) <= MAX_BODY:
            segments.append(_segment(APP1, mark + block))
    step = MAX_BODY - len(ICC) - 2
    parts = [metadata.icc[at : at + step] for at in range(0, len(metadata.icc), step)] if metadata.icc else []
    if len(parts) <= 255:
        segments += [_segment(APP2, ICC + bytes((i, len(parts))) + part) for i, part in enumerate(parts, 1)]
    return b"".join(segments)


def _segment(marker: int, body: bytes) -> bytes:
    return struct.pack(">BBH", 0xFF, marker, len(body) + 2) + body
