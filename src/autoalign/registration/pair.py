"""Both pictures of a pair in grey, prepared once for all attempts."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from autoalign.geometry.homography import Mask
from autoalign.picture.pixels import Picture, check_picture, grey, opaque, size_of, to_8_bit
from autoalign.registration.verdict import Sizes


@dataclass(frozen=True, kw_only=True)
class Pair:
    """Two pictures, and where each may be used."""

    fixed: Picture  # (h, w), own depth
    moving: Picture
    fixed_8_bit: NDArray[np.uint8]
    moving_8_bit: NDArray[np.uint8]
    masks: tuple[Mask | None, Mask | None]  # fixed, moving; True where usable, None where all is

    def mirrored(self) -> Pair:
        """The pair with its moving picture mirrored, left to right."""
        fixed_mask, mask = self.masks
        return replace(
            self,
            moving=np.ascontiguousarray(self.moving[:, ::-1]),
            moving_8_bit=np.ascontiguousarray(self.moving_8_bit[:, ::-1]),
            masks=(fixed_mask, None if mask is None else np.ascontiguousarray(mask[:, ::-1])),
        )

    @property
    def sizes(self) -> Sizes:
        return Sizes(fixed=size_of(self.fixed), moving=size_of(self.moving))


def prepare(fixed: Picture, moving: Picture, fixed_valid: Mask | None, moving_valid: Mask | None) -> Pair:
    """Check the pictures and masks that `align` was given, and bring them to grey; ValueError if they are none."""
    check_picture(fixed, "fixed")
    check_picture(moving, "moving")
    masks = _usable(fixed, fixed_valid, "fixed_valid"), _usable(moving, moving_valid, "moving_valid")
    fixed_grey, moving_grey = _finite(grey(fixed)), _finite(grey(moving))
    return Pair(
        fixed=fixed_grey,
        moving=moving_grey,
        fixed_8_bit=to_8_bit(fixed_grey),
        moving_8_bit=to_8_bit(moving_grey),
        masks=masks,
    )


def _usable(image: Picture, valid: Mask | None, name: str) -> Mask | None:
    """The mask, less what the picture's own alpha hides and what is no number; None where every pixel may be used."""
    if valid is not None and valid.shape != image.shape[:2]:
        raise ValueError(f"{name} has shape {valid.shape}, its picture {image.shape[:2]}")
    parts = [np.isfinite(grey(image))] if image.dtype == np.float32 else []
    parts += [part.astype(bool) for part in (valid, opaque(image)) if part is not None]
    usable = np.logical_and.reduce(parts) if parts else None
    return None if usable is None or usable.all() else usable


def _finite(image: Picture) -> Picture:
    """The picture with zero for every pixel that is no number; such pixels are masked."""
    return np.nan_to_num(image, nan=0.0, posinf=0.0, neginf=0.0) if image.dtype == np.float32 else image
