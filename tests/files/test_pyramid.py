"""Pictures written strip by strip: what is read back, by tifffile too, and what is left behind when it fails."""

from __future__ import annotations

import numpy as np
import pytest
import tifffile

from autoalign.errors import ImageWriteError
from autoalign.files import pyramid
from autoalign.files.metadata import Metadata
from autoalign.files.pyramid import TILE, write_in_strips
from autoalign.files.read import read_picture

SHAPE = (1_200, 1_701)


def picture(channels=None, dtype=np.uint8):
    shape = SHAPE if channels is None else (*SHAPE, channels)
    rng = np.random.default_rng(2)
    coarse = rng.random((shape[0] // 20 + 1, shape[1] // 20 + 1, *shape[2:]))
    values = coarse.repeat(20, axis=0).repeat(20, axis=1)[: shape[0], : shape[1]]
    return (values if dtype == np.float32 else values * np.iinfo(dtype).max).astype(dtype)


def strips(pixels):
    return (pixels[y : y + TILE] for y in range(0, pixels.shape[0], TILE))


@pytest.mark.parametrize("channels", [None, 2, 3, 4])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_what_is_written_is_read_back(tmp_path, channels, dtype):
    pixels = picture(channels, dtype)
    write_in_strips(tmp_path / "a.tif", strips(pixels), pixels)
    loaded = read_picture(tmp_path / "a.tif")
    assert np.array_equal(loaded.pixels, pixels)
    assert loaded.remark is None  # the overviews are no pages that were left out


def test_overviews_are_means_of_two_by_two(tmp_path):
    pixels = picture(3, np.float32)
    write_in_strips(tmp_path / "a.tif", strips(pixels), pixels)
    with tifffile.TiffFile(tmp_path / "a.tif") as file:
        assert file.is_bigtiff
        assert [page.shape[:2] for page in file.pages] == [SHAPE, (600, 850)]
        assert [page.is_reduced for page in file.pages] == [False, True]
        assert all(page.tile == (TILE, TILE) for page in file.pages)
        expected = pixels[:, :1700].reshape(600, 2, 850, 2, 3).mean((1, 3))
        assert np.allclose(file.pages[1].asarray(), expected, atol=1e-6)


def test_the_bytes_depend_on_the_picture_alone(tmp_path):
    pixels = picture()
    for name in ("a.tif", "b.tif"):
        write_in_strips(tmp_path / name, strips(pixels), pixels, Metadata(dpi=(300, 300)))
    assert (tmp_path / "a.tif").read_bytes() == (tmp_path / "b.tif").read_bytes()


def test_metadata_travels(tmp_path, monkeypatch):
    monkeypatch.setattr(pyramid, "SMALLEST", 10_000)
    pixels = picture(3)
    metadata = Metadata(dpi=(240.0, 120.0), xmp=b"<x:xmpmeta xmlns:x='adobe:ns:meta/'/>", no_data="0")
    write_in_strips(tmp_path / "a.tif", strips(pixels), pixels, metadata)
    found = read_picture(tmp_path / "a.tif").metadata
    assert (found.dpi, found.xmp, found.no_data) == (metadata.dpi, metadata.xmp, metadata.no_data)


def test_nothing_is_left_of_what_fails(tmp_path):
    pixels = picture()

    def broken():
        yield pixels[:TILE]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_in_strips(tmp_path / "a.tif", broken(), pixels)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "a.tif").write_bytes(b"precious")
    with pytest.raises(ImageWriteError, match="exists already"):
        write_in_strips(tmp_path / "a.tif", strips(pixels), pixels)
    assert (tmp_path / "a.tif").read_bytes() == b"precious"
