"""What travels with a picture: written by Pillow, read by us, written by us, read by Pillow or tifffile."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from hypothesis import given
from hypothesis import strategies as st
from PIL import ExifTags, Image, ImageCms

from autoalign.files.metadata import Metadata, describing, exif_orientation
from autoalign.files.read import read_picture
from autoalign.files.write import write_picture

RGB_PROFILE = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
GREY_PROFILE = RGB_PROFILE[:16] + b"GRAY" + RGB_PROFILE[20:]
XMP = b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:Description tiff:Orientation="6"/></x:xmpmeta>'
UPRIGHT_XMP = XMP.replace(b'"6"', b'"1"')
MODEL, DATE, MAKER_NOTE, LATITUDE = "Camera 3000", "2024:05:06 07:08:09", b"\1\2note" * 40, (47.0, 22.0, 33.5)


def camera_exif(orientation: int = 6, endian: str = "<") -> bytes:
    exif = Image.Exif()
    exif.endian = endian
    exif[ExifTags.Base.Model] = MODEL
    exif[ExifTags.Base.Orientation] = orientation
    exif[ExifTags.Base.ImageWidth] = 4000
    detail = exif.get_ifd(ExifTags.IFD.Exif)
    detail[ExifTags.Base.DateTimeOriginal] = DATE
    detail[ExifTags.Base.MakerNote] = MAKER_NOTE
    detail[ExifTags.Base.ExifImageWidth] = 4000
    detail[ExifTags.Base.ExifImageHeight] = 3000
    exif.get_ifd(ExifTags.IFD.GPSInfo)[ExifTags.GPS.GPSLatitude] = LATITUDE
    return exif.tobytes().removeprefix(b"Exif\0\0")


FULL = Metadata(icc=RGB_PROFILE, exif=camera_exif(), xmp=XMP, dpi=(300.0, 240.0))


def by_pillow(path: Path) -> tuple[dict[str, Any], Image.Exif]:
    with Image.open(path) as image:
        image.load()
        return dict(image.info), image.getexif()


@pytest.mark.parametrize("extension", ["jpg", "png", "webp"])
@pytest.mark.parametrize("endian", ["<", ">"])
def test_pillow_reads_what_we_write(tmp_path: Path, make_picture: Any, extension: str, endian: str) -> None:
    path = tmp_path / f"a.{extension}"
    write_picture(path, make_picture(), Metadata(icc=RGB_PROFILE, exif=camera_exif(6, endian), xmp=XMP, dpi=(300, 240)))
    info, exif = by_pillow(path)
    assert info["icc_profile"] == RGB_PROFILE
    assert exif[ExifTags.Base.Model] == MODEL
    assert exif[ExifTags.Base.Orientation] == 1
    assert exif[ExifTags.Base.ImageWidth] == 37
    detail = exif.get_ifd(ExifTags.IFD.Exif)
    assert detail[ExifTags.Base.DateTimeOriginal] == DATE
    assert detail[ExifTags.Base.MakerNote] == MAKER_NOTE
    assert (detail[ExifTags.Base.ExifImageWidth], detail[ExifTags.Base.ExifImageHeight]) == (37, 23)
    assert exif.get_ifd(ExifTags.IFD.GPSInfo)[ExifTags.GPS.GPSLatitude] == LATITUDE
    packet = info["xmp"]
    assert (packet.encode() if isinstance(packet, str) else packet) == UPRIGHT_XMP
    if extension != "webp":
        assert info["dpi"] == pytest.approx((300, 240), abs=0.02)


@pytest.mark.parametrize("extension", ["jpg", "png", "webp", "avif"])
def test_we_read_what_pillow_writes(tmp_path: Path, make_picture: Any, extension: str) -> None:
    path = tmp_path / f"a.{extension}"
    exif = b"Exif\0\0" + camera_exif()
    Image.fromarray(make_picture()).save(path, icc_profile=RGB_PROFILE, exif=exif, xmp=XMP, dpi=(300, 240))
    metadata = read_picture(path).metadata
    assert metadata.icc == RGB_PROFILE
    assert metadata.exif
    assert exif_orientation(metadata.exif) == 1
    if extension != "png":  # Pillow has no option to write it there
        assert metadata.xmp == UPRIGHT_XMP
    if extension in ("jpg", "png"):
        assert metadata.dpi == pytest.approx((240, 300), abs=0.02)  # orientation 6 lies on its side


@pytest.mark.parametrize(("first", "second"), list(itertools.product(["jpg", "png", "webp", "tif"], repeat=2)))
def test_from_file_to_file(tmp_path: Path, make_picture: Any, first: str, second: str) -> None:
    write_picture(tmp_path / f"a.{first}", make_picture(), FULL)
    loaded = read_picture(tmp_path / f"a.{first}")
    write_picture(tmp_path / f"b.{second}", loaded.pixels, loaded.metadata)
    metadata = read_picture(tmp_path / f"b.{second}").metadata
    assert metadata.icc == RGB_PROFILE
    assert metadata.xmp == UPRIGHT_XMP
    assert (metadata.exif is None) == ("tif" in (first, second))
    if "webp" not in (first, second):
        assert metadata.dpi == pytest.approx(FULL.dpi, abs=0.02)


def test_tiff_by_tifffile(tmp_path: Path, make_picture: Any) -> None:
    write_picture(tmp_path / "a.tif", make_picture(np.uint16, 4), FULL)
    with tifffile.TiffFile(tmp_path / "a.tif") as file:
        page = file.pages[0]
        assert page.iccprofile == RGB_PROFILE
        assert page.tags["XMP"].value == UPRIGHT_XMP
        assert page.get_resolution("inch") == pytest.approx((300, 240))
        assert not {"Software", "DateTime", "ImageDescription"} & {tag.name for tag in page.tags}


def test_centimetres(tmp_path: Path, make_picture: Any) -> None:
    tifffile.imwrite(tmp_path / "a.tif", make_picture(), resolution=(100, 50), resolutionunit="centimeter")
    assert read_picture(tmp_path / "a.tif").metadata.dpi == pytest.approx((254, 127))
    write_picture(tmp_path / "a.jpg", make_picture())
    data = bytearray((tmp_path / "a.jpg").read_bytes())
    data[13:18] = b"\2\0\x64\0\x32"
    (tmp_path / "a.jpg").write_bytes(data)
    assert read_picture(tmp_path / "a.jpg").metadata.dpi == pytest.approx((254, 127))


def test_bmp_keeps_the_resolution(tmp_path: Path, make_picture: Any) -> None:
    write_picture(tmp_path / "a.bmp", make_picture(), FULL)
    assert read_picture(tmp_path / "a.bmp").metadata == Metadata(dpi=pytest.approx((300, 240), abs=0.02))
    write_picture(tmp_path / "b.bmp", make_picture())
    assert read_picture(tmp_path / "b.bmp").metadata == Metadata()


@pytest.mark.parametrize("extension", ["jpg", "png", "webp", "tif"])
def test_nothing_in_nothing_out(tmp_path: Path, make_picture: Any, extension: str) -> None:
    write_picture(tmp_path / f"a.{extension}", make_picture())
    assert read_picture(tmp_path / f"a.{extension}").metadata == Metadata()


def test_long_profile_takes_many_segments(tmp_path: Path, make_picture: Any) -> None:
    profile = RGB_PROFILE + np.random.default_rng(1).bytes(200_000)
    write_picture(tmp_path / "a.jpg", make_picture(), Metadata(icc=profile))
    assert by_pillow(tmp_path / "a.jpg")[0]["icc_profile"] == profile
    assert read_picture(tmp_path / "a.jpg").metadata.icc == profile


def test_what_is_too_long_for_a_jpeg_is_left_out(tmp_path: Path, make_picture: Any) -> None:
    long = Metadata(icc=RGB_PROFILE, exif=camera_exif() + bytes(70_000), xmp=XMP + b" " * 70_000)
    write_picture(tmp_path / "a.jpg", make_picture(), long)
    assert read_picture(tmp_path / "a.jpg").metadata == Metadata(icc=RGB_PROFILE)


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_profile_for_other_colours_is_dropped(make_picture: Any, channels: int) -> None:
    right, wrong = (GREY_PROFILE, RGB_PROFILE) if channels < 3 else (RGB_PROFILE, GREY_PROFILE)
    assert describing(Metadata(icc=right), make_picture(channels=channels)).icc == right
    assert describing(Metadata(icc=wrong), make_picture(channels=channels)).icc is None


def test_thumbnail_is_unlinked(tmp_path: Path, make_picture: Any) -> None:
    block = bytearray(camera_exif())
    count = int.from_bytes(block[8:10], "little")
    link = 10 + 12 * count
    block[link : link + 4] = len(block).to_bytes(4, "little")  # a second directory, of one tag, at the end
    block += b"\1\0" + b"\x03\x01\x03\0\1\0\0\0\6\0\0\0" + bytes(4)
    exif = Image.Exif()
    exif.load(bytes(block))
    assert exif.get_ifd(ExifTags.IFD.IFD1)
    exif.load(describing(Metadata(exif=bytes(block)), make_picture()).exif or b"")
    assert not exif.get_ifd(ExifTags.IFD.IFD1)


def test_describing_twice_changes_nothing(make_picture: Any) -> None:
    once = describing(FULL, make_picture())
    assert describing(once, make_picture()) == once
    assert once != FULL


@pytest.mark.parametrize("orientation", [0, 9, 65535])
def test_orientation_without_sense(orientation: int) -> None:
    assert exif_orientation(camera_exif(orientation)) == 1


@given(block=st.binary(min_size=1, max_size=200))
def test_any_bytes_as_exif(block: bytes) -> None:
    for exif in (block, b"II*\0\x08\0\0\0" + block, b"MM\0*\0\0\0\x08" + block):
        assert 1 <= exif_orientation(exif) <= 8
        described = describing(Metadata(exif=exif), np.zeros((5, 7), np.uint8))
        assert described.exif is not None
        assert len(described.exif) == len(exif)
