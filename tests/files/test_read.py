"""Reading: every format, depth and orientation against a second decoder, and every refusal as one clear line."""

from __future__ import annotations

import io
import os
import re
import struct
import subprocess
import sys
import time
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import simplejpeg
import tifffile
from PIL import Image, ImageOps

from autoalign.errors import ImageReadError
from autoalign.files.read import LoadedPicture, ReadOptions, read_picture, read_text, upright

ORIENTATION = 274


def refusal(path: str | Path, page: int = 0, **options: Any) -> str:
    with pytest.raises(ImageReadError) as caught:
        read_picture(path, ReadOptions(**options), page=page)
    message = str(caught.value)
    assert "\n" not in message
    assert message.endswith(f": {path}")
    return message


def saved(path: Path, image: Image.Image, **options: Any) -> Path:
    image.save(path, **options)
    return path


def encoded(image: Image.Image, format: str, **options: Any) -> bytes:
    stream = io.BytesIO()
    image.save(stream, format, **options)
    return stream.getvalue()


# What comes out, with Pillow, OpenCV or tifffile as the second decoder


@pytest.mark.parametrize("mode", ["L", "RGB"])
@pytest.mark.parametrize("options", [{}, {"progressive": True}, {"subsampling": 0}])
def test_jpeg_is_what_pillow_reads(tmp_path: Path, make_picture: Any, mode: str, options: dict[str, Any]) -> None:
    image = Image.fromarray(make_picture(size=(67, 41), smooth=True)).convert(mode)
    path = saved(tmp_path / "a.jpg", image, quality=90, **options)
    loaded = read_picture(path)
    oracle = np.asarray(Image.open(path))
    assert loaded.pixels.shape == oracle.shape
    assert loaded.pixels.dtype == np.uint8
    # Two builds of libjpeg-turbo may round and upsample a little differently.
    assert np.abs(loaded.pixels.astype(int) - oracle).max() <= 3


@pytest.mark.parametrize("mode", ["1", "L", "LA", "P", "RGB", "RGBA"])
def test_png_is_what_pillow_reads(tmp_path: Path, make_picture: Any, mode: str) -> None:
    image = Image.fromarray(make_picture(channels=4 if "A" in mode else 3)).convert(mode)
    path = saved(tmp_path / "a.png", image)
    oracle = np.asarray(image.convert({"1": "L", "P": "RGB"}.get(mode, mode)))
    np.testing.assert_array_equal(read_picture(path).pixels, oracle)


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_png_of_16_bits_is_what_opencv_wrote(tmp_path: Path, make_picture: Any, channels: int) -> None:
    pixels = make_picture(np.uint16, channels)
    to_bgr = {1: None, 3: cv2.COLOR_RGB2BGR, 4: cv2.COLOR_RGBA2BGRA}[channels]
    cv2.imwrite(str(tmp_path / "a.png"), pixels if to_bgr is None else cv2.cvtColor(pixels, to_bgr))
    loaded = read_picture(tmp_path / "a.png")
    assert loaded.pixels.dtype == np.uint16
    np.testing.assert_array_equal(loaded.pixels, pixels)


@pytest.mark.parametrize(("mode", "key"), [("L", 9), ("RGB", (1, 2, 3)), ("P", 0)])
def test_transparent_colour_of_a_png_becomes_alpha(tmp_path: Path, mode: str, key: Any) -> None:
    image = Image.new(mode, (5, 3), key)
    image.putpixel((4, 1), {"L": 77, "RGB": (9, 9, 9), "P": 1}[mode])
    path = saved(tmp_path / "a.png", image, transparency=key)
    alpha = read_picture(path).pixels[..., -1]
    assert alpha[1, 4] == 255
    assert alpha.sum() == 255


@pytest.mark.parametrize("mode", ["1", "L", "P", "RGB"])
def test_bmp_is_what_pillow_wrote(tmp_path: Path, make_picture: Any, mode: str) -> None:
    image = Image.fromarray(make_picture()).convert(mode)
    path = saved(tmp_path / "a.bmp", image)
    oracle = np.asarray(image.convert({"1": "L", "P": "RGB"}.get(mode, mode)))
    np.testing.assert_array_equal(read_picture(path).pixels, oracle)


