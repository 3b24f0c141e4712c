"""What travels with a picture beside its pixels, and how it is made to describe a picture that was turned or aligned.

Kept: the ICC profile, the EXIF block (camera, time, place, maker notes), the XMP packet, the resolution.
Changed, so that it stays true: EXIF and XMP orientation become 1 (the pixels are upright), EXIF width and height become
those of the pixels, the EXIF thumbnail is unlinked (it shows the picture as it was), an ICC profile for another number
of colours is dropped.
Dropped: EXIF and descriptive tags of TIFF files, and EXIF on its way into TIFF and BMP; everything but the resolution
in BMP; resolution in WebP; extended XMP of JPEG; comments; gamma and chromaticity chunks of PNG; blocks that do not fit
into a JPEG (EXIF over 65,527 bytes, XMP over 65,504).
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass, replace

from autoalign.picture.pixels import Picture, has_alpha, size_of

ORIENTATION, EXIF_IFD = 0x0112, 0x8769
WIDTH_TAGS, HEIGHT_TAGS = (0x0100, 0xA002), (0x0101, 0xA003)  # in the main directory and in the EXIF directory
SHORT, LONG = 3, 4  # TIFF type codes: 2 and 4 bytes, unsigned
CM_PER_INCH = 2.54
EXIF_PREFIX = b"Exif\0\0"  # JPEG puts it before the block, and some writers of other formats do so too


@dataclass(frozen=True, kw_only=True)
class Metadata:
    """What a file says about its picture; None where it says nothing."""

    icc: bytes | None = None
    exif: bytes | None = None  # the TIFF structure alone, from its "II" or "MM" on
    xmp: bytes | None = None
    dpi: tuple[float, float] | None = None  # pixels per inch along x and y


def without_prefix(exif: bytes | None) -> bytes | None:
    """The EXIF block without the "Exif" mark that some containers put before it; None if nothing is left."""
    return exif.removeprefix(EXIF_PREFIX) or None if exif else None


def resolution(x: float, y: float, inches_per_unit: float = 1.0) -> tuple[float, float] | None:
    """Pixels per inch from pixels per unit along x and y; None where these are not positive."""
    return (x / inches_per_unit, y / inches_per_unit) if x > 0 and y > 0 else None


def exif_orientation(exif: bytes | None) -> int:
    """The EXIF orientation, 1 to 8; 1 where there is none or it makes no sense."""
    try:
        order = _byte_order(exif or b"")
        entries, _ = _directory(exif or b"", order)
        (value,) = struct.unpack_from(order + "H", exif or b"", entries[ORIENTATION] + 8)
    except (KeyError, struct.error):
        return 1
    return value if 1 <= value <= 8 else 1


def turned(metadata: Metadata, orientation: int) -> Metadata:
    """The metadata of a picture turned upright: orientations 5 to 8 swap the resolutions along x and y."""
    if metadata.dpi is None or orientation < 5:
        return metadata
    return replace(metadata, dpi=metadata.dpi[::-1])


def describing(metadata: Metadata, pixels: Picture) -> Metadata:
    """The metadata made true for `pixels` (h, w) or (h, w, c), which are upright. Doing it twice changes nothing."""
    return replace(
        metadata,
        icc=_fitting_icc(metadata.icc, pixels),
        exif=_describing_exif(metadata.exif, size_of(pixels)) if metadata.exif else None,
        # One digit for another: the packet keeps its length. Readers that trust XMP would turn the picture again.
        xmp=re.sub(rb"(tiff:Orientation(?:=[\"']|>))[2-8]", rb"\g<1>1", metadata.xmp) if metadata.xmp else None,
    )


def _fitting_icc(icc: bytes | None, pixels: Picture) -> bytes | None:
    """The profile unless it says that it is for grey and the pixels are RGB, or the other way round."""
    colours = 1 if pixels.ndim == 2 else pixels.shape[2] - has_alpha(pixels)
    return icc if icc and icc[16:20] != (b"RGB " if colours == 1 else b"GRAY") else None


def _describing_exif(exif: bytes, size: tuple[int, int]) -> bytes:
    """The block with orientation 1, this size (w, h) and no thumbnail.

    Values are changed where they stand: nothing moves, so that offsets inside maker notes stay right.
    """
    block = bytearray(exif)
    try:
        order = _byte_order(exif)
        main, link = _directory(exif, order)
        detail = _directory(exif, order, at=main[EXIF_IFD] + 8)[0] if EXIF_IFD in main else {}
    except struct.error:
        return exif
    if ORIENTATION in main:
        struct.pack_into(order + "HIHH", block, main[ORIENTATION] + 2, SHORT, 1, 1, 0)
    for tags, side in zip((WIDTH_TAGS, HEIGHT_TAGS), size, strict=True):
        for tag, entries in zip(tags, (main, detail), strict=True):
            if tag in entries:
                struct.pack_into(order + "HII", block, entries[tag] + 2, LONG, 1, side)
    if link + 4 <= len(block):
        struct.pack_into(order + "I", block, link, 0)
    return bytes(block)


def _byte_order(exif: bytes) -> str:
    """The byte order as `struct` writes it; struct.error if the block is none."""
    orders = {b"II*\0": "<", b"MM\0*": ">"}
    if exif[:4] not in orders:
        raise struct.error("no EXIF block")
    return orders[exif[:4]]


def _directory(exif: bytes, order: str, at: int = 4) -> tuple[dict[int, int], int]:
    """Where the entry of each tag stands in the directory that the pointer at `at` names, and where its link stands."""
    (start,) = struct.unpack_from(order + "I", exif, at)
    (count,) = struct.unpack_from(order + "H", exif, start)
    end = start + 2 + 12 * count
    if end > len(exif):
        raise struct.error("the directory leaves the block")
    return {struct.unpack_from(order + "H", exif, entry)[0]: entry for entry in range(start + 2, end, 12)}, end
