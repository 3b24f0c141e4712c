"""A pair of one gigapixel: is it aligned in bounded memory, how well, and how fast is it drawn?

    python scripts/gigapixel.py [--size 32768 30518] [--channels 3] [--batch] [--folder DIR]

Two views of one scene are written tile by tile as BigTIFF (a known transform, noise of its own in each), `autoalign
pair` puts one onto the other in a process of its own, and what that process took at its peak is measured; with --batch
`autoalign batch` does so too, with one worker, and its files must be the same. Then the same transform is drawn from
the file, strip by strip, with and without writing it, and a part of the picture that fits into memory is drawn by one
call of `warp`, all in one run: the ratios are what to look at.
"""

from __future__ import annotations

import argparse
import filecmp
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import psutil
import tifffile

from autoalign.files.large import opened_picture
from autoalign.files.result import Placed, ResultFiles, write_placed
from autoalign.files.sidecar import read_sidecar, transform_of
from autoalign.geometry.homography import project
from autoalign.picture.warp import warp
from autoalign.registration.drawing import Drawing

TILE = 512
FINE, COARSE = 2048, 2048  # texels of the two textures that the scene is made of
COARSE_PX = 24  # px a texel of the coarse one, which does not repeat within 49,152 px
NOISE = 1.5  # grey levels
POLL_S = 0.02  # between two looks at how much memory is taken
IN_MEMORY = 8192  # px a side of the part that is drawn in memory


def texture(seed: int, side: int, channels: int, blurs: tuple[float, ...]) -> np.ndarray:
    """(side, side, channels) noise with detail of several sizes, seamless where it repeats; mean 0, deviation 1."""
    rng = np.random.default_rng(seed)
    total = np.zeros((side, side, channels), np.float32)
    for blur in blurs:
        rim = int(4 * blur) + 1
        wide = np.pad(rng.standard_normal((side, side, channels), np.float32), ((rim, rim), (rim, rim), (0, 0)), "wrap")
        smooth = cv2.GaussianBlur(wide, (0, 0), blur)[rim:-rim, rim:-rim].reshape(total.shape)
        total += smooth / smooth.std()
    return total / total.std()


class Scene:
    """What both pictures show, at any place: a texture with detail of a pixel, over a coarse one that never repeats."""

    def __init__(self, channels: int) -> None:
        # One more texel, so that the last one has a neighbour to interpolate with.
        self._fine = np.pad(texture(1, FINE, channels, (1.0, 3.0, 9.0)), ((0, 1), (0, 1), (0, 0)), "wrap") * 25
        self._coarse = np.pad(texture(2, COARSE, 1, (1.5, 6.0)), ((0, 1), (0, 1), (0, 0)), "wrap") * 30

    def at(self, places: np.ndarray) -> np.ndarray:
        """(h, w, channels) brightness at places (h, w, 2), whole numbers falling on texels of the fine texture."""
        fine, coarse = np.mod(places, FINE), np.mod(places / COARSE_PX, COARSE)
        seen = [
            cv2.remap(plane, *cv2.split(where.astype(np.float32)), cv2.INTER_LINEAR)
            for plane, where in ((self._fine, fine), (self._coarse, coarse))
        ]
        return 128 + np.atleast_3d(seen[0]) + np.atleast_3d(seen[1])


def truth(size: tuple[int, int]) -> np.ndarray:
    """(3, 3) fixed from moving: a turn by a degree and a half, a little scale, shear and tilt."""
    w, h = size
    turn = np.deg2rad(1.5)
    c, s = np.cos(turn), np.sin(turn)
    return np.array([[1.004 * c, -s, 0.021 * w], [s, 0.997 * c, -0.008 * h], [4e-3 / w, -3e-3 / h, 1]])


def tiles(scene: Scene, size: tuple[int, int], fixed_from_view: np.ndarray, seed: int) -> Iterator[np.ndarray]:
    """The tiles (512, 512, c) of a view, row by row; those at the rim reach over it."""
    rng = np.random.default_rng(seed)
    channels = scene.at(np.zeros((1, 1, 2))).shape[2]
    noise = rng.normal(0, NOISE, (2 * TILE, 2 * TILE, channels)).astype(np.float32)
    columns, rows = np.meshgrid(np.arange(TILE), np.arange(TILE))
    for y in range(0, size[1], TILE):
        for x in range(0, size[0], TILE):
            pixels = np.stack([(columns + x).ravel(), (rows + y).ravel()], axis=1)
            places, _ = project(fixed_from_view, pixels.astype(np.float64))
            left, top = rng.integers(0, TILE, 2)
            view = scene.at(places.reshape(TILE, TILE, 2)) + noise[top : top + TILE, left : left + TILE]
            yield np.clip(np.rint(view), 0, 255).astype(np.uint8)


