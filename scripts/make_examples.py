"""Make the two pictures in examples/: one photograph, and the same scene as a second camera might have seen it.

The second view is nearer, turned by about 30 degrees, tilted, darker, bluer and noisy. How it was made is known, so
that a test can hold the result against it. Run with `python scripts/make_examples.py`; provenance: examples/README.md.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from skimage import data

from autoalign.files.write import write_picture
from autoalign.geometry.family import fit
from autoalign.geometry.homography import shown
from autoalign.picture.warp import warp

EXAMPLES = Path(__file__).parent.parent / "examples"
MOVING_SIZE = (480, 420)
CORNERS_IN_FIXED = ((262.0, 14.0), (570.0, 176.0), (360.0, 380.0), (66.0, 231.0))  # of the moving picture, clockwise
EXPOSURE, GAMMA, TINT, NOISE = 0.85, 1.1, (0.92, 0.98, 1.1), 2.5


def true_fixed_from_moving() -> NDArray[np.float64]:
    """(3, 3), [2, 2] == 1: what an alignment of the two pictures should find."""
    right, bottom = MOVING_SIZE[0] - 1.0, MOVING_SIZE[1] - 1.0
    corners = ((0.0, 0.0), (right, 0.0), (right, bottom), (0.0, bottom))
    return shown(fit("homography", corners, CORNERS_IN_FIXED))


def second_view(fixed: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(h, w, 3) the scene of `fixed` (h, w, 3) through another lens, in other light."""
    seen = warp(fixed, MOVING_SIZE, np.linalg.inv(true_fixed_from_moving())).pixels
    light = EXPOSURE * (seen / 255.0) ** GAMMA * TINT
    noise = np.random.default_rng(0).normal(0.0, NOISE, seen.shape)
    return np.clip(np.rint(light * 255.0 + noise), 0, 255).astype(np.uint8)


def main() -> None:
    fixed = data.coffee()
    write_picture(EXAMPLES / "fixed.jpg", fixed, overwrite=True, jpeg_quality=90)
    write_picture(EXAMPLES / "moving.jpg", second_view(fixed), overwrite=True, jpeg_quality=85)


if __name__ == "__main__":
    main()
