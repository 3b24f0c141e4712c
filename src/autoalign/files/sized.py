"""Pictures and masks that must have the size of another picture."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from autoalign.errors import ImageReadError
from autoalign.files.read import LoadedPicture, read_picture
from autoalign.geometry.homography import Mask
from autoalign.picture.pixels import PixelSource, grey, size_of


@dataclass(frozen=True, kw_only=True)
class LoadedMask:
    """A mask from a file."""

    valid: Mask  # (h, w) True where the file is black, that is, where nothing is to be ignored
    sha256: str  # of the file's bytes


def check_sized(pixels: PixelSource, size: tuple[int, int], path: Path | str) -> None:
    """Raise ImageReadError, the path or URL last, unless the pixels of a file are of `size` (w, h)."""
    (w, h), (wanted_w, wanted_h) = size_of(pixels), size
    if (w, h) != size:
        raise ImageReadError(f"is {w} x {h}, and a picture of {wanted_w} x {wanted_h} is needed: {path}")


def read_mask(path: Path, size: tuple[int, int]) -> LoadedMask:
    """Read the mask of a picture of `size` (w, h), which is not black where that picture is to be ignored.

    Raises ImageReadError, the path last.
    """
    return as_mask(read_picture(path), size, path)


def as_mask(loaded: LoadedPicture, size: tuple[int, int], path: Path | str) -> LoadedMask:
    """As `read_mask`, of a picture that was read already."""
    check_sized(loaded.pixels, size, path)
    return LoadedMask(valid=grey(loaded.pixels) == 0, sha256=loaded.sha256)
