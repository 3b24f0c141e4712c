"""Do the pixels under the overlay agree, and where? What a shared caption or logo cannot fake.

The overlap is cut into blocks; a block agrees if the two pictures correlate in it better than nearly all blocks do with
a block from elsewhere. True overlays agree all over, two pictures with one caption only under the caption.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from autoalign.geometry.homography import Array, Mask, jacobian, project, translation
from autoalign.geometry.uncertainty import overlap_points
from autoalign.picture.pixels import halve, shrink_by, size_of
from autoalign.picture.warp import warp

_OVERLAY_PIXELS = 0.1e6  # the overlap is looked at in so many pixels: coarse, so that a pixel or two do not matter
_BLOCK = 12  # px of the overlay
_FLAT = 3.0  # grey levels of standard deviation under which a block shows nothing
_SHIFTS = 40  # block orders that make the chance distribution
_PARTS = 4  # parts of the overlap, each way
_CHANCE = 0.05  # share of blocks that agree by chance

_Float = NDArray[np.float32]


@dataclass(frozen=True, kw_only=True)
class Agreement:
    """Blocks of the overlap that can tell, and those that agree."""

    blocks: int  # with structure in either picture
    agreeing: int  # of them, that correlate better than 19 in 20 by chance
    share: float  # of the blocks that agree, in the middle one of the parts of the overlap: a caption fills few parts
    core: float  # the same for the parts that do not touch the rim: a frame fills none of them
    correlation: float  # mean over the blocks, -1 to 1; of gradients where those agree better


NO_AGREEMENT = Agreement(blocks=0, agreeing=0, share=0.0, core=0.0, correlation=0.0)


def agreement(
    fixed: NDArray[np.uint8],
    moving: NDArray[np.uint8],
    fixed_from_moving: Array,
    fixed_valid: Mask | None = None,
    moving_valid: Mask | None = None,
) -> Agreement:
    """How far two 8-bit grey pictures (h, w) agree under a (3, 3) transform, where both are valid."""
    inside = overlap_points(fixed_from_moving, size_of(moving), size_of(fixed))
    if len(inside) < 4:
        return NO_AGREEMENT
    overlay = _overlay(fixed, moving, fixed_from_moving, inside, fixed_valid, moving_valid)
    if overlay is None:
        return NO_AGREEMENT
    looks = (_compare(*overlay), _compare(_edges(overlay[0]), _edges(overlay[1]), overlay[2]))
    return max(looks, key=lambda look: look.share)


def _overlay(
    fixed: NDArray[np.uint8],
    moving: NDArray[np.uint8],
    fixed_from_moving: Array,
    inside: Array,
    fixed_valid: Mask | None,
    moving_valid: Mask | None,
) -> tuple[_Float, _Float, Mask] | None:
    """Both pictures over the overlap, at the same coarse resolution, and where both have data."""
    there, _ = project(fixed_from_moving, inside)
    w, h = size_of(fixed)
    x0, y0 = np.clip(np.floor(there.min(0)), 0, (w - 1, h - 1)).astype(int)
    x1, y1 = np.clip(np.ceil(there.max(0)), 0, (w - 1, h - 1)).astype(int) + 1
    factor = max(1.0, float(np.sqrt((x1 - x0) * (y1 - y0) / _OVERLAY_PIXELS)))
    if min(x1 - x0, y1 - y0) < 2 * _BLOCK * factor:
        return None
    small_fixed, crop_from_small = _smaller(fixed[y0:y1, x0:x1], factor)
    zoom = float(np.median(np.sqrt(np.abs(np.linalg.det(jacobian(fixed_from_moving, inside))))))
    small_moving, moving_from_small = _smaller(moving, max(1.0, factor / max(zoom, 1e-6)))
    small_from_moving = np.linalg.inv(crop_from_small) @ translation(-x0, -y0) @ fixed_from_moving
    warped = warp(small_moving, size_of(small_fixed), small_from_moving @ moving_from_small)
    valid = warped.valid
    if fixed_valid is not None:
        crop = fixed_valid[y0:y1, x0:x1].astype(np.uint8)
        valid &= cv2.resize(crop, size_of(small_fixed), interpolation=cv2.INTER_NEAREST) > 0
    if moving_valid is not None:
        usable = moving_valid.astype(np.uint8)
        valid &= warp(usable, size_of(small_fixed), small_from_moving, interpolation="nearest").pixels > 0
    return small_fixed, warped.pixels, valid


def _smaller(image: NDArray[np.uint8], factor: float) -> tuple[_Float, Array]:
    """The picture smaller and smoothed, and the (3, 3) map back to its own pixels."""
    # Whole grey levels do as long as the mean of several pixels is still to be taken of them; halving is fast.
    picture_from_half = np.eye(3)
    while factor >= 4.0:
        half = halve(image)
        image, picture_from_half, factor = half.pixels, picture_from_half @ half.full_from_small, factor / 2
    small = shrink_by(image.astype(np.float32), factor)
    return np.asarray(cv2.GaussianBlur(small.pixels, (0, 0), 0.7)), picture_from_half @ small.full_from_small


def _edges(image: _Float) -> _Float:
    """Gradient magnitude: the same for opposite contrasts."""
    return np.asarray(cv2.magnitude(cv2.Sobel(image, cv2.CV_32F, 1, 0), cv2.Sobel(image, cv2.CV_32F, 0, 1)) / 4)


def _blocks(image: NDArray[np.generic]) -> NDArray[np.generic]:
    """(n, block x block) the whole blocks of a picture (h, w)."""
    rows, columns = image.shape[0] // _BLOCK, image.shape[1] // _BLOCK
    cut = image[: rows * _BLOCK, : columns * _BLOCK].reshape(rows, _BLOCK, columns, _BLOCK)
    return np.asarray(cut.transpose(0, 2, 1, 3).reshape(rows * columns, _BLOCK * _BLOCK))


def _means(a: _Float, b: _Float) -> _Float:
    """(n,) mean products of blocks (n, pixels); without BLAS, whose bits depend on the number of threads."""
    return np.asarray(np.einsum("ij,ij->i", a, b) / np.float32(a.shape[1]))


def _compare(fixed: _Float, moving: _Float, valid: Mask) -> Agreement:
    whole = np.flatnonzero(np.asarray(_blocks(valid)).all(1))
    a, b = (np.asarray(_blocks(p), np.float32)[whole] for p in (fixed, moving))
    a_contrast, b_contrast = a.std(1), b.std(1)
    told = np.maximum(a_contrast, b_contrast) > _FLAT
    a, b, a_contrast, b_contrast = a[told], b[told], a_contrast[told], b_contrast[told]
    if len(a) < 8:
        return NO_AGREEMENT
    # A contrast of one grey level stands for the noise, so that a flat block does not agree with a rich one.
    a = (a - a.mean(1, keepdims=True)) / np.hypot(a_contrast, 1.0)[:, None]
    b = (b - b.mean(1, keepdims=True)) / np.hypot(b_contrast, 1.0)[:, None]
    correlation = _means(a, b)
    shifts = np.unique(np.linspace(1, len(a) - 1, _SHIFTS).astype(int))
    twice = np.concatenate([b, b])
    by_chance = np.concatenate([_means(a, twice[s : s + len(b)]) for s in shifts])
    agreeing = correlation > np.quantile(by_chance, 1.0 - _CHANCE)
    share, core = _shares(agreeing, np.stack(np.divmod(whole[told], fixed.shape[1] // _BLOCK), 1))
    return Agreement(
        blocks=len(a),
        agreeing=int(agreeing.sum()),
        share=share,
        core=core,
        correlation=float(correlation.mean()),
    )


def _shares(agreeing: Mask, places: NDArray[np.int64]) -> tuple[float, float]:
    """The share of blocks that agree in the middle one of the parts of the overlap, and in the middle one of those
    parts that do not touch its rim; `places` (n, 2) are rows and columns."""
    low, high = places.min(0), places.max(0) + 1
    part = (places - low) * _PARTS // (high - low)
    index = part[:, 0] * _PARTS + part[:, 1]
    counts = np.bincount(index, minlength=_PARTS**2).reshape(_PARTS, _PARTS)
    shares = np.bincount(index, agreeing, minlength=_PARTS**2).reshape(_PARTS, _PARTS) / np.maximum(counts, 1)
    telling = counts >= min(4, counts.max())
    inner = telling.copy()
    inner[(0, -1), :] = inner[:, (0, -1)] = False
    everywhere = float(np.median(shares[telling]))
    return everywhere, float(np.median(shares[inner])) if inner.any() else everywhere
