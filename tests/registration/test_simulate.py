"""Views from other sides, and the map from each back to the picture."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from autoalign.geometry.homography import apply, invert
from autoalign.registration.simulate import views

SHAPE = (140, 230)


def noise() -> np.ndarray:
    return cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, SHAPE, dtype=np.uint8), (0, 0), 2)


def test_the_picture_itself_comes_first_and_alone_without_tilts():
    image, mask = noise(), np.full(SHAPE, 255, np.uint8)
    (only,) = views(image, mask, ())
    assert only.pixels is image
    assert only.mask is mask
    assert np.array_equal(only.picture_from_view, np.eye(3))


def test_turns_step_by_72_degrees_over_the_tilt():
    """The views of ASIFT: a half turn in steps of 72 / t degrees, that is 5 for a tilt of 2 and 10 for one of 4."""
    tilts = [view.tilt for view in views(noise(), None, (2.0, 4.0))]
    assert tilts == [1.0] + [2.0] * 5 + [4.0] * 10


@pytest.mark.parametrize("tilt", [1.5, 2.0, 4.0])
def test_every_view_is_a_turn_and_a_squeeze_by_its_tilt(tilt):
    """The scales of view_from_picture are 1 and 1 / tilt, to the rounding of the view's width to whole pixels."""
    for view in list(views(noise(), None, (tilt,)))[1:]:
        linear = invert(view.picture_from_view)
        across, along = np.linalg.svd((linear / linear[2, 2])[:2, :2], compute_uv=False)
        assert across == pytest.approx(1.0, abs=1e-9)
        assert along == pytest.approx(1 / tilt, abs=0.5 / (tilt * (view.pixels.shape[1] - 1)))
        assert np.linalg.det(view.picture_from_view) > 0


@pytest.mark.parametrize("tilt", [1.5, 3.0])
def test_the_whole_picture_is_in_every_view(tilt):
    """Centres of the corner pixels included, within half a pixel of the view's rim."""
    h, w = SHAPE
    corners = [[0, 0], [w - 1, 0], [0, h - 1], [w - 1, h - 1]]
    for view in views(noise(), None, (tilt,)):
        there = apply(invert(view.picture_from_view), corners)
        assert (there > -0.5 - 1e-9).all()
        assert (there < np.array(view.pixels.shape[::-1]) - 0.5 + 1e-9).all()


def test_points_come_back_to_the_picture():
    points = np.random.default_rng(1).uniform((0, 0), (229, 139), (50, 2))
    for view in views(noise(), None, (2.0, 4.0)):
        assert np.allclose(apply(view.picture_from_view, apply(invert(view.picture_from_view), points)), points)


@pytest.mark.parametrize("tilt", [2.0, 4.0])
def test_a_view_shows_each_point_where_its_map_says(tilt):
    """The centre of mass of a blob does not know of half pixels: it lies at the mapped centre to 0.02 px, what 8 bits
    and two bilinear interpolations leave."""
    x, y = np.meshgrid(np.arange(SHAPE[1]), np.arange(SHAPE[0]))
    centre = np.array([[121.3, 64.6]])
    blob = np.rint(250 * np.exp(-((x - centre[0, 0]) ** 2 + (y - centre[0, 1]) ** 2) / (2 * 9.0**2))).astype(np.uint8)
    for view in views(blob, None, (tilt,)):
        mass = view.pixels.astype(float)
        vx, vy = np.meshgrid(np.arange(mass.shape[1]), np.arange(mass.shape[0]))
        seen = np.array([(vx * mass).sum(), (vy * mass).sum()]) / mass.sum()
        assert np.allclose(seen, apply(invert(view.picture_from_view), centre), atol=0.02)


def test_a_squeeze_does_not_alias():
    """Stripes finer than the squeezed pixels turn grey instead of coarse."""
    stripes = np.tile(np.array([0, 0, 255, 255], np.uint8), (SHAPE[0], SHAPE[1] // 4 + 1))[:, : SHAPE[1]]
    squeezed = list(views(np.ascontiguousarray(stripes), None, (4.0,)))[1]  # the first turn is none: across the stripes
    inner = squeezed.pixels[20:-20, 5:-5].astype(float)
    assert inner.std() < 0.05 * stripes.std()
    assert inner.mean() == pytest.approx(stripes.mean(), abs=3)


def test_masks_are_seen_from_the_same_side_and_keep_off_the_rim():
    mask = np.full(SHAPE, 255, np.uint8)
    mask[:, :100] = 0
    for view in list(views(noise(), mask, (2.0,)))[1:]:
        assert view.mask is not None
        rows, columns = np.nonzero(view.mask)
        there = apply(view.picture_from_view, np.stack([columns, rows], 1))
        h, w = SHAPE
        assert (there >= [99.0, 0.0]).all()
        assert (there <= [w - 1, h - 1]).all()
        # Four pixels of the view off every edge of what is usable, so at least as many of the picture.
        assert there[:, 0].min() >= 103
        assert there[:, 1].min() >= 3
        assert len(rows) > 0.2 * view.pixels.size / 4
