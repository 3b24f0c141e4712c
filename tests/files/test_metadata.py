"""What travels with a picture: written by Pillow, read by us, written by us, read by Pillow or tifffile."""

from __future__ import annotations

import hashlib
import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from hypothesis import given
from hypothesis import strategies as st
from PIL import ExifTags, Image, ImageCms

from autoalign.files import microscope
from autoalign.files.exif import ASCII, DOUBLE, Tag, directory_of, exif_dpi, exif_orientation
from autoalign.files.georeference import shifted
from autoalign.files.metadata import Metadata, describing, on_grid_of, without_grid
from autoalign.files.read import read_picture
from autoalign.files.write import write_picture
from autoalign.geometry.homography import translation
from autoalign.picture.canvas import Canvas

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
    if "webp" not in (first, second):  # in EXIF only, to which nothing can be added where there are maker notes
        assert metadata.dpi == pytest.approx(FULL.dpi, abs=0.02)
    assert exif_dpi(directory_of(metadata.exif)) in (None, pytest.approx(FULL.dpi, abs=0.02))
    exif = Image.Exif()
    exif.load(metadata.exif)
    detail, place = exif.get_ifd(ExifTags.IFD.Exif), exif.get_ifd(ExifTags.IFD.GPSInfo)
    assert exif[ExifTags.Base.Model] == MODEL
    assert exif.get(ExifTags.Base.Orientation, 1) == 1
    assert detail[ExifTags.Base.DateTimeOriginal] == DATE
    assert detail[ExifTags.Base.MakerNote] == MAKER_NOTE
    assert place[ExifTags.GPS.GPSLatitude] == LATITUDE


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
    long = Metadata(icc=RGB_PROFILE, exif=camera_exif() + bytes(70_000))
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


@pytest.mark.parametrize("length", [100, 65_600, 200_000])
def test_packets_of_any_length_go_through_a_jpeg(tmp_path: Path, make_picture: Any, length: int) -> None:
    noise = np.random.default_rng(1).integers(97, 123, length).astype(np.uint8).tobytes()
    packet = b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><!-- ' + noise + b" --></x:xmpmeta>"
    write_picture(tmp_path / "a.jpg", make_picture(), Metadata(xmp=packet))
    assert read_picture(tmp_path / "a.jpg").metadata == Metadata(xmp=packet)
    assert by_pillow(tmp_path / "a.jpg")[0]["xmp"].startswith(b"<x:xmpmeta")


def test_extended_packet_stays_beside_its_own(tmp_path: Path, make_picture: Any) -> None:
    extended = np.random.default_rng(2).bytes(150_000)
    guid = hashlib.md5(extended).hexdigest().upper().encode()
    both = Metadata(xmp=b'<x xmpNote:HasExtendedXMP="%s"/>' % guid, extended_xmp=extended)
    write_picture(tmp_path / "a.jpg", make_picture(), both)
    assert read_picture(tmp_path / "a.jpg").metadata == both
    data = (tmp_path / "a.jpg").read_bytes()
    cut = data.replace(b"extension/\0" + guid, b"extension/\0" + b"0" * 32, 1)  # now one piece is another packet's
    (tmp_path / "b.jpg").write_bytes(cut)
    assert read_picture(tmp_path / "b.jpg").metadata == Metadata(xmp=both.xmp)


def test_resolution_that_jfif_cannot_count_in_inches(tmp_path: Path, make_picture: Any) -> None:
    for dpi, kept in ((70_000.0, 70_000.0), (254_000.0, None)):
        write_picture(tmp_path / "a.jpg", make_picture(), Metadata(dpi=(dpi, dpi)), overwrite=True)
        assert read_picture(tmp_path / "a.jpg").metadata.dpi == (kept and pytest.approx((kept, kept), abs=2))


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


# TIFF: what others keep in a block stands in directories


