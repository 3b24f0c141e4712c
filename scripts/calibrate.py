"""Evidence of true, unrelated and trap pairs, and what the verdict makes of it.

    python scripts/calibrate.py --data DIR [--unrelated 200] [--captions 100] [--effort normal] [--save rows.json]

DIR holds `pairs/<sequence>/{1,2,...}.*, H_1_k` (the HPatches layout) and `traps/*/{1,2}.*`. Unrelated pairs are drawn
from sequences that show different scenes; `--captions` burns one made-up caption into both pictures of so many of them.
Prints, for each piece of evidence, how far the groups lie apart, and the verdicts; a threshold is sound if it also
holds for each scene when it is chosen without that scene (leave one scene out).
"""

from __future__ import annotations

import argparse
import json
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from autoalign.files.read import read_picture
from autoalign.geometry.family import MODELS, fit
from autoalign.geometry.homography import apply, project
from autoalign.geometry.least_squares import correspondences, polish
from autoalign.registration.align import align
from autoalign.registration.alignment import Alignment, AlignOptions


def related(root: Path) -> list[dict[str, Any]]:
    jobs = []
    for sequence in sorted(p for p in root.iterdir() if p.is_dir()):
        pictures = {p.stem: p for p in sequence.iterdir() if p.stem.isdigit()}
        for truth in sorted(sequence.glob("H_1_*")):
            k = truth.name.split("_")[-1]
            marks = sequence / f"landmarks_1_{k}.csv"
            jobs.append(
                {
                    "kind": "related",
                    "name": f"{sequence.name} 1-{k}",
                    "scene": scene(sequence),
                    "fixed": str(pictures[k]),
                    "moving": str(pictures["1"]),
                    "truth": str(truth),
                    "landmarks": str(marks) if marks.exists() else None,
                }
            )
    return jobs


def scene(sequence: Path) -> str:
    file = sequence / "scene"
    return file.read_text().strip() if file.exists() else sequence.name.split("_")[-1].lower()


def unrelated(root: Path, count: int, seed: int, kind: str) -> list[dict[str, Any]]:
    pictures = [
        (scene(s), p) for s in sorted(root.iterdir()) if s.is_dir() for p in sorted(s.iterdir()) if p.stem.isdigit()
    ]
    rng = np.random.default_rng(seed)
    jobs: list[dict[str, Any]] = []
    while len(jobs) < count:
        (a, p), (b, q) = (pictures[i] for i in rng.choice(len(pictures), 2, replace=False))
        if a != b:
            jobs.append(
                {
                    "kind": kind,
                    "name": f"{p.parent.name}/{p.name} {q.parent.name}/{q.name}",
                    "scene": a,
                    "fixed": str(p),
                    "moving": str(q),
                    "seed": int(rng.integers(1 << 31)),
                }
            )
    return jobs


def traps(root: Path) -> list[dict[str, Any]]:
    return [
        {
            "kind": "trap",
            "name": d.name,
            "scene": d.name,
            "fixed": str(next(d.glob("1.*"))),
            "moving": str(next(d.glob("2.*"))),
        }
        for d in sorted(root.iterdir())
    ]


