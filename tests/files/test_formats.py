"""The formats beyond the common ones: against a second decoder, with what travels, and where a library is missing."""

from __future__ import annotations

import io
import struct
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import imagecodecs
import numpy as np
import pillow_heif
import pytest
from PIL import Image, ImageCms

from autoalign.errors import ImageReadError, ImageWriteError
from autoalign.files import boxes, jpegxl
from autoalign.files.codec import full_range
from autoalign.files.formats import FORMATS, table
from autoalign.files.metadata import Metadata
from autoalign.files.read import read_picture, upright
from autoalign.files.write import default_output, write_picture

PROFILE = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
XMP = b'<x:xmpmeta xmlns:x="adobe:ns:meta/"/>'


def exif_block(orientation: int = 1) -> bytes:
    exif = Image.Exif()
    exif[272] = "Camera 3000"
    exif[274] = orientation
    return exif.tobytes().removeprefix(b"Exif\0\0")


FULL = Metadata(icc=PROFILE, exif=exif_block(), xmp=XMP, dpi=(300, 240))


def refusal(path: Path) -> str:
    with pytest.raises(ImageReadError) as caught:
        read_picture(path)
    assert "\n" not in str(caught.value)
    assert str(caught.value).endswith(f": {path}")
    return str(caught.value)


def test_the_readme_has_the_table() -> None:
    assert table() in (Path(__file__).parents[2] / "README.md").read_text()


@pytest.mark.parametrize("bits", [1, 2, 4, 8, 10, 12, 14, 16])
def test_full_range_reaches_both_ends_and_can_be_undone(bits: int) -> None:
    stored = np.arange(2**bits).astype(np.uint8 if bits <= 8 else np.uint16)
    stretched = full_range(stored, bits)
    assert (stretched[0], stretched[-1]) == (0, np.iinfo(stored.dtype).max)
    np.testing.assert_array_equal(np.rint(stretched / stretched[-1] * stored[-1]), stored)


# JPEG 2000


@pytest.mark.parametrize("mode", ["L", "LA", "RGB", "RGBA"])
def test_jpeg_2000_of_pillow(tmp_path: Path, make_picture: Any, mode: str) -> None:
    pixels = make_picture(channels=len(mode))
    Image.fromarray(pixels).save(tmp_path / "a.jp2")
    np.testing.assert_array_equal(read_picture(tmp_path / "a.jp2").pixels, pixels)


@pytest.mark.parametrize("mode", ["L", "LA", "RGB", "RGBA"])
def test_jpeg_2000_for_pillow(tmp_path: Path, make_picture: Any, mode: str) -> None:
    pixels = make_picture(channels=len(mode))
    write_picture(tmp_path / "a.jp2", pixels, FULL)
    with Image.open(tmp_path / "a.jp2") as image:
        assert image.mode == mode
        np.testing.assert_array_equal(np.asarray(image), pixels)
        assert image.info["dpi"] == pytest.approx((300, 240), rel=1e-3)


def test_bare_codestream(tmp_path: Path, make_picture: Any) -> None:
    pixels = make_picture(np.uint16, 1)
    (tmp_path / "a.j2k").write_bytes(imagecodecs.jpeg2k_encode(pixels, level=0, reversible=True, codecformat="J2K"))
    np.testing.assert_array_equal(read_picture(tmp_path / "a.j2k").pixels, pixels)


def test_twelve_bits_are_stretched(tmp_path: Path, make_picture: Any) -> None:
    stored = make_picture(np.uint16, 1) >> 4
    data = imagecodecs.jpeg2k_encode(stored, level=0, reversible=True, bitspersample=12)
    (tmp_path / "a.jp2").write_bytes(data)
    np.testing.assert_array_equal(read_picture(tmp_path / "a.jp2").pixels, full_range(stored, 12))


def test_colours_of_jpeg_2000_that_are_refused(tmp_path: Path, make_picture: Any) -> None:
    write_picture(tmp_path / "a.jp2", make_picture())
    data = (tmp_path / "a.jp2").read_bytes()
    (tmp_path / "b.jp2").write_bytes(data.replace(struct.pack(">I", 16), struct.pack(">I", 18), 1))
    assert "neither RGB nor grey" in refusal(tmp_path / "b.jp2")
    at = data.index(b"\xff\x4f\xff\x51") + 42
    (tmp_path / "c.jp2").write_bytes(data[:at] + b"\x87" + data[at + 1 :])
    assert "different size or depth" in refusal(tmp_path / "c.jp2")


def test_missing_tiles_are_no_picture(tmp_path: Path, make_picture: Any) -> None:
    Image.fromarray(make_picture(size=(80, 60))).save(tmp_path / "a.jp2", tile_size=(32, 32))
    tiled = (tmp_path / "a.jp2").read_bytes()
    np.testing.assert_array_equal(read_picture(tmp_path / "a.jp2").pixels, make_picture(size=(80, 60)))
    start = tiled.index(b"\xff\x4f\xff\x51")
    lying = tiled[: start + 8] + struct.pack(">I", 8000) + tiled[start + 12 :]
    (tmp_path / "b.j2k").write_bytes(lying[start:])
    assert "6 tiles where there should be 500" in refusal(tmp_path / "b.j2k")
    (tmp_path / "b.jp2").write_bytes(lying)
    assert "header does not say 8000 x 60" in refusal(tmp_path / "b.jp2")