@pytest.mark.parametrize("endian", ["<", ">"])
def test_exif_in_tiff_by_pillow_and_tifffile(tmp_path: Path, make_picture: Any, endian: str) -> None:
    write_picture(tmp_path / "a.tif", make_picture(np.uint16), Metadata(exif=camera_exif(6, endian)))
    with tifffile.TiffFile(tmp_path / "a.tif") as file:
        page = file.pages.first
        assert file.byteorder == endian
        assert page.tags["Model"].value == MODEL
        assert page.tags["Orientation"].value == 1
        assert page.tags["ExifTag"].value["DateTimeOriginal"] == DATE
        assert page.tags["ExifTag"].value["PixelXDimension"] == 37
        latitude = page.tags["GPSTag"].value["GPSLatitude"]
    assert latitude == (47, 1, 22, 1, 67, 2)


def test_descriptive_tags_come_from_tiff_to_others(tmp_path: Path, make_picture: Any) -> None:
    tifffile.imwrite(
        tmp_path / "a.tif",
        make_picture(),
        description="A wall in Ghent",
        software="Scanner 2",
        datetime="2021:02:03 04:05:06",
        metadata=None,
        extratags=[(315, 2, 0, "Ann", True), (33432, 2, 0, "CC0", True)],
    )
    loaded = read_picture(tmp_path / "a.tif")
    write_picture(tmp_path / "b.jpg", loaded.pixels, loaded.metadata)
    _, exif = by_pillow(tmp_path / "b.jpg")
    assert {exif[tag] for tag in (270, 305, 306, 315, 33432)} == {
        "A wall in Ghent",
        "Scanner 2",
        "2021:02:03 04:05:06",
        "Ann",
        "CC0",
    }


def test_what_tifffile_writes_for_itself_is_not_kept(tmp_path: Path, make_picture: Any) -> None:
    tifffile.imwrite(tmp_path / "a.tif", make_picture())  # {"shape": ...}, which is no longer true of the result
    assert 270 not in directory_of(read_picture(tmp_path / "a.tif").metadata.exif)


# What belongs to the grid


def fixed_frame(dx: float = 0, dy: float = 0) -> Canvas:
    return Canvas(size=(50, 40), canvas_from_fixed=translation(dx, dy))


def place(*ties: float, scale: tuple[float, ...] = (0.5, 0.5, 0)) -> dict[int, Tag]:
    numbers = {33550: scale, 33922: ties}
    tags = {code: Tag(type=DOUBLE, data=np.array(values, "<f8").tobytes()) for code, values in numbers.items()}
    keys = np.array([1, 1, 0, 2, 1024, 0, 1, 1, 3072, 0, 1, 32632], "<u2")
    return tags | {34735: Tag(type=3, data=keys.tobytes()), 34737: Tag(type=ASCII, data=b"WGS 84|\0")}


@pytest.mark.parametrize("byteorder", ["<", ">"])
@pytest.mark.parametrize("bigtiff", [False, True])
def test_plain_scan_on_a_map_becomes_a_map(tmp_path: Path, make_picture: Any, byteorder: Any, bigtiff: bool) -> None:
    extra = [(33550, 12, 3, (0.5, 0.25, 0.0), True), (33922, 12, 6, (0.0, 0.0, 0.0, 4e5, 5e6, 0.0), True)]
    extra += [(34735, 3, 8, (1, 1, 0, 1, 3072, 0, 1, 32632), True), (34737, 2, 0, "UTM 32|", True)]
    extra += [(42113, 2, 0, "0", True)]
    tifffile.imwrite(tmp_path / "map.tif", make_picture(), byteorder=byteorder, bigtiff=bigtiff, extratags=extra)
    write_picture(tmp_path / "scan.jpg", make_picture(), FULL)
    fixed, moving = read_picture(tmp_path / "map.tif"), read_picture(tmp_path / "scan.jpg")
    frame = fixed_frame(10, 4)
    metadata = on_grid_of(fixed.metadata, moving.metadata, frame, np.eye(3), (37, 23))
    write_picture(tmp_path / "out.tif", make_picture(size=frame.size), metadata)
    with tifffile.TiffFile(tmp_path / "out.tif") as file:
        tags = file.pages.first.geotiff_tags
        assert file.pages.first.tags[42113].value == "0"
        assert file.pages.first.tags["Model"].value == MODEL
    assert tags["ModelPixelScale"] == [0.5, 0.25, 0]
    assert tags["ModelTiepoint"] == [10, 4, 0, 4e5, 5e6, 0]
    assert tags["ProjectedCSTypeGeoKey"] == 32632


