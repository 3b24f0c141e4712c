"""Writing: what comes back is what went in, in every format; what a format cannot hold is refused; no half files."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import imagecodecs
import numpy as np
import pytest
import tifffile
from PIL import Image

from autoalign.errors import ImageWriteError
from autoalign.files.formats import FORMATS
from autoalign.files.read import read_picture
from autoalign.files.write import (
    check_format,
    check_writable,
    default_output,
    write_bytes_atomically,
    write_picture,
)

LOSSLESS = {
    ".png": [np.uint8, np.uint16],
    ".tif": [np.uint8, np.uint16, np.float32],
    ".webp": [np.uint8],
    ".bmp": [np.uint8],
    ".jp2": [np.uint8, np.uint16],
    ".jxl": [np.uint8, np.uint16, np.float32],
}
HELD = [
    (extension, depth, channels)
    for extension, depths in LOSSLESS.items()
    for depth in depths
    for channels in ((1, 3) if extension == ".bmp" else (1, 2, 3, 4))
]


@pytest.fixture(autouse=True)
def nothing_is_left_behind(tmp_path: Path) -> Iterator[None]:
    yield
    assert not list(tmp_path.rglob(".*"))


def refusal(path: str | Path, *arguments: Any, **options: Any) -> str:
    with pytest.raises(ImageWriteError) as caught:
        write_picture(path, *arguments, **options)
    message = str(caught.value)
    assert "\n" not in message
    assert message.endswith(f": {path}")
    return message


def in_colour(pixels: Any) -> Any:
    """Grey as WebP returns it: RGB with or without alpha."""
    colours = pixels[..., :1] if pixels.ndim == 3 else pixels[..., None]
    return np.concatenate([colours] * 3 + ([pixels[..., 1:]] if pixels.ndim == 3 else []), axis=-1)


def by_other_library(path: Path, channels: int) -> Any:
    if path.suffix == ".tif":
        return tifffile.imread(path)
    if path.suffix == ".jxl":  # no second library that reads it is at hand
        return imagecodecs.jpegxl_decode(path.read_bytes())
    if path.suffix == ".jp2" and channels == 2:
        return imagecodecs.jpeg2k_decode(path.read_bytes())
    if path.suffix == ".png" and channels == 2:  # OpenCV makes four channels of these two
        return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[..., [0, 3]]
    pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    codes = {3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGBA}
    return cv2.cvtColor(pixels, codes[pixels.shape[2]]) if pixels.ndim == 3 else pixels


@pytest.mark.parametrize(("extension", "depth", "channels"), HELD)
def test_round_trip(tmp_path: Path, make_picture: Any, extension: str, depth: type, channels: int) -> None:
    pixels = make_picture(depth, channels)
    expected = in_colour(pixels) if extension == ".webp" and channels < 3 else pixels
    path = tmp_path / f"a{extension}"
    write_picture(path, pixels)
    for back in (read_picture(path).pixels, by_other_library(path, channels)):
        assert back.dtype == depth
        np.testing.assert_array_equal(back, expected)


@pytest.mark.parametrize("channels", [1, 3])
def test_jpeg_round_trip(tmp_path: Path, make_picture: Any, channels: int) -> None:
    pixels = make_picture(channels=channels, smooth=True)
    write_picture(tmp_path / "a.jpg", pixels)
    with Image.open(tmp_path / "a.jpg") as image:
        assert image.mode == ("L" if channels == 1 else "RGB")
        oracle = np.asarray(image)
    for back in (oracle, read_picture(tmp_path / "a.jpg").pixels):
        assert back.shape == pixels.shape
        assert np.abs(back.astype(int) - pixels).mean() < 2


def test_colours_of_a_jpeg_keep_their_resolution(tmp_path: Path) -> None:
    stripes = np.zeros((24, 40, 3), np.uint8)
    stripes[:, ::2, 0] = stripes[:, 1::2, 2] = 255  # one red, one blue: halved colour would make all of it purple
    write_picture(tmp_path / "a.jpg", stripes, jpeg_quality=100)
    assert np.abs(read_picture(tmp_path / "a.jpg").pixels.astype(int) - stripes).max() < 40


def test_quality_of_a_jpeg(tmp_path: Path, make_picture: Any) -> None:
    sizes = []
    for quality in (20, 95):
        write_picture(tmp_path / f"{quality}.jpg", make_picture(size=(97, 61)), jpeg_quality=quality)
        sizes.append((tmp_path / f"{quality}.jpg").stat().st_size)
    assert sizes[0] < sizes[1] / 2
    with pytest.raises(ValueError, match="jpeg_quality"):
        write_picture(tmp_path / "a.jpg", make_picture(), jpeg_quality=0)


@pytest.mark.parametrize("extension", [".jpg", ".png", ".tif", ".webp", ".bmp", ".avif", ".jp2", ".jxl"])
def test_same_picture_same_bytes(tmp_path: Path, make_picture: Any, extension: str) -> None:
    contents = set()
    for name in ("a", "b"):
        write_picture(tmp_path / f"{name}{extension}", make_picture())
        contents.add((tmp_path / f"{name}{extension}").read_bytes())
    assert len(contents) == 1


@pytest.mark.parametrize("extension", [".png", ".tif", ".webp", ".jpg", ".bmp", ".avif", ".jp2", ".jxl"])
def test_views_are_written_as_they_look(tmp_path: Path, extension: str) -> None:
    pixels = np.zeros((24, 40, 3), np.uint8)
    pixels[:, :16] = 255
    write_picture(tmp_path / f"a{extension}", pixels[:, ::-1])
    np.testing.assert_allclose(read_picture(tmp_path / f"a{extension}").pixels, pixels[:, ::-1], atol=3)


def test_one_channel_is_grey(tmp_path: Path, make_picture: Any) -> None:
    write_picture(tmp_path / "a.png", make_picture(channels=1)[..., None])
    np.testing.assert_array_equal(read_picture(tmp_path / "a.png").pixels, make_picture(channels=1))


# Nothing lost without a word


@pytest.mark.parametrize("extension", [".jpg", ".webp", ".bmp"])
def test_depth_is_not_lost(tmp_path: Path, make_picture: Any, extension: str) -> None:
    assert "uint16 pixels; PNG or TIFF or JPEG 2000 or JPEG XL can" in refusal(
        tmp_path / f"a{extension}", make_picture(np.uint16)
    )
    assert "float32 pixels; TIFF or JPEG XL can" in refusal(tmp_path / f"a{extension}", make_picture(np.float32))
    assert not list(tmp_path.iterdir())


def test_float_is_not_lost_in_png(tmp_path: Path, make_picture: Any) -> None:
    assert "float32 pixels; TIFF or JPEG XL can" in refusal(tmp_path / "a.png", make_picture(np.float32))


@pytest.mark.parametrize("extension", [".jpg", ".bmp"])
@pytest.mark.parametrize("channels", [2, 4])
def test_alpha_is_not_lost(tmp_path: Path, make_picture: Any, extension: str, channels: int) -> None:
    message = refusal(tmp_path / f"a{extension}", make_picture(channels=channels))
    assert "with alpha; PNG or TIFF or WebP or AVIF or JPEG 2000 or JPEG XL can" in message


def test_sides_that_a_format_cannot_count(tmp_path: Path) -> None:
    assert "70000 x 1 uint8 pixels; PNG or TIFF or BMP or" in refusal(tmp_path / "a.jpg", np.zeros((1, 70_000), "u1"))
    for extension, w in ((".webp", 16_383), (".jpg", 65_500)):
        write_picture(tmp_path / f"a{extension}", np.zeros((1, w), np.uint8))
        assert read_picture(tmp_path / f"a{extension}").pixels.shape[:2] == (1, w)


@pytest.mark.parametrize("name", ["a", "a.gif", "a.heic", "a.jpg.bak"])
def test_unknown_extension(tmp_path: Path, make_picture: Any, name: str) -> None:
    message = refusal(tmp_path / name, make_picture())
    assert "has an extension that autoalign does not write (.jpg, .jpeg, .png, .tif, .tiff, .webp, .bmp" in message


def test_extensions_in_capitals(tmp_path: Path, make_picture: Any) -> None:
    write_picture(tmp_path / "A.TIFF", make_picture())
    assert read_picture(tmp_path / "A.TIFF").format == "TIFF"


def test_what_is_no_picture(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="uint8, uint16 or float32"):
        write_picture(tmp_path / "a.tif", np.zeros((5, 7)))


def test_table_of_formats_agrees_with_the_encoders(tmp_path: Path, make_picture: Any) -> None:
    for format in FORMATS:
        for depth in format.depths:
            pixels = make_picture(depth, 4 if format.alpha else 3)
            path = tmp_path / f"{format.name}-{np.dtype(depth)}{format.extensions[-1]}"
            assert check_format(path, pixels) is format
            write_picture(path, pixels)
            assert read_picture(path).format == format.name


# Whole or not at all


def test_existing_file(tmp_path: Path, make_picture: Any) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(b"dear")
    assert "exists already" in refusal(path, make_picture())
    assert path.read_bytes() == b"dear"
    write_picture(path, make_picture(), overwrite=True)
    assert read_picture(path).pixels.shape == (23, 37, 3)


def test_link_to_nowhere_exists(tmp_path: Path, make_picture: Any) -> None:
    (tmp_path / "a.png").symlink_to(tmp_path / "nowhere")
    assert "exists already" in refusal(tmp_path / "a.png", make_picture())


def test_places_where_no_file_can_be(tmp_path: Path, make_picture: Any) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "folder.png").mkdir()
    assert "its folder does not exist" in refusal(tmp_path / "none" / "a.png", make_picture())
    assert "is a file" in refusal(tmp_path / "file" / "a.png", make_picture())
    assert "is a folder" in refusal(tmp_path / "folder.png", make_picture(), overwrite=True)
    assert "cannot be written" in refusal(tmp_path / ("a" * 300 + ".png"), make_picture())
    assert "cannot be written" in refusal(tmp_path / "a\0.png", make_picture())


def test_read_only_folder(tmp_path: Path, make_picture: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    # Tests may run as root, who may write everywhere: the system's answer is played.
    monkeypatch.setattr(os, "access", lambda *_: False)
    assert "its folder is read-only" in refusal(tmp_path / "a.png", make_picture())


def test_proc_takes_no_files() -> None:
    with pytest.raises(ImageWriteError, match="cannot be written"):
        write_bytes_atomically("/proc/autoalign", b"x")


@pytest.mark.parametrize("failing", ["fsync", "replace"])
@pytest.mark.parametrize("before", [None, b"dear"])
def test_disk_full(
    tmp_path: Path, make_picture: Any, monkeypatch: pytest.MonkeyPatch, failing: str, before: bytes | None
) -> None:
    path = tmp_path / "a.png"
    if before:
        path.write_bytes(before)

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, failing, full)
    assert "(No space left on device)" in refusal(path, make_picture(), overwrite=True)
    assert [file.read_bytes() for file in tmp_path.iterdir()] == ([before] if before else [])


def test_interrupted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_bytes_atomically(tmp_path / "a", b"x")
    assert not list(tmp_path.iterdir())


def test_failing_encoder(tmp_path: Path, make_picture: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise MemoryError

    monkeypatch.setattr("autoalign.files.write.encoder_for", broken)
    assert "cannot be encoded as PNG (MemoryError)" in refusal(tmp_path / "a.png", make_picture())


def test_new_files_have_the_usual_rights(tmp_path: Path) -> None:
    (tmp_path / "usual").touch()
    write_bytes_atomically(tmp_path / "ours", b"x")
    rights = {stat.S_IMODE((tmp_path / name).stat().st_mode) for name in ("usual", "ours")}
    assert len(rights) == 1


def test_longest_name_that_the_system_takes(tmp_path: Path) -> None:
    write_bytes_atomically(tmp_path / ("a" * 255), b"x")


def test_check_writable_leaves_nothing(tmp_path: Path) -> None:
    check_writable(tmp_path / "a.png")
    check_writable("a-name-without-a-folder.png")
    assert not list(tmp_path.iterdir())


# Names


@pytest.mark.parametrize(
    ("moving", "depth", "channels", "expected"),
    [
        ("some/scan.JPG", np.uint8, 3, "some/scan_aligned.JPG"),
        ("scan.v2.tiff", np.float32, 3, "scan.v2_aligned.tiff"),
        ("scan.avif", np.uint8, 3, "scan_aligned.avif"),
        ("scan.avif", np.uint16, 3, "scan_aligned.png"),
        ("scan.heic", np.uint8, 3, "scan_aligned.png"),
        ("scan.nef", np.uint16, 3, "scan_aligned.tif"),
        ("scan", np.uint8, 3, "scan_aligned.png"),
        ("scan.jpg", np.uint16, 3, "scan_aligned.png"),
        ("scan.jpg", np.uint8, 4, "scan_aligned.png"),
        ("scan.png", np.float32, 3, "scan_aligned.tif"),
    ],
)
def test_default_output(make_picture: Any, moving: str, depth: type, channels: int, expected: str) -> None:
    assert default_output(moving, make_picture(depth, channels)) == Path(expected)


def test_default_output_before_there_are_pixels() -> None:
    assert default_output("a.jpg") == Path("a_aligned.jpg")
    assert default_output("a.heic") == Path("a_aligned.png")
