"""A picture as it would look from other sides: for keypoints that survive steep viewpoints.

A camera tilted by acos(1 / t) squeezes the picture by t across its axis. The views of ASIFT: tilts t, and for each t
the turns of the axis in steps of 72 / t degrees.

Source: Morel and Yu, ASIFT, 2009; Mishkin, Matas and Perdoch, MODS, 2015 (few views first).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from autoalign.geometry.homography import IDENTITY, Array, invert, shown, translation
from autoalign.picture.pixels import size_of

_TURN_STEP = np.deg2rad(72.0)
_BLUR = 0.8  # px of Gaussian per unit of sqrt(t^2 - 1): what the squeeze would alias (Morel and Yu, 3.1)


@dataclass(frozen=True, kw_only=True)
class View:
    """One simulated view."""

    pixels: NDArray[np.uint8]
    mask: NDArray[np.uint8] | None  # 255 where the view shows the usable part of the picture; None: everywhere
    picture_from_view: Array  # (3, 3), affine
    tilt: float


def views(image: NDArray[np.uint8], mask: NDArray[np.uint8] | None, tilts: Sequence[float]) -> Iterator[View]:
    """The picture (h, w) itself, then its views under each of `tilts` (> 1)."""
    yield View(pixels=image, mask=mask, picture_from_view=IDENTITY, tilt=1.0)
    for tilt in tilts:
        for turn in np.arange(0.0, np.pi - 1e-9, _TURN_STEP / tilt):
            yield _view(image, mask, tilt, float(turn))


def _view(image: NDArray[np.uint8], mask: NDArray[np.uint8] | None, tilt: float, turn: float) -> View:
    turned_from_picture, turned_size = _turned(size_of(image), turn)
    turned = cv2.warpPerspective(image, turned_from_picture, turned_size, flags=cv2.INTER_LINEAR)
    turned = cv2.GaussianBlur(turned, (0, 0), sigmaX=_BLUR * float(np.sqrt(tilt**2 - 1)), sigmaY=0.01)
    size = (max(1, round(turned_size[0] / tilt)), turned_size[1])
    view_from_turned = np.diag([size[0] / turned_size[0], 1.0, 1.0])
    view_from_turned[0, 2] = 0.5 * view_from_turned[0, 0] - 0.5  # squeezed by edges, not by pixel centres
    view_from_picture = view_from_turned @ turned_from_picture
    pixels = cv2.warpPerspective(turned, view_from_turned, size, flags=cv2.INTER_LINEAR)
    usable = np.full(image.shape, 255, np.uint8) if mask is None else mask
    inside = cv2.warpPerspective(usable, view_from_picture, size, flags=cv2.INTER_NEAREST)
    # Keypoints at the turned picture's rim would be those of the rim.
    inside = cv2.erode(inside, np.ones((9, 9), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0)
    return View(
        pixels=np.asarray(pixels, np.uint8),
        mask=np.asarray(inside, np.uint8),
        picture_from_view=shown(invert(view_from_picture)),
        tilt=tilt,
    )


def _turned(size: tuple[int, int], turn: float) -> tuple[Array, tuple[int, int]]:
    """`turned_from_picture` of a turn that keeps a picture of `size` (w, h) whole, and the size that it takes."""
    cosine, sine = np.cos(turn), np.sin(turn)
    rotation = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    corners = np.array([[0, 0], [size[0] - 1, 0], [0, size[1] - 1], [size[0] - 1, size[1] - 1]]) @ rotation[:2, :2].T
    low = np.floor(corners.min(0))
    extent = np.ceil(corners.max(0)) - low + 1
    return translation(-low[0], -low[1]) @ rotation, (int(extent[0]), int(extent[1]))
