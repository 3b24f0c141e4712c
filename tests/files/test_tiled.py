"""Large TIFFs read box by box, against tifffile reading them whole."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest
import tifffile

from autoalign.errors import ImageReadError
from autoalign.files import tiled
from autoalign.files.read import read_picture
from autoalign.files.tiled import opened_large
from autoalign.geometry.homography import apply
from autoalign.picture.pixels import Picture

H, W = 211, 317
BOXES = [
    (slice(0, H), slice(0, W)),
    (slice(17, 90), slice(5, 300)),
    (slice(63, 65), slice(127, 129)),
    (slice(H - 1, H), slice(W - 3, W)),
]
LAYOUTS = {
    "tiles, deflate": {"tile": (64, 128), "compression": "zlib", "predictor": True},
    "tiles, zstd": {"tile": (64, 64), "compression": "zstd"},
    "tiles, bare": {"tile": (64, 128)},
    "strips, lzw": {"rowsperstrip": 37, "compression": "lzw"},
    "strips, bare": {},
    "big-endian": {"byteorder": ">", "bigtiff": True},
    "planes": {"tile": (64, 128), "planarconfig": "separate"},
}


def picture(channels: int = 3, dtype: type = np.uint8) -> Picture:
    values = np.random.default_rng(1).random((H, W, channels))
    scaled = values if dtype == np.float32 else values * np.iinfo(dtype).max
    return scaled.astype(dtype) if channels > 1 else scaled.astype(dtype)[..., 0]


def write(path: Path, pixels: Picture, **layout: object) -> Path:
    stored = np.moveaxis(pixels, -1, 0) if layout.get("planarconfig") == "separate" else pixels
    kind = "rgb" if pixels.ndim == 3 and pixels.shape[2] > 2 else "minisblack"
    extra = {"extrasamples": ["unassalpha"]} if pixels.ndim == 3 and pixels.shape[2] in (2, 4) else {}
    tifffile.imwrite(path, stored, photometric=kind, **extra, **layout)
    return path


@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS)
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_every_box_is_that_of_the_whole(tmp_path, layout, dtype):
    pixels = picture(dtype=dtype)
    path = write(tmp_path / "a.tif", pixels, **layout)
    with opened_large(path, above_pixels=1, max_pixels=1e6) as large:
        assert large is not None
        assert (large.pixels.shape, large.pixels.dtype) == (pixels.shape, pixels.dtype)
        for box in BOXES:
            assert np.array_equal(large.pixels[box], pixels[box])
        assert large.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.mark.parametrize("channels", [1, 2, 4])
def test_grey_and_alpha(tmp_path, channels):
    pixels = picture(channels)
    path = write(tmp_path / "a.tif", pixels, tile=(64, 128), compression="zlib")
    with opened_large(path, above_pixels=1, max_pixels=1e6) as large:
        assert np.array_equal(large.pixels[BOXES[1]], pixels[BOXES[1]])


def test_jpeg_inside(tmp_path):
    path = write(tmp_path / "a.tif", picture(), tile=(64, 128), compression="jpeg")
    with opened_large(path, above_pixels=1, max_pixels=1e6) as large:
        assert np.array_equal(large.pixels[BOXES[1]], read_picture(path).pixels[BOXES[1]])


def test_few_tiles_are_kept(tmp_path):
    pixels = picture()
    path = write(tmp_path / "a.tif", pixels, tile=(64, 128), compression="zlib")
    with opened_large(path, above_pixels=1, max_pixels=1e6) as large:
        source = tiled.TiledPixels(large.pixels._page, path, cache_bytes=3 * 64 * 128 * 3)
        for _ in range(2):
            assert np.array_equal(source[BOXES[0]], pixels)
            assert len(source._kept) == 3
        source.close()


def test_metadata_is_what_is_read_with_the_whole(tmp_path):
    path = write(tmp_path / "a.tif", picture(), tile=(64, 128), resolution=(300, 200), resolutionunit="INCH")
    with opened_large(path, above_pixels=1, max_pixels=1e6) as large:
        assert large.metadata == read_picture(path).metadata
        assert large.metadata.dpi == (300, 200)


def test_what_is_not_large_or_no_tiff_is_left_to_others(tmp_path):
    path = write(tmp_path / "a.tif", picture(), tile=(64, 128))
    (tmp_path / "text.tif").write_bytes(b"no picture at all")
    turned = write(tmp_path / "turned.tif", picture(), tile=(64, 128), extratags=[(274, 3, 1, 6, True)])
    for file, limit in ((path, W * H), (tmp_path / "text.tif", 1), (turned, 1)):
        with opened_large(file, above_pixels=limit, max_pixels=1e9) as large:
            assert large is None


def test_a_line_is_left_to_others(tmp_path):
    path = write(tmp_path / "a.tif", picture()[:20], tile=(64, 128))
    with opened_large(path, above_pixels=1, max_pixels=1e9) as large:
        assert large is None


def test_a_header_that_lies_about_the_size_is_refused(tmp_path):
    path = write(tmp_path / "a.tif", picture(), tile=(64, 128), compression="zlib")
    with tifffile.TiffFile(path, mode="r+") as file:
        file.pages.first.tags["ImageLength"].overwrite(50_000)
    with (
        pytest.raises(ImageReadError, match="12 tiles or strips, where there should be 2346"),
        opened_large(path, above_pixels=1, max_pixels=1e9),
    ):
        pytest.fail("opened")


def test_a_lone_compressed_strip_is_not_read_by_boxes(tmp_path, monkeypatch):
    monkeypatch.setattr(tiled, "MAX_TILE_PIXELS", W * 100)
    path = write(tmp_path / "a.tif", picture(), rowsperstrip=H, compression="zlib")
    with opened_large(path, above_pixels=1, max_pixels=1e9) as large:
        assert large is None


def test_too_many_pixels_are_refused(tmp_path):
    path = write(tmp_path / "a.tif", picture(), tile=(64, 128))
    with (
        pytest.raises(ImageReadError, match=r"megapixels \(317 x 211\), more than"),
        opened_large(path, above_pixels=1, max_pixels=1000),
    ):
        pytest.fail("opened")


def test_a_file_that_is_cut_short_is_refused_at_once(tmp_path):
    path = write(tmp_path / "a.tif", picture(), tile=(64, 128), compression="zlib")
    path.write_bytes(path.read_bytes()[:-200])
    with (
        pytest.raises(ImageReadError, match=rf"shorter than its header says\): {path}"),
        opened_large(path, above_pixels=1, max_pixels=1e6),
    ):
        pytest.fail("opened")


def test_a_damaged_tile_is_said_where_it_is_read(tmp_path):
    path = write(tmp_path / "a.tif", picture(), tile=(64, 128), compression="zlib")
    with tifffile.TiffFile(path) as file:
        start = file.pages.first.dataoffsets[0]
    data = bytearray(path.read_bytes())
    data[start : start + 50] = bytes(50)
    path.write_bytes(data)
    with opened_large(path, above_pixels=1, max_pixels=1e6) as large:
        assert large.pixels[slice(100, 110), slice(200, 210)].shape == (10, 10, 3)
        with pytest.raises(ImageReadError, match=rf"is damaged.*: {path}"):
            large.pixels[BOXES[0]]


@pytest.mark.parametrize("sub", [False, True], ids=["pages behind", "SubIFDs"])
def test_an_overview_spares_the_full_picture(tmp_path, sub):
    y, x = np.mgrid[:H, :W]
    ramp = np.stack([x, y], axis=-1).astype(np.float32)
    path = tmp_path / "a.tif"
    with tifffile.TiffWriter(path) as file:
        file.write(ramp[..., 0], tile=(64, 64), compression="zlib", subifds=1 if sub else None)
        half = ramp[: H & ~1, : W & ~1, 0].reshape(H // 2, 2, W // 2, 2).mean((1, 3))
        file.write(half + 1000, tile=(64, 64), compression="zlib", subfiletype=1)
    with opened_large(path, above_pixels=1, max_pixels=1e6) as large:
        assert [level.shape for level in large.overviews] == [(H // 2, W // 2)]
        copy = large.working_copy(W * H / 10)
        assert copy.pixels.min() > 900  # it is the overview that was read
        place = apply(copy.full_from_small, [[10.0, 7.0]])[0]
        assert copy.pixels[7, 10] - 1000 == pytest.approx(place[0])
        whole = large.working_copy(W * H)
        assert np.array_equal(whole.pixels, ramp[..., 0])


def test_pages_that_are_left_out_are_told(tmp_path):
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, np.stack([picture()] * 2), tile=(64, 64), photometric="rgb")
    for number, told in ((0, "has several pages, of which the first was taken"), (1, None)):
        with opened_large(path, above_pixels=1, max_pixels=1e6, number=number) as large:
            assert large.remark == told


def test_a_page_that_shows_something_else_is_no_overview(tmp_path):
    with tifffile.TiffWriter(tmp_path / "a.tif") as file:
        file.write(picture(), tile=(64, 64), photometric="rgb")
        file.write(picture()[:50, :60], tile=(64, 64), photometric="rgb", subfiletype=1)
    with opened_large(tmp_path / "a.tif", above_pixels=1, max_pixels=1e6) as large:
        assert large.overviews == ()
