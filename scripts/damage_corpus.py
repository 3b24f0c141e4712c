"""Damaged and hostile files of every format, read under limits: none may crash, hang, swell, or pass for another.

    python scripts/damage_corpus.py [--count 620] [--seed 1] [--workers 2] [--keep FOLDER]

Sound files of all formats are cut short, bits are turned, blocks zeroed, sizes in headers replaced by lies; to these
come bombs, endless chains, wrong names and empty files, all from one seed. Each is read in a worker process that is
killed at 2 GB, and may take 10 s of processor time. What must come out: one clear line and exit code 3, or a picture.
A picture is held against the sound file's, and, where it differs from that, against what a second decoder makes of the
same bytes. Damage that a format without checksums cannot show is counted as `as the reference`. Exit code 1 if a file
failed.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import io
import struct
import sys
import tempfile
import time
import zlib
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import imagecodecs
import numpy as np
import pillow_heif
import rawpy
import tifffile
from PIL import Image

from autoalign.batch.engine import LocalEngine
from autoalign.batch.slot import Limits
from autoalign.cli.main import main as autoalign
from autoalign.errors import ImageReadError
from autoalign.files.boxes import box
from autoalign.files.read import read_picture

LIMITS = Limits(time_s=120.0, memory=2_000_000_000)  # of reading and judging; what hangs is killed
MAX_READ_S = 10.0  # of processor time, which other programs do not make longer
LIES = (0, 1, 65_000, 16_000, 2**31 - 1)
GOOD = ("refused", "as the sound file", "as the reference")
JPEG_TOLERANCE = 4  # levels by which two builds of libjpeg may differ


@dataclass(frozen=True, kw_only=True)
class Case:
    """One file to be read."""

    path: Path
    sound: Path | None  # what it was before
    kind: str  # of damage


@functools.cache
def sound_files() -> dict[str, bytes]:
    """Name to content: small pictures of every format, and of every way to store pixels with a decoder of its own."""
    w, h = 200, 150
    y, x = np.mgrid[:h, :w]
    noise = np.random.default_rng(5).random((h, w, 3))
    rgb = ((np.dstack([x / w, y / h, (x + y) / (w + h)]) * 0.8 + noise * 0.2) * 255).astype(np.uint8)
    deep, image = rgb.astype(np.uint16) * 257, Image.fromarray(rgb)

    def pillow(format: str, image: Image.Image = image, **options: object) -> bytes:
        stream = io.BytesIO()
        image.save(stream, format, **options)
        return stream.getvalue()

    def tiff(pixels: np.ndarray = rgb, **options: object) -> bytes:
        stream = io.BytesIO()
        tifffile.imwrite(stream, pixels, photometric="rgb", metadata=None, **options)
        return stream.getvalue()

    return {
        "baseline.jpg": pillow("JPEG", quality=90),
        "progressive.jpg": pillow("JPEG", quality=80, progressive=True),
        "grey.jpg": pillow("JPEG", image.convert("L")),
        "plain.png": pillow("PNG"),
        "palette.png": pillow("PNG", image.convert("P")),
        "deep.png": bytes(imagecodecs.png_encode(deep)),
        "bare.tif": tiff(rowsperstrip=16),
        "lzw.tif": tiff(compression="lzw", rowsperstrip=16, predictor=True),
        "deflate.tif": tiff(deep, compression="zlib", tile=(64, 64)),
        "zstd.tif": tiff(rgb / np.float32(255), compression="zstd", bigtiff=True),
        "jpeg.tif": tiff(compression="jpeg", tile=(64, 64)),
        "lossy.webp": pillow("WEBP", quality=85),
        "lossless.webp": pillow("WEBP", lossless=True),
        "plain.bmp": pillow("BMP"),
        "palette.bmp": pillow("BMP", image.convert("P")),
        "plain.avif": pillow("AVIF", quality=85),
        "plain.jp2": bytes(imagecodecs.jpeg2k_encode(rgb, level=0, reversible=True, codecformat="JP2")),
        "bare.jxl": bytes(imagecodecs.jpegxl_encode(rgb, level=90, usecontainer=False)),
        "plain.heic": _heic(image),
        "plain.dng": camera_dng(),
        "boxed.jxl": bytes(imagecodecs.jpegxl_encode(deep, lossless=True, effort=1, usecontainer=True)),
    }


def camera_dng(orientation: int = 1) -> bytes:
    """The smallest DNG that LibRaw develops: a red, green and blue mosaic, brighter to the right."""
    mosaic = np.broadcast_to(np.linspace(1000, 60_000, 64).astype(np.uint16), (48, 64)).copy()
    stream = io.BytesIO()
    extra = [
        (50706, 1, 4, (1, 4, 0, 0), True),  # DNGVersion
        (50708, 2, 0, "Camera 3000", True),  # UniqueCameraModel
        (271, 2, 0, "Maker", True),
        (272, 2, 0, "Camera 3000", True),
        (274, 3, 1, orientation, True),
        (33421, 3, 2, (2, 2), True),  # CFARepeatPatternDim
        (33422, 1, 4, (0, 1, 1, 2), True),  # CFAPattern
        (50721, 10, 9, (1, 1, 0, 1, 0, 1, 0, 1, 1, 1, 0, 1, 0, 1, 0, 1, 1, 1), True),  # ColorMatrix1
        (50728, 5, 3, (1, 1, 1, 1, 1, 1), True),  # AsShotNeutral
        (50717, 4, 1, 65_535, True),  # WhiteLevel
    ]
    tifffile.imwrite(stream, mosaic, photometric="cfa", extratags=extra, metadata=None)
    return stream.getvalue()


def _heic(image: Image.Image) -> bytes:
    stream = io.BytesIO()
    pillow_heif.from_pillow(image).save(stream, quality=85)
    return stream.getvalue()


# Damages: (content, random numbers) to content


def cut_short(data: bytes, rng: np.random.Generator) -> bytes:
    return data[: rng.integers(1, len(data))]


def turn_bits(data: bytes, rng: np.random.Generator) -> bytes:
    changed = bytearray(data)
    for place in rng.integers(0, len(data), rng.integers(1, 9)):
        changed[place] ^= 1 << int(rng.integers(8))
    return bytes(changed)


def turn_bits_of_header(data: bytes, rng: np.random.Generator) -> bytes:
    return turn_bits(data[:400], rng) + data[400:]


def zero_a_block(data: bytes, rng: np.random.Generator) -> bytes:
    length = int(rng.integers(4, 300))
    start = int(rng.integers(0, max(1, len(data) - length)))
    return data[:start] + bytes(min(length, len(data) - start)) + data[start + length :]


def lie_about_a_size(data: bytes, rng: np.random.Generator) -> bytes:
    """One of the sides, wherever the format keeps it, becomes another number; checksums are made to fit."""
    lie = int(rng.choice(LIES))
    second = bool(rng.integers(2))
    changed = bytearray(data)
    if data.startswith(b"\x89PNG"):
        struct.pack_into(">I", changed, 16 + 4 * second, lie)
        struct.pack_into(">I", changed, 29, zlib.crc32(changed[12:29]))
    elif data.startswith(b"\xff\xd8"):
        at = max(data.find(b"\xff\xc0"), data.find(b"\xff\xc2")) + 5
        struct.pack_into(">H", changed, at + 2 * second, lie & 0xFFFF)
    elif data[:2] in (b"II", b"MM"):
        with tifffile.TiffFile(io.BytesIO(data)) as file:
            tags = file.pages.first.tags
            codes = [code for code in (256, 257, 258, 277, 278, 279, 322, 323) if code in tags]
            tag = tags[int(rng.choice(codes))]
            place = tag.valueoffset
        struct.pack_into("<H" if tag.dtype == 3 else "<I", changed, place, lie & (0xFFFF if tag.dtype == 3 else ~0))
    elif data.startswith(b"RIFF"):
        at = 26 if data[12:16] == b"VP8 " else 21
        struct.pack_into("<H", changed, at + 2 * second, lie & 0x3FFF)
    elif data.startswith(b"BM"):
        struct.pack_into("<i", changed, 18 + 4 * second, lie)
    elif b"ispe" in data[:600]:
        struct.pack_into(">I", changed, data.index(b"ispe") + 8 + 4 * second, lie)
    elif b"\xff\x4f\xff\x51" in data[:200]:
        struct.pack_into(">I", changed, data.index(b"\xff\x4f\xff\x51") + 8 + 4 * second, lie)
    else:  # JPEG XL packs its sides into bits
        at = data.index(b"\xff\x0a") + 2
        changed[at : at + 4] = rng.bytes(4)
    return bytes(changed)


DAMAGES: tuple[Callable[[bytes, np.random.Generator], bytes], ...] = (
    cut_short,
    turn_bits,
    zero_a_block,
    lie_about_a_size,
    turn_bits_of_header,
)


# Hostile files, made whole


@functools.cache
def hostile_files() -> dict[str, bytes]:
    """Name to content: bombs, endless chains, wrong names, and what is no picture at all."""
    sound = sound_files()
    return {
        "empty.jpg": b"",
        "text.png": b"to whom it may concern\n" * 50,
        "zeros.tif": bytes(10_000),
        "jpeg.png": sound["baseline.jpg"],
        "png.tif": sound["plain.png"],
        "tiff.jpg": sound["bare.tif"],
        "webp.bmp": sound["lossy.webp"],
        "html.webp": b"RIFF\x10\0\0\0WEBP<html>" * 9,
        "one_bit.png": _one_bit_png(17_000, 17_000),
        "over_the_limit.png": _one_bit_png(20_000, 20_000),
        "profile_bomb.png": _with_chunk(sound["plain.png"], b"iCCP", b"x\0\0" + _zeros(1 << 27)),
        "text_bomb.png": _with_chunk(sound["plain.png"], b"iTXt", b"XML:com.adobe.xmp\0\1\0\0\0" + _zeros(1 << 27)),
        "chunks.png": _many_chunks(sound["plain.png"], 200_000),
        "pixels_bomb.png": _with_pixels(sound["plain.png"], _zeros(1 << 28)),
        "strip_bomb.tif": _strip_bomb(),
        "circle.tif": _circle(sound["bare.tif"]),
        "tiles.tif": _giant_tile(),
        "scans.jpg": _many_scans(sound["progressive.jpg"], 1000),
        "lying_scans.jpg": _many_scans(lie_to(sound["progressive.jpg"], 15_000), 300),
        "fill.jpg": b"\xff\xd8" + b"\xff" * 3_000_000,
        "segments.jpg": b"\xff\xd8" + b"\xff\xe1\0\2" * 200_000 + sound["baseline.jpg"][2:],
        "boxes.jp2": sound["plain.jp2"][:32] + box(b"free", b"") * 100_000 + sound["plain.jp2"][32:],
        "packed.jxl": sound["boxed.jxl"]
        + box(b"brob", b"Exif" + bytes(imagecodecs.brotli_encode(bytes(1 << 27), level=1))),
        "deep.webp": sound["lossless.webp"] + bytes(1_000_000),
    }


def lie_to(data: bytes, side: int) -> bytes:
    """A JPEG that says it is so large in both directions."""
    at = max(data.find(b"\xff\xc0"), data.find(b"\xff\xc2")) + 5
    return data[:at] + struct.pack(">HH", side, side) + data[at + 4 :]


def _chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def _zeros(count: int) -> bytes:
    packer = zlib.compressobj(1)
    return b"".join(packer.compress(bytes(1 << 20)) for _ in range(count >> 20)) + packer.flush()


def _one_bit_png(w: int, h: int) -> bytes:
    packer = zlib.compressobj(1)
    rows = b"".join(packer.compress(bytes(1 + (w + 7) // 8) * 100) for _ in range(h // 100)) + packer.flush()
    head = _chunk(b"IHDR", struct.pack(">IIBBBBB", w, h, 1, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + _chunk(b"IDAT", rows) + _chunk(b"IEND", b"")


def _with_chunk(png: bytes, kind: bytes, body: bytes) -> bytes:
    return png[:33] + _chunk(kind, body) + png[33:]


def _many_chunks(png: bytes, count: int) -> bytes:
    return png[:33] + _chunk(b"teXt", b"") * count + png[33:]


def _with_pixels(png: bytes, stream: bytes) -> bytes:
    return png[:33] + _chunk(b"IDAT", stream) + _chunk(b"IEND", b"")


def _strip_bomb() -> bytes:
    """A TIFF of 100 x 80 pixels whose only strip inflates to 256 megabytes."""
    stream = io.BytesIO()
    tifffile.imwrite(stream, np.zeros((80, 100), np.uint8), compression="zlib", metadata=None)
    data = bytearray(stream.getvalue())
    with tifffile.TiffFile(io.BytesIO(data)) as file:
        tags = file.pages.first.tags
        offsets, counts = tags["StripOffsets"], tags["StripByteCounts"]
    bomb = _zeros(1 << 28)
    struct.pack_into("<I", data, offsets.valueoffset, len(data))
    struct.pack_into("<H" if counts.dtype == 3 else "<I", data, counts.valueoffset, min(len(bomb), 0xFFFF))
    return bytes(data) + bomb


def _circle(tiff: bytes) -> bytes:
    """The link of the last directory leads back to the first."""
    (start,) = struct.unpack_from("<I", tiff, 4)
    (count,) = struct.unpack_from("<H", tiff, start)
    link = start + 2 + 12 * count
    return tiff[:link] + struct.pack("<I", start) + tiff[link + 4 :]


def _giant_tile() -> bytes:
    """A small picture in one tile that claims to be enormous."""
    stream = io.BytesIO()
    tifffile.imwrite(stream, np.zeros((64, 80), np.uint8), tile=(64, 80), compression="zlib", metadata=None)
    data = bytearray(stream.getvalue())
    with tifffile.TiffFile(io.BytesIO(data)) as file:
        places = [file.pages.first.tags[code].valueoffset for code in (322, 323)]
    for place in places:
        struct.pack_into("<I", data, place, 65_520)
    return bytes(data)


def _many_scans(jpeg: bytes, count: int) -> bytes:
    """The last scan of a progressive JPEG again and again."""
    last = jpeg.rindex(b"\xff\xda")
    return jpeg[:last] + jpeg[last:-2] * count + jpeg[-2:]


# Reading


def make_corpus(folder: Path, count: int, seed: int) -> list[Case]:
    """Write `count` files, the hostile ones first; the same seed gives the same bytes."""
    rng = np.random.default_rng(seed)
    hostile = hostile_files()
    cases = [Case(path=folder / name, sound=None, kind="hostile") for name in hostile]
    for name, data in hostile.items():
        (folder / name).write_bytes(data)
    sound = sound_files()
    for name, data in sound.items():
        (folder / f"sound-{name}").write_bytes(data)
    names = list(sound)
    for i in range(count - len(cases)):
        name, damage = names[i % len(names)], DAMAGES[i // len(names) % len(DAMAGES)]
        path = folder / f"{i:04}-{damage.__name__}-{name}"
        path.write_bytes(damage(sound[name], rng))
        cases.append(Case(path=path, sound=folder / f"sound-{name}", kind=damage.__name__))
    return cases[:count]


def judge(case: Case) -> str:
    """What became of one file: one of `GOOD`, or what is wrong."""
    started = time.process_time()
    pixels, refusal = None, ""
    try:
        pixels = read_picture(case.path).pixels
    except ImageReadError as error:
        refusal = str(error)
    took_s = time.process_time() - started
    if took_s > MAX_READ_S:
        return f"took {took_s:.1f} s"
    if pixels is None:
        return _judge_refusal(case.path, refusal)
    if case.sound and _alike(pixels, read_picture(case.sound).pixels, case.path):
        return "as the sound file"
    try:
        expected = reference(case.path)
    except Exception as error:  # decoders raise what they like on damaged bytes
        return f"read, and the reference refuses: {error}"
    return "as the reference" if _alike(pixels, expected, case.path) else "differs from the reference"


def reference(path: Path) -> np.ndarray:
    """The pixels as another library reads them, strictly; where there is none, as the decoder itself does."""
    data = path.read_bytes()
    if b"\xff\x0a" in data[:64] and b"PNG" not in data[:8]:
        return np.asarray(imagecodecs.jpegxl_decode(data, index=0))
    if path.suffix == ".dng":
        with rawpy.imread(io.BytesIO(data)) as raw:
            return np.asarray(raw.postprocess(output_bps=16, use_camera_wb=True, no_auto_bright=True))
    if data[:2] in (b"II", b"MM"):
        return np.asarray(tifffile.imread(io.BytesIO(data), key=0))
    if data.startswith(b"\x89PNG"):
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB) if pixels.ndim == 3 else pixels)
    if path.suffix == ".heic":
        return np.array(pillow_heif.open_heif(io.BytesIO(data))[0])
    with Image.open(io.BytesIO(data)) as image:
        return np.asarray(image.convert({"1": "L", "P": "RGB"}.get(image.mode, image.mode)))


def _judge_refusal(path: Path, message: str) -> str:
    """The whole command must end with this one line and exit code 3."""
    said = io.StringIO()
    with contextlib.redirect_stderr(said):
        code = autoalign(["pair", str(path), str(path), "--json", "-", "--quiet"])
    line = said.getvalue()
    if code != 3 or line.count("\n") != 1 or not all(text.endswith(f": {path}") for text in (message, line[:-1])):
        return f"exit code {code} and {line!r}"
    return "refused"


def _alike(pixels: np.ndarray, expected: np.ndarray, path: Path) -> bool:
    if pixels.shape != expected.shape or pixels.dtype != expected.dtype:
        return False
    if "jpeg" in path.name or path.suffix == ".jpg":
        return bool(np.abs(pixels.astype(int) - expected).max() <= JPEG_TOLERANCE)
    return np.array_equal(pixels, expected, equal_nan=pixels.dtype == np.float32)


def run(count: int, seed: int, workers: int, folder: Path) -> dict[Case, str]:
    """Every case and what became of it."""
    found = {}
    for outcome in LocalEngine(workers=workers, limits=LIMITS).run(judge, make_corpus(folder, count, seed)):
        casualty = outcome.casualty
        found[outcome.job] = f"{casualty.cause}: {casualty.reason}" if casualty else str(outcome.result)
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=620)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--keep", type=Path, help="folder for the files; by default they are deleted")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.keep or Path(temporary)
        folder.mkdir(exist_ok=True)
        found = run(options.count, options.seed, options.workers, folder)
    kinds = sorted({case.kind for case in found})
    for kind in kinds:
        print(kind, dict(Counter(verdict for case, verdict in found.items() if case.kind == kind and verdict in GOOD)))
    failed = {case.path.name: verdict for case, verdict in found.items() if verdict not in GOOD}
    for name, verdict in sorted(failed.items()):
        print(f"FAILED {name}: {verdict}")
    print(f"{len(found)} files, {len(failed)} failed")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
