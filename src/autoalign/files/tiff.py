"""TIFF and BigTIFF: tifffile with the compressions of imagecodecs; metadata in the tags."""

from __future__ import annotations

import io
import logging
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import tifffile

from autoalign.files.codec import Decoder, Encoder, Header, Refused
from autoalign.files.metadata import CM_PER_INCH, Metadata, resolution
from autoalign.picture.pixels import DTYPES, Picture, has_alpha

if TYPE_CHECKING:
    from collections.abc import Iterator

PHOTOMETRIC, EXTRASAMPLE = tifffile.PHOTOMETRIC, tifffile.EXTRASAMPLE
COLOURS = {
    PHOTOMETRIC.MINISBLACK: 1,
    PHOTOMETRIC.MINISWHITE: 1,
    PHOTOMETRIC.PALETTE: 1,
    PHOTOMETRIC.RGB: 3,
    PHOTOMETRIC.YCBCR: 3,
}
"""Samples that make the colour of a pixel, for the kinds of TIFF that are read; the others are refused by name."""
ALPHAS = (EXTRASAMPLE.UNASSALPHA, EXTRASAMPLE.ASSOCALPHA)
JPEG_COMPRESSION = 7  # the only one whose YCbCr pixels arrive as RGB
INCHES_PER_UNIT = {2: 1.0, 3: 1 / CM_PER_INCH}  # the tag ResolutionUnit; 1 is an aspect ratio
BYTE = 1  # TIFF type code

# Both write their complaints about damaged files to the log; without a handler Python would print them.
for _name in ("tifffile", "imagecodecs"):
    logging.getLogger(_name).addHandler(logging.NullHandler())


def decoder(page: int) -> Decoder:
    """The page, counted from 0: grey, palette or RGB, with or without alpha, uint8, uint16, float32, 1 to 4 bits."""
    return Decoder(read_header=partial(_read_header, number=page), decode=partial(_decode, number=page))


def encoder() -> Encoder:
    """Grey or RGB, with or without alpha, uint8, uint16 or float32; Deflate with a predictor."""
    return _encode


def _read_header(data: bytes, number: int) -> Header:
    with _page(data, number) as page:
        _check_readable(page)
        orientation = _tag(page, "Orientation", 1)
        xmp = _tag(page, "XMP", None)
        return Header(
            size=(page.imagewidth, page.imagelength),
            orientation=orientation if orientation in range(1, 9) else 1,
            metadata=Metadata(
                icc=page.iccprofile or None,
                xmp=xmp if isinstance(xmp, bytes) and xmp else None,
                dpi=_read_dpi(page),
            ),
        )


def _decode(data: bytes, number: int) -> Picture:
    with _page(data, number) as page:
        stored = page.asarray(squeeze=False)
        # Of a file cut short tifffile may return nothing at all without an error.
        if stored.shape != page.shaped:
            raise ValueError(f"the pixels have shape {stored.shape}, the header says {page.shaped}")
        # (planes, depth, h, w, samples): either the planes or the samples are the channels.
        pixels = stored[0, 0] if len(stored) == 1 else np.concatenate(stored[:, 0], axis=-1)
        return _straight(_levels(pixels[..., 0] if pixels.shape[2] == 1 else pixels, page), page)


def _encode(pixels: Picture, metadata: Metadata) -> bytes:
    stream = io.BytesIO()
    tifffile.imwrite(
        stream,
        pixels,
        photometric="minisblack" if pixels.ndim == 2 or pixels.shape[2] < 3 else "rgb",
        planarconfig="contig" if pixels.ndim == 3 else None,
        extrasamples=["unassalpha"] if has_alpha(pixels) else None,
        compression="zlib",
        predictor=True,
        resolution=metadata.dpi,
        resolutionunit="INCH" if metadata.dpi else None,
        iccprofile=metadata.icc,
        extratags=[(700, BYTE, len(metadata.xmp), metadata.xmp, True)] if metadata.xmp else [],
        # Neither a description nor the name of the library: the bytes depend on the picture alone.
        metadata=None,
        software=False,
    )
    return stream.getvalue()


