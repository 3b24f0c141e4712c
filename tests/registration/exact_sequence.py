"""Time-lapses whose transforms are known exactly: views that drift over a scene and shake, under passing light."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from exact_pairs import camera, photo, render, turn
from numpy.typing import NDArray

from autoalign.geometry.homography import Array, apply, invert, shown, translation


@dataclass(frozen=True, kw_only=True)
class TimeLapse:
    """The frames, and the truth."""

    frames: tuple[NDArray[np.uint8], ...]
    reference_from_frame: tuple[Array, ...]  # (3, 3), [2, 2] == 1; the reference is the first frame

    @property
    def size(self) -> tuple[int, int]:
        """(w, h) of every frame."""
        rows, columns = self.frames[0].shape
        return columns, rows

    def error_px(self, found: Array, frame: int) -> float:
        """Mean distance from the truth over the whole frame, px of the reference."""
        grid = np.stack(np.meshgrid(*(np.linspace(0, s - 1, 16) for s in self.size)), -1).reshape(-1, 2)
        off = apply(found, grid) - apply(self.reference_from_frame[frame], grid)
        return float(np.linalg.norm(off, axis=1).mean())


def time_lapse(
    name: str,
    count: int,
    size: tuple[int, int],
    *,
    drift: tuple[float, float] = (0.5, 0.15),
    shake_px: float = 4.0,
    shake_degrees: float = 0.7,
    noise: float = 2.0,
    seed: int = 0,
) -> TimeLapse:
    """`count` frames over the middle of a picture: the last one has drifted by these shares of the frame's sides."""
    rng = np.random.default_rng(seed)
    (rows, columns), (w, h) = photo(name).shape[:2], size
    travel = np.array(drift) * size
    start = (np.array([columns, rows]) - size - travel) / 2
    scene_from_frame, frames = [], []
    for i in range(count):
        moved = start + travel * i / (count - 1) + rng.normal(0, shake_px, 2)
        shaken = turn((w - 1) / 2, (h - 1) / 2, rng.normal(0, shake_degrees), np.exp(rng.normal(0, 0.005)))
        scene_from_frame.append(translation(*moved) @ shaken)
        light = 0.8 + 0.2 * np.cos(3.0 * i / count) + 0.05 * rng.normal()
        seen = render(name, scene_from_frame[-1], size)
        frames.append(camera(seen, seed + 1 + i, noise=noise, gain=light, bias=10.0 * rng.normal()))
    reference_from_scene = invert(scene_from_frame[0])
    return TimeLapse(
        frames=tuple(frames),
        reference_from_frame=tuple(shown(reference_from_scene @ each) for each in scene_from_frame),
    )
