"""TIFF and BigTIFF: tifffile with the compressions of imagecodecs; metadata in the tags.

What other formats keep in an EXIF block stands here in the page's own directory, and in those that it points to.
"""

from __future__ import annotations

import io
import logging
import struct
from contextlib import contextmanager
from functools import partial
from itertools import islice
from typing import IO, TYPE_CHECKING, Any

import numpy as np
import tifffile

from autoalign.files import exif, microscope
from autoalign.files.codec import Decoder, Encoder, Header, Refused, full_range
from autoalign.files.georeference import NO_DATA, georeference_of
from autoalign.files.metadata import Metadata, resolution
from autoalign.picture.pixels import DTYPES, Picture, PixelSource, has_alpha, size_of

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
UNCOMPRESSED = 1
JPEG_COMPRESSION = 7  # the only one whose YCbCr pixels arrive as RGB
XMP, ICC = 700, 34675
PLACEHOLDERS = {exif.EXIF_IFD: "ExifTag", exif.GPS_IFD: "GPSTag"}  # tifffile lets them through by these names only
MAX_PAGES = 65_536
MAX_CLASSIC = 2**32 - 2**26  # bytes of pixels; with more, offsets may need more than 32 bits
MAX_TILE = 2**26  # pixels of a tile or strip that is larger than its picture: tiles overhang, but not without end

# Both write their complaints about damaged files to the log; without a handler Python would print them.
for _name in ("tifffile", "imagecodecs"):
    logging.getLogger(_name).addHandler(logging.NullHandler())


def decoder(page: int, lenient: bool = False) -> Decoder:
    """The page, counted from 0: grey, palette or RGB, with or without alpha, uint8, uint16, float32, 1 to 4 bits.

    `lenient`: strips and tiles that are damaged or missing are 0.
    """
    decode = _decode_leniently if lenient else _decode
    return Decoder(read_header=partial(_read_header, number=page), decode=partial(decode, number=page))


def encoder() -> Encoder:
    """Grey or RGB, with or without alpha, uint8, uint16 or float32; Deflate with a predictor."""
    return _encode


def _read_header(data: bytes, number: int) -> Header:
    with _page(data, number) as page:
        check_readable(page)
        orientation = tag(page, "Orientation", 1)
        return Header(
            size=(page.imagewidth, page.imagelength),
            orientation=orientation if orientation in range(1, 9) else 1,
            metadata=read_metadata(data, page, number),
            remark=left_out(page, number),
        )


def left_out(page: Any, number: int) -> str | None:
    """What is said of a file whose first page was taken although it has others, which are more than smaller copies."""
    if number != 0:
        return None
    try:
        others = any(not (other.is_reduced or other.is_mask) for other in islice(page.parent.pages, 1, None))
    except Exception:  # a page that is not wanted may be as damaged as it likes
        return None
    return "has several pages, of which the first was taken" if others else None


def _decode_leniently(data: bytes, number: int) -> Picture:
    with _page(data, number) as page:
        pixels = np.zeros(page.shaped, page.dtype)  # (planes, depth, h, w, samples)
        for index, (offset, count) in enumerate(zip(page.dataoffsets, page.databytecounts, strict=False)):
            stored = data[offset : offset + count]
            if page.compression == UNCOMPRESSED:
                stored = stored.ljust(min(count, pixels.nbytes), b"\0")
            try:
                segment, (plane, depth, top, left, _), _ = page.decode(
                    stored, index, jpegtables=page.jpegtables, jpegheader=page.jpegheader
                )
            except Exception:  # decoders raise what they like on damaged bytes; this strip or tile stays 0
                continue
            room = pixels[plane, depth:, top:, left:]
            d, h, w = (min(sides) for sides in zip(segment.shape[:3], room.shape[:3], strict=True))
            room[:d, :h, :w] = segment[:d, :h, :w]
        return as_picture(pixels[0, 0] if len(pixels) == 1 else np.concatenate(pixels[:, 0], axis=-1), page)


def _decode(data: bytes, number: int) -> Picture:
    with _page(data, number) as page:
        stored = page.asarray(squeeze=False)
        # Of a file cut short tifffile may return nothing at all without an error.
        if stored.shape != page.shaped:
            raise ValueError(f"the pixels have shape {stored.shape}, the header says {page.shaped}")
        # (planes, depth, h, w, samples): either the planes or the samples are the channels.
        pixels = stored[0, 0] if len(stored) == 1 else np.concatenate(stored[:, 0], axis=-1)
        return as_picture(pixels, page)


