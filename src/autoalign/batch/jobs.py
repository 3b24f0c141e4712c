"""What is to be done with one pair of a batch, and the key by which it is known to be done already."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Literal

import numpy as np

from autoalign import __version__
from autoalign.errors import ImageReadError
from autoalign.files.formats import TIFF
from autoalign.files.read import ReadOptions
from autoalign.files.remote import below, is_url, path_of
from autoalign.files.write import default_output
from autoalign.picture.border import Border, like_bordered
from autoalign.picture.pixels import Picture, has_alpha
from autoalign.registration.alignment import AlignOptions
from autoalign.registration.drawing import Drawing
from autoalign.registration.sequence import SequenceFrame

Recorded = Literal["none", "failed", "all"]
GREY_PIXEL: Picture = np.zeros((1, 1), np.uint8)


@dataclass(frozen=True, kw_only=True)
class JobOptions:
    """What many jobs of a batch have in common."""

    align: AlignOptions = AlignOptions()
    drawing: Drawing = Drawing()
    reading: ReadOptions = ReadOptions()
    fixed_page: int = 0  # of a TIFF of several, counted from 0
    moving_page: int = 0
    recorded: Recorded = "none"  # which pairs leave a recording for the viewer; failed: all but the aligned ones


@dataclass(frozen=True, kw_only=True)
class Job:
    """One moving picture, the fixed one it goes onto, and where the result goes."""

    name: str  # unique in its batch: the moving picture's path below the batch's folder, with slashes
    fixed: str  # a path or a URL
    moving: str
    out_dir: str
    options: JobOptions = JobOptions()
    fixed_mask: str | None = None  # a picture that is not black where the fixed one is to be ignored
    moving_mask: str | None = None
    placed: SequenceFrame | None = None  # where a whole sequence puts it; None where that is to be found out
    upload: str | None = None  # URL below which its files are put as well

    @property
    def output(self) -> Path:
        """The aligned picture: the moving one's name and format, or a format that can be written behind its name."""
        return Path(self._written[0])

    @property
    def large_output(self) -> Path:
        """The same where a picture is so large that the result can be written as TIFF only."""
        return Path(self._written[3])

    @property
    def sidecar(self) -> Path:
        """With the whole name, because a camera writes IMG_1.CR2 and IMG_1.JPG into one folder."""
        return Path(self._written[1])

    @property
    def recording(self) -> Path:
        """For the viewer, if it is wanted."""
        return Path(self._written[2])

    @property
    def inputs(self) -> tuple[str, ...]:
        """All that it reads."""
        return tuple(path for path in (self.fixed, self.moving, self.fixed_mask, self.moving_mask) if path)

    @property
    def outputs(self) -> tuple[Path, ...]:
        """All that it may write."""
        return tuple(map(Path, self._written))

    @property
    def places(self) -> Iterator[str]:
        """The `place` of all that it may write or upload."""
        for path in dict.fromkeys(self._written):
            yield place(path)
            if self.upload:
                yield place(below(self.upload, self.within(Path(path))))

    def within(self, output: Path) -> str:
        """The name of one of its outputs in the batch's folder, with slashes."""
        return output.relative_to(self.out_dir).as_posix()

    @property
    def _written(self) -> tuple[str, str, str, str]:
        """The outputs as text, without what paths cost where there are a hundred thousand."""
        extension = os.path.splitext(self.name)[1]
        written = _written_extension(extension, self.options.drawing.border)
        path = os.path.join(self.out_dir, self.name)
        picture = path if written == extension else path + written
        # Not .tif alone: beside IMG_1.jpg there may be a picture with the name IMG_1.jpg.tif.
        large = picture if written.lower() in TIFF.extensions else f"{path}.autoalign{TIFF.extensions[0]}"
        return picture, f"{path}.autoalign.json", f"{path}.autoalign.rrd", large


@lru_cache
def _written_extension(extension: str, border: Border) -> str:
    """The extension of a format that can be written, and that can hold what the border needs."""
    like = like_bordered(GREY_PIXEL, border)
    return default_output(f"name{extension}", like if has_alpha(like) else None).suffix


def place(path: str) -> str:
    """Equal for the paths, or for the URLs, of one file, however they are written."""
    return str(path_of(path)) if is_url(path) else os.path.abspath(path)


def rooted(job: Job) -> Job:
    """The job with absolute paths, for workers that are not in the working folder of this process."""
    paths = {name: getattr(job, name) for name in ("fixed", "moving", "out_dir", "fixed_mask", "moving_mask")}
    return replace(job, **{name: os.path.abspath(path) for name, path in paths.items() if path and not is_url(path)})


def key(job: Job, hash_of: Callable[[str], str]) -> str:
    """Hexadecimal name of a job: equal exactly where inputs, options and version, and so the results, are equal.

    It is another where the results are to be uploaded to another place. `hash_of` gives the hash of the content behind
    a path or URL.
    """
    inputs = [path and hash_of(path) for path in (job.fixed, job.moving, job.fixed_mask, job.moving_mask)]
    words = [job.name, *(word or "" for word in inputs), _digest(job.options), _place(job.placed), job.upload or ""]
    return hashlib.sha256("\0".join(words).encode("utf-8", "surrogateescape")).hexdigest()


def readable(hash_of: Callable[[str], str]) -> Callable[[str], str]:
    """`hash_of` with a word for what cannot be read, which changes as soon as it can: the worker will say why."""

    def hash_or_word(path: str) -> str:
        try:
            return hash_of(path)
        except ImageReadError:
            return "unreadable"

    return hash_or_word


def _place(frame: SequenceFrame | None) -> str:
    """All that a sequence says of a frame, to the last bit."""
    if frame is None:
        return ""
    transform = frame.reference_from_frame
    return json.dumps(asdict(replace(frame, reference_from_frame=None))) + repr(transform is None or transform.tolist())


@lru_cache(maxsize=1024)
def _digest(options: JobOptions) -> str:
    """Of everything but the inputs; a batch has few options and many jobs."""
    text = json.dumps({"version": __version__, "options": asdict(options)}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()