# JPEG XL


@pytest.mark.parametrize("size", [(37, 23), (64, 40), (640, 480), (700, 20), (16, 9)])
def test_size_of_jpeg_xl(make_picture: Any, size: tuple[int, int]) -> None:
    pixels = make_picture(channels=1, size=size)
    for container in (False, True):
        data = imagecodecs.jpegxl_encode(pixels, lossless=True, effort=1, usecontainer=container)
        assert jpegxl.decoder().read_header(bytes(data)).size == size


def test_jpeg_that_was_packed(tmp_path: Path, make_picture: Any) -> None:
    stream = io.BytesIO()
    Image.fromarray(make_picture(smooth=True)).save(stream, "JPEG", quality=95, subsampling=0)
    (tmp_path / "a.jxl").write_bytes(imagecodecs.jpegxl_encode_jpeg(stream.getvalue()))
    loaded = read_picture(tmp_path / "a.jxl")
    oracle = np.asarray(Image.open(stream))
    assert np.abs(loaded.pixels.astype(int) - oracle).max() <= 4


def test_packed_boxes_of_jpeg_xl(tmp_path: Path, make_picture: Any) -> None:
    write_picture(tmp_path / "a.jxl", make_picture())
    packed = boxes.box(b"brob", b"xml " + bytes(imagecodecs.brotli_encode(XMP)))
    bomb = boxes.box(b"brob", b"Exif" + bytes(imagecodecs.brotli_encode(bytes(1 << 27))))
    (tmp_path / "b.jxl").write_bytes((tmp_path / "a.jxl").read_bytes() + packed + bomb)
    assert read_picture(tmp_path / "b.jxl").metadata == Metadata(xmp=XMP)


def test_floats_beyond_their_nominal_range(tmp_path: Path, make_picture: Any) -> None:
    pixels = make_picture(np.float32) * 1000 - 300
    pixels[3, 4] = np.nan
    write_picture(tmp_path / "a.jxl", pixels)
    np.testing.assert_array_equal(read_picture(tmp_path / "a.jxl").pixels, pixels)


# AVIF


@pytest.mark.parametrize("channels", [3, 4])
def test_avif_is_nearly_lossless(tmp_path: Path, make_picture: Any, channels: int) -> None:
    pixels = make_picture(channels=channels, size=(97, 61))
    write_picture(tmp_path / "a.avif", pixels, FULL)
    with Image.open(tmp_path / "a.avif") as image:
        for back in (np.asarray(image), read_picture(tmp_path / "a.avif").pixels):
            assert back.shape == pixels.shape
            assert np.abs(back.astype(int) - pixels).max() <= 4


@pytest.mark.parametrize("bits", [10, 12])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_deep_avif(tmp_path: Path, make_picture: Any, bits: int, channels: int) -> None:
    stored = make_picture(np.uint16, channels) >> (16 - bits)
    (tmp_path / "a.avif").write_bytes(imagecodecs.avif_encode(stored, level=100, bitspersample=bits))
    pixels = read_picture(tmp_path / "a.avif").pixels
    np.testing.assert_array_equal(pixels, full_range(stored, bits))
    assert default_output("a.avif", pixels) == Path("a_aligned.png")


def test_avif_that_lies_about_its_size(tmp_path: Path, make_picture: Any) -> None:
    write_picture(tmp_path / "a.avif", make_picture())
    data = bytearray((tmp_path / "a.avif").read_bytes())
    at = data.index(b"ispe") + 8
    data[at : at + 8] = struct.pack(">II", 16_000, 16_000)
    (tmp_path / "a.avif").write_bytes(data)
    assert "larger than the 134 megapixels" in refusal(tmp_path / "a.avif")


# What all of them keep


@pytest.mark.parametrize("extension", ["jp2", "jxl", "avif"])
def test_what_travels(tmp_path: Path, make_picture: Any, extension: str) -> None:
    write_picture(tmp_path / f"a.{extension}", make_picture(), FULL)
    metadata = read_picture(tmp_path / f"a.{extension}").metadata
    assert metadata.icc == (None if extension == "jxl" else PROFILE)
    assert metadata.xmp == XMP
    assert metadata.dpi == pytest.approx(FULL.dpi, rel=1e-3)
    exif = Image.Exif()
    exif.load(metadata.exif)
    assert exif[272] == "Camera 3000"


@pytest.mark.parametrize("orientation", range(1, 9))
def test_turned_jpeg_2000(tmp_path: Path, make_picture: Any, orientation: int) -> None:
    write_picture(tmp_path / "a.jp2", make_picture(), Metadata(exif=exif_block()))
    data = (tmp_path / "a.jp2").read_bytes()
    (tmp_path / "a.jp2").write_bytes(data.replace(exif_block(), exif_block(orientation)))
    loaded = read_picture(tmp_path / "a.jp2")
    with Image.open(tmp_path / "a.jp2") as image:
        turn = {2: 0, 3: 3, 4: 1, 5: 5, 6: 4, 7: 6, 8: 2}  # of the EXIF orientation, for Pillow
        oracle = image if orientation == 1 else image.transpose(Image.Transpose(turn[orientation]))
        np.testing.assert_array_equal(loaded.pixels, np.asarray(oracle))


