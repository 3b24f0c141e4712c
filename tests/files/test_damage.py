"""A small part of the corpus of damaged files, read in workers that may die; `scripts/damage_corpus.py` reads all."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType


def test_nothing_crashes_hangs_swells_or_passes_for_another(damage_corpus: ModuleType, tmp_path: Path) -> None:
    found = damage_corpus.run(count=64, seed=2, workers=2, folder=tmp_path)
    assert len(found) == 64
    assert {case.path.name: verdict for case, verdict in found.items() if verdict not in damage_corpus.GOOD} == {}
    assert sum(verdict == "refused" for verdict in found.values()) > 20


def test_the_same_seed_damages_alike(damage_corpus: ModuleType, tmp_path: Path) -> None:
    contents = []
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        cases = damage_corpus.make_corpus(tmp_path / name, count=60, seed=3)
        contents.append([case.path.read_bytes() for case in cases if case.sound])
    assert contents[0] == contents[1]
