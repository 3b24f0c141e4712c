"""JPEG: strict decoding and encoding by simplejpeg, metadata in the segments before the scan.

An XMP packet too long for a segment is cut into pieces (extended XMP), to which a short one in its place refers by the
MD5 sum of the whole.
"""

from __future__ import annotations

import hashlib
import re
import struct
from collections.abc import Iterator
from functools import partial

import numpy as np
import simplejpeg

from autoalign.files.codec import Decoder, Encoder, Header, Refused
from autoalign.files.exif import PREFIX as EXIF
from autoalign.files.exif import exif_orientation, without_prefix
from autoalign.files.metadata import Metadata, resolution
from autoalign.picture.pixels import Picture

APP0, APP1, APP2, END, SCAN = 0xE0, 0xE1, 0xE2, 0xD9, 0xDA
JFIF, XMP, ICC = b"JFIF\0", b"http://ns.adobe.com/xap/1.0/\0", b"ICC_PROFILE\0"
EXTENDED_XMP = b"http://ns.adobe.com/xmp/extension/\0"
REFERENCE = (
    b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    b'<rdf:Description rdf:about="" xmlns:xmpNote="http://ns.adobe.com/xmp/note/" xmpNote:HasExtendedXMP="%s"/>'
    b"</rdf:RDF></x:xmpmeta>"
)
"""An XMP packet that says nothing but where the whole one is."""
GUID = 32  # hexadecimal digits
MAX_BODY = 0xFFFF - 2  # a segment's length field counts itself
INCHES_PER_UNIT = {1: 1.0, 2: 1 / 2.54}  # JFIF's density units; 0 is an aspect ratio
MAX_DENSITY = 0xFFFF
MAX_PIXELS_PER_BYTE = 8 * 64  # every block of 8 x 8 costs at least a bit
MAX_SCANNED_PIXELS = 6e9  # a progressive JPEG has 10 to 20 scans


def decoder(lenient: bool = False) -> Decoder:
    """RGB or grey, uint8. CMYK is refused. `lenient`: what is missing is grey, what is damaged as it comes."""
    return Decoder(read_header=_read_header, decode=partial(_decode, strict=not lenient))


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


def _check_work(pixels: int, data: bytes) -> None:
    """Raise ValueError if the bytes cannot hold so many pixels, or would have them gone through too often."""
    if pixels > MAX_PIXELS_PER_BYTE * len(data):
        raise ValueError(f"{pixels:,} pixels cannot be in {len(data):,} bytes")
    scans = data.count(bytes((0xFF, SCAN)))  # never among the pixels: there 0 follows 0xFF
    if scans * pixels > MAX_SCANNED_PIXELS:
        raise ValueError(f"{scans:,} passes over {pixels:,} pixels")


def _decode(data: bytes, strict: bool) -> Picture:
    h, w, colours, _ = simplejpeg.decode_jpeg_header(data)
    _check_work(w * h, data)
    grey = colours == "Gray"
    pixels: Picture = simplejpeg.decode_jpeg(data, colorspace="GRAY" if grey else "RGB", strict=strict)
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
    extension: dict[int, bytes] = {}
    profile: dict[int, bytes] = {}
    profile_parts = 0
    for marker, body in _segments(data):
        if marker == APP0 and body.startswith(JFIF) and len(body) >= 12:
            unit, x, y = struct.unpack_from(">BHH", body, 7)
            dpi = resolution(x, y, INCHES_PER_UNIT[unit]) if unit in INCHES_PER_UNIT else None
        elif marker == APP1 and body.startswith(EXIF):
            exif = exif or without_prefix(body)
        elif marker == APP1 and body.startswith(XMP):
            xmp = xmp or body.removeprefix(XMP) or None
        elif marker == APP1 and body.startswith(EXTENDED_XMP) and _names(xmp, body):
            at = len(EXTENDED_XMP) + GUID
            extension[int.from_bytes(body[at + 4 : at + 8], "big")] = body[at + 8 :]
        elif marker == APP2 and body.startswith(ICC) and len(body) > len(ICC) + 2:
            number, profile_parts = body[len(ICC)], body[len(ICC) + 1]
            profile[number] = body[len(ICC) + 2 :]
    whole = sorted(profile) == list(range(1, profile_parts + 1))
    icc = b"".join(profile[number] for number in sorted(profile)) if whole else b""
    extended = _whole_extension(extension, xmp)
    if extended and xmp == REFERENCE % _guid(extended):
        xmp, extended = extended, None
    return Metadata(icc=icc or None, exif=exif, xmp=xmp, extended_xmp=extended, dpi=dpi)


def _names(xmp: bytes | None, body: bytes) -> bool:
    """True if the packet refers to the extension that this segment is a piece of."""
    named = re.search(rb"HasExtendedXMP(?:=[\"']|>)([0-9A-Fa-f]{32})", xmp or b"")
    return named is not None and body[len(EXTENDED_XMP) :].startswith(named[1])


def _whole_extension(pieces: dict[int, bytes], xmp: bytes | None) -> bytes | None:
    """The pieces, by where they begin, as one; None if some are missing or the sum is not the one that was said."""
    whole = b"".join(pieces[at] for at in sorted(pieces))
    return whole if whole and _guid(whole) in (xmp or b"").upper() else None


def _guid(packet: bytes) -> bytes:
    return hashlib.md5(packet, usedforsecurity=False).hexdigest().upper().encode()


def _metadata_segments(metadata: Metadata) -> bytes:
    """APP0 with the resolution, then what there is of EXIF, XMP and ICC; what is too long for a segment is left out."""
    segments = [_segment(APP0, JFIF + struct.pack(">BBBHHBB", 1, 1, *_density(metadata.dpi), 0, 0))]
    if metadata.exif and len(EXIF + metadata.exif) <= MAX_BODY:
        segments.append(_segment(APP1, EXIF + metadata.exif))
    segments += _xmp_segments(metadata.xmp, metadata.extended_xmp)
    step = MAX_BODY - len(ICC) - 2
    parts = [metadata.icc[at : at + step] for at in range(0, len(metadata.icc), step)] if metadata.icc else []
    if len(parts) <= 255:
        segments += [_segment(APP2, ICC + bytes((i, len(parts))) + part) for i, part in enumerate(parts, 1)]
    return b"".join(segments)


def _density(dpi: tuple[float, float] | None) -> tuple[int, int, int]:
    """JFIF's unit, and the whole number of pixels in it along x and y; those it has no number for are left out."""
    for unit, inches in INCHES_PER_UNIT.items():
        x, y = (round(dots * inches) for dots in dpi or (0.0, 0.0))
        if 1 <= x <= MAX_DENSITY and 1 <= y <= MAX_DENSITY:
            return unit, x, y
    return 0, 1, 1


def _xmp_segments(xmp: bytes | None, extended: bytes | None) -> list[bytes]:
    if xmp and len(XMP + xmp) > MAX_BODY:
        xmp, extended = REFERENCE % _guid(xmp), xmp
    segments = [_segment(APP1, XMP + xmp)] if xmp else []
    if not extended:
        return segments
    head, step = EXTENDED_XMP + _guid(extended), MAX_BODY - len(EXTENDED_XMP) - GUID - 8
    for at in range(0, len(extended), step):
        piece = struct.pack(">II", len(extended), at) + extended[at : at + step]
        segments.append(_segment(APP1, head + piece))
    return segments


def _segment(marker: int, body: bytes) -> bytes:
    return struct.pack(">BBH", 0xFF, marker, len(body) + 2) + body
