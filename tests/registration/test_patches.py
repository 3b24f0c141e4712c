"""Patches say how far they want to move, on pictures that are exact: polynomials, and views of one scene."""

from __future__ import annotations

import numpy as np
import pytest
from exact_pairs import camera, pair, render, translation

from autoalign.geometry.homography import IDENTITY, Array, apply, invert
from autoalign.picture.pixels import Picture, Shrunken, halve
from autoalign.registration import patches as subject
from autoalign.registration.patches import RIM, Comparison, compare, compare_as

SIZE = (150, 120)
RADIUS = 8
TRUTH = np.array([[1.02, 0.05, 4.0], [-0.04, 0.98, 6.5], [2e-4, -1e-4, 1.0]])


def whole(image: Picture) -> Shrunken:
    return Shrunken(pixels=image, full_from_small=IDENTITY)


def look(fixed: Picture, moving: Picture, transform: Array, places: Array, **others) -> Comparison:
    return compare(whole(fixed), whole(moving), transform, places, **({"radius": RADIUS, "cubic": True} | others))


def lattice(step: int = 10, rim: int = RADIUS + RIM, size: tuple[int, int] = SIZE) -> Array:
    """(n, 2) whole places all over a picture, whose patches lie inside it."""
    x, y = (np.arange(rim, length - rim, step) for length in size)
    return np.stack(np.meshgrid(x, y), -1).reshape(-1, 2).astype(np.float64)


def wave(points: Array) -> Array:
    """A scene of curvature all over, a cubic along both axes about every place; (n,) at points (n, 2)."""
    u, v = (points - 60.0).T / 20.0
    return 40.0 * (u**3 / 6 - u + v**3 / 6 + 0.5 * v**2 + u * v)


def drawn(scene_from_view: Array, size: tuple[int, int] = SIZE) -> Picture:
    x, y = np.meshgrid(*(np.arange(s, dtype=np.float64) for s in size))
    return wave(apply(scene_from_view, np.stack([x.ravel(), y.ravel()], 1))).reshape(x.shape).astype(np.float32)


@pytest.mark.parametrize("fraction", [0.0, 0.25, 0.5, 0.9])
def test_cubic_interpolation_is_exact_where_the_picture_is_a_cubic(fraction):
    """To the rounding of float32. The bilinear one leaves a thousand times as much."""
    shifted = translation(3 + fraction, -2 - fraction)
    fixed, moving = drawn(IDENTITY), drawn(shifted)
    seen = look(fixed, moving, shifted, lattice())
    assert seen.inside.sum() > 50
    assert np.abs(seen.shift[seen.inside]).max() < 1e-4
    assert np.abs(1.0 - seen.correlation[seen.inside]).max() < 1e-5


def test_a_homography_is_followed_to_the_last_pixel_of_a_patch():
    """What places of the pixels are off would show in the shift: they are off by less than 1e-4 px."""
    fixed, moving = drawn(IDENTITY), drawn(TRUTH)
    seen = look(fixed, moving, TRUTH, lattice())
    assert seen.inside.sum() > 50
    assert np.abs(seen.shift[seen.inside]).max() < 3e-4


@pytest.mark.parametrize("off", [(0.3, 0.0), (-0.2, 0.25), (0.0, -0.4)])
def test_patches_want_to_move_to_where_they_belong(off):
    of = pair("gravel.png", TRUTH, SIZE, gain=0.7, bias=20.0)
    seen = look(of.fixed, of.moving, translation(*off) @ of.fixed_from_moving, lattice())
    told = seen.correlation > 0.8
    assert told.sum() > 50
    assert np.allclose(np.median(seen.shift[told], axis=0), off, atol=0.03)
    # and the pair that comes of it lies where the truth has it, within a few of the errors it gives itself
    error = apply(of.fixed_from_moving, seen.pairs.src[told]) - seen.pairs.dst[told]
    assert np.median(np.linalg.norm(error, axis=1) / seen.pairs.dst_sigma[told]) < 3.0


