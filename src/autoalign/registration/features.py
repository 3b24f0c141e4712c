"""Picture -> Features: keypoints in full-resolution pixels, and descriptors. The only file that knows cv2.KeyPoint.

OpenCV's biases are removed here, so that a picture turned by half a turn gives points that are exact mirror images:
SIFT needs `enable_precise_upscale` (0.25 px otherwise, opencv#23123), ORB maps pyramid levels back as if their corners,
not their edges, were aligned (up to 2 px), and the shrunken working picture has its own map (`pixels.resize_map`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from autoalign.geometry.homography import Array, Mask, apply
from autoalign.picture.pixels import resize_map, shrink, size_of
from autoalign.registration.simulate import views

Detector = Literal["orb", "sift"]
DETECTORS: tuple[Detector, ...] = get_args(Detector)

_ORB_STEP = 1.2  # from one pyramid level of ORB to the next
_SIFT_NORM = 2800.0  # a RootSIFT descriptor of this length, rounded: squared distances of two stay under 2**24


@dataclass(frozen=True, kw_only=True)
class FeatureOptions:
    """What to look for in a picture, and at which size."""

    detector: Detector = "sift"
    """sift finds more under blur and turns of view, orb is ten times faster"""
    working_pixels: float = 1e6
    """larger pictures are shrunken to this many pixels"""
    max_features: int = 4000
    """kept, spread over the picture"""
    contrast: float = 0.02
    """sift: least contrast of a keypoint (0.04 is OpenCV's default)"""
    root: bool = True
    """sift: compare square roots of the histograms (RootSIFT)"""
    tilts: tuple[float, ...] = ()
    """look at the picture as from the side too, squeezed by these factors (ASIFT)"""
    equalise: bool = False
    """even out the contrast of every part of the picture first (CLAHE)"""

    def __post_init__(self) -> None:
        if self.detector not in DETECTORS or self.working_pixels < 1 or self.max_features < 1 or self.contrast <= 0:
            raise ValueError(f"FeatureOptions out of range: {self}")


@dataclass(frozen=True, kw_only=True)
class Features:
    """Keypoints of one picture, the strongest of each part of it first."""

    points: Array  # (n, 2) px of the full picture
    sizes: Array  # (n,) diameter of the described patch, px of the full picture
    angles: Array  # (n,) orientation, radians
    sigmas: Array  # (n,) expected error of a point, px of the full picture
    descriptors: NDArray[np.float32]  # (n, d) whole numbers whose squared distances are exact in float32
    detector: Detector

    def __len__(self) -> int:
        return len(self.points)


def detect(image: NDArray[np.uint8], options: FeatureOptions, valid: Mask | None = None) -> Features:
    """Features of an 8-bit grey picture (h, w), none of them where `valid` (h, w) is False.

    Arandjelovic and Zisserman 2012 (RootSIFT); Lowe 2004; Rublee et al. 2011.
    """
    small = shrink(image, options.working_pixels)
    pixels = cv2.createCLAHE(4.0, (8, 8)).apply(small.pixels) if options.equalise else small.pixels
    mask = None if valid is None else _shrink_mask(valid, size_of(pixels))
    find = _sift if options.detector == "sift" else _orb
    found = []
    for view in views(np.asarray(pixels, np.uint8), mask, options.tilts):
        share = replace(options, max_features=max(1, round(options.max_features / view.tilt)))
        found.append(
            _in_full_pixels(find(view.pixels, share, view.mask), small.full_from_small @ view.picture_from_view)
        )
    return found[0] if len(found) == 1 else _pooled(found)


def threads() -> int:
    """How many threads the work on pictures may take: as many as cv2 was told."""
    return cv2.getNumThreads()


def with_reversed_contrast(features: Features) -> Features:
    """The SIFT features, and each as it would be found in the picture's negative.

    A negative turns every gradient round, and with them the keypoint's own angle: the histograms of the 4 x 4 cells
    stay as they are, but the cells change places by half a turn.
    """
    if features.detector != "sift":
        raise ValueError(f"only features of sift can have their contrast reversed, not those of {features.detector}")
    cells = features.descriptors.reshape(-1, 4, 4, 8)[:, ::-1, ::-1]
    negative = replace(features, descriptors=cells.reshape(-1, 128), angles=features.angles + np.pi)
    return _pooled([features, negative])


def _shrink_mask(valid: Mask, size: tuple[int, int]) -> NDArray[np.uint8]:
    """255 where every pixel under a small one is valid."""
    if size_of(valid) == size:
        return valid.astype(np.uint8) * 255
    share = cv2.resize(valid.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return (share > 0.999).astype(np.uint8) * 255


def _pooled(found: Sequence[Features]) -> Features:
    """The features of all views as those of one picture."""

    def joined(name: str) -> NDArray[Any]:
        return np.concatenate([getattr(features, name) for features in found])

    return Features(
        points=joined("points"),
        sizes=joined("sizes"),
        angles=joined("angles"),
        sigmas=joined("sigmas"),
        descriptors=joined("descriptors"),
        detector=found[0].detector,
    )


def _in_full_pixels(found: Features, full_from_small: Array) -> Features:
    pixel = float(np.sqrt(np.linalg.det(full_from_small[:2, :2])))
    return Features(
        points=apply(full_from_small, found.points),
        sizes=found.sizes * pixel,
        angles=found.angles,
        sigmas=found.sigmas * pixel,
        descriptors=found.descriptors,
        detector=found.detector,
    )


def _spread(keypoints: Sequence[cv2.KeyPoint], size: tuple[int, int], count: int) -> NDArray[np.int64]:
    """Indices of at most `count` keypoints: the strongest of every cell of a grid, then the second of every cell, etc.

    The order is total, so that it does not depend on the order in which threads delivered them.
    """
    if not keypoints:
        return np.zeros(0, np.int64)
    xy = np.array([k.pt for k in keypoints])
    key = np.array([(-k.response, k.pt[1], k.pt[0], k.octave, k.angle) for k in keypoints])
    order = np.lexsort(key.T[::-1])
    cell_px = max(8.0, np.sqrt(size[0] * size[1] * 8 / count))
    columns = int(size[0] / cell_px) + 1
    cells = (xy[order] // cell_px).astype(np.int64) @ np.array([1, columns])
    by_cell = np.argsort(cells, kind="stable")
    starts = np.flatnonzero(np.diff(cells[by_cell], prepend=-1))
    rank = np.empty(len(order), np.int64)
    rank[by_cell] = np.arange(len(order)) - np.repeat(starts, np.diff(np.append(starts, len(order))))
    return order[np.argsort(rank, kind="stable")[:count]]


def _sift(image: NDArray[np.uint8], options: FeatureOptions, mask: NDArray[np.uint8] | None) -> Features:
    # Twice as many as wanted are described, and the best of every part kept: describing only those would build the
    # pyramid a second time, which costs more.
    sift = cv2.SIFT.create(2 * options.max_features, contrastThreshold=options.contrast, enable_precise_upscale=True)
    keypoints, raw = sift.detectAndCompute(image, mask)
    chosen = _spread(keypoints, size_of(image), options.max_features)
    described = np.asarray(np.zeros((0, 128)) if raw is None else raw[chosen], np.float32)
    points, sizes, angles = _columns([keypoints[i] for i in chosen])
    return Features(
        points=points,
        sizes=sizes,
        angles=angles,
        sigmas=np.ones(len(points)),
        descriptors=_whole_descriptors(described, options.root),
        detector="sift",
    )


def _whole_descriptors(raw: NDArray[np.float32], root: bool) -> NDArray[np.float32]:
    """(n, 128) of length 4000, rounded to whole numbers.

    Sums of whole numbers under 2**24 are exact in float32 in any order: so the matches do not depend on the number of
    threads of the matrix product, and the rounding (1e-4 of the length) changes no ratio that matters.
    """
    rooted = np.sqrt(raw) if root else raw
    lengths = np.linalg.norm(rooted, axis=1, keepdims=True)
    return np.asarray(np.floor(rooted * (_SIFT_NORM / np.maximum(lengths, 1e-6)) + 0.5).astype(np.float32))


def _orb(image: NDArray[np.uint8], options: FeatureOptions, mask: NDArray[np.uint8] | None) -> Features:
    # Three times as many as wanted: ORB keeps the strongest of the whole picture, `_spread` those of every part of it.
    orb = cv2.ORB.create(nfeatures=3 * options.max_features, scaleFactor=_ORB_STEP, fastThreshold=7)
    # Smaller pictures have no room for its patches and make it fail.
    found = orb.detectAndCompute(image, mask) if min(image.shape) >= 64 else ((), None)
    chosen = _spread(found[0], size_of(image), options.max_features)
    bits = np.asarray(np.zeros((0, 32)) if found[1] is None else found[1][chosen], np.uint8)
    keypoints = [found[0][i] for i in chosen]
    points, sizes, angles = _columns(keypoints)
    octaves = np.array([k.octave for k in keypoints], np.int64)
    return Features(
        points=_from_pyramid(points, octaves, size_of(image)),
        sizes=sizes,
        angles=angles,
        sigmas=np.asarray(_ORB_STEP**octaves, np.float64),
        descriptors=np.unpackbits(bits, axis=1).astype(np.float32) * 2 - 1,
        detector="orb",
    )


def _from_pyramid(points: Array, octaves: NDArray[np.int64], size: tuple[int, int]) -> Array:
    """Undo ORB's product with the scale and go from the level's pixels to the picture's by their common edges."""
    out = np.empty_like(points)
    for octave in np.unique(octaves):
        at, scale = octaves == octave, _ORB_STEP**octave
        picture_from_level = resize_map(size, _level_size(size, int(octave)))
        out[at] = points[at] / scale * picture_from_level[(0, 1), (0, 1)] + picture_from_level[:2, 2]
    return out


def _level_size(size: tuple[int, int], octave: int) -> tuple[int, int]:
    """(w, h) of a level of ORB's pyramid, rounded from single precision as cv2 does it, which decides ties."""
    inverse = np.float32(1) / np.float32(float(np.float32(_ORB_STEP)) ** octave)
    w, h = np.rint(np.array(size, np.float32) * inverse).astype(int)
    return int(w), int(h)


def _columns(keypoints: Sequence[cv2.KeyPoint]) -> tuple[Array, Array, Array]:
    """Points (n, 2), sizes (n,) and angles in radians (n,) of cv2 keypoints."""
    points = np.array([k.pt for k in keypoints], np.float64).reshape(-1, 2)
    sizes = np.array([k.size for k in keypoints], np.float64)
    return points, sizes, np.deg2rad(np.array([k.angle for k in keypoints], np.float64))
