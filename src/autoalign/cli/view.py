"""`autoalign view`: recordings in the viewer; and how `pair` shows and keeps what it found."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from threading import Thread
from typing import Annotated

from cyclopts import Parameter

from autoalign.cli.terminal import GENERAL, Common, Exit, complain, note
from autoalign.errors import ImageReadError
from autoalign.files.read import LoadedPicture
from autoalign.files.sidecar import read_sidecar
from autoalign.files.write import write_bytes_atomically
from autoalign.registration.alignment import Alignment
from autoalign.views.window import MARK, check_listening, has_display, open_window


@dataclass(frozen=True, kw_only=True)
class Viewing:
    """Whether and where `pair` shows what it found."""

    rerun: bool = False
    """open the viewer on what was found, whatever the verdict"""
    save_rrd: Path | None = None
    """record what was found for `autoalign view`; as <output stem>.autoalign.rrd it is found by its record, too"""
    rerun_connect: str | None = None
    """send what was found to the viewer that listens at this URL, such as rerun+http://127.0.0.1:9876/proxy"""

    def __bool__(self) -> bool:
        return bool(self.rerun or self.save_rrd or self.rerun_connect)


def view(
    first: Path,
    /,
    *others: Path,
    common: Annotated[Common, Parameter(name="*", group=GENERAL)] = Common(),
) -> int:
    """Find the recordings, open one window on all of them.

    Parameters
    ----------
    first
        a recording (.rrd), or the record of a pair that has its recording beside it
    others
        more of them
    """
    recordings = [_recording(path) for path in (first, *others)]
    if not has_display():
        names = ", ".join(map(str, recordings))
        raise OSError(f"there is no display to open a window on; what was to be shown: {names}")
    open_window(recordings)
    note(f"opened {', '.join(map(str, recordings))}", common)
    return Exit.DONE


def recording_beside(sidecar: Path) -> Path:
    """Where the recording of a pair is kept if nobody says: beside its record, under the same name."""
    return sidecar.with_suffix(".rrd")


def check_viewing(viewing: Viewing, beside: Path) -> Path | None:
    """Get ready to show, and say which file is to be recorded, or None. Without a display `--rerun` records one,
    `beside` the sidecar, since nothing can be shown.

    Raises as `check_listening` does for a URL where no viewer is.
    """
    if viewing.rerun_connect:
        check_listening(viewing.rerun_connect)
    if viewing:  # importing rerun takes a second, which is spent while the pair is aligned
        Thread(target=import_module, args=("autoalign.views.viewer",), daemon=True).start()
    blind = viewing.rerun and not has_display()
    return viewing.save_rrd or (beside if blind else None)


def show(
    alignment: Alignment,
    pictures: tuple[LoadedPicture, LoadedPicture],
    viewing: Viewing,
    recording: Path | None,
    beside: Path,
    *,
    timings: bool,
    common: Common,
) -> None:
    """Record the alignment of (fixed, moving) once, then save, send and open it as `viewing` asks; `recording` is what
    `check_viewing` made of it, `beside` where it is kept if the viewer does not start."""
    from autoalign.views.viewer import recorded  # not above: it would load rerun for those who do not look, too

    data = recorded(*pictures, alignment, stream_to=viewing.rerun_connect, timings=timings)
    if recording:
        _keep(recording, data, common)
    if viewing.rerun and has_display():
        try:
            open_window(recording=data)
        except OSError as error:  # a display that is no good is no display
            if recording is None:
                recording = beside
                _keep(recording, data, common)
            complain(f"{error}; where it does, autoalign view opens: {recording}")
    elif viewing.rerun:
        complain(f"there is no display to open the viewer on; where there is one, autoalign view opens: {recording}")


def _keep(path: Path, data: bytes, common: Common) -> None:
    write_bytes_atomically(path, data, common.overwrite)
    note(f"wrote {path}", common)


def _recording(path: Path) -> Path:
    """The recording that a path names, itself or by its sidecar; ImageReadError, the path last, if there is none."""
    if path.suffix == ".json":
        read_sidecar(path)
        beside = recording_beside(path)
        if not beside.exists():
            raise ImageReadError(f"has no recording {beside.name} beside it (pair --save-rrd makes one): {path}")
        path = beside
    try:
        with path.open("rb") as file:
            head = file.read(len(MARK))
    except OSError as error:
        raise ImageReadError(f"cannot be read ({error.strerror or error}): {path}") from None
    if head != MARK:
        raise ImageReadError(f"is no recording: {path}")
    return path