def _encode(pixels: Picture, metadata: Metadata) -> bytes:
    stream = io.BytesIO()
    layout = layout_for(metadata, big=pixels.nbytes > MAX_CLASSIC)
    with tifffile.TiffWriter(stream, bigtiff=layout.big, byteorder=layout.order) as file:
        file.write(pixels, **how_stored(pixels), **tags_of(metadata, size_of(pixels), layout))
    append_directories(stream, metadata, layout)
    return stream.getvalue()


def layout_for(metadata: Metadata, *, big: bool) -> exif.Layout:
    """The byte order of the camera, because maker notes keep theirs."""
    return exif.Layout(order=_order(metadata.exif), big=big)


def how_stored(like: PixelSource) -> dict[str, Any]:
    """What the writer is to be told of pixels like these, (h, w) or (h, w, c)."""
    return {
        "photometric": "minisblack" if (*like.shape, 1)[2] < 3 else "rgb",
        "planarconfig": "contig" if len(like.shape) == 3 else None,
        "extrasamples": ["unassalpha"] if has_alpha(like) else None,
        "compression": "zlib",
        "predictor": True,
        # Neither a description nor the name of the library: the bytes depend on the picture alone.
        "metadata": None,
        "software": False,
    }


def tags_of(metadata: Metadata, size: tuple[int, int], layout: exif.Layout) -> dict[str, Any]:
    """What the writer is to be told of a picture of `size` (w, h) beside its pixels."""
    return {
        **_resolution(metadata),
        "iccprofile": metadata.icc,
        "extratags": _extra_tags(metadata, _directory(metadata), size, layout),
    }


def _directory(metadata: Metadata) -> exif.Directory:
    """The EXIF block as a part of the page's own directory."""
    return exif.described(exif.directory_of(metadata.exif))


@contextmanager
def _page(data: bytes, number: int) -> Iterator[Any]:
    if not 0 <= number < MAX_PAGES:
        raise Refused(f"has no page {number} (pages count from 0)")
    with tifffile.TiffFile(io.BytesIO(data)) as file:
        try:
            page = file.pages[number]
        except IndexError:
            if number == 0:
                raise ValueError("the first page is missing") from None
            raise Refused(f"has no page {number}; its last is {len(file.pages) - 1}, counted from 0") from None
        yield page


def tag(page: Any, name: str, default: Any) -> Any:
    """The value of a tag, or what is to be taken where the page has none."""
    return page.tags[name].value if name in page.tags else default


def as_picture(stored: Picture, page: Any) -> Picture:
    """Numbers (h, w, samples) as a page stores them, all or some of its rows and columns, as (h, w) or (h, w, c)."""
    return _straight(_levels(stored[..., 0] if stored.shape[2] == 1 else stored, page), page)


def check_readable(page: Any) -> None:
    """Raise Refused, with the reason, unless the pixels can become a picture."""
    kind = page.photometric
    if kind not in COLOURS or (kind == PHOTOMETRIC.YCBCR and page.compression != JPEG_COMPRESSION):
        raise Refused(f"holds {getattr(kind, 'name', kind)} pixels; convert it to grey or RGB first")
    w, h, samples = page.imagewidth, page.imagelength, page.samplesperpixel
    tile = (page.tilewidth, page.tilelength) if page.is_tiled else (w, min(page.rowsperstrip, h))
    if tile[0] * tile[1] > max(MAX_TILE, 4 * w * h):
        raise ValueError(f"tiles of {tile[0]} x {tile[1]} pixels in a picture of {w} x {h}")
    if page.imagedepth != 1:
        raise Refused("holds a volume, not a picture")
    extra = tuple(page.extrasamples)
    if samples != COLOURS[kind] + len(extra) or extra not in ((), *((alpha,) for alpha in ALPHAS)):
        raise Refused(f"has {samples} channels that are not grey or RGB with or without alpha")
    if page.dtype is None or not (page.dtype == np.bool_ or page.dtype in DTYPES):
        raise Refused(f"holds {page.dtype or 'unknown'} pixels; autoalign takes uint8, uint16 and float32")
    if kind == PHOTOMETRIC.PALETTE and (page.dtype != np.uint8 or extra):
        raise Refused("has a palette of an unusual kind; convert it to RGB first")


