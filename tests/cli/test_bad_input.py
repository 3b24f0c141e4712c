"""Every bad input: one line on stderr, its exit code, and nothing left behind."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest

import autoalign as aa


def png_bomb() -> bytes:
    """A one-bit PNG of 30,000 x 30,000, a hundred kilobytes long."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    rows = zlib.compress(bytes((1 + 30_000 // 8) * 30_000))
    header = struct.pack(">IIBBBBB", 30_000, 30_000, 1, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def truncated(path: str) -> bytes:
    data = Path(path).read_bytes()
    return data[: len(data) // 2]


@pytest.fixture
def bad(pictures: Path) -> Path:
    """The pictures, and a folder `bad` full of what is none."""
    aa.write_picture("whole.png", np.arange(12_000, dtype=np.uint16).reshape(100, 120))
    folder = pictures / "bad"
    folder.mkdir()
    for name, data in {
        "empty.jpg": b"",
        "text.jpg": b"to whom it may concern\n" * 20,
        "truncated.jpg": truncated("fixed.jpg"),
        "truncated.png": truncated("whole.png"),
        "bomb.png": png_bomb(),
    }.items():
        (folder / name).write_bytes(data)
    (folder / "folder.jpg").mkdir()
    return pictures


def everything(folder: Path) -> dict[str, bytes | None]:
    return {str(path): path.read_bytes() if path.is_file() else None for path in sorted(folder.rglob("*"))}


def assert_refused(run, folder: Path, code: int, *words: str) -> str:
    before = everything(folder)
    outcome = run(*words)
    assert outcome.code == code
    assert outcome.out == ""
    assert outcome.err.startswith("autoalign: ")
    assert outcome.err.count("\n") == 1
    assert everything(folder) == before
    return outcome.err


@pytest.mark.parametrize(
    "name", ["missing.jpg", "folder.jpg", "empty.jpg", "text.jpg", "truncated.jpg", "truncated.png", "bomb.png"]
)
def test_no_picture(bad, run, name):
    assert assert_refused(run, bad, 3, "pair", "fixed.jpg", f"bad/{name}").endswith(f": bad/{name}\n")
    assert assert_refused(run, bad, 3, "pair", f"bad/{name}", "moving.jpg").endswith(f": bad/{name}\n")


def test_no_place_to_write(bad, run):
    (bad / "read_only").mkdir(mode=0o500)
    (bad / "there.png").write_bytes(b"precious")
    for words in (
        ["-o", "no_folder/out.png"],
        ["-o", "there.png"],
        ["-o", "bad"],
        ["-o", "fixed.jpg/out.png"],
        ["-o", "out.doc"],
        ["-o", "out.png", "--json", "no_folder/out.json"],
    ):
        assert_refused(run, bad, 3, "pair", "fixed.jpg", "moving.jpg", *words)
    if os.geteuid() != 0:  # root may write everywhere
        assert_refused(run, bad, 3, "pair", "fixed.jpg", "moving.jpg", "-o", "read_only/out.png")


@pytest.mark.parametrize(
    "words",
    [
        ["pair"],
        ["pair", "fixed.jpg"],
        ["pair", "fixed.jpg", "moving.jpg", "third.jpg"],
        ["pair", "fixed.jpg", "moving.jpg", "--modell", "affine"],
        ["pair", "fixed.jpg", "moving.jpg", "--model", "projective"],
        ["pair", "fixed.jpg", "moving.jpg", "--overlay-style", "sepia"],
        ["pair", "fixed.jpg", "moving.jpg", "--seed", "x"],
        ["pair", "fixed.jpg", "moving.jpg", "--threshold", "-1"],
        ["pair", "fixed.jpg", "moving.jpg", "--json"],
        ["pair", "fixed.jpg", "moving.jpg", "--points", "points.csv", "--fixed-mask", "fixed.jpg"],
        ["pear"],
        ["rectify", "fixed.jpg"],
        ["apply", "moving.jpg"],
        ["apply", "x.json", "moving.jpg", "--inverse"],
        ["apply", "x.json", "moving.jpg", "fixed.jpg", "-o", "out.png"],
    ],
)
def test_wrong_usage(pictures, run, words):
    assert_refused(run, pictures, 2, *words)


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        ("batch - --out-dir out <&-", 3, "autoalign: is no manifest (has no rows): stdin\n"),
        ("--version >&-", 0, ""),
        ("--version >/dev/full", 3, "autoalign: cannot be used (No space left on device): stdout\n"),
    ],
)
def test_streams_that_are_closed_or_full(folder, words, code, said):
    shell = subprocess.run(
        f'"{sys.executable}" -m autoalign.cli.main {words}', shell=True, stderr=subprocess.PIPE, text=True, timeout=60
    )
    assert (shell.returncode, shell.stderr) == (code, said)


def test_bad_points(pictures, run):
    for text in ("", "a,b\n1,2\n", "fixed_x,fixed_y,moving_x,moving_y\n1,2,3,four\n"):
        (pictures / "points.csv").write_text(text)
        assert_refused(run, pictures, 3, "pair", "fixed.jpg", "moving.jpg", "--points", "points.csv")


def test_a_mask_of_another_size(pictures, run):
    assert_refused(run, pictures, 3, "pair", "fixed.jpg", "moving.jpg", "--fixed-mask", "moving.jpg")


def test_a_sidecar_that_is_none(pictures, run):
    (pictures / "x.json").write_text('{"format": "something else"}')
    assert_refused(run, pictures, 3, "apply", "x.json", "moving.jpg")
    assert_refused(run, pictures, 3, "apply", "missing.json", "moving.jpg")
