"""What people read before they start."""

from __future__ import annotations

import os
import subprocess
import sys
import time

import pytest

import autoalign as aa
from autoalign.cli.main import COMMANDS, app


@pytest.mark.parametrize("words", [[], *([name] for name in COMMANDS)])
def test_help_fits_eighty_columns(run, words):
    outcome = run(*words, "--help")
    assert (outcome.code, outcome.err) == (0, "")
    assert max(map(len, outcome.out.splitlines())) <= 80
    assert run(*words, "-h").out == outcome.out


def test_help_says_which_picture_stays(run):
    assert "Put MOVING onto FIXED, which stays as it is." in run("--help").out
    assert "the picture that stays" in run("pair", "--help").out


def test_version(run):
    assert run("--version").out == f"autoalign {aa.__version__}\n"


def test_help_loads_no_picture_library_and_is_quick():
    """Under three times what `import numpy` takes; the best of three, because other programs want the machine too."""

    def seconds(code: str) -> float:
        times = []
        for _ in range(3):
            started = time.perf_counter()
            subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)
            times.append(time.perf_counter() - started)
        return min(times)

    script = "import sys; from autoalign.cli.main import main; main(['--help'])"
    assert seconds(script) < 3 * seconds("import numpy")
    check = script + "; assert not {'cv2', 'numpy', 'skimage', 'rerun'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", check], check=True, capture_output=True)


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_knows_commands_and_options(shell):
    script = app.generate_completion(shell=shell)
    for word in (*COMMANDS, "overlay-style", "red-cyan"):
        assert word in script


def test_completion_installs(folder, monkeypatch):
    environment = os.environ | {"HOME": str(folder), "SHELL": "/bin/bash"}
    done = subprocess.run(
        [sys.executable, "-m", "autoalign.cli.main", "--install-completion"],
        env=environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0
    assert list(folder.rglob("autoalign"))