@contextmanager
def _page(data: bytes, number: int) -> Iterator[Any]:
    with tifffile.TiffFile(io.BytesIO(data)) as file:
        try:
            page = file.pages[number]
        except IndexError:
            if number == 0:
                raise ValueError("the first page is missing") from None
            raise Refused(f"has no page {number} (pages count from 0)") from None
        yield page


def _tag(page: Any, name: str, default: Any) -> Any:
    return page.tags[name].value if name in page.tags else default


def _check_readable(page: Any) -> None:
    """Raise Refused, with the reason, unless the pixels can become a picture."""
    kind = page.photometric
    if kind not in COLOURS or (kind == PHOTOMETRIC.YCBCR and page.compression != JPEG_COMPRESSION):
        raise Refused(f"holds {getattr(kind, 'name', kind)} pixels; convert it to grey or RGB first")
    if page.imagedepth != 1:
        raise Refused("holds a volume, not a picture")
    extra = tuple(page.extrasamples)
    if page.samplesperpixel != COLOURS[kind] + len(extra) or extra not in ((), *((alpha,) for alpha in ALPHAS)):
        raise Refused(f"has {page.samplesperpixel} channels that are not grey or RGB with or without alpha")
    if page.dtype is None or not (page.dtype == np.bool_ or page.dtype in DTYPES):
        raise Refused(f"holds {page.dtype or 'unknown'} pixels; autoalign takes uint8, uint16 and float32")
    if kind == PHOTOMETRIC.PALETTE and (page.dtype != np.uint8 or extra):
        raise Refused("has a palette of an unusual kind; convert it to RGB first")


def _levels(pixels: Picture, page: Any) -> Picture:
    """The stored numbers as brightness: palettes looked up, fewer than 8 bits stretched to 8, white-is-zero turned."""
    if page.photometric == PHOTOMETRIC.PALETTE:
        palette = (page.colormap >> 8).astype(np.uint8).T  # 16 bits by the standard
        return np.asarray(palette[pixels])
    if page.bitspersample < 8:
        pixels = pixels.astype(np.uint8) * np.uint8(255 // (2**page.bitspersample - 1))
    if page.photometric != PHOTOMETRIC.MINISWHITE:
        return pixels
    white = 1.0 if pixels.dtype == np.float32 else np.iinfo(pixels.dtype).max
    if pixels.ndim == 2:
        return np.asarray(white - pixels, dtype=pixels.dtype)
    pixels[..., 0] = white - pixels[..., 0]
    return pixels


def _straight(pixels: Picture, page: Any) -> Picture:
    """Colours that were stored multiplied by their opacity, divided by it again."""
    if tuple(page.extrasamples) != (EXTRASAMPLE.ASSOCALPHA,):
        return pixels
    top = 1.0 if pixels.dtype == np.float32 else float(np.iinfo(pixels.dtype).max)
    alpha = pixels[..., -1:].astype(np.float64) / top
    colours = np.divide(pixels[..., :-1], alpha, out=np.zeros(pixels[..., :-1].shape), where=alpha > 0)
    if pixels.dtype != np.float32:
        colours = np.clip(np.rint(colours), 0, top)
    return np.concatenate([colours.astype(pixels.dtype), pixels[..., -1:]], axis=-1)


def _read_dpi(page: Any) -> tuple[float, float] | None:
    unit = _tag(page, "ResolutionUnit", 2)
    x, y = (_tag(page, name, (0, 1)) for name in ("XResolution", "YResolution"))
    if unit not in INCHES_PER_UNIT or 0 in (x[1], y[1]):
        return None
    return resolution(x[0] / x[1], y[0] / y[1], INCHES_PER_UNIT[unit])
