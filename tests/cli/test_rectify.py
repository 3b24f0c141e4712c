"""`autoalign rectify`: a plane seen upright."""

from __future__ import annotations

import numpy as np
import pytest

import autoalign as aa
from autoalign.files.points import PLANE_POINTS

# A page of 20 x 30 cm, seen at an angle.
PAGE = [[0, 0, 100, 50], [20, 0, 420, 90], [20, 30, 470, 380], [0, 30, 60, 330]]


@pytest.fixture
def page(pictures):
    aa.write_points("page.csv", PAGE, PLANE_POINTS)
    return pictures


def test_the_picture_keeps_its_width_or_takes_the_scale(page, run):
    outcome = run("rectify", "fixed.jpg", "--points", "page.csv")
    assert outcome.code == 0
    assert outcome.out.startswith("rectified: 4 points, 600 x ")
    assert aa.read_picture("fixed_rectified.jpg").pixels.shape[1] == 600
    scaled = run("rectify", "fixed.jpg", "--points", "page.csv", "--scale", "7.5", "-o", "scaled.png")
    assert "7.5 pixels per world unit" in scaled.out


def test_the_plane_is_upright(page, run):
    picture = np.zeros((400, 600), np.uint8)
    world_from_image = aa.fit("homography", [row[2:] for row in PAGE], [row[:2] for row in PAGE])
    y, x = np.mgrid[:400, :600]
    on_page = aa.apply(world_from_image, np.stack([x.ravel(), y.ravel()], axis=1))
    inside = ((on_page >= 0) & (on_page <= [20, 30])).all(axis=1).reshape(picture.shape)
    aa.write_picture("drawn.png", np.where(inside, np.uint8(255), picture))
    assert run("rectify", "drawn.png", "--points", "page.csv", "--scale", "10", "-o", "upright.png").code == 0
    white = aa.read_picture("upright.png").pixels > 127
    rows, columns = np.flatnonzero(white.any(axis=1)), np.flatnonzero(white.any(axis=0))
    assert rows[-1] - rows[0] + 1 == pytest.approx(300, abs=3)
    assert columns[-1] - columns[0] + 1 == pytest.approx(200, abs=3)
    assert white[rows[0] : rows[-1], columns[0] : columns[-1]].mean() > 0.99


def test_a_horizon_in_the_picture_is_a_stated_crop(page, run):
    floor = [[0, 0, 250, 120], [1, 0, 350, 120], [1, 2, 500, 390], [0, 2, 100, 390]]
    aa.write_points("floor.csv", floor, PLANE_POINTS)
    outcome = run("rectify", "fixed.jpg", "--points", "floor.csv")
    assert outcome.code == 0
    assert "horizon" in outcome.err


def test_an_endless_canvas_is_refused(page, run):
    outcome = run("rectify", "fixed.jpg", "--points", "page.csv", "--scale", "1e5")
    assert outcome.code == 1
    assert outcome.err.count("\n") == 1
    assert not (page / "fixed_rectified.jpg").exists()


@pytest.mark.parametrize("points", [PAGE[:3], [[0, 0, 1, 1], [1, 1, 2, 2], [2, 2, 3, 3], [3, 3, 4, 4]]])
def test_points_that_fix_no_plane(page, run, points):
    aa.write_points("few.csv", points, PLANE_POINTS)
    outcome = run("rectify", "fixed.jpg", "--points", "few.csv")
    assert outcome.code == 2
    assert outcome.err.count("\n") == 1
