"""The viewer as a program of its own: started on this machine, reached on this machine only. Does not import rerun."""

from __future__ import annotations

import importlib.util
import os
import socket
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import urlsplit

LOOPBACK = "127.0.0.1"  # the viewer's own default is 0.0.0.0: everybody on the network
EXAMPLE_URL = f"rerun+http://{LOOPBACK}:9876/proxy"
MARK = b"RRF"  # of every recording
_SCHEMES = ("rerun", "rerun+http", "rerun+https")
_STARTS_WITHIN_S = 1.5  # a viewer that lives longer has found its display
_ANSWERS_WITHIN_S = 3.0


def has_display() -> bool:
    """Whether a window can be opened at all."""
    if sys.platform in ("darwin", "win32"):
        return True
    return any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))


def open_window(recordings: Sequence[Path] = (), recording: bytes | None = None) -> None:
    """Start the viewer on recording files, or on the bytes of one, and leave it running.

    Raises OSError if it is not installed or does not start.
    """
    command = [str(viewer_program()), "--bind", LOOPBACK, "--port", "auto"]
    command += [str(path.resolve()) for path in recordings] + ([] if recording is None else ["-"])
    with tempfile.TemporaryFile() as stdin:  # unlike a pipe it is all there when this process ends
        stdin.write(recording or b"")
        stdin.seek(0)
        process = subprocess.Popen(
            command, stdin=stdin, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
        )
    try:
        code = process.wait(_STARTS_WITHIN_S)
    except subprocess.TimeoutExpired:
        return
    if code:
        raise OSError(f"the viewer did not start (it ended with {code})")


def viewer_program() -> Path:
    """The native viewer inside the installed package: the script of that name in PATH only wraps it.

    Raises OSError if it is not there.
    """
    package = importlib.util.find_spec("rerun_cli")
    if package is None or package.origin is None:
        raise OSError("the viewer is not installed (rerun-sdk)")
    return Path(package.origin).with_name("rerun.exe" if sys.platform == "win32" else "rerun")


def check_listening(url: str) -> None:
    """Raise ValueError for what is no viewer's URL, and OSError if nobody listens there."""
    parts = urlsplit(url)
    if parts.scheme not in _SCHEMES or parts.path != "/proxy" or not parts.hostname or not parts.port:
        raise ValueError(f"a viewer's URL looks like {EXAMPLE_URL}, not {url}")
    try:
        socket.create_connection((parts.hostname, parts.port), _ANSWERS_WITHIN_S).close()
    except OSError as error:
        raise OSError(f"no viewer listens at {url} ({error.strerror or error})") from None
