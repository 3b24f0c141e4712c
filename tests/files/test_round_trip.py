"""A picture aligned with itself, shifted: what came in is in what comes out, in every format, depth and kind of pixel.

Files are read back by another library than the one that wrote them, where one can.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import imagecodecs
import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageCms

from autoalign.cli.main import main
from autoalign.files.formats import FORMATS, Format
from autoalign.files.metadata import Metadata
from autoalign.files.read import read_picture
from autoalign.files.ready import Both, Ready, Source
from autoalign.files.result import ResultFiles, write_result
from autoalign.files.write import write_picture
from autoalign.geometry.homography import translation
from autoalign.registration.drawing import Drawing

SHIFT = (3, 2)  # whole pixels, so that resampling is copying
PROFILES = {
    3: ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes(),
    1: ImageCms.ImageCmsProfile(ImageCms.createProfile("LAB")).tobytes(),
}
PROFILES[1] = PROFILES[1][:16] + b"GRAY" + PROFILES[1][20:]
XMP = b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:Description tiff:Orientation="6"/></x:xmpmeta>'
LATITUDE = (47.0, 22.0, 33.5)
CASES = [
    pytest.param(format, depth, channels, id=f"{format.name}-{np.dtype(depth)}-{channels}")
    for format in FORMATS
    for depth in format.depths
    for channels in (1, 2, 3, 4)
    if format.alpha or channels in (1, 3)
]


def camera_exif() -> bytes:
    exif = Image.Exif()
    exif[ExifTags.Base.Model] = "Camera 3000"
    exif[ExifTags.Base.Orientation] = 6
    exif[ExifTags.Base.XResolution] = exif[ExifTags.Base.YResolution] = 72.0
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.DateTimeOriginal] = "2024:05:06 07:08:09"
    exif.get_ifd(ExifTags.IFD.GPSInfo)[ExifTags.GPS.GPSLatitude] = LATITUDE
    return exif.tobytes().removeprefix(b"Exif\0\0")


def by_cv2(path: Path) -> NDArray[Any]:
    pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert pixels is not None
    codes = {3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGBA}
    return cv2.cvtColor(pixels, codes[pixels.shape[2]]) if pixels.ndim == 3 else pixels


def by_other_library(path: Path, depth: type, channels: int) -> NDArray[Any]:
    data = path.read_bytes()
    if path.suffix == ".tif":
        return tifffile.imread(path)
    if path.suffix == ".jxl":
        return imagecodecs.jpegxl_decode(data)
    if path.suffix == ".jp2" and depth is np.uint16:  # Pillow has no such pixels, others apply the profile
        return imagecodecs.jpeg2k_decode(data[data.index(b"\xff\x4f\xff\x51") :])
    if depth is not np.uint16:
        with Image.open(path) as image:
            return np.asarray(image)
    return by_cv2(path)[..., [0, 3]] if channels == 2 else by_cv2(path)


def as_kept(pixels: NDArray[Any], format: Format) -> NDArray[Any]:
    """The pixels as the format gives them back: RGB for grey where it knows no other."""
    if format.grey or (pixels.ndim == 3 and pixels.shape[2] > 2):
        return pixels
    grey = pixels[..., None] if pixels.ndim == 2 else pixels
    return np.concatenate([grey[..., :1]] * 3 + [grey[..., 1:]], axis=-1)


@pytest.mark.parametrize(("format", "depth", "channels"), CASES)
def test_what_came_in_comes_out(tmp_path: Path, make_picture: Any, format: Format, depth: type, channels: int) -> None:
    pixels = make_picture(depth, channels, size=(53, 34), smooth=format.lossy)
    colours = 1 if channels < 3 else 3
    first, last = tmp_path / f"a{format.extensions[-1]}", tmp_path / f"b{format.extensions[0]}"
    write_picture(first, pixels, Metadata(icc=PROFILES[colours], exif=camera_exif(), xmp=XMP, dpi=(300, 240)))
    loaded = read_picture(first)
    ready = Ready(source=Source(path=str(first)), picture=loaded)
    written = write_result(ResultFiles(aligned=last), Both(fixed=ready, moving=ready), translation(*SHIFT), Drawing())
    assert written == [last]

    expected = as_kept(pixels, format)[: -SHIFT[1], : -SHIFT[0]]
    tolerance = 6 if format.lossy else 0
    for back in (by_other_library(last, depth, channels), read_picture(last).pixels):
        assert back.dtype == depth
        assert back.shape == as_kept(pixels, format).shape
        difference = np.abs(back[SHIFT[1] :, SHIFT[0] :].astype(float) - expected)
        assert difference[8:, 8:].max() <= tolerance  # nearer the border lossy formats mix in what is beyond
        assert difference.mean() <= tolerance / 3

    metadata = read_picture(last).metadata
    fitting = "ICC" in format.kept and (colours == 3 or format.grey)  # what was grey has no profile as RGB
    assert metadata.icc == (PROFILES[colours] if fitting else None)
    assert metadata.xmp == (XMP.replace(b'"6"', b'"1"') if "XMP" in format.kept else None)
    if "resolution" in format.kept:
        assert metadata.dpi == pytest.approx((300, 240), rel=1e-3)
    if "EXIF" in format.kept:
        exif = Image.Exif()
        exif.load(metadata.exif)
        assert exif[ExifTags.Base.Model] == "Camera 3000"
        assert exif.get(ExifTags.Base.Orientation, 1) == 1  # Pillow leaves it out of AVIF, which means the same
        assert exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.DateTimeOriginal] == "2024:05:06 07:08:09"
        assert exif.get_ifd(ExifTags.IFD.GPSInfo)[ExifTags.GPS.GPSLatitude] == LATITUDE


def typed_shift(folder: Path, dx: int, dy: int) -> Path:
    """A file of correspondences that say where the moving picture lies."""
    lines = [f"{x + dx},{y + dy},{x},{y}" for x, y in ((0, 0), (50, 0), (50, 30), (0, 30))]
    path = folder / "points.csv"
    path.write_text("\n".join(["fixed_x,fixed_y,moving_x,moving_y", *lines]))
    return path


@pytest.mark.parametrize(
    ("extension", "write"),
    [
        (".jpg", lambda path, pixels: Image.fromarray(pixels[..., :3]).save(path, quality=95)),
        (".png", lambda path, pixels: Image.fromarray(pixels).save(path)),
        (".webp", lambda path, pixels: Image.fromarray(pixels).save(path, lossless=True, exact=True)),
        (".tif", lambda path, pixels: tifffile.imwrite(path, pixels.astype("u2") * 257, compression="lzw")),
        (".tiff", lambda path, pixels: tifffile.imwrite(path, pixels[..., 0] / np.float32(255), tile=(32, 48))),
        (".jp2", lambda path, pixels: Image.fromarray(pixels).save(path)),
        (".avif", lambda path, pixels: Image.fromarray(pixels).save(path, quality=100, subsampling="4:4:4")),
    ],
)
def test_files_of_others_through_the_command(
    tmp_path: Path, make_picture: Any, extension: str, write: Callable[[Path, NDArray[Any]], None]
) -> None:
    pixels = make_picture(channels=4, size=(53, 34), smooth=True)
    pixels[..., 3] = 255
    path = tmp_path / f"moving{extension}"
    write(path, pixels)
    points = typed_shift(tmp_path, *SHIFT)
    fixed = tmp_path / "fixed.png"
    Image.fromarray(pixels).save(fixed)
    assert main(["pair", str(fixed), str(path), "--points", str(points), "--model", "translation", "-q"]) == 0
    stored = read_picture(path).pixels
    back = read_picture(tmp_path / f"moving_aligned{extension}").pixels
    assert (back.dtype, back.shape) == (stored.dtype, stored.shape)
    tolerance = 6 if extension in (".jpg", ".avif") else 1e-6
    difference = np.abs(back[SHIFT[1] + 8 :, SHIFT[0] + 8 :].astype(float) - stored[8 : -SHIFT[1], 8 : -SHIFT[0]])
    assert difference.max() <= tolerance


@pytest.mark.parametrize(("canvas", "tie"), [("fixed", (0, 0)), ("union", (3, 2)), ("moving", (3, 2))])
def test_scan_on_a_map_is_a_map_on_any_canvas(
    tmp_path: Path, make_picture: Any, canvas: str, tie: tuple[int, int]
) -> None:
    pixels = make_picture(channels=3, size=(53, 34), smooth=True)
    place = [(33550, 12, 3, (0.5, 0.5, 0.0), True), (33922, 12, 6, (0.0, 0.0, 0.0, 4e5, 5e6, 0.0), True)]
    place += [(34735, 3, 8, (1, 1, 0, 1, 3072, 0, 1, 32632), True)]
    tifffile.imwrite(tmp_path / "map.tif", pixels, photometric="rgb", extratags=place)
    lying = Image.fromarray(pixels).transpose(Image.Transpose.ROTATE_90)  # its EXIF says how to turn it back
    lying.save(tmp_path / "scan.jpg", quality=95, exif=b"Exif\0\0" + camera_exif())
    points = typed_shift(tmp_path, -3, -2)
    words = ["pair", "map.tif", "scan.jpg", "--points", points.name, "--model", "translation", "-o", "out.tif", "-q"]
    with contextlib.chdir(tmp_path):
        assert main([*words, "--canvas", canvas]) == 0
    with tifffile.TiffFile(tmp_path / "out.tif") as file:
        page = file.pages.first
        assert page.geotiff_tags["ModelTiepoint"] == [*tie, 0, 4e5, 5e6, 0]
        assert page.geotiff_tags["ModelPixelScale"] == [0.5, 0.5, 0]
        assert page.geotiff_tags["ProjectedCSTypeGeoKey"] == 32632
        assert page.tags["GPSTag"].value["GPSLatitude"][::2] == (47, 22, 67)
        assert page.tags["Orientation"].value == 1
