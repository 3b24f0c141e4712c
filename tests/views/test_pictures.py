"""What a viewer is given to decode."""

from __future__ import annotations

import hashlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from skimage import data

import autoalign as aa
from autoalign.files.jpeg import decoder
from autoalign.files.metadata import Metadata
from autoalign.files.read import LoadedPicture, ReadOptions
from autoalign.files.write import write_picture
from autoalign.geometry.homography import IDENTITY, scaling, translation
from autoalign.views import pictures
from autoalign.views.pictures import (
    MAX_SIDE,
    THUMBNAIL_SIDE,
    Encoded,
    as_shown,
    layers,
    original_bytes,
    thumbnails,
)


def small(data: bytes | None) -> np.ndarray:
    """(h, w, 3) the pixels of a thumbnail."""
    assert data is not None
    return decoder().decode(data).astype(float)


def decoded(picture: Encoded) -> np.ndarray:
    assert picture.media_type == "image/jpeg"
    pixels = decoder().decode(picture.data)
    assert (pixels.shape[1], pixels.shape[0]) == picture.size
    return pixels.astype(float)


@pytest.fixture
def photo() -> np.ndarray:
    return data.coffee()[:200, :300]


@pytest.mark.parametrize("extension", ["jpg", "png"])
def test_files_that_a_viewer_decodes_are_kept(extension: str, photo: np.ndarray, tmp_path: Path) -> None:
    path = tmp_path / f"photo.{extension}"
    write_picture(path, photo)
    loaded = aa.read_picture(path)
    shown = as_shown(loaded.pixels, "photo", original_bytes(loaded))
    assert shown.picture.data == path.read_bytes()
    assert shown.notes == ()


def test_a_turned_picture_is_encoded_upright(photo: np.ndarray, tmp_path: Path) -> None:
    path = tmp_path / "turned.jpg"
    exif = b"II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0"  # orientation 6
    write_picture(path, photo, Metadata())
    plain = path.read_bytes()
    body = b"Exif\0\0" + exif
    path.write_bytes(plain[:2] + b"\xff\xe1" + (len(body) + 2).to_bytes(2, "big") + body + plain[2:])
    loaded = aa.read_picture(path)
    assert loaded.pixels.shape == (300, 200, 3)
    shown = as_shown(loaded.pixels, "turned", original_bytes(loaded))
    assert abs(decoded(shown.picture) - loaded.pixels).mean() < 4


@pytest.mark.parametrize("extension", ["tif", "webp", "bmp"])
def test_files_that_no_viewer_decodes_are_encoded(extension: str, photo: np.ndarray, tmp_path: Path) -> None:
    path = tmp_path / f"photo.{extension}"
    write_picture(path, photo)
    loaded = aa.read_picture(path)
    assert abs(decoded(as_shown(loaded.pixels, "photo", original_bytes(loaded)).picture) - photo).mean() < 5


def test_a_damaged_file_is_shown_as_it_was_read(photo: np.ndarray, tmp_path: Path) -> None:
    path = tmp_path / "photo.png"
    write_picture(path, photo)
    path.write_bytes(path.read_bytes()[:-5000])
    loaded = aa.read_picture(path, ReadOptions(lenient=True))
    assert original_bytes(loaded) is None
    assert abs(decoded(as_shown(loaded.pixels, "photo").picture) - loaded.pixels).mean() < 5


def test_other_depths_are_stretched_and_this_is_said(photo: np.ndarray) -> None:
    for deep in (photo.astype(np.uint16) * 16, photo.astype(np.float32) / 1000):
        shown = as_shown(deep, "it")
        assert np.ptp(decoded(shown.picture)) > 230
        assert str(deep.dtype) in shown.notes[0]


def test_alpha_is_left_out(photo: np.ndarray) -> None:
    clear = np.concatenate([photo, np.full((200, 300, 1), 128, np.uint8)], axis=2)
    assert decoded(as_shown(clear, "it").picture).shape == photo.shape
    assert decoded(as_shown(clear[..., [0, 3]], "it").picture).shape == (200, 300)


def test_large_pictures_are_shrunken_and_this_is_said() -> None:
    shown = as_shown(np.zeros((40, MAX_SIDE + 800), np.uint8), "it")
    assert max(shown.picture.size) <= MAX_SIDE
    assert f"its full size is {MAX_SIDE + 800} × 40" in shown.notes[0]


def test_a_file_that_has_changed_is_not_taken_for_the_picture(photo: np.ndarray, tmp_path: Path) -> None:
    path = tmp_path / "photo.jpg"
    write_picture(path, photo)
    loaded = aa.read_picture(path)
    write_picture(path, photo[::-1], overwrite=True)
    assert original_bytes(loaded) is None
    path.unlink()
    assert original_bytes(loaded) is None
    assert isinstance(loaded, LoadedPicture)
    assert loaded.sha256 != hashlib.sha256(b"").hexdigest()


def test_the_layers_of_a_picture_on_itself(photo: np.ndarray) -> None:
    drawn = layers(photo, photo, IDENTITY)
    assert drawn is not None
    assert drawn.fixed is None  # the picture itself serves
    assert drawn.size == (300, 200)
    assert abs(decoded(drawn.moving) - photo).mean() < 4
    assert decoded(drawn.difference).max() < 10
    green_magenta = decoded(drawn.green_magenta)
    assert abs(green_magenta[..., 0] - green_magenta[..., 1]).mean() < 3
    checkerboard = decoded(drawn.checkerboard)
    bluer = (checkerboard - photo)[..., 2] - (checkerboard - photo)[..., 0]
    assert 0.3 < (bluer > 10).mean() < 0.7  # the squares of the moving picture


