"""The file formats: how each is told by its first bytes and its name, what it can hold, and where its codec lives.

Codecs are imported when their format is met: a pair of JPEGs does not wait for the third of a second that TIFF takes.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from autoalign.files.codec import Decoder, Encoder, Refused
from autoalign.picture.pixels import Picture, has_alpha

HEAD_BYTES = 64  # enough for every mark below


@dataclass(frozen=True, kw_only=True)
class Format:
    """One file format. `depths` are the dtypes that autoalign can write in it; empty where it can only read it."""

    name: str
    mark: bytes  # regular expression for the first bytes
    extensions: tuple[str, ...]
    depths: tuple[type, ...]
    alpha: bool
    max_side: int  # pixels

    def holds(self, pixels: Picture) -> bool:
        """True if the pixels can be written in this format with nothing lost but, for JPEG, what compression costs."""
        return (
            pixels.dtype in self.depths
            and (self.alpha or not has_alpha(pixels))
            and max(pixels.shape[:2]) <= self.max_side
        )


ENDLESS = 2**31 - 1
JPEG = Format(
    name="JPEG",
    mark=rb"\xff\xd8\xff",
    extensions=(".jpg", ".jpeg"),
    depths=(np.uint8,),
    alpha=False,
    max_side=65_500,
)
PNG = Format(
    name="PNG",
    mark=rb"\x89PNG\r\n\x1a\n",
    extensions=(".png",),
    depths=(np.uint8, np.uint16),
    alpha=True,
    max_side=1_000_000,
)
TIFF = Format(
    name="TIFF",
    mark=rb"II[*+]\0|MM\0[*+]",
    extensions=(".tif", ".tiff"),
    depths=(np.uint8, np.uint16, np.float32),
    alpha=True,
    max_side=ENDLESS,
)
WEBP = Format(
    name="WebP",
    mark=rb"RIFF.{4}WEBP",
    extensions=(".webp",),
    depths=(np.uint8,),
    alpha=True,
    max_side=16_383,
)
BMP = Format(
    name="BMP",
    mark=rb"BM.{12}[\x0c\x28\x34\x38\x40\x6c\x7c]\0\0\0",  # "BM" begins many a text, the lengths of headers do not
    extensions=(".bmp",),
    depths=(np.uint8,),
    alpha=False,
    max_side=ENDLESS,
)
AVIF = Format(
    name="AVIF",
    mark=rb".{4}ftyp(?:.{4})*?avi[fs]",
    extensions=(".avif",),
    depths=(),
    alpha=True,
    max_side=65_536,
)
FORMATS = (JPEG, PNG, TIFF, WEBP, BMP, AVIF)

STRANGERS = {
    "GIF": rb"GIF8",
    "HEIC": rb".{4}ftyp(?:hei|hev|mif1|msf1)",
    "JPEG 2000": rb".{4}jP  |\xff\x4f\xff\x51",
    "JPEG XL": rb".{4}JXL |\xff\x0a",
    "OpenEXR": rb"\x76\x2f\x31\x01",
    "Photoshop": rb"8BPS",
    "PDF": rb"%PDF",
}
"""Pictures that are recognised only to be refused by name."""


def of_bytes(head: bytes) -> Format:
    """The format that a file's first `HEAD_BYTES` bytes are in; `Refused` if autoalign does not read it."""
    for format in FORMATS:
        if re.match(format.mark, head, re.DOTALL):
            return format
    for name, mark in STRANGERS.items():
        if re.match(mark, head, re.DOTALL):
            raise Refused(f"is a {name} file, which autoalign does not read")
    raise Refused(f"is not a picture in a format that autoalign reads ({', '.join(f.name for f in FORMATS)})")


def of_name(path: Path) -> Format | None:
    """The format that a file's extension says, in either case; None if autoalign knows no such extension."""
    return next((format for format in FORMATS if path.suffix.lower() in format.extensions), None)


def decoder_for(format: Format, page: int) -> Decoder:
    """What reads this format; `Refused` for a page other than 0 of a format that has but one."""
    if format is TIFF:
        from autoalign.files import tiff

        return tiff.decoder(page)
    if page != 0:
        raise Refused(f"is a {format.name} file, which has no page {page} (pages count from 0)")
    if format is JPEG:
        from autoalign.files import jpeg

        return jpeg.decoder()
    if format is PNG:
        from autoalign.files import png

        return png.decoder()
    from autoalign.files import pillow

    return {WEBP: pillow.webp_decoder, BMP: pillow.bmp_decoder, AVIF: pillow.avif_decoder}[format]()


def encoder_for(format: Format, jpeg_quality: int) -> Encoder:
    """What writes this format, which must be one that has `depths`."""
    if format is TIFF:
        from autoalign.files import tiff

        return tiff.encoder()
    if format is JPEG:
        from autoalign.files import jpeg

        return jpeg.encoder(jpeg_quality)
    if format is PNG:
        from autoalign.files import png

        return png.encoder()
    from autoalign.files import pillow

    return {WEBP: pillow.webp_encoder, BMP: pillow.bmp_encoder}[format]()
