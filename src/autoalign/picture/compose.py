"""Two pictures in one frame, made one for the eye.

Every style takes the fixed and the moving picture as 8-bit (h, w) or (h, w, 3), both alike and black where they have no
data, and the two masks (h, w) of where they have. `compose` makes that of any two pictures and looks the style up.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from autoalign.picture.pixels import Picture, check_picture, grey, has_alpha, in_colour, opaque

Pixels = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Style = Callable[[Pixels, Pixels, Mask, Mask], Pixels]

# Cells of the checkerboard along the longer side of where the pictures overlap.
CELLS = 12

# A difference is brightened until its brightest hundredth is white, but at most this many times: noise stays dark.
MAX_GAIN = 4.0

# The stretch of 16-bit and float pictures is measured on about this many pixels.
SAMPLED_PIXELS = 1_000_000


def compose(
    style: str, fixed: Picture, moving: Picture, fixed_valid: Mask | None = None, moving_valid: Mask | None = None
) -> Pixels:
    """One uint8 picture, (h, w) or (h, w, 3), of two in the same frame (h, w); masks (h, w) are True where data is.

    RGB if either is. Pictures of other depths are stretched, each by itself, between the 0.1 and 99.9 percentiles of
    its data, all channels alike so that colours stay. Without a mask all is data but what alpha hides.

    Raises ValueError for an unknown style or pictures and masks of different sizes.
    """
    if style not in STYLES:
        raise ValueError(f"style must be one of {', '.join(STYLES)}, not {style!r}")
    check_picture(fixed, "fixed")
    check_picture(moving, "moving")
    if fixed.shape[:2] != moving.shape[:2]:
        raise ValueError(f"one frame is needed, but fixed is {fixed.shape[:2]} and moving {moving.shape[:2]}")
    fixed_data, moving_data = _data(fixed, fixed_valid), _data(moving, moving_valid)
    fixed_shown, moving_shown = _shown(fixed, fixed_data), _shown(moving, moving_data)
    if fixed_shown.ndim != moving_shown.ndim:
        fixed_shown, moving_shown = in_colour(fixed_shown), in_colour(moving_shown)
    return STYLES[style](fixed_shown, moving_shown, fixed_data, moving_data)


def mean(fixed: Pixels, moving: Pixels, fixed_valid: Mask, moving_valid: Mask) -> Pixels:
    """The mean where both have data, elsewhere the one that has."""
    # Where one has no data it is black, so that the sum is the other.
    sole = np.asarray(cv2.add(fixed, moving), np.uint8)
    return _chosen(fixed_valid & moving_valid, cv2.addWeighted(fixed, 0.5, moving, 0.5, 0), sole)


def checkerboard(fixed: Pixels, moving: Pixels, fixed_valid: Mask, moving_valid: Mask) -> Pixels:
    """Squares of one and the other by turns, the fixed one first; where one has no data, the other."""
    h, w = fixed_valid.shape
    cell = _cell(fixed_valid & moving_valid)
    turns = (np.arange(h) // cell)[:, None] + np.arange(w) // cell
    take_fixed = (fixed_valid & (turns % 2 == 0)) | ~moving_valid
    return _chosen(take_fixed, fixed, moving)


def difference(fixed: Pixels, moving: Pixels, fixed_valid: Mask, moving_valid: Mask) -> Pixels:
    """The absolute difference where both have data, brightened up to `MAX_GAIN` times; black elsewhere."""
    both = fixed_valid & moving_valid
    values = _chosen(both, cv2.absdiff(fixed, moving))
    sample = _sample(values, both)
    bright = float(np.percentile(sample, 99)) if sample.size else 0.0
    gain = float(np.clip(255 / max(bright, 1.0), 1.0, MAX_GAIN))
    return np.asarray(cv2.convertScaleAbs(values, alpha=gain), np.uint8)


def red_cyan(fixed: Pixels, moving: Pixels, fixed_valid: Mask, moving_valid: Mask) -> Pixels:
    """The fixed one's luminance in red, the moving one's in green and blue: grey where they agree.

    The moving one takes the brightness and contrast that the fixed one has where they overlap: a longer exposure is no
    disagreement.
    """
    red, cyan = grey(fixed), grey(moving)
    both = fixed_valid & moving_valid
    if both.any():
        cyan = _chosen(moving_valid, _exposed_like(red[both], cyan, cyan[both]))
    return np.stack([red, cyan, cyan], axis=-1)


def side_by_side(fixed: Pixels, moving: Pixels, fixed_valid: Mask, moving_valid: Mask) -> Pixels:
    """(h, 2 w): the fixed one on the left, the moving one on the right."""
    return np.concatenate([fixed, moving], axis=1)


STYLES: dict[str, Style] = {
    "mean": mean,
    "checkerboard": checkerboard,
    "difference": difference,
    "red-cyan": red_cyan,
    "side-by-side": side_by_side,
}


def _data(picture: Picture, valid: Mask | None) -> Mask:
    """(h, w) True where a picture has data that is not hidden by alpha."""
    if valid is not None and valid.shape != picture.shape[:2]:
        raise ValueError(f"a mask is {valid.shape}, its picture {picture.shape[:2]}")
    data = np.ones(picture.shape[:2], bool) if valid is None else valid
    seen = opaque(picture)
    return data if seen is None else data & seen


def _shown(picture: Picture, valid: Mask) -> Pixels:
    """(h, w) or (h, w, 3) as uint8, black where there is no data."""
    colours = picture[..., :-1] if has_alpha(picture) else picture
    if colours.shape[2:] == (1,):
        colours = colours[..., 0]
    eight_bit = colours if colours.dtype == np.uint8 else _stretched(colours, valid)
    return _chosen(valid, eight_bit)


def _stretched(colours: Picture, valid: Mask) -> Pixels:
    """As `pixels.to_8_bit`, but by the data alone: what is painted around it must not move the ends of the stretch."""
    sample = _sample(colours, valid)
    sample = sample[np.isfinite(sample)]
    low, high = np.percentile(sample, (0.1, 99.9)).tolist() if sample.size else (0.0, 1.0)
    values = np.nan_to_num(colours.astype(np.float32), copy=False, nan=low, posinf=high, neginf=low)
    values -= low
    values *= 255.0 / max(high - low, 1e-12)
    return np.rint(np.clip(values, 0, 255, out=values), out=values).astype(np.uint8)


def _sample(picture: Picture, valid: Mask) -> Picture:
    """(n,) or (n, 3) every so many of the pixels that are data."""
    step = max(1, round((valid.size / SAMPLED_PIXELS) ** 0.5))
    thinned: Picture = picture[::step, ::step][valid[::step, ::step]]
    return thinned


def _cell(overlap: Mask) -> int:
    """Side of a checkerboard's cell in pixels."""
    rows, columns = np.flatnonzero(overlap.any(axis=1)), np.flatnonzero(overlap.any(axis=0))
    longer = max(np.ptp(rows), np.ptp(columns)) + 1 if len(rows) else max(overlap.shape)
    return max(1, round(longer / CELLS))


def _exposed_like(model: Pixels, picture: Pixels, sample: Pixels) -> Pixels:
    """`picture` (h, w) with the gain and offset that give its `sample` (n,) the mean and spread of `model` (n,)."""
    gain = float(np.clip(model.std() / max(sample.std(), 1.0), 1 / MAX_GAIN, MAX_GAIN))
    levels = np.rint((np.arange(256) - sample.mean()) * gain + model.mean())
    return np.asarray(cv2.LUT(picture, np.clip(levels, 0, 255).astype(np.uint8)), np.uint8)


def _chosen(mask: Mask, where: Picture, elsewhere: Pixels | None = None) -> Pixels:
    """`where` where the mask is True, `elsewhere` or black where not; ten times as fast as np.where for RGB."""
    base = np.zeros_like(where) if elsewhere is None else elsewhere.copy()
    return np.asarray(cv2.copyTo(where, np.ascontiguousarray(mask).view(np.uint8), base), np.uint8)
