"""The pixels under a true overlay agree all over; those of other pictures, captions and frames do not."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from exact_pairs import Pair, camera, pair, photo, render, turn

from autoalign.geometry.homography import IDENTITY, Array, scaling, translation
from autoalign.registration.agreement import NO_AGREEMENT, Agreement, agreement

TRUTH = turn(160, 120, 20, 0.9)
SIZE = (320, 240)
CHANCE = 0.05  # of unrelated blocks, by construction


@cache
def plane() -> Pair:
    return pair("gravel.png", TRUTH, SIZE)


@cache
def other() -> np.ndarray:
    return camera(render("grass.png", translation(100, 100), SIZE), seed=3)


def look(fixed: np.ndarray, moving: np.ndarray, transform: Array = IDENTITY, **masks) -> Agreement:
    found = agreement(fixed, moving, transform, **masks)
    assert 0 <= found.agreeing <= found.blocks
    assert 0 <= found.share <= 1
    assert -1 <= found.correlation <= 1
    return found


def test_a_true_overlay_agrees_nearly_everywhere():
    found = look(plane().fixed, plane().moving, TRUTH)
    assert found.blocks > 100
    assert found.agreeing > 0.95 * found.blocks
    assert found.share > 0.95
    assert found.correlation > 0.8


def test_the_same_picture_agrees_wholly():
    found = look(plane().fixed, plane().fixed)
    assert found.agreeing == found.blocks
    assert found.share == 1.0
    assert found.correlation > 0.98


@pytest.mark.parametrize("shift", [(0, 0), (40, -25)])
def test_other_pictures_agree_by_chance_only(shift):
    """Twice the share that chance has by construction leaves room for the scatter of some hundred blocks."""
    found = look(plane().fixed, other(), translation(*shift))
    assert found.blocks > 100
    assert found.agreeing < 2.5 * CHANCE * found.blocks
    assert found.share < 3 * CHANCE
    assert abs(found.correlation) < 0.1


def test_a_true_pair_under_a_wrong_transform_agrees_by_chance_only():
    found = look(plane().fixed, plane().moving, translation(30, 40) @ TRUTH)
    assert found.share < 3 * CHANCE


def test_a_pixel_or_two_do_not_matter():
    """The overlay is looked at coarsely; how far off a transform is, is not the question here."""
    wide = pair("gravel.png", translation(4, 3), (480, 360))
    exact, off = (look(wide.fixed, wide.moving, translation(4 + d, 3)) for d in (0.0, 1.5))
    assert exact.share > 0.95
    assert off.share > 0.9


def test_a_shared_caption_agrees_under_the_caption_only():
    fixed, moving = plane().fixed.copy(), other().copy()
    caption = photo("text.png")[40:90, 20:320]
    fixed[185:235, 10:310], moving[185:235, 10:310] = caption, caption
    found = look(fixed, moving)
    assert found.agreeing > 0.1 * found.blocks  # a fifth of the area is the caption
    assert found.share < 0.25


@pytest.mark.parametrize("width", [8, 16, 32, 44])
def test_a_shared_frame_is_no_agreement(width):
    """From a fortieth of the picture's width to a seventh, and as rich as a frame can be."""
    fixed, moving = plane().fixed.copy(), other().copy()
    stripes = (128 + 90 * np.sign(np.sin(np.add.outer(np.arange(240), np.arange(320)) * 0.9))).astype(np.uint8)
    inside = np.zeros((240, 320), bool)
    inside[width:-width, width:-width] = True
    for image in (fixed, moving):
        image[~inside] = stripes[~inside]
    assert look(fixed, moving).core < 0.25


def test_opposite_contrast_agrees_by_its_edges():
    found = look(plane().fixed, 255 - plane().moving, TRUTH)
    assert found.share > 0.8
    assert found.correlation > 0.3


@pytest.mark.parametrize("light", [lambda v: v * 0.4 + 20, lambda v: 255 * (v / 255) ** 2.2])
def test_other_light_agrees(light):
    moving = np.rint(light(plane().moving.astype(float))).astype(np.uint8)
    assert look(plane().fixed, moving, TRUTH).share > 0.95


@pytest.mark.parametrize("zoom", [0.3, 3.0])
def test_other_resolution_agrees(zoom):
    moving_size = (int(320 / max(zoom, 1)), int(240 / max(zoom, 1)))
    truth = scaling(zoom, zoom)
    of = pair("gravel.png", truth, SIZE, moving_size)
    assert look(of.fixed, of.moving, truth).share > 0.9


@pytest.mark.parametrize("side", ["fixed_valid", "moving_valid"])
def test_masked_blocks_do_not_count(side):
    """Half of the moving picture shows something else; masked in either picture, what is left agrees."""
    fixed, moving = plane().fixed, plane().fixed.copy()
    moving[:, 160:] = other()[:, 160:]
    valid = np.ones((240, 320), bool)
    valid[:, 160:] = False
    plain, masked = look(fixed, moving), look(fixed, moving, **{side: valid})
    assert plain.agreeing < 0.65 * plain.blocks
    assert masked.agreeing > 0.98 * masked.blocks
    assert masked.blocks == pytest.approx(plain.blocks / 2, rel=0.15)


def test_blocks_without_structure_do_not_count():
    fixed, moving = plane().fixed.copy(), plane().moving.copy()
    fixed[:, 160:] = 90
    moving[:] = fixed
    found = look(fixed, moving)
    whole = look(plane().fixed, plane().fixed)
    assert found.blocks == pytest.approx(whole.blocks / 2, rel=0.15)
    assert found.agreeing > 0.98 * found.blocks


def test_a_blank_picture_does_not_agree_with_a_rich_one():
    assert look(plane().fixed, np.full((240, 320), 90, np.uint8)).share < 3 * CHANCE


@pytest.mark.parametrize(
    ("fixed", "moving", "transform"),
    [
        (np.full((240, 320), 90, np.uint8), np.full((240, 320), 90, np.uint8), IDENTITY),
        (np.zeros((1, 1), np.uint8), np.zeros((1, 1), np.uint8), IDENTITY),
        (np.zeros((240, 320), np.uint8), np.zeros((240, 320), np.uint8), translation(5000, 0)),
        (np.zeros((240, 320), np.uint8), np.zeros((240, 320), np.uint8), translation(315, 235)),
        (np.zeros((240, 320), np.uint8), np.zeros((10, 12), np.uint8), IDENTITY),
    ],
    ids=["blank", "one pixel", "no overlap", "a corner of overlap", "a stamp"],
)
def test_nothing_to_compare_is_no_agreement(fixed, moving, transform):
    assert look(fixed, moving, transform) == NO_AGREEMENT


def test_all_masked_is_no_agreement():
    nothing = np.zeros((240, 320), bool)
    assert look(plane().fixed, plane().fixed, fixed_valid=nothing) == NO_AGREEMENT