def test_matrix_and_tie_points_place_a_pixel_alike() -> None:
    matrix = np.array([[0.5, 0.1, 0, 4e5], [0.2, -0.25, 0, 5e6], [0, 0, 0, 0], [0, 0, 0, 1]])
    moved = shifted({34264: Tag(type=DOUBLE, data=matrix.astype("<f8").tobytes())}, 7, -3)
    after = np.frombuffer(moved[34264].data).reshape(4, 4)
    np.testing.assert_allclose(after @ (20 + 7, 30 - 3, 0, 1), matrix @ (20, 30, 0, 1), rtol=1e-14)
    ties = np.frombuffer(shifted(place(1, 2, 0, 4e5, 5e6, 0, 5, 6, 0, 4e5 + 2, 5e6 - 2, 0), 7, -3)[33922].data)
    np.testing.assert_array_equal(ties, [8, -1, 0, 4e5, 5e6, 0, 12, 3, 0, 4e5 + 2, 5e6 - 2, 0])


def test_moving_map_does_not_keep_its_place(tmp_path: Path, make_picture: Any) -> None:
    moving = Metadata(georeference=place(0, 0, 0, 1, 2, 0), no_data="-9999")
    on_grid = on_grid_of(Metadata(), moving, fixed_frame(), np.eye(3), (37, 23))
    assert on_grid == Metadata(no_data="-9999")
    assert on_grid_of(None, moving, fixed_frame(), np.eye(3), (37, 23)).georeference is None
    assert without_grid(moving).georeference is None


def test_turned_map_has_no_place(tmp_path: Path, make_picture: Any) -> None:
    extra = [(33922, 12, 6, (0.0,) * 6, True), (274, 3, 1, 6, True)]
    tifffile.imwrite(tmp_path / "a.tif", make_picture(), extratags=extra)
    assert read_picture(tmp_path / "a.tif").metadata.georeference is None


def test_pixels_are_as_large_as_those_of_the_grid() -> None:
    half = np.diag([0.5, 0.5, 1.0])
    moving = Metadata(dpi=(600, 300))
    assert on_grid_of(Metadata(dpi=(200, 100)), moving, fixed_frame(), half, (37, 23)).dpi == (200, 100)
    assert on_grid_of(None, moving, fixed_frame(), half, (37, 23)).dpi == pytest.approx((300, 150))
    assert on_grid_of(Metadata(), Metadata(), fixed_frame(), half, (37, 23)).dpi is None


def test_resolution_finds_a_place_in_exif(tmp_path: Path, make_picture: Any) -> None:
    exif = Image.Exif()
    exif.endian = ">"
    exif[ExifTags.Base.Model] = MODEL
    for block in (None, exif.tobytes().removeprefix(b"Exif\0\0")):
        write_picture(tmp_path / "a.webp", make_picture(), Metadata(exif=block, dpi=(300, 150.25)), overwrite=True)
        assert read_picture(tmp_path / "a.webp").metadata.dpi == (300, 150.25)
        _, written = by_pillow(tmp_path / "a.webp")
        assert written.get(ExifTags.Base.Model) == (MODEL if block else None)


def test_resolution_of_exif_follows(tmp_path: Path, make_picture: Any) -> None:
    exif = Image.Exif()
    exif[ExifTags.Base.XResolution] = exif[ExifTags.Base.YResolution] = 72.0
    exif[ExifTags.Base.ResolutionUnit] = 3  # centimetres
    Image.fromarray(make_picture()).save(tmp_path / "a.webp", exif=exif)
    loaded = read_picture(tmp_path / "a.webp")
    assert loaded.metadata.dpi == pytest.approx((72 * 2.54,) * 2)
    moved = on_grid_of(Metadata(dpi=(300.5, 150)), loaded.metadata, fixed_frame(), np.eye(3), (37, 23))
    write_picture(tmp_path / "b.webp", loaded.pixels, moved)
    _, written = by_pillow(tmp_path / "b.webp")
    assert (written[282], written[283], written[296]) == (300.5, 150, 2)


