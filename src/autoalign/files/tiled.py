"""TIFF files that are too large to be read whole: their pixels are read box by box, where they are asked for."""

from __future__ import annotations

import hashlib
import itertools
import math
import mmap
import os
import re
from collections import OrderedDict
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from io import BufferedReader
from pathlib import Path
from typing import Any, cast

import numpy as np
import tifffile
from numpy.typing import NDArray

from autoalign.errors import ImageReadError
from autoalign.files import tiff
from autoalign.files.codec import Refused, one_line
from autoalign.files.formats import HEAD_BYTES, TIFF
from autoalign.files.metadata import Metadata, describing
from autoalign.files.read import check_size, opened
from autoalign.picture.pixels import Picture, PixelSource, Shrunken, resize_map, size_of, working_copy

CACHE_BYTES = 160 * 2**20  # of decoded tiles: a strip of a turned gigapixel passes through some hundred of them
THREADS = 2  # that decode; more would only wait for the warper
MAX_TILE_PIXELS = 2**25  # a page in larger pieces is not read box by box
MIN_SIDE = 64  # px; nor is one that is thinner: its working copy would be as large as itself
BARE_ROWS = 64  # of pixels that are not compressed, that are read at once
JPEGS = (6, 7, 33007, 34892)  # compressions whose tiles share tables


_Tile = NDArray[Any]


@dataclass(frozen=True, kw_only=True)
class LargePicture:
    """A picture that stays in its file, and what came with it; good while the file is open."""

    pixels: TiledPixels
    overviews: tuple[TiledPixels, ...]  # the same picture smaller, as the file has it
    metadata: Metadata
    sha256: str  # of the file's bytes, 64 hexadecimal digits
    format: str
    path: Path
    remark: str | None = None  # what of the file is not taken, a sentence

    def working_copy(self, max_pixels: float) -> Shrunken:
        """The picture made smaller to at most `max_pixels`, from the smallest overview that has more, if there is one.

        Raises ImageReadError, the path last, where the pixels are damaged.
        """
        enough = [level for level in self.overviews if level.shape[0] * level.shape[1] >= max_pixels]
        level = min(enough, key=lambda one: one.shape[0], default=self.pixels)
        small = working_copy(level, max_pixels)
        level.forget()
        full_from_level = resize_map(_covered(level, self.pixels), size_of(level))
        return Shrunken(pixels=small.pixels, full_from_small=full_from_level @ small.full_from_small)


