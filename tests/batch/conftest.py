"""A folder of pictures as batches meet it: some of one thing, one of another, one that is no picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from skimage.data import camera, coins

import autoalign as aa


def views(count: int, size: tuple[int, int] = (240, 180)) -> list[np.ndarray]:
    """Grey views (h, w) of one scene, each shifted by a few whole pixels."""
    w, h = size
    scene = camera()
    return [np.ascontiguousarray(scene[60 + 3 * k : 60 + 3 * k + h, 90 + 5 * k : 90 + 5 * k + w]) for k in range(count)]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """in/ with frame1, frame2, frame10 of one scene, stranger.png of another, damaged.png, notes.txt, below/frame3."""
    source = tmp_path / "in"
    (source / "below").mkdir(parents=True)
    one, two, three, ten = views(4)
    aa.write_picture(source / "frame1.png", one)
    aa.write_picture(source / "frame2.png", two)
    aa.write_picture(source / "below" / "frame3.png", three)
    aa.write_picture(source / "frame10.png", ten)
    aa.write_picture(source / "stranger.png", np.ascontiguousarray(coins()[20:200, 30:270]))
    whole = (source / "frame1.png").read_bytes()
    (source / "damaged.png").write_bytes(whole[: len(whole) // 2])
    (source / "notes.txt").write_text("no picture")
    (source / ".hidden.png").write_bytes(whole)
    return source