# Microscopes


def test_ome_tiff(tmp_path: Path, make_picture: Any) -> None:
    planes = np.stack([make_picture(np.uint16, 1) + i for i in range(6)]).reshape(2, 3, 23, 37)  # z, channels
    axes = {"axes": "ZCYX", "PhysicalSizeX": 250, "PhysicalSizeXUnit": "nm", "PhysicalSizeY": 0.5}
    axes |= {"PhysicalSizeYUnit": "µm", "Channel": {"Name": ["DAPI", "GFP", "RFP"]}}
    tifffile.imwrite(tmp_path / "a.ome.tif", planes, photometric="minisblack", metadata=axes)
    loaded = read_picture(tmp_path / "a.ome.tif", page=4)  # z 1, channel 1
    np.testing.assert_array_equal(loaded.pixels, planes[1, 1])
    assert loaded.metadata.dpi == pytest.approx((101_600, 50_800))
    moved = on_grid_of(Metadata(dpi=(25_400, 25_400)), loaded.metadata, fixed_frame(), np.eye(3), (37, 23))
    write_picture(tmp_path / "b.ome.tif", make_picture(np.uint16, 1, size=(50, 40)), moved)
    with tifffile.TiffFile(tmp_path / "b.ome.tif") as file:
        assert file.is_ome
        assert file.series[0].shape == (40, 50)  # tifffile takes it from the sizes in the text
        pixels = tifffile.xml2dict(file.ome_metadata)["OME"]["Image"]["Pixels"]
    assert (pixels["PhysicalSizeX"], pixels["PhysicalSizeXUnit"], pixels["PhysicalSizeY"]) == (1, "µm", 1)
    assert pixels["Channel"]["Name"] == "GFP"
    assert (pixels["SizeX"], pixels["SizeY"], pixels["SizeC"], pixels["SizeZ"]) == (50, 40, 1, 1)


def test_imagej_tiff(tmp_path: Path, make_picture: Any) -> None:
    planes = np.stack([make_picture(np.uint16, 1)] * 3)
    tifffile.imwrite(
        tmp_path / "a.tif", planes, imagej=True, resolution=(4, 2), metadata={"unit": "micron", "axes": "CYX"}
    )
    loaded = read_picture(tmp_path / "a.tif", page=2)
    assert loaded.metadata.dpi == pytest.approx((101_600, 50_800))
    moved = on_grid_of(Metadata(dpi=(25_400, 12_700)), loaded.metadata, fixed_frame(), np.eye(3), (37, 23))
    write_picture(tmp_path / "b.tif", loaded.pixels, moved)
    with tifffile.TiffFile(tmp_path / "b.tif") as file:
        assert file.is_imagej
        assert file.imagej_metadata["unit"] == "micron"
        assert "images" not in file.imagej_metadata
        assert file.pages.first.tags["XResolution"].value == (1, 1)
        assert file.pages.first.tags["YResolution"].value == (1, 2)
        assert file.asarray().shape == (23, 37)


@given(text=st.text(max_size=60), number=st.integers(0, 5))
def test_any_text_as_description(text: str, number: int) -> None:
    for description in (text, f"ImageJ={text}", f"<OME>{text}</OME>", f"<OME><Pixels SizeX='{text}'/></OME>"):
        plane = microscope.of_plane(description, number) if microscope.is_known(description) else None
        if plane is not None:
            assert microscope.with_grid(plane, (3, 4), (300.0, 300.0))


def test_entities_are_not_followed() -> None:
    bomb = '<!DOCTYPE a [<!ENTITY b "bb"><!ENTITY c "&b;&b;">]><OME><Pixels>&c;</Pixels></OME>'
    assert microscope.is_known(bomb)
    assert microscope.of_plane(bomb, 0) is None
