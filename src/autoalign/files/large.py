"""Pictures of whichever size, opened: a large TIFF stays in its file, everything else is read as a whole.

What knows TIFF is imported when one is met.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from autoalign.errors import ImageReadError
from autoalign.files.formats import HEAD_BYTES, TIFF
from autoalign.files.read import LoadedPicture, ReadOptions, opened, read_picture
from autoalign.files.remote import is_url, read_url
from autoalign.picture.pixels import PixelSource, size_of

if TYPE_CHECKING:
    from autoalign.files.tiled import LargePicture

LARGE_PIXELS = 100e6  # a TIFF with more is read box by box
MAX_PIXELS = 2**30  # of such a TIFF

AnyPicture: TypeAlias = "LoadedPicture | LargePicture"


@contextmanager
def opened_picture(path: str | Path, options: ReadOptions = ReadOptions(), *, page: int = 0) -> Iterator[AnyPicture]:
    """A picture from a path or URL: a large TIFF that can be read box by box is, everything else is read as a whole.

    Raises ImageReadError as `read_picture` does.
    """
    if is_url(str(path)):
        yield read_url(str(path), options, page=page)
        return
    with opened(Path(path)) as file:
        is_tiff = re.match(TIFF.mark, file.read(HEAD_BYTES), re.DOTALL)
    if is_tiff:
        from autoalign.files.tiled import opened_large

        max_pixels = options.max_pixels or MAX_PIXELS
        with opened_large(path, above_pixels=LARGE_PIXELS, max_pixels=max_pixels, number=page) as large:
            if large is not None:
                yield large
                return
    yield read_picture(path, options, page=page)


def is_large(picture: AnyPicture) -> bool:
    """True for one that stays in its file."""
    return not isinstance(picture, LoadedPicture)


def check_sized(pixels: PixelSource, size: tuple[int, int], path: Path | str) -> None:
    """Raise ImageReadError, the path or URL last, unless the pixels of a file are of `size` (w, h)."""
    (w, h), (wanted_w, wanted_h) = size_of(pixels), size
    if (w, h) != size:
        raise ImageReadError(f"is {w} x {h}, and a picture of {wanted_w} x {wanted_h} is needed: {path}")
