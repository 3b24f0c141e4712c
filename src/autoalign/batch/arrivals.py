"""Pictures as they arrive in a folder: which of them are there, whole, and not taken yet.

What the system tells of files is only a hint, which comes late, twice, or on network disks never. The truth is a look
at the folder: a picture counts when it was closed or renamed into place, or has not changed for a while.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Event

from autoalign.batch.sources import Selection, found_pictures, natural

SETTLED_S = 2.0

Stamp = tuple[int, int]  # bytes, ns since 1970


@dataclass
class _Seen:
    stamp: Stamp
    since: float  # in the clock's seconds


class Arrivals:
    """What has arrived in a folder. `closed` may be called from any thread, `take` from one."""

    def __init__(
        self,
        folder: Path,
        selection: Selection,
        *,
        without: Path | None = None,
        clock: Callable[[], float] = time.time,
    ) -> None:
        self._folder, self._selection, self._without, self._clock = folder, selection, without, clock
        self._seen: dict[str, _Seen] = {}
        self._taken: dict[str, Stamp] = {}
        self._closed: set[str] = set()

    def closed(self, path: str) -> None:
        """Note that a writer has closed a file, or that it was renamed into its place."""
        self._closed.add(os.path.abspath(path))

    def take(self) -> list[str]:
        """The pictures, relative to the folder, that are whole and were not taken as they are now.

        In the order that people count in.
        """
        now, there = self._clock(), {}
        for name in found_pictures(self._folder, self._selection, without=self._without):
            with suppress(OSError):  # gone meanwhile
                there[name] = _stamp(os.path.join(self._folder, name))
        ready = {
            name: stamp
            for name, stamp in there.items()
            if self._taken.get(name) != stamp and self._whole(name, stamp, now)
        }
        self._seen = {name: seen for name, seen in self._seen.items() if name in there and name not in ready}
        self._taken = {name: stamp for name, stamp in self._taken.items() if name in there} | ready
        return sorted(ready, key=natural)

    def waiting(self) -> bool:
        """Whether something is there that is not whole yet."""
        return bool(self._seen)

    def _whole(self, name: str, stamp: Stamp, now: float) -> bool:
        path = os.path.abspath(self._folder / name)
        if path in self._closed:
            self._closed.discard(path)
            return True
        seen = self._seen.get(name)
        if seen is None or seen.stamp != stamp:
            # It may have been here, unchanged, for long before anybody looked.
            seen = self._seen[name] = _Seen(stamp=stamp, since=min(now, stamp[1] / 1e9))
        return now - seen.since >= SETTLED_S


@contextmanager
def hints(folder: Path, arrivals: Arrivals, *, recursive: bool) -> Iterator[Event]:
    """An event that is set whenever the system says that something was closed or moved into the folder."""
    from watchdog.events import FileClosedEvent, FileMovedEvent, FileSystemEvent, FileSystemEventHandler
    from watchdog.observers import Observer

    hint = Event()

    class Listener(FileSystemEventHandler):
        def on_any_event(self, event: FileSystemEvent) -> None:
            if isinstance(event, FileClosedEvent):
                arrivals.closed(os.fsdecode(event.src_path))
                hint.set()
            elif isinstance(event, FileMovedEvent):
                arrivals.closed(os.fsdecode(event.dest_path))
                hint.set()

    observer = Observer()
    observer.schedule(Listener(), str(folder), recursive=recursive)
    observer.start()
    try:
        yield hint
    finally:
        observer.stop()
        observer.join()


def _stamp(path: str) -> Stamp:
    found = os.stat(path)
    return found.st_size, found.st_mtime_ns
