"""The files that a command reads and writes, refused before any work is done."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from autoalign.errors import ImageReadError
from autoalign.files.read import LoadedPicture, read_picture
from autoalign.files.write import check_format, check_writable
from autoalign.picture.pixels import Picture, size_of

SCREEN_PIXEL: Picture = np.zeros((1, 1, 3), np.uint8)
"""What a picture made for the eye is made of."""


def check_outputs(
    outputs: Iterable[tuple[Path | None, Picture | None]], *, inputs: Iterable[Path | None], overwrite: bool
) -> None:
    """Go through (path, pixels like those to be written or None for no picture); a path that is None is not wanted.

    Raises ImageWriteError, the path last, for what cannot be written, and ValueError for a file that is named twice or
    is an input as well: even --overwrite must not cost an original.
    """
    taken = {path.resolve() for path in inputs if path is not None}
    for path, pixels in outputs:
        if path is None:
            continue
        if path.resolve() in taken:
            raise ValueError(f"is an input, or another output, as well: {path}")
        taken.add(path.resolve())
        if pixels is not None:
            check_format(path, pixels)
        check_writable(path, overwrite)


def read_sized(path: Path, size: tuple[int, int]) -> LoadedPicture:
    """Read a picture that must be of `size` (w, h). Raises ImageReadError, the path last."""
    loaded = read_picture(path)
    if size_of(loaded.pixels) != size:
        (w, h), (wanted_w, wanted_h) = size_of(loaded.pixels), size
        raise ImageReadError(f"is {w} x {h}, and a picture of {wanted_w} x {wanted_h} is needed: {path}")
    return loaded
