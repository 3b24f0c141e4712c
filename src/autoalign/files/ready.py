"""The two pictures of a pair, whatever their size: opened, made ready, and aligned.

Where one of them stays in its file, both are looked at as working copies, and settled on patches of the full pictures.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from autoalign.files.feature_store import recall_from
from autoalign.files.large import AnyPicture, check_sized, opened_picture
from autoalign.files.read import LoadedPicture, ReadOptions
from autoalign.files.remote import shown
from autoalign.geometry.homography import Array, Mask, invert
from autoalign.picture.pixels import Picture, Shrunken, grey, size_of, working_copy
from autoalign.registration.align import align
from autoalign.registration.alignment import Alignment, AlignOptions
from autoalign.registration.large import WORKING_PIXELS, Large, align_large
from autoalign.registration.prepared import Prepared, prepare


@dataclass(frozen=True, kw_only=True)
class Source:
    """Where a picture is, and what of it is taken."""

    path: str  # or a URL
    mask: str | None = None  # a picture of the same size that is not black where this one is to be ignored
    page: int = 0
    reading: ReadOptions = ReadOptions()
    store: str | None = None  # folder where its features are kept


@dataclass(frozen=True, kw_only=True)
class Seen:
    """What a picture is aligned by."""

    copy: Shrunken  # the picture itself, where both of a pair were read as a whole
    prepared: Prepared  # of the copy, without what the mask hides


@dataclass(frozen=True, kw_only=True)
class Ready:
    """A picture that is open, and what it is aligned by, made when it is first asked for."""

    source: Source
    picture: AnyPicture
    _seen: dict[bool, Seen] = field(default_factory=dict)

    def seen(self, *, small: bool) -> Seen:
        """The picture itself, or `small`, a working copy, which alone there is of one that stays in its file.

        Raises ImageReadError, the path last, where the pixels are damaged, or the mask is no mask of it.
        """
        if small not in self._seen:
            self._seen[small] = _look(self.source, self.picture, small)
        return self._seen[small]

    @property
    def nbytes(self) -> int:
        """Bytes that keeping it takes."""
        pixels = [seen.copy.pixels for seen in self._seen.values()]
        pixels += [self.picture.pixels] if isinstance(self.picture, LoadedPicture) else []
        each_once = {id(array): array.nbytes for array in pixels}
        return sum(each_once.values()) + sum(seen.prepared.nbytes for seen in self._seen.values())


@dataclass(frozen=True, kw_only=True)
class Both:
    """The two pictures of a pair."""

    fixed: Ready
    moving: Ready

    @property
    def pictures(self) -> tuple[AnyPicture, AnyPicture]:
        """The fixed and the moving one."""
        return self.fixed.picture, self.moving.picture

    @property
    def whole(self) -> tuple[LoadedPicture, LoadedPicture] | None:
        """The fixed and the moving one, if both were read as a whole."""
        fixed, moving = self.pictures
        return (fixed, moving) if isinstance(fixed, LoadedPicture) and isinstance(moving, LoadedPicture) else None

    @property
    def is_large(self) -> bool:
        """True where one of them stays in its file: both are seen as copies, and the result is drawn strip by strip."""
        return self.whole is None

    def seen(self) -> tuple[Seen, Seen]:
        """What the fixed and the moving one are aligned by. Raises as `Ready.seen` does."""
        return self.fixed.seen(small=self.is_large), self.moving.seen(small=self.is_large)

    def as_seen(self, fixed_from_moving: Array) -> Array:
        """(3, 3) a transform of the pictures as one of what they are aligned by."""
        fixed, moving = (seen.copy for seen in self.seen())
        return invert(fixed.full_from_small) @ fixed_from_moving @ moving.full_from_small


@contextmanager
def opened_source(source: Source) -> Iterator[Ready]:
    """A picture, open to be read as long as the block lasts. Raises ImageReadError as `read_picture` does."""
    with opened_picture(source.path, source.reading, page=source.page) as picture:
        yield Ready(source=source, picture=picture)


def align_both(both: Both, options: AlignOptions) -> Alignment:
    """Find the transform that puts the moving picture onto the fixed one. Raises as `Ready.seen` does."""
    fixed, moving = both.seen()
    if not both.is_large:
        return align(fixed.prepared, moving.prepared, options)
    fixed_picture, moving_picture = both.pictures
    return align_large(_large(fixed_picture, fixed), _large(moving_picture, moving), options)


def _large(picture: AnyPicture, seen: Seen) -> Large:
    return Large(pixels=picture.pixels, copy=seen.prepared, full_from_copy=seen.copy.full_from_small)


def _look(source: Source, picture: AnyPicture, small: bool) -> Seen:
    copy = _copy(picture, small)
    identity = f"{picture.sha256} {source.page} {source.reading.lenient} {size_of(copy.pixels)}"
    valid = None
    if source.mask is not None:
        with opened_picture(source.mask) as mask:
            check_sized(mask.pixels, size_of(picture.pixels), shown(source.mask))
            valid = _visible(mask, copy.pixels, small)
            identity += f" {mask.sha256}"
    recall = recall_from(Path(source.store), identity) if source.store else None
    return Seen(copy=copy, prepared=prepare(copy.pixels, valid, recall=recall))


def _copy(picture: AnyPicture, small: bool) -> Shrunken:
    if not isinstance(picture, LoadedPicture):
        return picture.working_copy(WORKING_PIXELS)
    if small:
        return working_copy(picture.pixels, WORKING_PIXELS)
    return Shrunken(pixels=picture.pixels, full_from_small=np.eye(3))


def _visible(mask: AnyPicture, copy: Picture, small: bool) -> Mask:
    """(h, w) of the copy: True where the mask, of the picture's full size, is black."""
    hidden = grey(working_copy(mask.pixels, WORKING_PIXELS if small else math.inf).pixels) != 0
    # The copy may be of an overview, which is smaller by another number.
    rows, columns = (np.arange(n) * m // n for n, m in zip(copy.shape, hidden.shape, strict=False))
    return np.asarray(~hidden[np.ix_(rows, columns)])
