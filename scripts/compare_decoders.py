"""Time to read a 12 MP JPEG, whole and strictly, against the decoders there are, all in one run, as ratios.

    python scripts/compare_decoders.py [--picture FILE] [--megapixels 12] [--repeats 7]

Every decoder gets the same bytes and gives all pixels in colour; `autoalign` also reads the file, its metadata and its
SHA-256. Times are the least of the repeats, which take turns, in processor seconds over those of the fastest.
"""

from __future__ import annotations

import argparse
import io
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import simplejpeg
from PIL import Image

from autoalign.files.read import read_picture
from benchmark import photograph


def decoders(path: Path) -> dict[str, Callable[[], object]]:
    """Name to what decodes the file once."""
    data = path.read_bytes()
    stream = np.frombuffer(data, np.uint8)
    return {
        "autoalign": lambda: read_picture(path).pixels,
        "cv2": lambda: cv2.imdecode(stream, cv2.IMREAD_COLOR),
        "Pillow": lambda: np.asarray(Image.open(io.BytesIO(data))),
        "simplejpeg": lambda: simplejpeg.decode_jpeg(data),
    }


def least_seconds(actions: dict[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """Processor seconds of each, the least of the repeats; they take turns, so that a busy moment is no one's own."""
    seconds = dict.fromkeys(actions, np.inf)
    for _ in range(repeats):
        for name, action in actions.items():
            started = time.process_time()
            action()
            seconds[name] = min(seconds[name], time.process_time() - started)
    return seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--megapixels", type=float, default=12)
    parser.add_argument("--repeats", type=int, default=7)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "picture.jpg"
        Image.fromarray(photograph(options.picture, options.megapixels)).save(path, quality=90)
        seconds = least_seconds(decoders(path), options.repeats)
    fastest = min(seconds.values())
    for name, taken in sorted(seconds.items(), key=lambda pair: pair[1]):
        print(f"{name:12} {taken / fastest:.2f}")


if __name__ == "__main__":
    main()
