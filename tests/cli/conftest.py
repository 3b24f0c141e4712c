"""A folder with the example pictures to work in, and the command line run inside this process."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

import autoalign as aa
from autoalign.cli.main import main

EXAMPLES = Path(__file__).parent.parent.parent / "examples"


@dataclass(frozen=True)
class Outcome:
    """What a command left behind in the terminal."""

    code: int
    out: str
    err: str


Run = Callable[..., Outcome]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty working folder, and an environment that says nothing about autoalign."""
    for name in [name for name in os.environ if name.startswith("AUTOALIGN_")]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def pictures(folder: Path) -> Path:
    """The working folder with fixed.jpg and moving.jpg in it."""
    for name in ("fixed.jpg", "moving.jpg"):
        shutil.copy(EXAMPLES / name, folder)
    return folder


@pytest.fixture
def run(folder: Path, capsys: pytest.CaptureFixture[str]) -> Run:
    """Run `autoalign` with these words."""

    def run_words(*words: str | Path) -> Outcome:
        capsys.readouterr()
        code = main([str(word) for word in words])
        captured = capsys.readouterr()
        return Outcome(code, captured.out, captured.err)

    return run_words


@pytest.fixture
def sidecar(pictures: Path, run: Run) -> Path:
    """The record of the examples, aligned by four typed points, which is quick; the working folder has the pictures."""
    (pictures / "typed.csv").write_text(
        "fixed_x,fixed_y,moving_x,moving_y\n262,14,0,0\n570,176,479,0\n360,380,479,419\n66,231,0,419\n"
    )
    assert run("pair", "fixed.jpg", "moving.jpg", "--points", "typed.csv", "-o", "typed.png", "-q").code == 0
    (pictures / "typed.png").unlink()
    return pictures / "typed.autoalign.json"


@pytest.fixture
def rng_pictures(folder: Path) -> tuple[Path, Path]:
    """Two unrelated pictures, a.png and b.png."""
    for name, seed, shape in (("a.png", 1, (120, 160)), ("b.png", 2, (130, 150))):
        noise = np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)
        aa.write_picture(folder / name, noise)
    return folder / "a.png", folder / "b.png"