@pytest.mark.parametrize("orientation", range(1, 9))
def test_turned_jpeg_xl(tmp_path: Path, make_picture: Any, orientation: int) -> None:
    """The orientation of the codestream: bits 12 to 14 of a small header that says more than the usual."""
    pixels = make_picture(size=(40, 24))
    data = bytearray(imagecodecs.jpegxl_encode(pixels, lossless=True, effort=1, usecontainer=False))
    bits = int.from_bytes(data[2:10], "little")
    header = jpegxl._Bits(bytes(data[2:34]))
    jpegxl._size(header)
    assert header.take(1) == 0  # not all as usual
    assert header.take(1) == 0  # nothing beyond the pixels: no place for an orientation in these bytes
    at = header.at
    grown = (bits & ((1 << at) - 1)) | 1 << (at - 1) | (orientation - 1) << at
    assert jpegxl.decoder().read_header(bytes(data[:2]) + grown.to_bytes(9, "little")).orientation == orientation


@pytest.mark.parametrize("extension", ["jp2", "jxl", "avif"])
@pytest.mark.parametrize("part", [0.02, 0.3, 0.9, 0.999])
def test_cut_short(tmp_path: Path, make_picture: Any, extension: str, part: float) -> None:
    write_picture(tmp_path / f"a.{extension}", make_picture(size=(97, 61)))
    data = (tmp_path / f"a.{extension}").read_bytes()
    (tmp_path / f"a.{extension}").write_bytes(data[: int(len(data) * part)])
    assert "is damaged" in refusal(tmp_path / f"a.{extension}") or part == 0.02


# What needs more than is installed by default


@pytest.mark.parametrize(("library", "name", "head"), [
    ("pillow_heif", "a.heic", b"\0\0\0\x18ftypheic\0\0\0\0mif1heic"),
    ("rawpy", "a.dng", b"II*\0\x08\0\0\0"),
])  # fmt: skip
def test_missing_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, library: str, name: str, head: bytes) -> None:
    monkeypatch.setitem(sys.modules, library, None)
    (tmp_path / name).write_bytes(head)
    extra = next(format.extra for format in FORMATS if Path(name).suffix in format.extensions)
    assert f"pip install 'autoalign[{extra}]'" in refusal(tmp_path / name)


@pytest.mark.parametrize("bits", [8, 10])
@pytest.mark.parametrize("channels", [3, 4])
def test_heic(tmp_path: Path, make_picture: Any, bits: int, channels: int) -> None:
    pixels = make_picture(np.uint8 if bits == 8 else np.uint16, channels, size=(96, 64), smooth=True)
    mode = {3: "RGB", 4: "RGBA"}[channels] + ("" if bits == 8 else ";16")
    image = pillow_heif.from_bytes(mode=mode, size=(96, 64), data=pixels.tobytes())
    image.save(tmp_path / "a.heic", quality=100, chroma=444, exif=exif_block(6), icc_profile=PROFILE, xmp=XMP)
    loaded = read_picture(tmp_path / "a.heic")
    pixels = upright(pixels, 6)  # the orientation became a turn of the file's own
    assert loaded.pixels.dtype == pixels.dtype
    assert np.abs(loaded.pixels.astype(float) - pixels).max() <= 6 * (1 if bits == 8 else 257)
    assert loaded.metadata.icc == PROFILE
    assert loaded.metadata.xmp == XMP
    assert default_output(tmp_path / "a.heic", loaded.pixels).name == "a_aligned.png"
    with pytest.raises(ImageWriteError, match="does not write"):
        write_picture(tmp_path / "b.heic", loaded.pixels)
    (tmp_path / "c.heic").write_bytes((tmp_path / "a.heic").read_bytes()[:700])
    assert "is damaged" in refusal(tmp_path / "c.heic")


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_dng(tmp_path: Path, damage_corpus: ModuleType, orientation: int) -> None:
    (tmp_path / "a.dng").write_bytes(damage_corpus.camera_dng(orientation))
    loaded = read_picture(tmp_path / "a.dng")
    w, h = (64, 48) if orientation < 5 else (48, 64)
    assert loaded.pixels.shape == (h, w, 3)
    assert loaded.pixels.dtype == np.uint16
    grows = {1: loaded.pixels[20], 3: loaded.pixels[20, ::-1], 6: loaded.pixels[:, 20], 8: loaded.pixels[::-1, 20]}
    assert (np.diff(grows[orientation][4:-4].astype(int).mean(axis=-1)) > 0).all()
    exif = Image.Exif()
    exif.load(loaded.metadata.exif)
    assert (exif[272], exif[274]) == ("Camera 3000", 1)
    assert default_output(tmp_path / "a.dng", loaded.pixels).name == "a_aligned.tif"
