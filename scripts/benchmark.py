"""Time of a pair against its floor and against the OpenCV recipes, all in one run, as ratios.

    python scripts/benchmark.py [--picture FILE] [--megapixels 0.3 0.5 1 3 12 30 100] [--repeats 3]

Two views of one photograph are rendered at every size (known transform, other exposure, noise) and saved as JPEG. The
floor is what any program must do: decode both, warp one, encode it. `autoalign` is the same plus `align`. The recipes
are OpenCV's SIFT + ratio test + MAGSAC++, at full size and shrunken to 1 MP, plus the same floor. Times are the least
of the repeats, in units of the floor; memory is what a fresh process takes at its peak, beyond its imports, over the
bytes of the two decoded pictures.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from autoalign.files.read import read_picture
from autoalign.files.write import write_picture
from autoalign.geometry.homography import project
from autoalign.picture.pixels import grey, shrink, size_of
from autoalign.picture.warp import warp
from autoalign.registration.align import align
from autoalign.registration.alignment import Alignment

STAGES = ("detect", "match", "consensus", "refine", "verdict")


def photograph(file: Path | None, megapixels: float) -> np.ndarray:
    """An RGB picture of about 4 : 3 with detail at every scale: the photograph.

    One that is too small is enlarged, which is nowhere the same twice, and tiled, which is sharp; half of either.
    """
    if file is None:
        from skimage import data

        source = np.concatenate([data.astronaut()[:400, :500], data.coffee()[:400, :500]], axis=1)
    else:
        source = read_picture(file).pixels[..., :3]
    w, h = (round((megapixels * 1e6 * r) ** 0.5) for r in (4 / 3, 3 / 4))
    if source.shape[0] >= h * 0.7:
        return np.asarray(cv2.resize(source, (w, h), interpolation=cv2.INTER_AREA))
    times = int(np.ceil(max(h / source.shape[0], w / source.shape[1])))
    tiled = np.concatenate([np.roll(source, 37 * k, axis=1) for k in range(times)], axis=0)
    tiled = np.concatenate([np.roll(tiled, 53 * k, axis=0)[:, :: (-1) ** k] for k in range(times)], axis=1)
    return cv2.addWeighted(cv2.resize(source, (w, h), interpolation=cv2.INTER_CUBIC), 0.5, tiled[:h, :w], 0.5, 0)


def make_pair(folder: Path, file: Path | None, megapixels: float) -> tuple[Path, Path, np.ndarray]:
    """Two JPEG views of one photograph and the transform that takes the second to the first."""
    picture = photograph(file, megapixels)
    w, h = size_of(picture)
    s = 1 / np.hypot(w, h)
    moving_from_fixed = np.array([[0.98, 0.08, 0.01 / s], [-0.07, 1.01, 0.03 / s], [0.04 * s, -0.05 * s, 1.0]])
    rng = np.random.default_rng(7)
    moved = warp(picture, (w, h), moving_from_fixed).pixels
    paths = folder / "fixed.jpg", folder / "moving.jpg"
    for path, image, gain in zip(paths, (picture, moved), (1.0, 0.85), strict=True):
        noise = cv2.resize(rng.normal(0, 3, (1024, 1024)).astype(np.float32), (w, h), interpolation=cv2.INTER_NEAREST)
        write_picture(path, np.clip(image * gain + noise[..., None], 0, 255).astype(np.uint8), overwrite=True)
    return *paths, np.linalg.inv(moving_from_fixed)


def floor(fixed: Path, moving: Path, estimate: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> None:
    """Decode both, estimate, warp, encode."""
    still, mover = read_picture(fixed).pixels, read_picture(moving).pixels
    drawn = warp(mover, size_of(still), estimate(still, mover)).pixels
    write_picture(moving.with_name("out.jpg"), drawn, overwrite=True)


def recipe(still: np.ndarray, mover: np.ndarray, max_pixels: float) -> np.ndarray:
    """The strong recipe people run: SIFT 8000, RootSIFT, ratio 0.8, mutual, MAGSAC++."""
    found = []
    for image in (still, mover):
        small = shrink(np.asarray(grey(image)), max_pixels)
        points, descriptors = cv2.SIFT.create(8000).detectAndCompute(small.pixels, None)
        xy = np.array([p.pt for p in points]) * small.full_from_small[0, 0] + small.full_from_small[0, 2]
        found.append((xy, np.sqrt(descriptors / (descriptors.sum(1, keepdims=True) + 1e-7))))
    (a, da), (b, db) = found
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    back = {m.queryIdx: m.trainIdx for m in matcher.match(da, db)}
    good = [
        m for m, n in matcher.knnMatch(db, da, k=2) if m.distance < 0.8 * n.distance and back[m.trainIdx] == m.queryIdx
    ]
    src, dst = np.array([b[m.queryIdx] for m in good]), np.array([a[m.trainIdx] for m in good])
    return cv2.findHomography(src, dst, cv2.USAC_MAGSAC, 2.0, maxIters=10000, confidence=0.9999)[0]


def ours(still: np.ndarray, mover: np.ndarray, kept: list[Alignment]) -> np.ndarray:
    kept.append(align(still, mover))
    return kept[-1].fixed_from_moving


def least_seconds(run: Callable[[], None], repeats: int) -> float:
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return min(times)


def error_px(found: np.ndarray, truth: np.ndarray, size: tuple[int, int]) -> float:
    grid = np.stack(np.meshgrid(*(np.linspace(0, s - 1, 20) for s in size)), -1).reshape(-1, 2)
    return float(np.linalg.norm(project(found, grid)[0] - project(truth, grid)[0], axis=1).mean())


def peak_bytes(fixed: Path, moving: Path) -> int:
    """Peak memory that a fresh process takes, beyond its imports, to align the pair and write the result."""
    code = (
        "import re, sys; from pathlib import Path; import benchmark as b;"
        "status = lambda: Path('/proc/self/status').read_text();"
        "now = int(re.search(r'VmRSS:\\s+(\\d+)', status())[1]);"
        "b.floor(Path(sys.argv[1]), Path(sys.argv[2]), lambda f, m: b.ours(f, m, []));"
        "print(int(re.search(r'VmHWM:\\s+(\\d+)', status())[1]) - now)"
    )
    here = Path(__file__).parent
    done = subprocess.run(
        [sys.executable, "-c", code, str(fixed), str(moving)], capture_output=True, text=True, cwd=here, check=True
    )
    return int(done.stdout) * 1024


def measure(file: Path | None, megapixels: float, repeats: int, with_recipes: bool) -> None:
    with tempfile.TemporaryDirectory() as folder:
        fixed, moving, truth = make_pair(Path(folder), file, megapixels)
        size = size_of(read_picture(fixed).pixels)
        kept: list[Alignment] = []
        base = least_seconds(lambda: floor(fixed, moving, lambda f, m: truth), repeats)
        whole = least_seconds(lambda: floor(fixed, moving, lambda f, m: ours(f, m, kept)), repeats)
        stages = {s: min(k.seconds.get(s, 0.0) for k in kept) / base for s in STAGES}
        memory = peak_bytes(fixed, moving) / (6 * size[0] * size[1])
        line = (
            f"{megapixels:6.1f} MP  autoalign {whole / base:5.2f}  ("
            + " ".join(f"{s} {t:.2f}" for s, t in stages.items())
            + f")  {kept[-1].status} {error_px(kept[-1].fixed_from_moving, truth, size):.4f} px  memory {memory:.1f}"
        )
        if with_recipes:
            for name, limit in (("full size", 1e12), ("1 MP", 1e6)):
                found: list[np.ndarray] = []
                spent = least_seconds(
                    lambda limit=limit, found=found: floor(
                        fixed, moving, lambda f, m: found.append(recipe(f, m, limit)) or found[-1]
                    ),
                    1,
                )
                line += f"  magsac at {name} {spent / base:.2f} ({error_px(found[-1], truth, size):.3f} px)"
        print(line, flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--megapixels", type=float, nargs="+", default=[0.3, 0.5, 1, 3, 12, 30, 100])
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    print("times in units of the floor: decode both + warp + encode; memory in units of the two decoded pictures")
    for megapixels in arguments.megapixels:
        measure(arguments.picture, megapixels, arguments.repeats, with_recipes=megapixels <= 12)


if __name__ == "__main__":
    main()
