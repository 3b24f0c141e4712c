"""The file formats: how each is told by its first bytes and its name, what it can hold, and where its codec lives.

Codecs are imported when their format is met: a pair of JPEGs does not wait for the third of a second that TIFF takes.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, Literal

import numpy as np

from autoalign.files.codec import Decoder, Encoder, Refused
from autoalign.picture.pixels import Picture, has_alpha

HEAD_BYTES = 64  # enough for every mark below


@dataclass(frozen=True, kw_only=True)
class Format:
    """One file format, and what autoalign can do with it."""

    name: str
    mark: bytes  # regular expression for the first bytes
    extensions: tuple[str, ...]
    reads: tuple[type, ...]
    depths: tuple[type, ...] = ()  # the dtypes that can be written; empty where it can only be read
    lossy: bool = False  # what is written is a little different from what went in
    alpha: bool = True
    grey: bool = True  # False: what is written grey comes back as RGB
    kept: tuple[str, ...]  # of what travels with a picture
    max_side: int = 2**31 - 1  # pixels
    decoder: str  # module and function that makes its `Decoder`
    encoder: str | None = None  # the same of its `Encoder`; None where it can only be read
    told: tuple[Literal["page", "lenient", "quality"], ...] = ()  # what these functions can be told
    extra: str | None = None  # what must be installed on top to read it
    named: bool = False  # the first bytes are not its own, so that the extension must be one of these

    def holds(self, pixels: Picture) -> bool:
        """True if the pixels can be written in this format with nothing lost but what lossy compression costs."""
        return (
            pixels.dtype in self.depths
            and (self.alpha or not has_alpha(pixels))
            and max(pixels.shape[:2]) <= self.max_side
        )

    def is_of(self, head: bytes, path: Path | None) -> bool:
        """True for a file with these first bytes, and this name where that has a say."""
        named = not self.named or (path is not None and path.suffix.lower() in self.extensions)
        return named and re.match(self.mark, head, re.DOTALL) is not None


EXIF, XMP, ICC, RESOLUTION = "EXIF", "XMP", "ICC", "resolution"
JPEG = Format(
    name="JPEG",
    mark=rb"\xff\xd8\xff",
    extensions=(".jpg", ".jpeg"),
    reads=(np.uint8,),
    depths=(np.uint8,),
    lossy=True,
    alpha=False,
    kept=(EXIF, XMP, ICC, RESOLUTION),
    decoder="jpeg:decoder",
    encoder="jpeg:encoder",
    told=("lenient", "quality"),
    max_side=65_500,
)
PNG = Format(
    name="PNG",
    mark=rb"\x89PNG\r\n\x1a\n",
    extensions=(".png",),
    reads=(np.uint8, np.uint16),
    depths=(np.uint8, np.uint16),
    kept=(EXIF, XMP, ICC, RESOLUTION),
    decoder="png:decoder",
    encoder="png:encoder",
    told=("lenient",),
    max_side=1_000_000,
)
TIFF = Format(
    name="TIFF",
    mark=rb"II[*+]\0|MM\0[*+]",
    extensions=(".tif", ".tiff"),
    reads=(np.uint8, np.uint16, np.float32),
    depths=(np.uint8, np.uint16, np.float32),
    kept=(EXIF, XMP, ICC, RESOLUTION, "GeoTIFF", "OME-XML", "ImageJ"),
    decoder="tiff:decoder",
    encoder="tiff:encoder",
    told=("page", "lenient"),
)
WEBP = Format(
    name="WebP",
    mark=rb"RIFF.{4}WEBP",
    extensions=(".webp",),
    reads=(np.uint8,),
    depths=(np.uint8,),
    grey=False,
    kept=(EXIF, XMP, ICC, RESOLUTION),
    decoder="pillow:webp_decoder",
    encoder="pillow:webp_encoder",
    max_side=16_383,
)
BMP = Format(
    name="BMP",
    mark=rb"BM.{12}[\x0c\x28\x34\x38\x40\x6c\x7c]\0\0\0",  # "BM" begins many a text, the lengths of headers do not
    extensions=(".bmp",),
    reads=(np.uint8,),
    depths=(np.uint8,),
    alpha=False,
    kept=(RESOLUTION,),
    decoder="pillow:bmp_decoder",
    encoder="pillow:bmp_encoder",
    told=("lenient",),
)
AVIF = Format(
    name="AVIF",
    mark=rb".{4}ftyp(?:.{4})*?avi[fs]",
    extensions=(".avif",),
    reads=(np.uint8, np.uint16),
    depths=(np.uint8,),
    lossy=True,
    grey=False,
    kept=(EXIF, XMP, ICC, RESOLUTION),
    decoder="avif:decoder",
    encoder="avif:encoder",
    max_side=16_384,
)
JPEG_2000 = Format(
    name="JPEG 2000",
    mark=rb"\0\0\0\x0cjP  \r\n\x87\n|\xff\x4f\xff\x51",
    extensions=(".jp2",),
    reads=(np.uint8, np.uint16),
    depths=(np.uint8, np.uint16),
    kept=(EXIF, XMP, ICC, RESOLUTION),
    decoder="jpeg2000:decoder",
    encoder="jpeg2000:encoder",
)
JPEG_XL = Format(
    name="JPEG XL",
    mark=rb"\0\0\0\x0cJXL \r\n\x87\n|\xff\x0a",
    extensions=(".jxl",),
    reads=(np.uint8, np.uint16, np.float32),
    depths=(np.uint8, np.uint16, np.float32),
    kept=(EXIF, XMP, RESOLUTION),
    decoder="jpegxl:decoder",
    encoder="jpegxl:encoder",
    max_side=2**30,
)
HEIC = Format(
    name="HEIC",
    mark=rb".{4}ftyp(?:hei|hev|mif1|msf1)",
    extensions=(".heic", ".heif"),
    reads=(np.uint8, np.uint16),
    kept=(EXIF, XMP, ICC, RESOLUTION),
    decoder="heic:decoder",
    extra="heic",
)
RAW = Format(
    name="raw",
    mark=rb"II[*]\0|MM\0[*]|IIRO|IIU\0|FUJIFILMCCD-RAW|.{4}ftypcrx",
    extensions=(".dng", ".nef", ".cr2", ".cr3", ".arw", ".orf", ".rw2", ".raf", ".pef", ".srw"),
    reads=(np.uint16,),
    alpha=False,
    kept=(EXIF,),
    decoder="raw:decoder",
    extra="raw",
    named=True,
)
FORMATS = (JPEG, PNG, RAW, TIFF, WEBP, BMP, AVIF, JPEG_2000, JPEG_XL, HEIC)
"""In the order in which they are tried: what goes by its name comes before what it looks like."""

STRANGERS = {
    "GIF": rb"GIF8",
    "OpenEXR": rb"\x76\x2f\x31\x01",  # half floats, layers and linear light: float TIFF holds what is needed of it
    "Photoshop": rb"8BPS",
    "PDF": rb"%PDF",
}
"""Pictures that are recognised only to be refused by name."""


def of_bytes(head: bytes, path: Path | None = None) -> Format:
    """The format that a file of these first `HEAD_BYTES` bytes is in; `Refused` if autoalign does not read it.

    `path` says so for raw files of cameras, many of which begin as a TIFF does.
    """
    for format in FORMATS:
        if format.is_of(head, path):
            return format
    for name, mark in STRANGERS.items():
        if re.match(mark, head, re.DOTALL):
            raise Refused(f"is in the format {name}, which autoalign does not read")
    raise Refused(f"is not a picture in a format that autoalign reads ({', '.join(f.name for f in FORMATS)})")


def of_name(path: Path) -> Format | None:
    """The format that a file's extension says, in either case; None if autoalign knows no such extension."""
    return next((format for format in FORMATS if path.suffix.lower() in format.extensions), None)