@pytest.mark.parametrize("channels", [3, 4])
def test_webp_is_what_opencv_reads(tmp_path: Path, make_picture: Any, channels: int) -> None:
    path = saved(tmp_path / "a.webp", Image.fromarray(make_picture(channels=channels)), lossless=True, exact=True)
    to_rgb = {3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGBA}[channels]
    np.testing.assert_array_equal(
        read_picture(path).pixels, cv2.cvtColor(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), to_rgb)
    )


def test_avif_is_read(tmp_path: Path, make_picture: Any) -> None:
    pixels = make_picture(smooth=True)
    path = saved(tmp_path / "a.avif", Image.fromarray(pixels), quality=100, subsampling="4:4:4")
    loaded = read_picture(path)
    assert loaded.format == "AVIF"
    assert np.abs(loaded.pixels.astype(int) - pixels).max() <= 4


@pytest.mark.parametrize("compression", [None, "lzw", "zlib", "zstd"])
@pytest.mark.parametrize("layout", [{}, {"tile": (16, 32)}, {"rowsperstrip": 5}, {"bigtiff": True}, {"byteorder": ">"}])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_tiff_layouts(
    tmp_path: Path, make_picture: Any, compression: str | None, layout: dict[str, Any], dtype: type
) -> None:
    pixels = make_picture(dtype)
    tifffile.imwrite(tmp_path / "a.tif", pixels, photometric="rgb", compression=compression, **layout)
    loaded = read_picture(tmp_path / "a.tif")
    assert loaded.pixels.dtype == dtype
    np.testing.assert_array_equal(loaded.pixels, pixels)


def test_tiff_planes_become_channels(tmp_path: Path, make_picture: Any) -> None:
    pixels = make_picture()
    tifffile.imwrite(tmp_path / "a.tif", np.moveaxis(pixels, -1, 0), photometric="rgb", planarconfig="separate")
    np.testing.assert_array_equal(read_picture(tmp_path / "a.tif").pixels, pixels)


@pytest.mark.parametrize("mode", ["1", "P"])
def test_tiff_of_few_bits_and_palettes_as_pillow_reads_them(tmp_path: Path, make_picture: Any, mode: str) -> None:
    image = Image.fromarray(make_picture()).convert(mode)
    path = saved(tmp_path / "a.tif", image)
    oracle = np.asarray(image.convert({"1": "L", "P": "RGB"}[mode]))
    np.testing.assert_array_equal(read_picture(path).pixels, oracle)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_tiff_where_white_is_zero(tmp_path: Path, make_picture: Any, dtype: type) -> None:
    stored = make_picture(dtype, 1)
    tifffile.imwrite(tmp_path / "a.tif", stored, photometric="miniswhite")
    white = 1 if dtype == np.float32 else np.iinfo(dtype).max
    np.testing.assert_array_equal(read_picture(tmp_path / "a.tif").pixels, white - stored)


def test_tiff_compressed_as_jpeg_is_rgb(tmp_path: Path, make_picture: Any) -> None:
    pixels = make_picture(size=(64, 48), smooth=True)
    path = saved(tmp_path / "a.tif", Image.fromarray(pixels), compression="jpeg", quality=95)
    assert np.abs(read_picture(path).pixels.astype(int) - pixels).max() <= 8


def test_premultiplied_alpha_is_undone(tmp_path: Path) -> None:
    straight = np.array([[[200, 100, 50, 255], [200, 100, 50, 51], [0, 0, 0, 0]]], np.uint8)
    stored = straight.copy()
    stored[..., :3] = np.rint(straight[..., :3] * (straight[..., 3:] / 255.0))
    tifffile.imwrite(tmp_path / "a.tif", stored, photometric="rgb", extrasamples=["assocalpha"])
    np.testing.assert_array_equal(read_picture(tmp_path / "a.tif").pixels, straight)


