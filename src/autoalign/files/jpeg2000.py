"""JPEG 2000: decoding and lossless encoding by imagecodecs (OpenJPEG), metadata in the boxes around the codestream."""

from __future__ import annotations

import struct
import uuid
from dataclasses import dataclass

import imagecodecs
import numpy as np

from autoalign.files.boxes import bodies, box, boxes, uuid_body, uuid_box
from autoalign.files.codec import Decoder, Encoder, Header, Refused, full_range
from autoalign.files.exif import exif_orientation, without_prefix
from autoalign.files.metadata import Metadata, resolution
from autoalign.picture.pixels import Picture, has_alpha, size_of

CODESTREAM = b"\xff\x4f\xff\x51"  # its first two markers
TILE_PART = b"\xff\x90"
EXIF, XMP = uuid.UUID(bytes=b"JpgTiffExif->JP2"), uuid.UUID("be7acfcb-97a9-42e8-9c71-999491e3afac")
ENUMERATED, ICC = 1, 2  # ways in which a colour box names its colours
SRGB, GREY = 16, 17
RGB_OR_GREY = (SRGB, GREY)
INCHES_PER_METRE = 1 / 0.0254
OPACITY, WHOLE_PICTURE = 1, 0  # of a channel that is no colour


@dataclass(frozen=True, kw_only=True)
class Codestream:
    """What the codestream says of itself."""

    size: tuple[int, int]
    channels: int
    bits: int  # of every channel
    tiles: int


def decoder() -> Decoder:
    """Grey or RGB, with or without alpha, uint8 or uint16; depths between are stretched to the next."""
    return Decoder(read_header=_read_header, decode=_decode)


def encoder() -> Encoder:
    """Lossless: grey or RGB, with or without alpha, uint8 or uint16."""

    def encode(pixels: Picture, metadata: Metadata) -> bytes:
        data = imagecodecs.jpeg2k_encode(np.ascontiguousarray(pixels), level=0, reversible=True, codecformat="J2K")
        return (
            box(b"jP  ", b"\r\n\x87\n")
            + box(b"ftyp", b"jp2 \0\0\0\0jp2 ")
            + box(b"jp2h", _header_boxes(pixels, metadata))
            + uuid_box(EXIF, metadata.exif)
            + uuid_box(XMP, metadata.xmp)
            + box(b"jp2c", bytes(data))
        )

    return encode


def _read_header(data: bytes) -> Header:
    codestream = _codestream(data)
    if data.startswith(CODESTREAM):
        return Header(size=codestream.size, orientation=1, metadata=Metadata())
    head = next(bodies(data, b"jp2h"), b"")
    w, h = codestream.size
    if not next(bodies(head, b"ihdr"), b"").startswith(struct.pack(">II", h, w)):
        raise ValueError(f"its header does not say {w} x {h}, its codestream does")
    if any(letters == b"pclr" for letters, _, _ in boxes(head)):
        raise Refused("has a palette, which is not read of JPEG 2000; convert it to RGB first")
    icc = None
    for body in bodies(head, b"colr"):
        if body[:1] == bytes([ICC]):
            icc = icc or body[3:] or None
        elif body[:1] == bytes([ENUMERATED]) and int.from_bytes(body[3:7], "big") not in RGB_OR_GREY:
            raise Refused("holds colours that are neither RGB nor grey; convert it to RGB first")
    exif = without_prefix(uuid_body(data, EXIF))
    metadata = Metadata(icc=icc, exif=exif, xmp=uuid_body(data, XMP), dpi=_read_dpi(head))
    return Header(size=codestream.size, orientation=exif_orientation(exif), metadata=metadata)


def _decode(data: bytes) -> Picture:
    # Of the codestream alone: a profile that lies around it would be applied to the pixels, and is kept instead.
    stream, said = _stream(data), _codestream(data)
    there = len(_tiles(stream))
    if there != said.tiles:  # OpenJPEG would leave black what is missing
        raise ValueError(f"{there} tiles where there should be {said.tiles}")
    return full_range(imagecodecs.jpeg2k_decode(stream), said.bits)