def test_both_ways_the_answer_is_that_of_swapped_roles():
    """But for the rounding of inverses."""
    of = pair("gravel.png", TRUTH, SIZE, gain=0.7, bias=20.0)
    places = lattice()
    there = compare_as("both ways", whole(of.fixed), whole(of.moving), of.fixed_from_moving, places, RADIUS)
    moving_from_fixed = invert(of.fixed_from_moving)
    back = compare_as(
        "both ways", whole(of.moving), whole(of.fixed), moving_from_fixed, apply(moving_from_fixed, places), RADIUS
    )
    assert np.array_equal(there.inside, back.inside)
    told = there.inside
    assert told.sum() > 50
    for name, swapped in (("src", "dst"), ("dst", "src"), ("src_sigma", "dst_sigma"), ("dst_sigma", "src_sigma")):
        same = getattr(back.pairs, swapped)[told]
        assert np.allclose(getattr(there.pairs, name)[told], same, rtol=0, atol=1e-5)
    assert np.allclose(there.correlation, back.correlation, rtol=0, atol=1e-5)
    one_way = compare_as("fine", whole(of.fixed), whole(of.moving), of.fixed_from_moving, places, RADIUS)
    assert (there.inside <= one_way.inside).all()
    assert (there.correlation[~there.inside] == -1).all()


def test_patches_of_halved_pictures_are_told_in_full_pixels():
    of = pair("gravel.png", TRUTH, (301, 241), noise=0.0)
    places = lattice(20, 2 * (RADIUS + RIM) + 2, (301, 241))
    seen = compare(halve(of.fixed), halve(of.moving), of.fixed_from_moving, places, RADIUS, cubic=True)
    told = seen.correlation > 0.8
    assert told.sum() > 40
    assert np.abs(seen.pairs.dst - places).max() <= 1.0
    error = np.linalg.norm(apply(of.fixed_from_moving, seen.pairs.src[told]) - seen.pairs.dst[told], axis=1)
    assert np.median(error) < 0.05
    assert (seen.pairs.dst_sigma >= 2 * 0.01).all()


def test_patches_at_the_very_rim_are_as_good():
    """Beyond the outermost second difference there is none; a cubic's changes little over a pixel."""
    fixed, moving = drawn(IDENTITY), drawn(translation(0.5, 0.5))
    reach = RADIUS + RIM
    last_x, last_y = SIZE[0] - 1 - reach, SIZE[1] - 1 - reach
    corners = np.array([[reach, reach], [last_x, reach], [last_x, last_y], [reach, last_y]], np.float64)
    seen = look(fixed, moving, translation(0.5, 0.5), corners)
    # The moving picture begins half a pixel later than the fixed one: the far corner is the one inside both.
    assert seen.inside.tolist() == [False, False, True, False]
    assert np.abs(seen.shift[2]).max() < 1e-3
    assert look(fixed, fixed, IDENTITY, corners).inside.all()


def test_what_lies_outside_says_so():
    of = pair("gravel.png", TRUTH, SIZE)
    places = np.array([[RADIUS, 50.0], [75.0, 60.0], [75.0, 119.0], [-40.0, 60.0]])
    seen = look(of.fixed, of.moving, TRUTH, places)
    assert seen.inside.tolist() == [False, True, False, False]
    assert (seen.correlation == -1.0).tolist() == [True, False, True, True]
    assert not seen.shift[~seen.inside].any()


def test_a_patch_that_is_torn_apart_is_not_compared():
    of = pair("gravel.png", IDENTITY, SIZE)
    squeezed = np.diag([0.2, 1.0, 1.0])  # a patch is five times as wide in the moving picture
    places = np.array([[12.0, 60.0]])
    assert not look(of.fixed, of.moving, squeezed, places).inside.any()
    assert look(of.fixed, of.moving, np.diag([0.3, 1.0, 1.0]), places).inside.all()


