"""A picture made ready to be aligned, once for all attempts and for all pictures that it is paired with."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from autoalign.geometry.homography import Mask
from autoalign.picture.pixels import Picture, check_picture, grey, opaque, size_of, to_8_bit
from autoalign.registration.features import FeatureOptions, Features, detect
from autoalign.registration.verdict import Sizes

Recall = Callable[[FeatureOptions, Callable[[], Features]], Features]
"""The features of one picture for these options, remembered, or else as the function finds them."""


@dataclass(frozen=True, kw_only=True)
class Prepared:
    """A picture in grey, where it may be used, and the features found in it so far."""

    grey: Picture  # (h, w), own depth
    grey_8_bit: NDArray[np.uint8]  # (h, w)
    usable: Mask | None  # (h, w) True where usable, None where all is
    recall: Recall | None = None  # a memory that outlives this object
    _found: dict[FeatureOptions, Features] = field(default_factory=dict)

    @property
    def size(self) -> tuple[int, int]:
        """(w, h)."""
        return size_of(self.grey)

    @property
    def nbytes(self) -> int:
        """Bytes that keeping it takes."""
        arrays = [self.grey] if self.grey is self.grey_8_bit else [self.grey, self.grey_8_bit]
        arrays += [] if self.usable is None else [self.usable]
        return sum(array.nbytes for array in arrays) + sum(found.descriptors.nbytes for found in self._found.values())

    def features(self, options: FeatureOptions) -> Features:
        """The picture's features, found at most once for the same options."""
        if options not in self._found:
            recall = self.recall or _forgetful
            self._found[options] = recall(options, lambda: detect(self.grey_8_bit, options, self.usable))
        return self._found[options]

    def mirrored(self) -> Prepared:
        """The picture mirrored, left to right."""
        image, image_8_bit = (np.ascontiguousarray(array[:, ::-1]) for array in (self.grey, self.grey_8_bit))
        usable = None if self.usable is None else np.ascontiguousarray(self.usable[:, ::-1])
        return Prepared(grey=image, grey_8_bit=image_8_bit, usable=usable)


@dataclass(frozen=True, kw_only=True)
class Pair:
    """Two pictures that are to be aligned."""

    fixed: Prepared
    moving: Prepared

    @property
    def masks(self) -> tuple[Mask | None, Mask | None]:
        return self.fixed.usable, self.moving.usable

    @property
    def sizes(self) -> Sizes:
        return Sizes(fixed=self.fixed.size, moving=self.moving.size)

    def mirrored(self) -> Pair:
        """The pair with its moving picture mirrored."""
        return Pair(fixed=self.fixed, moving=self.moving.mirrored())


def prepare(
    picture: Picture, valid: Mask | None = None, *, name: str = "picture", recall: Recall | None = None
) -> Prepared:
    """Make a picture ready to be aligned with any number of others.

    `picture` is (h, w) or (h, w, 1..4), uint8, uint16 or float32; `valid` (h, w) is True where a pixel may be used, and
    pixels of zero alpha, or that are no number, are not used either. `recall` remembers features beyond this object.
    Raises ValueError, with `name`, for an array that is no picture and a mask of another size.
    """
    check_picture(picture, name)
    if valid is not None and valid.shape != picture.shape[:2]:
        raise ValueError(f"{name}_valid has shape {valid.shape}, its picture {picture.shape[:2]}")
    image = _finite(grey(picture))
    return Prepared(grey=image, grey_8_bit=to_8_bit(image), usable=_usable(picture, valid), recall=recall)


def _forgetful(options: FeatureOptions, find: Callable[[], Features]) -> Features:
    return find()


def _usable(image: Picture, valid: Mask | None) -> Mask | None:
    """The mask, less what the picture's own alpha hides and what is no number; None where every pixel may be used."""
    parts = [np.isfinite(grey(image))] if image.dtype == np.float32 else []
    parts += [part.astype(bool) for part in (valid, opaque(image)) if part is not None]
    usable = np.logical_and.reduce(parts) if parts else None
    return None if usable is None or usable.all() else usable


def _finite(image: Picture) -> Picture:
    """The picture with zero for every pixel that is no number; such pixels are masked."""
    return np.nan_to_num(image, nan=0.0, posinf=0.0, neginf=0.0) if image.dtype == np.float32 else image