def _stream(data: bytes) -> bytes:
    return data if data.startswith(CODESTREAM) else next(bodies(data, b"jp2c"), b"")


def _codestream(data: bytes) -> Codestream:
    """Raises Refused if its pixels cannot become a picture, struct.error or StopIteration if it makes no sense."""
    stream = _stream(data)
    # The picture, and the first of the tiles, on the reference grid.
    right, bottom, left, top, tile_w, tile_h, tile_left, tile_top = struct.unpack_from(">8I", stream, 8)
    (channels,) = struct.unpack_from(">H", stream, 40)
    if not 1 <= channels <= 4:
        raise Refused(f"has {channels} channels that are not grey or RGB with or without alpha")
    kinds = {stream[42 + 3 * i : 45 + 3 * i] for i in range(channels)}
    depth, dx, dy = next(iter(kinds))
    if len(kinds) > 1 or (dx, dy) != (1, 1):
        raise Refused("has channels of different size or depth; convert it to RGB first")
    if depth & 0x80 or depth + 1 > 16:
        raise Refused(f"holds {'signed' if depth & 0x80 else depth + 1} bit pixels; autoalign takes up to 16 bits")
    return Codestream(
        size=(right - left, bottom - top),
        channels=channels,
        bits=depth + 1,
        tiles=-(-(right - tile_left) // tile_w) * -(-(bottom - tile_top) // tile_h),
    )


def _tiles(stream: bytes) -> set[int]:
    """The numbers of the tiles of which there is a part, by the markers before them."""
    at = 2
    while stream[at : at + 2] != TILE_PART:
        (length,) = struct.unpack_from(">H", stream, at + 2)
        at += 2 + max(length, 2)
    found = set()
    while stream[at : at + 2] == TILE_PART:
        number, length = struct.unpack_from(">HI", stream, at + 4)
        found.add(number)
        at += length if length >= 14 else len(stream)  # 0: to the end
    return found


def _read_dpi(head: bytes) -> tuple[float, float] | None:
    """From the resolution at capture, or else for display: pixels per metre as fractions and powers of 10."""
    inner = next(bodies(head, b"res "), b"")
    for letters in (b"resc", b"resd"):
        for body in bodies(inner, letters):
            if len(body) >= 10:
                vn, vd, hn, hd, v, h = struct.unpack(">4H2b", body[:10])
                return resolution(hn / max(hd, 1) * 10.0**h, vn / max(vd, 1) * 10.0**v, INCHES_PER_METRE)
    return None


def _header_boxes(pixels: Picture, metadata: Metadata) -> bytes:
    w, h = size_of(pixels)
    channels = pixels.shape[2] if pixels.ndim == 3 else 1
    colours = channels - has_alpha(pixels)
    result = box(b"ihdr", struct.pack(">IIHBBBB", h, w, channels, pixels.dtype.itemsize * 8 - 1, 7, 0, 0))
    if metadata.icc:
        result += box(b"colr", bytes([ICC, 0, 0]) + metadata.icc)
    else:
        result += box(b"colr", struct.pack(">BBBI", ENUMERATED, 0, 0, SRGB if colours == 3 else GREY))
    if has_alpha(pixels):
        kinds = [(i, 0, i + 1) for i in range(colours)] + [(colours, OPACITY, WHOLE_PICTURE)]
        result += box(b"cdef", struct.pack(">H", channels) + b"".join(struct.pack(">3H", *kind) for kind in kinds))
    if metadata.dpi:
        x, y = (_scientific(dots * INCHES_PER_METRE) for dots in metadata.dpi)
        result += box(b"res ", box(b"resc", struct.pack(">4H2b", *y[:2], *x[:2], y[2], x[2])))
    return result


def _scientific(value: float) -> tuple[int, int, int]:
    """Numerator, denominator and power of 10 of a positive number, to four digits and more."""
    power = len(str(int(value))) - 4
    return round(value / 10.0**power), 1, power