def _levels(pixels: Picture, page: Any) -> Picture:
    """The stored numbers as brightness: palettes looked up, fewer than 8 bits stretched to 8, white-is-zero turned."""
    if page.photometric == PHOTOMETRIC.PALETTE:
        palette = (page.colormap >> 8).astype(np.uint8).T  # 16 bits by the standard
        return np.asarray(palette[pixels])
    if pixels.dtype != np.float32:
        pixels = full_range(pixels.astype(np.uint8) if pixels.dtype == np.bool_ else pixels, page.bitspersample)
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


def read_metadata(data: bytes, page: Any, number: int) -> Metadata:
    layout = exif.Layout(order=page.parent.byteorder, big=page.parent.is_bigtiff)
    directory = dict(exif.read_directory(data, page.offset, layout))
    # A microscope describes all pictures of a file in the first one; other programs each its own.
    written = page.parent.pages[0].description
    scope = microscope.of_plane(written, number) if microscope.is_known(written) else None
    if scope or microscope.is_known(page.description) or page.is_shaped:
        directory.pop(exif.DESCRIPTION, None)
    x, y = (tag(page, name, (0, 1)) for name in ("XResolution", "YResolution"))
    ratio = resolution(x[0] / x[1], y[0] / y[1]) if x[1] and y[1] else None
    dpi = exif.exif_dpi(directory)
    xmp, no_data = directory.get(XMP), directory.get(NO_DATA)
    return Metadata(
        icc=page.iccprofile or None,
        exif=exif.block_of(exif.described(directory), layout.order),
        xmp=xmp.data or None if isinstance(xmp, exif.Tag) else None,
        dpi=microscope.dpi_of(written, dpi, ratio) if scope else dpi,
        georeference=georeference_of(directory),
        no_data=no_data.text or None if isinstance(no_data, exif.Tag) else None,
        microscope=scope,
    )


def _order(block: bytes | None) -> exif.Order:
    return ">" if block and block.startswith(b"MM") else "<"


def _resolution(metadata: Metadata) -> dict[str, Any]:
    """What the writer is to say of the resolution, in the unit that goes with the description."""
    if metadata.dpi is None:
        return {}
    own = microscope.tag_resolution(metadata.microscope, metadata.dpi) if metadata.microscope else None
    return {"resolution": own or metadata.dpi, "resolutionunit": "NONE" if own else "INCH"}


def _extra_tags(
    metadata: Metadata, directory: exif.Directory, size: tuple[int, int], layout: exif.Layout
) -> list[tuple[int | str, int, int, bytes | int, bool]]:
    """All tags that the writer does not make itself, in its words; places to be filled for directories."""
    tags: dict[int, exif.Tag | exif.Directory] = {**directory, **(metadata.georeference or {})}
    texts = {NO_DATA: metadata.no_data}
    if metadata.microscope:
        texts[exif.DESCRIPTION] = microscope.with_grid(metadata.microscope, size, metadata.dpi)
    tags |= {code: exif.Tag(type=exif.ASCII, data=text.encode() + b"\0") for code, text in texts.items() if text}
    if metadata.xmp:
        tags |= {XMP: exif.Tag(type=exif.BYTE, data=metadata.xmp)}
    pointer = exif.LONG8 if layout.big else exif.LONG
    return [
        (code, item.type, item.count, item.in_order(layout.order), True)
        if isinstance(item, exif.Tag)
        else (PLACEHOLDERS[code], pointer, 1, 0, True)
        for code, item in tags.items()
        if isinstance(item, exif.Tag) or code in PLACEHOLDERS
    ]


def append_directories(stream: IO[bytes], metadata: Metadata, layout: exif.Layout) -> None:
    """Put the directories that a page points to at the end of the file, and where they are into their places."""
    found = _directory(metadata)
    inner = {code: item for code, item in found.items() if code in PLACEHOLDERS and not isinstance(item, exif.Tag)}
    if not inner:
        return
    stream.seek(8 if layout.big else 4)
    (start,) = struct.unpack(layout.offset, stream.read(struct.calcsize(layout.offset)))
    stream.seek(start)
    places, _ = exif.entry_places(stream.read(layout.entry_size * exif.MAX_TAGS), 0, layout)
    for code, item in inner.items():
        at = stream.seek(0, io.SEEK_END)
        at += stream.write(bytes(at % 2))  # directories begin at even places
        stream.write(exif.pack_directory(item, layout, at))
        stream.seek(start + places[code] + layout.entry_size - struct.calcsize(layout.offset))
        stream.write(struct.pack(layout.offset, at))
