"""Pictures that are written as they are made, strip by strip: tiled BigTIFF, compressed, with overviews.

Each overview is made of the one before it, which is read back from the file, so that nothing of the picture's size is
ever in memory. They stand behind the picture as pages of reduced resolution, where viewers of maps look for them.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import tifffile

from autoalign.files import tiff
from autoalign.files.metadata import Metadata, describing
from autoalign.files.tiled import TiledPixels
from autoalign.files.write import blaming, file_atomically
from autoalign.picture.pixels import Picture, PixelSource, halve, size_of

TILE = 512  # px; strips that are written have so many rows
PART = 8 * TILE  # px of a strip that are made smaller at once
SMALLEST = 1024  # px; no overview is made of what is not larger
THREADS = 2  # that compress
BUFFER_BYTES = 2**24  # of tiles that are compressed side by side
LEVEL = 1  # of deflate: six times as fast as the usual 6, and less than a tenth larger

Strips = Iterator[Picture]


def write_in_strips(
    path: str | Path,
    strips: Strips,
    like: PixelSource,
    metadata: Metadata | None = None,
    *,
    overwrite: bool = False,
) -> None:
    """Write a picture of the shape (h, w) or (h, w, c) and dtype of `like` from strips of `TILE` rows, top to bottom.

    The same pixels and metadata give the same bytes. Raises ImageWriteError, the path last, as `write_picture` does;
    then nothing is left behind.
    """
    path = Path(path)
    metadata = describing(metadata or Metadata(), np.broadcast_to(np.zeros((), like.dtype), like.shape))
    layout = tiff.layout_for(metadata, big=True)
    with file_atomically(path, overwrite) as file, blaming(path):
        with tifffile.TiffWriter(file, bigtiff=True, byteorder=layout.order) as writer:
            _write_page(writer, strips, like, **tiff.tags_of(metadata, size_of(like), layout))
            shape = like.shape
            while max(shape[:2]) > SMALLEST:
                shape = _write_overview(writer, file, path)
        tiff.append_directories(file, metadata, layout)


def _write_page(writer: tifffile.TiffWriter, strips: Strips, like: PixelSource, **words: Any) -> None:
    writer.write(
        _tiles(strips),
        shape=like.shape,
        dtype=like.dtype,
        tile=(TILE, TILE),
        maxworkers=THREADS,
        buffersize=BUFFER_BYTES,
        compressionargs={"level": LEVEL},
        **tiff.how_stored(like),
        **words,
    )


def _write_overview(writer: tifffile.TiffWriter, file: BinaryIO, path: Path) -> tuple[int, ...]:
    """Append the last page made half as large, and return its shape."""
    file.flush()
    with tifffile.TiffFile(file.name) as written:
        larger = TiledPixels(written.pages[-1], path, cache_bytes=0)  # no tile is asked for twice
        try:
            shape = (larger.shape[0] // 2, larger.shape[1] // 2, *larger.shape[2:])
            like = np.broadcast_to(np.zeros((), larger.dtype), shape)
            _write_page(writer, _halved(larger), like, subfiletype=1)
        finally:
            larger.close()
    return shape


def _halved(larger: PixelSource) -> Strips:
    """A picture half as large, a last odd row and column left out, strip by strip."""
    h, w = larger.shape[0] & ~1, larger.shape[1] & ~1
    for row in range(0, h, 2 * TILE):
        rows = slice(row, min(row + 2 * TILE, h))
        parts = [halve(larger[rows, slice(x, min(x + PART, w))]).pixels for x in range(0, w, PART)]
        yield np.concatenate(parts, axis=1)


def _tiles(strips: Strips) -> Iterator[Picture]:
    """The strips cut into tiles, those at the rim filled up with their outermost pixels, which compress best."""
    for strip in strips:
        for column in range(0, strip.shape[1], TILE):
            part = strip[:, column : column + TILE]
            right, below = TILE - part.shape[1], TILE - part.shape[0]
            yield np.pad(part, ((0, below), (0, right), *[(0, 0)] * (part.ndim - 2)), mode="edge")