def test_pages_of_a_tiff(tmp_path: Path, make_picture: Any) -> None:
    pages = [make_picture(), make_picture(np.uint16, 1, (19, 31))]
    with tifffile.TiffWriter(tmp_path / "a.tif") as writer:
        for page in pages:
            writer.write(page, photometric="rgb" if page.ndim == 3 else "minisblack")
    np.testing.assert_array_equal(read_picture(tmp_path / "a.tif").pixels, pages[0])
    np.testing.assert_array_equal(read_picture(tmp_path / "a.tif", page=1).pixels, pages[1])
    assert "several pages" in str(read_picture(tmp_path / "a.tif").remark)
    assert read_picture(tmp_path / "a.tif", page=1).remark is None  # who asks for a page knows
    assert "has no page 2; its last is 1, counted from 0" in refusal(tmp_path / "a.tif", page=2)
    assert "no page 1" in refusal(saved(tmp_path / "a.png", Image.fromarray(pages[0])), page=1)


@pytest.mark.parametrize("size", [(1, 1), (1, 5), (5, 1)])
@pytest.mark.parametrize("extension", ["png", "tif", "bmp", "jpg"])
def test_pictures_one_pixel_wide(tmp_path: Path, size: tuple[int, int], extension: str) -> None:
    path = saved(tmp_path / f"a.{extension}", Image.new("RGB", size, (255, 255, 255)))
    np.testing.assert_array_equal(read_picture(path).pixels, np.full((size[1], size[0], 3), 255, np.uint8))


def test_what_is_said_about_the_file(tmp_path: Path, make_picture: Any) -> None:
    path = saved(tmp_path / "lies.jpg", Image.fromarray(make_picture()), format="PNG")
    loaded = read_picture(str(path))
    assert isinstance(loaded, LoadedPicture)
    assert (loaded.format, loaded.path) == ("PNG", path)
    assert len(loaded.sha256) == 64


@pytest.mark.parametrize("extension", ["jpg", "png", "tif", "webp", "bmp", "avif"])
def test_pixels_can_be_worked_with(tmp_path: Path, make_picture: Any, extension: str) -> None:
    flags = read_picture(saved(tmp_path / f"a.{extension}", Image.fromarray(make_picture()))).pixels.flags
    assert flags.c_contiguous
    assert flags.writeable


# Orientation


@pytest.mark.parametrize("orientation", range(1, 9))
def test_upright_is_what_pillow_does(make_picture: Any, orientation: int) -> None:
    stored = make_picture()
    image = Image.fromarray(stored)
    image.getexif()[ORIENTATION] = orientation
    np.testing.assert_array_equal(upright(stored, orientation), np.asarray(ImageOps.exif_transpose(image)))


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("extension", ["jpg", "png", "webp", "tif", "avif"])
def test_orientation_is_applied_once(tmp_path: Path, make_picture: Any, orientation: int, extension: str) -> None:
    image = Image.fromarray(make_picture(size=(64, 40), smooth=True))
    path = tmp_path / f"a.{extension}"
    if extension == "tif":
        tifffile.imwrite(path, np.asarray(image), photometric="rgb", extratags=[(ORIENTATION, 3, 1, orientation, True)])
    else:
        exif = Image.Exif()
        exif[ORIENTATION] = orientation
        image.save(path, exif=exif, quality=95)
    loaded = read_picture(path)
    oracle = np.asarray(upright(np.asarray(image), orientation))
    assert loaded.pixels.shape == oracle.shape
    assert np.abs(loaded.pixels.astype(int) - oracle).max() <= 24  # lossy, yet far from any other orientation
    if loaded.metadata.exif:
        rewritten = Image.Exif()
        rewritten.load(loaded.metadata.exif)
        assert rewritten[ORIENTATION] == 1


# Refusals


def test_missing_file(tmp_path: Path) -> None:
    assert "does not exist" in refusal(tmp_path / "none.jpg")


def test_folder(tmp_path: Path) -> None:
    assert "is a folder" in refusal(tmp_path)


def test_file_as_folder(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"x")
    assert "cannot be read" in refusal(tmp_path / "file" / "a.jpg")


def test_pipe_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.jpg")
    assert "not a regular file" in refusal(tmp_path / "pipe.jpg")


def test_names_that_no_system_takes(tmp_path: Path) -> None:
    assert "cannot be read" in refusal(tmp_path / ("a" * 5000))
    assert "cannot be read" in refusal(tmp_path / "a\0b.jpg")


