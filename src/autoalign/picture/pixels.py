"""What a picture is, its grey version, and its area-shrunken version with the exact coordinate map back."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

Picture = NDArray[Any]
"""Pixels (h, w) or (h, w, c) with c in 1..4: grey, grey + alpha, RGB, RGB + alpha; uint8, uint16 or float32."""


class PixelSource(Protocol):
    """A picture that is asked for its pixels box by box: an array, or a file that is read where it is asked for."""

    @property
    def shape(self) -> tuple[int, ...]:
        """(h, w) or (h, w, c)."""
        ...

    @property
    def dtype(self) -> np.dtype[Any]: ...

    def __getitem__(self, box: tuple[slice, slice], /) -> Picture:
        """The pixels in these rows and columns, whose ends lie in the picture."""
        ...


DTYPES = (np.uint8, np.uint16, np.float32)

STRIP_PIXELS = 1 << 24  # of a large picture that are held at once


@dataclass(frozen=True, kw_only=True)
class Shrunken:
    """A picture made smaller, and the transform that takes its pixels to those of the full one."""

    pixels: Picture
    full_from_small: NDArray[np.float64]  # (3, 3)


def check_picture(image: Picture, name: str = "picture") -> None:
    """Raise ValueError unless `image` is a picture as `Picture` says."""
    if not isinstance(image, np.ndarray):
        raise ValueError(f"{name} must be a uint8, uint16 or float32 array, not {type(image)}")
    check_source(image, name)


def check_source(image: PixelSource, name: str = "picture") -> None:
    """Raise ValueError unless dtype and shape are those of a picture."""
    if image.dtype not in DTYPES:
        raise ValueError(f"{name} must be a uint8, uint16 or float32 array, not {image.dtype}")
    if len(image.shape) not in (2, 3) or not 1 <= (*image.shape, 1)[2] <= 4:
        raise ValueError(f"{name} must have shape (h, w) or (h, w, 1..4), not {image.shape}")
    if 0 in image.shape:
        raise ValueError(f"{name} has no pixels: shape {image.shape}")


def size_of(image: PixelSource) -> tuple[int, int]:
    """(w, h) of a picture."""
    return image.shape[1], image.shape[0]


def has_alpha(image: PixelSource) -> bool:
    """True if the last channel is an opacity."""
    return len(image.shape) == 3 and image.shape[2] in (2, 4)


def full_scale(image: PixelSource) -> float:
    """The value that stands for full opacity, and for white: 1 for float32, else the largest of the dtype."""
    return 1.0 if image.dtype == np.float32 else float(np.iinfo(image.dtype).max)


def opaque(image: Picture) -> NDArray[np.bool_] | None:
    """(h, w) True where an alpha channel is not zero; None for a picture without one."""
    return image[..., -1] > 0 if has_alpha(image) else None


def grey(image: Picture) -> Picture:
    """(h, w) luminance (ITU-R BT.601) in the picture's own dtype; alpha is dropped."""
    if image.ndim == 2:
        return image
    if image.shape[2] < 3:
        return np.ascontiguousarray(image[..., 0])
    code = cv2.COLOR_RGBA2GRAY if image.shape[2] == 4 else cv2.COLOR_RGB2GRAY
    return np.asarray(cv2.cvtColor(image, code))


def in_colour(image: Picture) -> Picture:
    """(h, w, 3) or (h, w, 4): grey repeated for red, green and blue, alpha kept; what is RGB comes back as it is."""
    if image.ndim == 3 and image.shape[2] > 2:
        return image
    if image.ndim == 2:
        return np.stack([image] * 3, axis=-1)
    return np.concatenate([image[..., :1]] * 3 + [image[..., 1:]], axis=-1)