def caption(image: np.ndarray, seed: int) -> np.ndarray:
    """The picture with a strip of made-up text, the same for the same seed."""
    rng = np.random.default_rng(seed)
    image = np.ascontiguousarray(image if image.ndim == 3 else np.repeat(image[..., None], 3, 2))[..., :3].copy()
    lines = int(rng.integers(1, 4))
    height = int(rng.integers(12, max(13, image.shape[0] // (6 * lines))))  # a quarter of the picture at most
    strip = lines * height * 3 // 2
    image[-strip:] = rng.integers(0, 2) * 200
    for line in range(lines):
        text = "".join(chr(c) for c in rng.integers(48, 90, 40))
        at = (10, image.shape[0] - strip + (line + 1) * height * 3 // 2 - height // 3)
        cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, height / 30, (255, 255, 60), 2, cv2.LINE_AA)
    return image


def true_error(job: dict[str, Any], fixed_from_moving: np.ndarray, moving: np.ndarray, fixed: np.ndarray) -> float:
    """Mean distance over the true overlap, or root-mean-square at the landmarks, px of the fixed picture."""
    if job["landmarks"]:
        marks = np.loadtxt(job["landmarks"], delimiter=",", skiprows=1)[:, :4]
        return float(np.sqrt(((apply(fixed_from_moving, marks[:, :2]) - marks[:, 2:]) ** 2).sum(1).mean()))
    grid, truth = in_overlap(job, moving, fixed), np.loadtxt(job["truth"]).reshape(3, 3)
    return float(np.linalg.norm(project(fixed_from_moving, grid)[0] - project(truth, grid)[0], axis=1).mean())


def in_overlap(job: dict[str, Any], moving: np.ndarray, fixed: np.ndarray) -> np.ndarray:
    """(n, 2) points of a grid over moving that truly land in fixed."""
    (h, w), (h2, w2) = moving.shape[:2], fixed.shape[:2]
    grid = np.stack(np.meshgrid(np.linspace(0, w - 1, 48), np.linspace(0, h - 1, 48)), -1).reshape(-1, 2)
    there = project(np.loadtxt(job["truth"]).reshape(3, 3), grid)[0]
    return grid[((there >= 0) & (there <= (w2 - 1, h2 - 1))).all(1)]


def loop_error(
    fixed_from_moving: np.ndarray, back: Alignment, job: dict[str, Any], moving: np.ndarray, fixed: np.ndarray
) -> float:
    """Mean distance over the true overlap by which a point that goes there and back misses itself, px of moving."""
    if back.best.fixed_from_moving is None:
        return float("inf")
    grid = in_overlap(job, moving, fixed)
    there_and_back = project(back.best.fixed_from_moving, project(fixed_from_moving, grid)[0])[0]
    return float(np.linalg.norm(there_and_back - grid, axis=1).mean())


def landmark_noise(job: dict[str, Any]) -> float:
    """Error of the truth, px: by how much hand-placed landmarks miss their own best homography, for its freedom.

    Those of the cmp pairs fit theirs exactly, because they were made from it; it is good to about 1 px.
    """
    if not job["landmarks"]:
        return 0.0
    marks = np.loadtxt(job["landmarks"], delimiter=",", skiprows=1)[:, :4]
    pairs = correspondences(marks[:, :2], marks[:, 2:])
    own = polish(MODELS["homography"], fit("homography", pairs.src, pairs.dst), pairs)
    squared = ((apply(own, pairs.src) - pairs.dst) ** 2).sum(1).mean()
    return max(float(np.sqrt(squared * 2 * len(marks) / max(2 * len(marks) - 8, 1))), 1.0)


def run(job: dict[str, Any], effort: str) -> dict[str, Any]:
    cv2.setNumThreads(1)
    fixed, moving = (read_picture(Path(job[k])).pixels for k in ("fixed", "moving"))
    if job["kind"] == "caption":
        fixed, moving = caption(fixed, job["seed"]), caption(moving, job["seed"])
    alignment = align(fixed, moving, AlignOptions(effort=effort))  # type: ignore[arg-type]
    row = {k: job[k] for k in ("kind", "name", "scene")}
    row |= {
        "status": alignment.status,
        "reason": alignment.reason,
        "model": alignment.model,
        "rung": alignment.best.rung,
        "expected": alignment.expected_error_px,
        "seconds": sum(alignment.seconds.values()),
        "evidence": [
            asdict(a.evidence) | {"share": a.evidence.agreement.share} if a.evidence else None
            for a in alignment.attempts
        ],
        "best": alignment.attempts.index(alignment.best),
        "sharpened": alignment.counts()["sharpened"],
    }
    if job["kind"] == "related":
        found = alignment.best.fixed_from_moving
        row["error"] = float("inf") if found is None else true_error(job, found, moving, fixed)
        row["truth_noise"] = landmark_noise(job)
        if found is not None and job["name"].startswith("exact"):
            row["loop"] = loop_error(found, align(moving, fixed, alignment.options), job, moving, fixed)
    return row


def report(rows: list[dict[str, Any]]) -> None:
    """A line for each related pair and for each other one that was not rejected, and the tally of each group."""
    print(f"{'':5}{'pair':38}{'verdict':10}{'error':>9}{'expected':>9}  model       rung         numbers")
    for row in sorted(rows, key=lambda r: (r["kind"], r.get("error", 0.0))):
        if row["kind"] == "related" or row["status"] != "rejected":
            error, expected = row.get("error", 0.0), row["expected"] or 0.0
            print(
                f"{row['kind'][:4]} {row['name'][:37]:38}{row['status']:10}{error:9.3f}{expected:9.3f}  "
                f"{row['model'] or '-':11.11} {row['rung'][:12]:12} {numbers(row['evidence'][row['best']])}"
            )
    for kind in dict.fromkeys(r["kind"] for r in rows):
        group = [r for r in rows if r["kind"] == kind]
        tally = {s: sum(r["status"] == s for r in group) for s in ("aligned", "doubtful", "rejected")}
        print(kind, len(group), tally, f"mean {np.mean([r['seconds'] for r in group]):.2f} s")


def numbers(evidence: dict[str, Any] | None) -> str:
    if evidence is None:
        return ""
    parts = {
        "log nfa": "{log10_false_alarms:.1f}",
        "alone": "{independent_inliers}/{independent_matches}",
        "share": "{share:.2f}",
        "anisotropy": "{anisotropy:.1f}",
        "halves": "{halves_px:.2f}",
        "fit": "{fit_px:.3f}",
        "model": "{model_px:.3f}",
        "overlap": "{overlap:.2f}",
    }
    return " ".join(f"{name} {form.format(**evidence)}" for name, form in parts.items())


def calibration(rows: list[dict[str, Any]]) -> None:
    """True over expected error of aligned pairs whose truth is exact, or known from landmarks, less good."""
    for name, chosen in (("exact", "exact"), ("landmarks", ("cmp", "mm_cv"))):
        group = [
            r for r in rows if r["kind"] == "related" and r["status"] == "aligned" and r["name"].startswith(chosen)
        ]
        ratio = np.array([r["error"] / np.hypot(r["expected"], r["truth_noise"]) for r in group])
        print(
            f"true over expected error, {name}: {len(group)} pairs, median {np.median(ratio):.2f}, "
            f"within twice {np.mean(ratio <= 2):.1%}, largest {ratio.max():.1f}"
        )
    loops = [r["loop"] for r in rows if "loop" in r]
    if loops:
        print(
            f"there and back, exact: {len(loops)} pairs, median {np.median(loops):.4f} px, largest {max(loops):.4f} px"
        )


def leave_one_scene_out(rows: list[dict[str, Any]]) -> None:
    """For each piece of evidence: the gap between true and false, and what thresholds chosen without a scene do to it.

    The threshold is the middle of the gap that the other scenes leave. False for the false alarms are the consensuses
    of unrelated pictures, for the agreement those of captions and traps.
    """

    def told(kinds: tuple[str, ...], key: str) -> list[tuple[float, str]]:
        return [(e[key], r["scene"]) for r in rows if r["kind"] in kinds for e in r["evidence"] if e]

    true = [r for r in rows if r["kind"] == "related" and r["error"] < 5 and r["status"] != "rejected"]
    for key, sign, kinds in (("log10_false_alarms", -1, ("unrelated",)), ("share", 1, ("trap", "caption"))):
        good = [(sign * r["evidence"][r["best"]][key], r["scene"]) for r in true]
        bad = [(sign * value, scene) for value, scene in told(kinds, key)]
        if not good or not bad:
            continue
        wrong = 0
        for scene in {s for _, s in good + bad}:
            low = max((v for v, s in bad if s != scene), default=-np.inf)
            high = min((v for v, s in good if s != scene), default=np.inf)
            middle = (low + high) / 2
            wrong += sum(v > middle for v, s in bad if s == scene) + sum(v <= middle for v, s in good if s == scene)
        worst_good, worst_bad = sign * min(v for v, _ in good), sign * max(v for v, _ in bad)
        print(
            f"{key}: {len(good)} true, the least clear {worst_good:.2f}; {len(bad)} false, the most misleading "
            f"{worst_bad:.2f}; {wrong} wrong with thresholds of the other scenes"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--unrelated", type=int, default=200)
    parser.add_argument("--captions", type=int, default=100)
    parser.add_argument("--effort", default="normal")
    parser.add_argument("--save", type=Path)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--load", type=Path, help="report on rows saved earlier")
    arguments = parser.parse_args()
    rows = json.loads(arguments.load.read_text()) if arguments.load else measure(arguments)
    if arguments.save:
        arguments.save.write_text(json.dumps(rows))
    report(rows)
    calibration(rows)
    leave_one_scene_out(rows)


def measure(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    root = arguments.data / "pairs"
    jobs = related(root) + traps(arguments.data / "traps")
    jobs += unrelated(root, arguments.unrelated, 1, "unrelated") + unrelated(root, arguments.captions, 2, "caption")
    with ProcessPoolExecutor(arguments.workers) as pool:
        return list(pool.map(run, jobs, [arguments.effort] * len(jobs), chunksize=4))


if __name__ == "__main__":
    main()
