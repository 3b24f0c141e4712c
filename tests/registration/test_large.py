"""Pictures aligned as working copies and sharpened at full size, on pairs whose truth is known."""

from __future__ import annotations

import numpy as np
import pytest
from exact_pairs import mean_error_px, pair

from autoalign.picture.pixels import shrink, working_copy
from autoalign.registration import large as large_module
from autoalign.registration.alignment import AlignOptions
from autoalign.registration.large import Large, align_large
from autoalign.registration.prepared import prepare
from autoalign.registration.refine import RefineOptions

TRUTH = np.array([[1.02, 0.05, 10.0], [-0.04, 0.98, 7.5], [1e-5, -5e-6, 1.0]])


@pytest.fixture(scope="module")
def views():
    return pair("astronaut.png", TRUTH, (500, 420))


def seen(pixels, max_pixels=30_000, valid=None, source=None):
    copy = working_copy(pixels, max_pixels)
    return Large(
        pixels=pixels if source is None else source,
        copy=prepare(copy.pixels, valid),
        full_from_copy=copy.full_from_small,
    )


class Boxes:
    """A picture that is never given out whole."""

    def __init__(self, pixels):
        self._pixels, self.shape, self.dtype = pixels, pixels.shape, pixels.dtype

    def __getitem__(self, box):
        part = self._pixels[box]
        assert part.size < self._pixels.size / 2
        return part


@pytest.fixture(autouse=True)
def small_limits(monkeypatch):
    monkeypatch.setattr(large_module, "WORKING_PIXELS", 30_000)
    monkeypatch.setattr(large_module, "_PLACED_ON", 30_000)


def test_the_full_pictures_sharpen_what_the_copies_gave(views):
    copies = align_large(
        seen(views.fixed), seen(views.moving), AlignOptions(refine=RefineOptions(patches=0), model="homography")
    )
    fixed, moving = (seen(of, source=Boxes(of)) for of in (views.fixed, views.moving))
    found = align_large(fixed, moving, AlignOptions(model="homography"))
    assert found.status == "aligned"
    assert (found.fixed_size, found.moving_size) == ((500, 420), (500, 420))
    error = mean_error_px(found.fixed_from_moving, views)
    assert error < 0.05
    assert error < mean_error_px(copies.fixed_from_moving, views) / 3
    assert found.best.refinement.sharpened
    assert found.expected_error_px == pytest.approx(error, rel=2, abs=0.05)


def test_pictures_of_different_sizes(views):
    smaller = shrink(views.moving, 500 * 420 / 4)
    found = align_large(seen(views.fixed), seen(smaller.pixels))
    assert found.moving_size == (250, 210)
    assert mean_error_px(found.fixed_from_moving @ np.linalg.inv(smaller.full_from_small), views) < 0.15


def test_float_with_holes_is_sharpened_around_them(views):
    fixed, moving = (of.astype(np.float32) / 100 for of in (views.fixed, views.moving))
    fixed[100:103, 200:260] = np.nan
    found = align_large(seen(fixed), seen(moving))
    assert found.status == "aligned"
    assert mean_error_px(found.fixed_from_moving, views) < 0.05


def test_masks_are_those_of_the_copies(views):
    blind = np.zeros(seen(views.fixed).copy.grey.shape, bool)
    found = align_large(seen(views.fixed, valid=blind), seen(views.moving))
    assert found.status == "rejected"
    assert found.best.fixed_from_moving is None


def test_unrelated_pictures_stay_rejected(views):
    noise = np.random.default_rng(3).integers(0, 256, views.moving.shape, np.uint8)
    found = align_large(seen(views.fixed), seen(noise))
    assert found.status == "rejected"
    assert found.moving_size == (views.moving.shape[1], views.moving.shape[0])