def test_flat_patches_have_no_say():
    flat = np.full(SIZE[::-1], 90, np.uint8)
    of = pair("gravel.png", IDENTITY, SIZE)
    for fixed, moving in ((flat, of.moving), (of.fixed, flat)):
        assert (look(fixed, moving, IDENTITY, lattice()).correlation == -1.0).all()


@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
@pytest.mark.parametrize("cubic", [False, True])
def test_every_depth_gives_the_same(dtype, cubic):
    of = pair("gravel.png", TRUTH, SIZE)
    a = look(of.fixed, of.moving, TRUTH, lattice(), cubic=cubic)
    b = look(of.fixed.astype(dtype), of.moving.astype(dtype), TRUTH, lattice(), cubic=cubic)
    assert np.array_equal(a.shift, b.shift)
    assert np.array_equal(a.correlation, b.correlation)


def test_light_does_not_matter():
    scene = render("gravel.png", translation(100, 100), SIZE)
    a, b = (camera(scene, seed) for seed in (1, 2))
    bright = look(a, b, IDENTITY, lattice())
    dim = look(a, (b.astype(np.float32) * 0.25 + 7).astype(np.float32), IDENTITY, lattice())
    assert np.allclose(bright.shift, dim.shift, atol=1e-4)
    assert np.allclose(bright.correlation, dim.correlation, atol=1e-5)


def test_swapped_roles_want_the_opposite():
    scene = render("gravel.png", translation(100, 100), SIZE)
    a, b = (camera(scene, seed) for seed in (1, 2))
    there, back = look(a, b, IDENTITY, lattice()), look(b, a, IDENTITY, lattice())
    assert np.allclose(there.shift, -back.shift, atol=1e-5)
    assert np.allclose(there.correlation, back.correlation, atol=1e-5)


@pytest.mark.parametrize("at_once", [1, 7, 1000])
def test_how_many_are_done_at_once_does_not_matter(at_once, monkeypatch):
    """But for the rounding of their places in float32, a few ten-thousandths of a pixel."""
    of = pair("gravel.png", TRUTH, SIZE)
    expected = look(of.fixed, of.moving, IDENTITY, lattice(6))
    monkeypatch.setattr(subject, "_AT_ONCE", at_once)
    seen = look(of.fixed, of.moving, IDENTITY, lattice(6))
    assert expected.inside.sum() > 128
    assert np.allclose(seen.shift, expected.shift, atol=1e-3)
    assert np.allclose(seen.correlation, expected.correlation, atol=1e-5)


@pytest.mark.parametrize("radius", [3, 50, 210])
def test_patches_of_any_size_will_do(radius):
    size = (500, 480)
    of = pair("gravel.png", translation(2.0, 1.0), size)
    seen = look(of.fixed, of.moving, of.fixed_from_moving, lattice(3, radius + RIM + 4, size)[:400], radius=radius)
    assert seen.inside.all()
    assert np.median(seen.correlation) > 0.8
    assert np.abs(np.median(seen.shift, axis=0)).max() < 0.05


def test_no_patches_at_all():
    of = pair("gravel.png", TRUTH, SIZE)
    seen = look(of.fixed, of.moving, TRUTH, np.zeros((0, 2)))
    assert len(seen.pairs) == len(seen.shift) == len(seen.correlation) == len(seen.inside) == 0


def test_the_inverse_of_a_pair_is_where_it_was():
    """Unmoved patches pair the centre with its own image."""
    of = pair("gravel.png", TRUTH, SIZE)
    seen = look(of.fixed, of.moving, TRUTH, lattice())
    centre = apply(invert(TRUTH), seen.pairs.dst + seen.shift)
    assert np.allclose(centre[seen.inside], seen.pairs.src[seen.inside], atol=1e-9)
