"""A picture drawn strip by strip is the picture drawn at once."""

from __future__ import annotations

import numpy as np
import pytest

from autoalign.registration.drawing import Drawing, draw, draw_in_strips

TRANSFORM = np.array([[0.9, -0.2, 30.0], [0.25, 1.1, -12.0], [1e-4, 2e-4, 1.0]])


@pytest.mark.parametrize("canvas", ["fixed", "union", "inner"])
@pytest.mark.parametrize("border", ["constant", "transparent"])
@pytest.mark.parametrize("interpolation", ["linear", "nearest"])
def test_strips_are_those_of_the_whole(canvas, border, interpolation):
    moving = np.random.default_rng(1).integers(0, 256, (140, 190, 3), np.uint8)
    drawing = Drawing(canvas=canvas, border=border)
    whole = draw(moving, (170, 130), TRANSFORM, drawing, interpolation=interpolation)
    transform = whole.frame.canvas_from_fixed @ TRANSFORM
    strips = list(draw_in_strips(moving, whole.frame.size, transform, drawing, 32, interpolation))
    assert all(strip.pixels.shape[0] == 32 for strip in strips[:-1])
    assert np.array_equal(np.concatenate([strip.valid for strip in strips]), whole.warped.valid)
    difference = np.concatenate([strip.pixels for strip in strips]).astype(int) - whole.warped.pixels
    # Rounding of places differs by tiles: now and then a pixel by one level, or its neighbour at a tie.
    assert (difference != 0).mean() < 1e-3
    assert interpolation == "nearest" or np.abs(difference).max() <= 1


def test_no_strip_knows_the_nearest_pixel():
    drawing = Drawing(border="replicate")
    with pytest.raises(ValueError, match="in another strip"):
        next(draw_in_strips(np.zeros((4, 5), np.uint8), (5, 4), np.eye(3), drawing, 2))