def make_pair(folder: Path, size: tuple[int, int], channels: int) -> np.ndarray:
    """fixed.tif and moving.tif, and the transform (3, 3) that takes the second to the first."""
    scene, fixed_from_moving = Scene(channels), truth(size)
    for name, transform, seed in (("fixed", np.eye(3), 3), ("moving", fixed_from_moving, 4)):
        tifffile.imwrite(
            folder / f"{name}.tif",
            tiles(scene, size, transform, seed),
            shape=(size[1], size[0], channels),
            dtype=np.uint8,
            photometric="rgb" if channels == 3 else "minisblack",
            planarconfig="contig",
            tile=(TILE, TILE),
            compression="zlib",
            compressionargs={"level": 1},
            predictor=True,
            bigtiff=True,
            metadata=None,
        )
    return fixed_from_moving


def error_px(found: np.ndarray, true: np.ndarray, size: tuple[int, int]) -> float:
    """Mean distance of two transforms (3, 3) over the moving picture (w, h), px of the fixed one."""
    x, y = np.meshgrid(*(np.linspace(0, side - 1, 50) for side in size))
    points = np.stack([x.ravel(), y.ravel()], axis=1)
    return float(np.linalg.norm(project(found, points)[0] - project(true, points)[0], axis=1).mean())


PAIR = ("pair", "fixed.tif", "moving.tif", "-o", "aligned.tif", "--overwrite", "-v")
BATCH = ("batch", ".", "--reference", "fixed.tif", "--include", "moving.tif", "--out-dir", "batch", "--workers", "1")
RESULTS = (("aligned.tif", "moving.tif"), ("aligned.autoalign.json", "moving.tif.autoalign.json"))  # of pair, of batch


def run(folder: Path, words: tuple[str, ...]) -> tuple[float, float]:
    """Align the pair in a process of its own: seconds, and GB resident at the peak of it or of one that it started."""
    started, peak = time.perf_counter(), 0
    process = psutil.Popen([sys.executable, "-m", "autoalign.cli.main", *words], cwd=folder)
    while process.poll() is None:
        with suppress(psutil.Error):  # one that has just ended
            peak = max(peak, *(one.memory_info().rss for one in (process, *process.children(recursive=True))))
        time.sleep(POLL_S)
    if process.returncode:
        raise SystemExit(f"autoalign ended with {process.returncode}")
    return time.perf_counter() - started, peak / 1e9


def speeds(folder: Path, fixed_from_moving: np.ndarray, size: tuple[int, int]) -> dict[str, float]:
    """MP/s of drawing the moving picture, of output."""
    found = {}
    with opened_picture(folder / "moving.tif") as moving:
        what = Placed(picture=moving, fixed_size=size, fixed_from_moving=fixed_from_moving, drawing=Drawing())
        side = min(IN_MEMORY, *size)
        part = moving.pixels[slice(0, side), slice(0, side)]
        found["in memory"] = _rate((side, side), lambda: warp(part, (side, side), fixed_from_moving))
        found["from the file"] = _rate(size, lambda: [None for _ in what.strips()])
        files = ResultFiles(aligned=folder / "drawn.tif")
        found["from the file to a file"] = _rate(size, lambda: write_placed(files, what, None, in_strips=True))
        files.aligned.unlink()
    return found


def _rate(size: tuple[int, int], draw) -> float:
    started = time.perf_counter()
    draw()
    return size[0] * size[1] / 1e6 / (time.perf_counter() - started)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--size", type=int, nargs=2, default=(32_768, 30_518))
    parser.add_argument("--channels", type=int, choices=(1, 3), default=3)
    parser.add_argument("--batch", action="store_true", help="also align the pair as a batch")
    parser.add_argument("--folder", type=Path, default=None, help="in which there is room for 8 GB for a while")
    words = parser.parse_args()
    size = (words.size[0], words.size[1])
    with tempfile.TemporaryDirectory(dir=words.folder) as name:
        folder = Path(name)
        started = time.perf_counter()
        true = make_pair(folder, size, words.channels)
        sizes_gb = [round((folder / f"{one}.tif").stat().st_size / 1e9, 2) for one in ("fixed", "moving")]
        print(
            f"made two pictures of {size[0]} x {size[1]}: {sizes_gb} GB, {time.perf_counter() - started:.0f} s",
            flush=True,
        )
        seconds, gb = run(folder, PAIR)
        record = read_sidecar(folder / "aligned.autoalign.json")
        error = error_px(transform_of(record), true, size)
        print(f"{record.status}: {error:.3f} px of error, {record.expected_error_px:.3f} expected; ", end="")
        print(
            f"{seconds:.0f} s, {gb:.2f} GB at the peak; output {(folder / 'aligned.tif').stat().st_size / 1e9:.2f} GB"
        )
        if words.batch:
            seconds, gb = run(folder, BATCH)
            same = all(filecmp.cmp(folder / a, folder / "batch" / b, shallow=False) for a, b in RESULTS)
            print(f"the same as a batch: {seconds:.0f} s, {gb:.2f} GB at the peak; files are equal: {same}", flush=True)
        rates = speeds(folder, true, size)
        for what, rate in rates.items():
            print(f"drawn {what}: {rate:.1f} MP/s, {rate / rates['in memory']:.2f} of that in memory")


if __name__ == "__main__":
    main()