def to_8_bit(image: Picture) -> NDArray[np.uint8]:
    """(h, w) grey as uint8: 8-bit as it is, others stretched between their 0.1 and 99.9 percentiles.

    Values that are not finite count as the darkest.
    """
    if image.dtype == np.uint8:
        return image
    values = np.nan_to_num(image.astype(np.float32), nan=0.0, posinf=0.0, neginf=0.0)
    low, high = np.percentile(values, (0.1, 99.9))
    stretched = (values - low) * (255.0 / max(float(high - low), 1e-12))
    return np.asarray(np.clip(np.rint(stretched), 0, 255).astype(np.uint8))


def resize_map(full_size: tuple[int, int], small_size: tuple[int, int]) -> NDArray[np.float64]:
    """(3, 3) `full_from_small` of a resize between two sizes (w, h).

    `cv2.resize` aligns the edges of the pictures, not the centres of their corner pixels, which puts half a pixel on
    either side: x_full = (x_small + 0.5) * W / w - 0.5.
    """
    sx, sy = full_size[0] / small_size[0], full_size[1] / small_size[1]
    return np.array([[sx, 0.0, 0.5 * sx - 0.5], [0.0, sy, 0.5 * sy - 0.5], [0.0, 0.0, 1.0]])


def shrink(image: Picture, max_pixels: float) -> Shrunken:
    """Shrink by area to at most `max_pixels`; a smaller picture comes back as it is."""
    w, h = size_of(image)
    scale = min(1.0, (max_pixels / (w * h)) ** 0.5)
    return _shrink_to(image, (max(1, round(w * scale)), max(1, round(h * scale))))


def shrink_by(image: Picture, factor: float) -> Shrunken:
    """Shrink by area to sides `factor` times smaller, rounded to whole pixels; by 1 it comes back as it is."""
    w, h = size_of(image)
    return _shrink_to(image, (max(1, round(w / factor)), max(1, round(h / factor))))


def halve(image: Picture) -> Shrunken:
    """Means of 2 x 2 pixels; a last odd row or column is left out, and one that is alone is doubled.

    A twentieth of the time of a shrink to any size, and exact in whole pixels.
    """
    h, w = image.shape[:2]
    even = image[: max(h & ~1, 1), : max(w & ~1, 1)]
    pixels = cv2.resize(even, (max(w // 2, 1), max(h // 2, 1)), interpolation=cv2.INTER_AREA)
    return Shrunken(pixels=np.asarray(pixels), full_from_small=resize_map(size_of(even), size_of(pixels)))


def working_copy(source: PixelSource, max_pixels: float) -> Shrunken:
    """A source that may be too large for memory, made smaller by a whole number: means over its squares.

    At most `max_pixels` come back, unless the picture is thinner than that number. What is left over at the right and
    at the bottom, less than a square, is left out. Every pixel is asked for once, from the top to the bottom.
    """
    w, h = size_of(source)
    factor = max(1, int(np.ceil((w * h / max_pixels) ** 0.5)))
    factor = min(factor, w, h)
    small_size = w // factor, h // factor
    strips = [
        cv2.resize(source[rows, slice(0, small_size[0] * factor)], (small_size[0], count), interpolation=cv2.INTER_AREA)
        for rows, count in _whole_strips(small_size, factor)
    ]
    covered = small_size[0] * factor, small_size[1] * factor
    return Shrunken(pixels=np.concatenate(strips), full_from_small=resize_map(covered, small_size))


def _whole_strips(small_size: tuple[int, int], factor: int) -> Iterator[tuple[slice, int]]:
    """Rows of the full picture that make whole rows of the small one, and how many they make."""
    at_once = max(1, STRIP_PIXELS // (small_size[0] * factor * factor))
    for row in range(0, small_size[1], at_once):
        count = min(at_once, small_size[1] - row)
        yield slice(row * factor, (row + count) * factor), count


def _shrink_to(image: Picture, size: tuple[int, int]) -> Shrunken:
    full_size = size_of(image)
    pixels = image if size == full_size else cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return Shrunken(pixels=np.asarray(pixels), full_from_small=resize_map(full_size, size))