def test_blending_changes_the_overlap_alone(photo: np.ndarray) -> None:
    drawn = layers(photo, 255 - photo, translation(150, 0))
    assert drawn is not None
    moving = decoded(drawn.moving)
    assert abs(moving[:, :142] - photo[:, :142]).mean() < 4
    assert abs(moving[:, 158:] - (255.0 - photo[:, 8:150])).mean() < 4


def test_fixed_is_green_and_moving_magenta() -> None:
    fixed, moving = np.full((60, 80), 20, np.uint8), np.full((60, 80), 20, np.uint8)
    fixed[20:40, 10:30], moving[20:40, 50:70] = 250, 250
    drawn = layers(fixed, moving, translation(0, 10))
    assert drawn is not None
    pixels = decoded(drawn.green_magenta)
    red, green, blue = pixels[25:35, 15:25].mean((0, 1))
    assert green > 200 > 100 > max(red, blue)
    red, green, blue = pixels[35:45, 55:65].mean((0, 1))
    assert min(red, blue) > 200 > 100 > green
    assert pixels[:8].max() < 30  # nothing to compare with


def test_large_layers_are_shrunken_together(photo: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pictures, "LAYER_PIXELS", 15_000)
    drawn = layers(photo, photo, IDENTITY)
    assert drawn is not None
    assert drawn.size == (150, 100)
    assert drawn.fixed is not None
    assert abs(decoded(drawn.fixed) - decoded(drawn.moving)).mean() < 2


def test_a_transform_without_an_inverse_draws_nothing(photo: np.ndarray) -> None:
    assert layers(photo, photo, np.diag([1.0, 0.0, 1.0])) is None


def test_thumbnails_show_the_pictures_shrunken_by_area(photo: np.ndarray) -> None:
    found = thumbnails(photo, photo, IDENTITY)
    oracle = cv2.resize(photo, (THUMBNAIL_SIDE, 107), interpolation=cv2.INTER_AREA)
    for thumbnail in (found.fixed, found.before, found.after):
        assert small(thumbnail).shape == (107, THUMBNAIL_SIDE, 3)
        assert abs(small(thumbnail) - oracle)[1:-1, 1:-1].mean() < 4


def test_a_thumbnail_is_laid_where_the_transform_lays_the_picture() -> None:
    fixed, moving = np.zeros((400, 640), np.uint8), np.zeros((200, 320), np.uint8)
    moving[100:140, 40:80] = 255  # by the transform rows 200 to 280, columns 240 to 320 of fixed
    found = thumbnails(fixed, moving, translation(160.5, 0.5) @ scaling(2, 2))
    row, column = np.nonzero(small(found.after)[..., 0] > 128)
    assert (row.min(), row.max(), column.min(), column.max()) == (50, 69, 60, 79)
    row, column = np.nonzero(small(found.before)[..., 0] > 128)
    assert (row.min(), row.max(), column.min(), column.max()) == (50, 69, 20, 39)


def test_before_keeps_its_proportions() -> None:
    found = thumbnails(np.zeros((300, 600), np.uint8), np.full((500, 500), 255, np.uint8), None)
    lit = small(found.before)[..., 0] > 128
    columns = np.flatnonzero(lit.any(axis=0))
    assert lit.shape == (80, 160)
    assert lit.any(axis=1).sum() >= 78
    assert len(columns) == pytest.approx(80, abs=2)
    assert columns.mean() == pytest.approx(79.5, abs=1)
    assert found.after is None


def test_a_fixed_picture_has_one_thumbnail_beside_any_other(photo: np.ndarray) -> None:
    grey = photo[..., 0]
    found = [thumbnails(grey, other, IDENTITY) for other in (photo, grey[::-1], grey.astype(np.uint16))]
    assert len({each.fixed for each in found}) == 1
    assert found[0] == thumbnails(grey, photo, IDENTITY)


def test_thumbnails_of_other_depths_are_stretched(photo: np.ndarray) -> None:
    dark = (photo // 8).astype(np.uint16)
    for deep in (dark, dark.astype(np.float32) / 1000, np.dstack([dark, np.full(dark.shape[:2], 9, np.uint16)])):
        found = thumbnails(deep, deep, IDENTITY)
        assert min(np.ptp(small(each)) for each in (found.fixed, found.before, found.after)) > 180


def test_large_pictures_are_shrunken_before_they_are_warped(monkeypatch: pytest.MonkeyPatch) -> None:
    warped = []
    plain_warp = pictures.warp
    monkeypatch.setattr(
        pictures, "warp", lambda picture, *others: warped.append(picture.size) or plain_warp(picture, *others)
    )
    scene = np.random.default_rng(0).integers(0, 255, (1500, 2000), np.uint8)
    found = thumbnails(scene, scene, IDENTITY)
    assert max(warped) <= THUMBNAIL_SIDE * 120
    assert small(found.after).std() < 12  # fine noise is averaged, not picked from


@pytest.mark.parametrize("size", [(1, 1), (1, 900), (3, 2)])
def test_thumbnails_of_pictures_of_hardly_any_size(size: tuple[int, int], photo: np.ndarray) -> None:
    tiny = np.full(size, 200, np.uint8)
    assert small(thumbnails(tiny, photo, IDENTITY).fixed).mean() == pytest.approx(200, abs=3)
    assert small(thumbnails(photo, tiny, IDENTITY).before).shape == (107, THUMBNAIL_SIDE, 3)


def test_a_transform_without_an_inverse_has_no_thumbnail(photo: np.ndarray) -> None:
    assert thumbnails(photo, photo, np.diag([1.0, 0.0, 1.0])).after is None
