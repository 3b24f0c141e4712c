"""A recording as the viewer shows it, to a PNG, on a machine without a screen or a graphics card.

    python scripts/render_recording.py RECORDING.rrd OUT.png [--size 1680x1000] [--max-side 1680] [--at fade=30]

The viewer runs headless on a software rasteriser: apt-get install mesa-vulkan-drivers libvulkan1. It panics on letters
that its fonts do not have (Chinese names of pictures, say), and exits with 1 if it logged an error.
"""

from __future__ import annotations

import argparse
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import rerun_cli
from rerun.experimental import ViewerClient

VIEWER = Path(rerun_cli.__file__).with_name("rerun")
START_S, TOASTS_S, PAINT_S = 30.0, 7.0, 90.0  # to answer; until the notices of the start are gone; to paint


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--size", default="1680x1000", help="of the window")
    parser.add_argument("--max-side", type=int, default=1680, help="of the PNG; the viewer paints at twice the size")
    parser.add_argument("--at", help="where the time bar is to stand: a timeline and a step of it, as in fade=30")
    words = parser.parse_args()
    with viewer(words.size) as client:
        client.open(str(words.recording.resolve()))
        time.sleep(TOASTS_S)
        if words.at is not None:
            timeline, _, step = words.at.partition("=")
            patiently(lambda: client.set_time(timeline, sequence=int(step), play_state="paused"))
        words.output.write_bytes(settled(client, words.max_side))
        errors = [entry for entry in patiently(client.get_logs) if "ERROR" in str(entry.level).upper()]
    for entry in errors:
        print(entry, file=sys.stderr)
    return 1 if errors else 0


@contextmanager
def viewer(size: str) -> Iterator[ViewerClient]:
    """A headless viewer that listens on loopback only."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [VIEWER, "--headless", "--bind", "127.0.0.1", "--port", str(port), "--window-size", size]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        try:
            yield connected(f"rerun+http://127.0.0.1:{port}/proxy")
        finally:
            process.terminate()


def connected(url: str) -> ViewerClient:
    start = time.monotonic()
    while True:
        try:
            return ViewerClient.connect(url)
        except Exception:
            if time.monotonic() - start > START_S:
                raise
            time.sleep(0.3)


def patiently(ask: Callable[[], Any]) -> Any:
    """The answer of a viewer that may be busy painting."""
    start = time.monotonic()
    while True:
        try:
            return ask()
        except TimeoutError:
            if time.monotonic() - start > PAINT_S:
                raise


def settled(client: ViewerClient, max_side: int) -> bytes:
    """A screenshot that equals the one before: everything has been decoded and drawn."""
    before = b""
    for _ in range(20):
        now: bytes = patiently(lambda: client.take_screenshot(max_size=max_side))
        if now == before:
            break
        before = now
        time.sleep(1.0)
    return before


if __name__ == "__main__":
    sys.exit(main())
