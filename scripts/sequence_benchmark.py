"""A long time-lapse, put onto its first frame: solved together, beside plain chaining and each frame straight.

    python scripts/sequence_benchmark.py [--frames 100] [--size 480 400] [--picture hubble_deep_field.jpg]
                                         [--drift 0.5 0.15] [--noise 2] [--wrong 0] [--seed 0] [--jobs 2]

The frames are rendered from one picture of scikit-image, so that all transforms are known exactly: the view drifts by
so many shares of its sides from the first frame to the last, each frame is shaken (4 px, 0.7 degrees, 0.5 % zoom), the
light changes, and each frame has noise of its own. `--wrong` puts so many of the aligned links 5 to 100 px off.

Printed are errors, mean over the whole frame, in px of the reference: `together` is the network of all links,
`neighbours` the same network of the links between neighbours only, `chained` their plain product, `straight` one
alignment onto the first frame. `expected` is what the network says of its own error.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from itertools import accumulate
from pathlib import Path
from time import perf_counter

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "tests" / "registration"))  # the scenes of the tests

from exact_sequence import TimeLapse, time_lapse

from autoalign.geometry.homography import Array, translation
from autoalign.registration.align import align
from autoalign.registration.sequence import Link, SequenceFrame, link_of, links, solve_sequence

_lapse: TimeLapse  # of a worker


def _start(lapse: TimeLapse) -> None:
    global _lapse
    _lapse = lapse
    cv2.setNumThreads(1)


def aligned(pair: tuple[int, int]) -> tuple[Link, Array | None]:
    """The link, and the transform of the pair's own verdict; None if rejected."""
    fixed, moving = pair
    alignment = align(_lapse.frames[fixed], _lapse.frames[moving])
    link = link_of(alignment, fixed, moving)
    return link, None if alignment.status == "rejected" else alignment.fixed_from_moving


def spoilt(found: list[Link], count: int, rng: np.random.Generator) -> list[Link]:
    """The links, some of the aligned ones shifted."""
    out = list(found)
    for k in rng.choice([k for k, link in enumerate(found) if link.status == "aligned"], count, replace=False):
        turn, shift = rng.uniform(0, 2 * np.pi), rng.uniform(5, 100)
        off = np.array(found[k].fixed_from_moving) @ translation(shift * np.cos(turn), shift * np.sin(turn))
        out[k] = replace(found[k], fixed_from_moving=tuple(map(tuple, off.tolist())))
    return out


def errors(lapse: TimeLapse, frames: tuple[SequenceFrame, ...]) -> list[float]:
    transforms = [frame.reference_from_frame for frame in frames]
    return [np.nan if t is None else lapse.error_px(t, i) for i, t in enumerate(transforms)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--size", type=int, nargs=2, default=(480, 400), help="w h of a frame")
    parser.add_argument("--picture", default="hubble_deep_field.jpg", help="of skimage.data")
    parser.add_argument("--drift", type=float, nargs=2, default=(0.5, 0.15), help="shares of the frame's sides")
    parser.add_argument("--noise", type=float, default=2.0, help="grey levels")
    parser.add_argument("--wrong", type=int, default=0, help="links put off")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2)
    chosen = parser.parse_args()
    n, pairs = chosen.frames, links(chosen.frames, 0)
    lapse = time_lapse(
        chosen.picture, n, tuple(chosen.size), drift=tuple(chosen.drift), noise=chosen.noise, seed=chosen.seed
    )
    start = perf_counter()
    with ProcessPoolExecutor(chosen.jobs, initializer=partial(_start, lapse)) as pool:
        results = dict(zip(pairs, pool.map(aligned, pairs, chunksize=4), strict=True))
    spent = perf_counter() - start
    found = [link for link, _ in results.values()]
    print(f"{len(found)} links in {spent:.0f} s: {dict(Counter(link.status for link in found))}")
    found = spoilt(found, chosen.wrong, np.random.default_rng(chosen.seed))

    start = perf_counter()
    frames = solve_sequence(n, 0, found, [lapse.size] * n)
    overruled = {pair for frame in frames for pair in frame.overruled}
    print(f"solved in {perf_counter() - start:.2f} s: {dict(Counter(frame.status for frame in frames))}, ", end="")
    print(f"{frames[-1].model}, {len(overruled)} overruled")
    near = [link for link in found if link.moving == link.fixed + 1]
    steps = [results[i, i + 1][1] for i in range(n - 1)]
    nan = np.full((3, 3), np.nan)
    product = accumulate((nan if t is None else t for t in steps), np.matmul, initial=np.eye(3))
    straight = [np.eye(3)] + [nan if results[0, i][1] is None else results[0, i][1] for i in range(1, n)]
    table = {
        "together": errors(lapse, frames),
        "neighbours": errors(lapse, solve_sequence(n, 0, near, [lapse.size] * n)),
        "chained": [np.nan if np.isnan(t).any() else lapse.error_px(t, i) for i, t in enumerate(product)],
        "straight": [np.nan if np.isnan(t).any() else lapse.error_px(t, i) for i, t in enumerate(straight)],
        "expected": [np.nan if frame.expected_error_px is None else frame.expected_error_px for frame in frames],
    }
    print(f"{'frame':>6} " + " ".join(f"{name:>10}" for name in table))
    for i in np.unique(np.linspace(1, n - 1, 11).round().astype(int)):
        print(f"{i:6} " + " ".join(f"{column[i]:10.4f}" for column in table.values()))
    for name, of in (("mean", np.nanmean), ("worst", np.nanmax)):
        print(f"{name:>6} " + " ".join(f"{of(column[1:]):10.4f}" for column in table.values()))


if __name__ == "__main__":
    main()
