"""HEIC by pillow-heif, which is installed only on request: libheif decodes, and turns the pixels as the file asks."""

from __future__ import annotations

import io
from typing import Any

import numpy as np

from autoalign.files.codec import Decoder, Header, Refused
from autoalign.files.exif import without_prefix
from autoalign.files.metadata import Metadata
from autoalign.picture.pixels import Picture

MODES = ("L", "LA", "RGB", "RGBA", "I;16", "RGB;16", "RGBA;16")


def decoder() -> Decoder:
    """Grey or RGB, with or without alpha: uint8, or uint16 for 10 and 12 bits; Refused where pillow-heif is missing."""
    return Decoder(read_header=_read_header, decode=_decode)


def _read_header(data: bytes) -> Header:
    image = _opened(data)
    if image.mode not in MODES:
        raise Refused(f"holds {image.mode} pixels; convert it to RGB first")
    metadata = Metadata(
        icc=image.info.get("icc_profile") or None,
        exif=without_prefix(image.info.get("exif")),
        xmp=image.info.get("xmp") or None,
    )
    return Header(size=image.size, orientation=1, metadata=metadata)


def _decode(data: bytes) -> Picture:
    return np.array(_opened(data))


def _opened(data: bytes) -> Any:
    """The primary picture, of which only the header was read."""
    try:
        import pillow_heif
    except ImportError:
        raise Refused("is a HEIC file; to read it: pip install 'autoalign[heic]'") from None
    file = pillow_heif.open_heif(io.BytesIO(data), convert_hdr_to_8bit=False)
    return file[file.primary_index]