def decoder_for(format: Format, page: int = 0, lenient: bool = False) -> Decoder:
    """What reads this format; `Refused` for a page other than 0 of a format that has but one.

    `lenient` takes of a damaged file what can be had, where the format has parts that can be read without the others.
    """
    if page != 0 and "page" not in format.told:
        raise Refused(f"is a {format.name} file, which has no page {page} (pages count from 0)")
    decoder: Decoder = _made(format.decoder, format, page=page, lenient=lenient)
    return decoder


def encoder_for(format: Format, jpeg_quality: int) -> Encoder:
    """What writes this format, which must be one that has `depths`."""
    assert format.encoder is not None, format.name
    encoder: Encoder = _made(format.encoder, format, quality=jpeg_quality)
    return encoder


def table() -> str:
    """What can be read, written and kept, as a table for people."""
    lines = ["| format | extensions | read | written | alpha | kept |", "|---|---|---|---|---|---|"]
    for format in sorted(FORMATS, key=lambda format: (not format.depths, format.extra or "")):
        extensions = " ".join(f"`{extension}`" for extension in format.extensions)
        read = _words(format.reads) + (f", with `autoalign[{format.extra}]`" if format.extra else "")
        written = _words(format.depths) if format.depths else f"no: {default_for(format).extensions[0]} instead"
        remarks = [word for word, said in (("lossy", format.lossy), ("grey as RGB", not format.grey)) if said]
        written += f" ({', '.join(remarks)})" if format.depths and remarks else ""
        kept = ", ".join(format.kept)
        lines.append(
            f"| {format.name} | {extensions} | {read} | {written} | {'yes' if format.alpha else 'no'} | {kept} |"
        )
    return "\n".join(lines)


def default_for(format: Format | None, pixels: Picture | None = None) -> Format:
    """The format in which a picture is written whose own cannot be, or cannot hold these pixels."""
    return TIFF if format is RAW or (pixels is not None and not PNG.holds(pixels)) else PNG


def _words(depths: tuple[type, ...]) -> str:
    words: dict[type, str] = {np.uint8: "8", np.uint16: "16", np.float32: "float"}
    return ", ".join(words[depth] for depth in depths)


def _made(function: str, format: Format, **words: object) -> Any:
    """What a function of a codec makes, once it is told those of the words that it knows."""
    known = {name: value for name, value in words.items() if name in format.told}
    return resolve_name(f"{__package__}.{function}")(**known)
