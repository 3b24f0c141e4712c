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
import re
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from autoalign.files.read import read_picture
from autoalign.geometry.homography import apply, project
from autoalign.registration.align import AlignOptions, align


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
    lines, height = int(rng.integers(1, 4)), int(rng.integers(14, 40))
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
    truth = np.loadtxt(job["truth"]).reshape(3, 3)
    (h, w), (h2, w2) = moving.shape[:2], fixed.shape[:2]
    grid = np.stack(np.meshgrid(np.linspace(0, w - 1, 48), np.linspace(0, h - 1, 48)), -1).reshape(-1, 2)
    there = project(truth, grid)[0]
    inside = ((there >= 0) & (there <= (w2 - 1, h2 - 1))).all(1)
    return float(np.linalg.norm(project(fixed_from_moving, grid)[0] - there, axis=1)[inside].mean())


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
    return row


def report(rows: list[dict[str, Any]]) -> None:
    for row in sorted(rows, key=lambda r: (r["kind"], r.get("error", 0.0))):
        if row["kind"] == "related" or row["status"] != "rejected":
            e = row["evidence"][row["best"]]
            numbers = (
                ""
                if e is None
                else (
                    f"nfa {e['log10_false_alarms']:8.1f} inl {e['independent_inliers']:4d}/{e['independent_matches']:<4d} "
                    f"blocks {e['share']:.2f} of {e['agreement']['blocks']:<4d} aniso {e['anisotropy']:5.1f} "
                    f"halves {e['halves_px']:7.2f} fit {e['fit_px']:7.3f} model {e['model_px']:6.3f} overlap {e['overlap']:.2f}"
                )
            )
            name = re.sub(r"^(.{38}).*", r"\1", row["name"])
            print(
                f"{row['kind'][:4]} {name:38} {row['status'][:5]:5} {row.get('error', 0):9.3f} {row['expected'] or 0:7.3f} "
                f"{row['model'] or '-':11.11} {row['rung'][:12]:12} {numbers}"
            )
    for kind in dict.fromkeys(r["kind"] for r in rows):
        group = [r for r in rows if r["kind"] == kind]
        tally = {s: sum(r["status"] == s for r in group) for s in ("aligned", "doubtful", "rejected")}
        print(kind, len(group), tally, f"mean {np.mean([r['seconds'] for r in group]):.2f} s")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--unrelated", type=int, default=200)
    parser.add_argument("--captions", type=int, default=100)
    parser.add_argument("--effort", default="normal")
    parser.add_argument("--save", type=Path)
    parser.add_argument("--workers", type=int, default=2)
    arguments = parser.parse_args()
    root = arguments.data / "pairs"
    jobs = related(root) + traps(arguments.data / "traps")
    jobs += unrelated(root, arguments.unrelated, 1, "unrelated") + unrelated(root, arguments.captions, 2, "caption")
    with ProcessPoolExecutor(arguments.workers) as pool:
        rows = list(pool.map(run, jobs, [arguments.effort] * len(jobs), chunksize=4))
    if arguments.save:
        arguments.save.write_text(json.dumps(rows))
    report(rows)


if __name__ == "__main__":
    main()
