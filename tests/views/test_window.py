"""The viewer is started on loopback only, and what goes wrong is said. No window is opened here."""

from __future__ import annotations

import json
import socket
import sys
import time
from pathlib import Path

import pytest

from autoalign.views import window
from autoalign.views.window import EXAMPLE_URL, check_listening, has_display, open_window, viewer_program


@pytest.fixture
def program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A viewer that notes what it was told in told.json, and ends."""
    path = tmp_path / "viewer"
    told = tmp_path / "told.json"
    path.write_text(
        f"#!{sys.executable}\nimport json, sys\n"
        f"json.dump([sys.argv[1:], sys.stdin.buffer.read().decode()], open({str(told)!r}, 'w'))\n"
    )
    path.chmod(0o755)
    monkeypatch.setattr(window, "viewer_program", lambda: path)
    return told


def test_the_viewer_listens_on_loopback_only(program: Path, tmp_path: Path) -> None:
    open_window([tmp_path / "a.rrd", tmp_path / "-b.rrd"])
    words, stdin = json.loads(program.read_text())
    assert words[:2] == ["--bind", "127.0.0.1"]
    assert words[-2:] == [str(tmp_path / "a.rrd"), str(tmp_path / "-b.rrd")]
    assert stdin == ""


def test_a_recording_needs_no_file(program: Path) -> None:
    open_window(recording=b"bytes")
    words, stdin = json.loads(program.read_text())
    assert words[-1] == "-"
    assert stdin == "bytes"


def test_a_viewer_that_does_not_start_is_told(program: Path) -> None:
    program.with_name("viewer").write_text("#!/bin/sh\nexit 3\n")
    with pytest.raises(OSError, match="did not start"):
        open_window(recording=b"")


def test_a_viewer_that_starts_is_left_running(program: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(window, "_STARTS_WITHIN_S", 0.2)
    program.with_name("viewer").write_text(f"#!/bin/sh\nsleep 1\ntouch {program}\n")
    with pytest.warns(ResourceWarning, match="still running"):
        open_window(recording=b"")
    for _ in range(50):
        if program.exists():
            break
        time.sleep(0.1)
    assert program.exists()


def test_the_viewer_is_the_one_of_the_package() -> None:
    assert viewer_program().is_file()


def test_whether_there_is_a_display(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert not has_display()
    monkeypatch.setenv("WAYLAND_DISPLAY", "wayland-0")
    assert has_display()
    monkeypatch.delenv("WAYLAND_DISPLAY")
    monkeypatch.setattr(sys, "platform", "darwin")
    assert has_display()


@pytest.mark.parametrize("url", ["localhost", "http://127.0.0.1:9876/proxy", "rerun+http://127.0.0.1/proxy", ""])
def test_what_is_no_viewers_url(url: str) -> None:
    with pytest.raises(ValueError, match="looks like"):
        check_listening(url)


def test_whether_a_viewer_listens() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        url = EXAMPLE_URL.replace("9876", str(server.getsockname()[1]))
        check_listening(url)
    with pytest.raises(OSError, match="no viewer listens"):
        check_listening(url)