def test_no_permission(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Tests may run as root, who may read everything: the system's answer is played.
    path = saved(tmp_path / "a.png", Image.new("RGB", (5, 3)))

    def denied(*_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "open", denied)
    assert "permission denied" in refusal(path)


def test_empty_file(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").touch()
    assert "is empty" in refusal(tmp_path / "a.jpg")


@pytest.mark.parametrize("content", [b"Just some words.\n", b"BMW is a car maker of Munich.", b"\0" * 100, b"x"])
def test_text_named_jpg(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.jpg").write_bytes(content)
    assert "is not a picture in a format that autoalign reads (JPEG, PNG" in refusal(tmp_path / "a.jpg")


def test_other_formats_are_named(tmp_path: Path) -> None:
    path = saved(tmp_path / "a.jpg", Image.new("L", (5, 3)), format="GIF")
    assert "in the format GIF" in refusal(path)
    (tmp_path / "b.exr").write_bytes(b"\x76\x2f\x31\x01\x02\0\0\0")
    assert "in the format OpenEXR" in refusal(tmp_path / "b.exr")


@pytest.mark.parametrize("format", ["JPEG", "PNG", "WebP", "BMP", "AVIF"])
@pytest.mark.parametrize("part", [0.1, 0.5, 0.9])
def test_truncated(tmp_path: Path, make_picture: Any, format: str, part: float) -> None:
    whole = encoded(Image.fromarray(make_picture(size=(97, 61))), format)
    (tmp_path / "a").write_bytes(whole[: int(len(whole) * part)])
    assert f"is damaged, or no {format}" in refusal(tmp_path / "a")


@pytest.mark.parametrize("compression", [None, "lzw", "zlib", "zstd"])
def test_truncated_tiff(tmp_path: Path, make_picture: Any, compression: str | None) -> None:
    pixels = make_picture(size=(97, 61))
    stream = io.BytesIO()
    tifffile.imwrite(stream, pixels, photometric="rgb", compression=compression, rowsperstrip=8)
    whole = stream.getvalue()
    for length in range(8, len(whole) - 8, len(whole) // 40):
        (tmp_path / "a.tif").write_bytes(whole[:length])
        assert "is damaged, or no TIFF" in refusal(tmp_path / "a.tif")


def test_damage_in_the_middle_of_a_jpeg(tmp_path: Path, make_picture: Any) -> None:
    data = bytearray(encoded(Image.fromarray(make_picture(size=(97, 61))), "JPEG"))
    data[len(data) // 2 : len(data) // 2 + 8] = b"\xff\xd9" * 4
    (tmp_path / "a.jpg").write_bytes(data)
    assert "is damaged" in refusal(tmp_path / "a.jpg")


def test_one_wrong_bit_in_a_png(tmp_path: Path, make_picture: Any) -> None:
    whole = encoded(Image.fromarray(make_picture()), "PNG")
    for position in range(16, len(whole) - 12, 97):
        damaged = bytearray(whole)
        damaged[position] ^= 4
        (tmp_path / "a.png").write_bytes(damaged)
        assert re.search("is damaged|megapixels", refusal(tmp_path / "a.png"))


# Lenient: what can be had


def leniently(path: Path) -> LoadedPicture:
    loaded = read_picture(path, ReadOptions(lenient=True))
    assert loaded.remark is not None
    assert loaded.remark.startswith("is damaged (")
    assert "\n" not in loaded.remark
    return loaded


@pytest.mark.parametrize(
    ("format", "mode"),
    [
        *(("PNG", mode) for mode in ("1", "L", "P", "RGB", "RGBA")),
        *(("JPEG", mode) for mode in ("L", "RGB")),
        *(("BMP", mode) for mode in ("L", "RGB")),
        *(("TIFF", compression) for compression in ("none", "lzw", "zlib")),
    ],
)
def test_first_half_of_a_file(tmp_path: Path, format: str, mode: str) -> None:
    pixels = np.random.default_rng(3).integers(0, 256, (200, 61, 3), np.uint8)  # as many bytes in every row
    if format == "TIFF":
        stream = io.BytesIO()
        tifffile.imwrite(stream, pixels, photometric="rgb", compression=mode, rowsperstrip=20)
        data = stream.getvalue()
    else:
        data = encoded(Image.fromarray(pixels).convert(mode), format)
    (tmp_path / "whole").write_bytes(data)
    whole = read_picture(tmp_path / "whole", ReadOptions(lenient=True))
    assert whole.remark is None
    (tmp_path / "half").write_bytes(data[: int(len(data) * 0.6)])
    assert "is damaged" in refusal(tmp_path / "half")
    half = leniently(tmp_path / "half").pixels
    assert half.shape == whole.pixels.shape
    rows = slice(None, 80) if format != "BMP" else slice(-80, None)  # which begins at the bottom
    difference = np.abs(half.astype(int) - whole.pixels)[rows]
    assert difference.max() <= (2 if format == "JPEG" else 0)


def test_damage_inside_costs_a_part(tmp_path: Path, make_picture: Any) -> None:
    pixels = make_picture(size=(97, 160))
    (tmp_path / "a.png").write_bytes(encoded(Image.fromarray(pixels), "PNG"))
    tifffile.imwrite(tmp_path / "a.tif", pixels, photometric="rgb", compression="zlib", tile=(32, 32))
    for name in ("a.png", "a.tif"):
        data = bytearray((tmp_path / name).read_bytes())
        data[len(data) * 7 // 10 : len(data) * 7 // 10 + 8] = bytes(8)
        (tmp_path / name).write_bytes(data)
        assert "is damaged" in refusal(tmp_path / name)
        found = leniently(tmp_path / name).pixels
        assert 0.5 < (found == pixels).all(axis=-1).mean() < 1


def test_what_even_leniency_does_not_take(tmp_path: Path, make_picture: Any) -> None:
    for format in ("PNG", "JPEG", "TIFF", "WebP", "AVIF"):
        data = encoded(Image.fromarray(make_picture(size=(97, 61))), format)
        (tmp_path / "a").write_bytes(data[:30])
        assert f"is damaged, or no {format}" in refusal(tmp_path / "a", lenient=True)
    (tmp_path / "bomb.png").write_bytes(one_bit_png(30_000, 30_000)[:500])
    assert "megapixels" in refusal(tmp_path / "bomb.png", lenient=True)


def one_bit_png(w: int, h: int) -> bytes:
    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    packer = zlib.compressobj(9)
    rows = b"".join(packer.compress(bytes(1 + (w + 7) // 8) * 100) for _ in range(h // 100)) + packer.flush()
    header = struct.pack(">IIBBBBB", w, h, 1, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def test_bombs_cost_nothing(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(one_bit_png(30_000, 30_000))
    lying = bytearray(simplejpeg.encode_jpeg(np.zeros((5, 7, 3), np.uint8)))
    at = lying.index(b"\xff\xc0") + 5
    lying[at : at + 4] = struct.pack(">HH", 60_000, 65_000)
    (tmp_path / "a.jpg").write_bytes(lying)
    start = time.perf_counter()
    assert "has 900.0 megapixels (30000 x 30000), more than the 300.0 allowed" in refusal(tmp_path / "a.png")
    assert "65000 x 60000" in refusal(tmp_path / "a.jpg")
    assert time.perf_counter() - start < 0.5


def test_endless_file(tmp_path: Path) -> None:
    path = saved(tmp_path / "a.bmp", Image.new("RGB", (50, 30)))
    os.truncate(path, 20_000_000_000)  # a hole, which takes no room
    assert "is larger than the 0.1 GB that a picture as large as allowed takes" in refusal(path, max_pixels=1500)


def test_jpeg_that_cannot_be_as_large_as_it_says(tmp_path: Path) -> None:
    stream = encoded(Image.new("RGB", (64, 40)), "JPEG", progressive=True)
    at = stream.index(b"\xff\xc2") + 5
    (tmp_path / "a.jpg").write_bytes(stream[:at] + struct.pack(">HH", 9000, 9000) + stream[at + 4 :])
    assert "81,000,000 pixels cannot be in" in refusal(tmp_path / "a.jpg")
    large = encoded(Image.new("L", (9000, 9000)), "JPEG", quality=1)  # nothing is smaller than one colour
    (tmp_path / "b.jpg").write_bytes(large)
    assert read_picture(tmp_path / "b.jpg").pixels.shape == (9000, 9000)
    scan = large[large.index(b"\xff\xda") : -2]
    (tmp_path / "c.jpg").write_bytes(large[:-2] + scan * 80 + large[-2:])
    assert "81 passes over 81,000,000 pixels" in refusal(tmp_path / "c.jpg")


@pytest.mark.parametrize("extension", ["jpg", "png", "tif", "webp", "bmp", "avif"])
def test_the_limit_is_the_callers(tmp_path: Path, extension: str) -> None:
    path = saved(tmp_path / f"a.{extension}", Image.new("RGB", (50, 30)))
    assert read_picture(path, ReadOptions(max_pixels=1500)).pixels.shape == (30, 50, 3)
    assert "(50 x 30), more than" in refusal(path, max_pixels=1499)


def test_cmyk(tmp_path: Path) -> None:
    for extension in ("jpg", "tif"):
        assert "convert it to" in refusal(saved(tmp_path / f"a.{extension}", Image.new("CMYK", (5, 3))))


@pytest.mark.parametrize("dtype", [np.int16, np.uint32, np.float16, np.float64])
def test_tiff_depths_that_are_refused(tmp_path: Path, dtype: type) -> None:
    tifffile.imwrite(tmp_path / "a.tif", np.zeros((5, 7), dtype))
    assert f"holds {np.dtype(dtype)} pixels" in refusal(tmp_path / "a.tif")


def test_tiff_channels_that_are_refused(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "a.tif", np.zeros((7, 9, 5), np.uint8), photometric="rgb")
    assert "has 5 channels" in refusal(tmp_path / "a.tif")
    infrared = np.zeros((7, 9, 4), np.uint8)
    tifffile.imwrite(tmp_path / "b.tif", infrared, photometric="rgb", extrasamples=["unspecified"])
    assert "has 4 channels that are not grey or RGB" in refusal(tmp_path / "b.tif")


def test_nothing_is_printed(tmp_path: Path, make_picture: Any) -> None:
    """Libraries warn through logs, warnings or the bare file descriptor: a process of its own sees all three."""
    image = Image.fromarray(make_picture(size=(97, 61)))
    for format in ("PNG", "JPEG", "TIFF", "WebP", "AVIF", "BMP"):
        junk = {} if format == "BMP" else {"icc_profile": b"garbage" * 40}
        if format in ("JPEG", "WebP"):  # Pillow puts no other junk into a file
            junk["exif"] = b"II*\0junk" * 4
        data = encoded(image, format, **junk)
        for name, part in (("whole", 1.0), ("half", 0.5), ("head", 0.05)):
            (tmp_path / f"{format}-{name}").write_bytes(data[: int(len(data) * part)])
    (tmp_path / "large").write_bytes(one_bit_png(10_000, 10_000))  # large enough for Pillow's own warning
    code = """
import sys
from pathlib import Path
from autoalign.errors import ImageReadError
from autoalign.files.read import read_picture
for path in sorted(Path(sys.argv[1]).iterdir()):
    try:
        read_picture(path)
        print(path.name, "read")
    except ImageReadError as error:
        print(error)
"""
    run = subprocess.run([sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, check=True)
    assert run.stderr == ""
    assert run.stdout.count(" read\n") == 7
    assert len(run.stdout.splitlines()) == 19


def test_only_the_codec_that_is_needed_is_imported(tmp_path: Path) -> None:
    code = """
import sys
from autoalign.files.read import read_picture
from autoalign.files.write import write_picture
write_picture(sys.argv[2], read_picture(sys.argv[1]).pixels)
print(*({"simplejpeg", "imagecodecs", "tifffile", "PIL"} & set(sys.modules)))
"""
    for extension, codec in (("jpg", "simplejpeg"), ("png", "imagecodecs"), ("webp", "PIL")):
        path = saved(tmp_path / f"a.{extension}", Image.new("RGB", (5, 3)))
        arguments = [sys.executable, "-c", code, str(path), str(tmp_path / f"b.{extension}")]
        run = subprocess.run(arguments, capture_output=True, text=True, check=True)
        assert run.stdout.split() == [codec]


# Text


def test_text_files(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_bytes("\ufeffä\r\nb\rc".encode())
    assert read_text(path, max_bytes=100) == "ä\nb\nc"
    with pytest.raises(ImageReadError, match="larger than the 3 bytes"):
        read_text(path, max_bytes=3)
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(ImageReadError, match="not UTF-8"):
        read_text(path, max_bytes=3)
