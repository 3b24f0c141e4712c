"""The formats that Pillow reads and writes for us: WebP, BMP, and what stands around the pixels of AVIF.

The classes of the formats are called directly, not through `PIL.Image.open`: they read the header alone, and neither
warn nor refuse by a limit that is global to the process. The size is checked by our own limit.
"""

from __future__ import annotations

import io
from collections.abc import Callable

import numpy as np
from PIL import Image
from PIL.ImageFile import ImageFile

from autoalign.files.codec import Decoder, Encoder, Header, Refused
from autoalign.files.exif import exif_orientation, with_resolution, without_prefix
from autoalign.files.metadata import Metadata, resolution
from autoalign.picture.pixels import Picture

MODES = {"1": "L", "P": "RGB"}  # how Pillow is to hand over what is no picture of ours


def webp_decoder() -> Decoder:
    """RGB, with or without alpha, uint8; the first picture of an animation."""
    from PIL.WebPImagePlugin import WebPImageFile

    return _decoder(WebPImageFile)


def bmp_decoder(lenient: bool = False) -> Decoder:
    """Grey or RGB, with or without alpha, uint8; palettes are resolved. `lenient`: what is missing is 0."""
    from PIL.BmpImagePlugin import BmpImageFile

    strict = _decoder(BmpImageFile)
    if not lenient:
        return strict

    def decode(data: bytes) -> Picture:
        w, h = strict.read_header(data).size
        return strict.decode(data + bytes(4 * (w + 4) * h))  # as much as the pixels can be

    return Decoder(read_header=strict.read_header, decode=decode)


def webp_encoder() -> Encoder:
    """Lossless: grey (which becomes RGB, WebP knows no other) or RGB, uint8, with or without alpha."""

    def encode(pixels: Picture, metadata: Metadata) -> bytes:
        blocks = {
            "icc_profile": metadata.icc,
            "exif": with_resolution(metadata.exif, metadata.dpi),
            "xmp": metadata.xmp,
        }
        present = {name: block for name, block in blocks.items() if block}
        # Exact: the colour under full transparency stays too.
        return saved(pixels, "WEBP", lossless=True, exact=True, **present)

    return encode


def bmp_encoder() -> Encoder:
    """Grey or RGB, uint8."""

    def encode(pixels: Picture, metadata: Metadata) -> bytes:
        return saved(pixels, "BMP", dpi=metadata.dpi or (0, 0))

    return encode


def avif_header(data: bytes) -> Header:
    """Of AVIF; the turns that its boxes ask for are among the orientations of EXIF."""
    from PIL.AvifImagePlugin import AvifImageFile

    return _header(AvifImageFile(io.BytesIO(data)))


def _decoder(opened: Callable[[io.BytesIO], ImageFile]) -> Decoder:
    def read_header(data: bytes) -> Header:
        try:
            return _header(opened(io.BytesIO(data)))
        except Image.DecompressionBombError:  # of WebP, whose reader allocates on opening
            raise Refused("is larger than the 178 megapixels that are read of this format") from None

    def decode(data: bytes) -> Picture:
        image = opened(io.BytesIO(data))
        return np.array(image.convert(MODES.get(image.mode, image.mode)))

    return Decoder(read_header=read_header, decode=decode)


def _header(image: ImageFile) -> Header:
    info = image.info
    metadata = Metadata(
        icc=info.get("icc_profile") or None,
        exif=without_prefix(info.get("exif")),
        xmp=info.get("xmp") or None,
        dpi=resolution(*info.get("dpi", (0, 0))),
    )
    return Header(size=image.size, orientation=exif_orientation(metadata.exif), metadata=metadata)


def saved(pixels: Picture, name: str, **options: object) -> bytes:
    """The bytes of a file in the format that Pillow calls `name`."""
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, name, **options)
    return stream.getvalue()