class TiledPixels:
    """The pixels of a page of an open TIFF file. Tiles, or strips, that were decoded are kept while there is room."""

    def __init__(self, page: Any, path: Path, cache_bytes: int = CACHE_BYTES) -> None:
        self._page = page
        self._path = path
        self._cache_bytes = cache_bytes
        self._kept: OrderedDict[int, _Tile] = OrderedDict()
        self._pool = ThreadPoolExecutor(THREADS)
        tables = {"jpegtables": page.jpegtables, "jpegheader": page.jpegheader} if page.compression in JPEGS else {}
        # Made here, since it may read from the file, where one thread at a time can be.
        self._unpack = partial(page.decode, **tables)
        self._is_bare = _is_bare(page)
        like = tiff.as_picture(np.zeros((1, 1, page.samplesperpixel), page.dtype), page)
        self.shape: tuple[int, ...] = (page.imagelength, page.imagewidth, *like.shape[2:])
        self.dtype: np.dtype[Any] = like.dtype
        self._tile = _tile_of(page)
        self._grid = tuple(-(-side // length) for side, length in zip(self.shape, self._tile, strict=False))
        self._planes = [slice(None)]
        if page.planarconfig != 1:
            self._planes = [slice(i, i + 1) for i in range(page.samplesperpixel)]

    def __getitem__(self, box: tuple[slice, slice], /) -> Picture:
        """The pixels in these rows and columns. Raises ImageReadError, the path last, where they are damaged."""
        (y0, y1, _), (x0, x1, _) = (part.indices(side) for part, side in zip(box, self.shape, strict=False))
        places = list(self._places(y0, y1, x0, x1))
        samples = np.empty((y1 - y0, x1 - x0, self._page.samplesperpixel), self._page.dtype)
        try:
            tiles = self._decoded([index for index, *_ in places])
            for index, plane, top, left in places:
                _copy_common(tiles[index], samples[..., plane], top - y0, left - x0)
            return tiff.as_picture(samples, self._page)
        except Exception as error:  # decoders raise what they like on damaged bytes
            raise _damaged(error, self._path) from error

    def close(self) -> None:
        """End the threads and forget the tiles."""
        self._pool.shutdown(wait=True, cancel_futures=True)
        self.forget()

    def forget(self) -> None:
        """Keep no tile any longer."""
        self._kept.clear()

    def _places(self, y0: int, y1: int, x0: int, x1: int) -> Iterator[tuple[int, slice, int, int]]:
        """Number, channels, first row and first column of each tile that has a part in a box."""
        height, width = self._tile
        rows, columns = self._grid
        for number, plane in enumerate(self._planes):
            for row in range(y0 // height, -(-y1 // height)):
                for column in range(x0 // width, -(-x1 // width)):
                    yield (number * rows + row) * columns + column, plane, row * height, column * width

    def _decoded(self, indices: list[int]) -> dict[int, _Tile]:
        """The tiles (h, w, samples) of these numbers; this thread reads, others decode side by side."""
        missing = [index for index in indices if index not in self._kept]
        futures = {index: self._pool.submit(self._decode, index, self._bytes_of(index)) for index in missing}
        tiles = {}
        for index in indices:
            tiles[index] = self._kept.pop(index) if index in self._kept else futures[index].result()
            self._kept[index] = tiles[index]  # as the one used last
        total = sum(tile.nbytes for tile in self._kept.values())
        while total > self._cache_bytes:
            total -= self._kept.popitem(last=False)[1].nbytes
        return tiles

    def _bytes_of(self, index: int) -> bytes:
        if self._is_bare:
            row_bytes = self._page.imagewidth * self._page.samplesperpixel * self._page.dtype.itemsize
            start = index * self._tile[0] * row_bytes
            offset = self._page.dataoffsets[0] + start
            count = min(self._tile[0] * row_bytes, self._page.imagelength * row_bytes - start)
        else:
            offset, count = self._page.dataoffsets[index], self._page.databytecounts[index]
        handle = self._page.parent.filehandle
        handle.seek(offset)
        data = bytes(handle.read(count))
        if len(data) != count:
            raise EOFError("the file ends in the middle of a tile")
        return data

    def _decode(self, index: int, data: bytes) -> _Tile:
        page = self._page
        if self._is_bare:
            stored = np.frombuffer(data, page.parent.byteorder + page.dtype.char)
            return stored.reshape(-1, page.imagewidth, page.samplesperpixel)
        tile, _, shape = self._unpack(data or None, index)
        # None is a hole, where nothing was ever written.
        return np.full(shape[1:], page.nodata, page.dtype) if tile is None else np.asarray(tile[0])


@contextmanager
def opened_large(
    path: str | Path, *, above_pixels: float, max_pixels: float, number: int = 0
) -> Iterator[LargePicture | None]:
    """A page of a TIFF with more than `above_pixels` pixels, open to be read box by box; None for anything else.

    None as well for one that is stored lying or mirrored, which would have to be turned as a whole, for one that is
    compressed in one piece, and for a mere line. Raises
    ImageReadError, one line with the path last, if there is no such file, or it is such a TIFF and has more than
    `max_pixels` pixels, is cut short, or is of a kind that autoalign does not take.
    """
    path = Path(path)
    with ExitStack() as stack:
        with opened(path):  # says why it cannot be opened; what goes wrong later is no matter of opening
            file = stack.enter_context(path.open("rb"))
        page = _large_page(stack, file, number, above_pixels)
        if page is None:
            yield None
            return
        _check(page, file, max_pixels, path)
        levels = [TiledPixels(level, path) for level in (page, *_overviews(page, number))]
        for level in levels:
            stack.callback(level.close)
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            metadata = tiff.read_metadata(cast(bytes, data), page, number)  # which is sliced, and no more
        file.seek(0)
        yield LargePicture(
            pixels=levels[0],
            overviews=tuple(level for level in levels[1:] if _is_like(level, levels[0])),
            metadata=describing(metadata, np.broadcast_to(np.zeros((), levels[0].dtype), levels[0].shape)),
            sha256=hashlib.file_digest(file, "sha256").hexdigest(),
            format=TIFF.name,
            path=path,
            remark=tiff.left_out(page, number),
        )


def _large_page(stack: ExitStack, file: BufferedReader, number: int, above_pixels: float) -> Any:
    """The page, if it is one to be read box by box, of a file that the stack will close; else None."""
    head = file.read(HEAD_BYTES)
    file.seek(0)
    if not re.match(TIFF.mark, head, re.DOTALL):
        return None
    try:
        page: Any = stack.enter_context(tifffile.TiffFile(file)).pages[number]
        lies = tiff.tag(page, "Orientation", 1) in range(2, 9)
        rows, columns = _tile_of(page)
        w, h = page.imagewidth, page.imagelength
        by_boxes = rows * columns <= MAX_TILE_PIXELS and min(w, h) >= MIN_SIDE and not lies
        return page if w * h > above_pixels and by_boxes else None
    except Exception:  # `read_picture`, which comes next, says what is wrong with the file
        return None


def _is_bare(page: Any) -> bool:
    """True for pixels that stand in the file one after the other, whatever strips it says they are in."""
    if page.is_tiled or page.compression != 1 or page.planarconfig != 1 or page.bitspersample < 8:
        return False
    ends = map(sum, zip(page.dataoffsets, page.databytecounts, strict=True))
    return all(end == start for end, start in zip(ends, page.dataoffsets[1:], strict=False))


def _tile_of(page: Any) -> tuple[int, int]:
    """Rows and columns of what is decoded at once."""
    if page.is_tiled:
        return page.tilelength, page.tilewidth
    return min(BARE_ROWS if _is_bare(page) else page.rowsperstrip, page.imagelength), page.imagewidth


def _check(page: Any, file: BufferedReader, max_pixels: float, path: Path) -> None:
    """Raise ImageReadError, the path last, for what cannot be read, as far as the header tells."""
    try:
        tiff.check_readable(page)
        check_size((page.imagewidth, page.imagelength), max_pixels)
        pieces = page.dataoffsets
        if not _is_bare(page) and len(pieces) != math.prod(page.chunked):
            raise ValueError(f"{len(pieces)} tiles or strips, where there should be {math.prod(page.chunked)}")
        end = file.seek(0, os.SEEK_END)
        if max(map(sum, zip(page.dataoffsets, page.databytecounts, strict=True))) > end:
            raise EOFError("the file is shorter than its header says")
    except Refused as refusal:
        raise ImageReadError(f"{refusal}: {path}") from refusal
    except Exception as error:
        raise _damaged(error, path) from error


def _damaged(error: Exception, path: Path) -> ImageReadError:
    return ImageReadError(f"is damaged, or no {TIFF.name} that can be read ({one_line(error)}): {path}")


def _overviews(page: Any, number: int) -> Iterator[Any]:
    """The pages that say of themselves that they show this one smaller."""
    behind = page.parent.pages[number + 1 :]
    for other in (*(page.pages or ()), *itertools.takewhile(lambda one: one.is_reduced, behind)):
        try:
            tiff.check_readable(other)
        except (Refused, ValueError):
            continue
        yield other


def _is_like(level: TiledPixels, full: TiledPixels) -> bool:
    """True if it is smaller by a whole number, as far as that can be, and of the same channels."""
    factor = _factor(level, full)
    misses = (abs(side / factor - small) for side, small in zip(full.shape[:2], level.shape[:2], strict=True))
    return factor > 1 and max(misses) < 1 and (level.shape[2:], level.dtype) == (full.shape[2:], full.dtype)


def _factor(level: PixelSource, full: PixelSource) -> int:
    return round(full.shape[1] / level.shape[1])


def _covered(level: PixelSource, full: PixelSource) -> tuple[int, int]:
    """(w, h) of the full picture that an overview shows: all, or what whole squares make up where sides were rounded
    down, as libvips and `write_in_strips` do; GDAL rounds up."""
    (w, h), (small_w, small_h), factor = size_of(full), size_of(level), _factor(level, full)
    return min(w, small_w * factor), min(h, small_h * factor)


def _copy_common(tile: _Tile, box: _Tile, top: int, left: int) -> None:
    """Copy into a box (h, w, c) what it has in common with a tile that begins at its row `top`, column `left`."""
    rows, columns = (
        slice(max(start, 0), max(min(start + length, side), 0))
        for start, length, side in zip((top, left), tile.shape[:2], box.shape[:2], strict=True)
    )
    box[rows, columns] = tile[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left]
