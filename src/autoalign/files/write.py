"""A picture, or any bytes, to a file: whole or not at all, and nothing lost without a word."""

from __future__ import annotations

import os
import secrets
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from autoalign.errors import ImageWriteError
from autoalign.files.codec import one_line
from autoalign.files.formats import FORMATS, Format, default_for, encoder_for, of_name
from autoalign.files.metadata import Metadata, describing
from autoalign.picture.pixels import Picture, check_picture, has_alpha, in_colour, size_of

TEMPORARY = ".autoalign-{}.tmp"  # name of a file that is being written
NEW_FILE_MODE = 0o666  # less what the umask takes, as for every file that a program makes


def write_picture(
    path: str | Path,
    pixels: Picture,
    metadata: Metadata | None = None,
    *,
    overwrite: bool = False,
    jpeg_quality: int = 95,
) -> None:
    """Write a picture (h, w) or (h, w, c), in the format that the extension says, with what travels with it.

    The same pixels and metadata give the same bytes. JPEG at `jpeg_quality` (1 to 100) with colours at full
    resolution, AVIF nearly lossless; all other formats are lossless. Raises ImageWriteError, the path last, if the
    format cannot hold these pixels (`check_format`) or the file cannot be written (`check_writable`, a full disk); then
    nothing is left behind, and a file that was there is as it was. Raises ValueError if `pixels` is no picture or the
    quality is out of range.
    """
    if not 1 <= jpeg_quality <= 100:
        raise ValueError(f"jpeg_quality must be 1 to 100, not {jpeg_quality}")
    path = Path(path)
    format = check_format(path, pixels)
    check_writable(path, overwrite)
    if pixels.ndim == 3 and pixels.shape[2] == 1:
        pixels = pixels[..., 0]
    if not format.grey:
        pixels = in_colour(pixels)
    try:
        data = encoder_for(format, jpeg_quality)(pixels, describing(metadata or Metadata(), pixels))
    except Exception as error:  # encoders raise what they like: memory, their own limits
        raise ImageWriteError(f"cannot be encoded as {format.name} ({one_line(error)}): {path}") from error
    write_bytes_atomically(path, data, overwrite)


def write_bytes_atomically(path: str | Path, data: bytes, overwrite: bool = False) -> None:
    """Make `data` the content of the file: nobody ever sees a part of it, and a failure leaves no trace.

    Raises ImageWriteError, the path last, if the file exists and `overwrite` is not set, or it cannot be written.
    """
    with writing_atomically(path, overwrite) as write:
        write(data)


@contextmanager
def writing_atomically(path: str | Path, overwrite: bool = False) -> Iterator[Callable[[bytes], None]]:
    """What appends bytes to a file that is at `path`, whole, once the block has ended well; else nothing is left.

    Raises ImageWriteError, the path last, as `write_bytes_atomically` does.
    """
    with file_atomically(path, overwrite) as file:

        def write(data: bytes) -> None:
            with blaming(Path(path)):
                file.write(data)

        yield write


@contextmanager
def file_atomically(path: str | Path, overwrite: bool = False) -> Iterator[BinaryIO]:
    """A new file, to be written and read, that is at `path` once the block has ended well; else nothing is left behind.

    Raises ImageWriteError, the path last, as `write_bytes_atomically` does, but for what goes wrong inside the block.
    """
    path = Path(path)
    check_writable(path, overwrite)
    # Beside the file, because a rename is atomic only within one file system; a short name, because long ones may fail.
    temporary = path.with_name(TEMPORARY.format(secrets.token_hex(8)))
    try:
        with _new_file(temporary, path) as file:
            yield file
            with blaming(path):
                file.flush()
                os.fsync(file.fileno())
        with blaming(path):
            os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def check_writable(path: str | Path, overwrite: bool = False) -> None:
    """Raise ImageWriteError, the path last, if it is plain already that nothing can be written there.

    For callers with minutes of work before them. It says nothing about formats: that is `check_format`.
    """
    path = Path(path)
    try:
        if path.is_dir():
            raise ImageWriteError(f"is a folder, not a file: {path}")
        if os.path.lexists(path) and not overwrite:
            raise ImageWriteError(f"exists already, and overwriting was not asked for: {path}")
        if not path.parent.exists():
            raise ImageWriteError(f"cannot be written, because its folder does not exist: {path}")
        if not path.parent.is_dir():
            raise ImageWriteError(f"cannot be written, because what should be its folder is a file: {path}")
    except OSError as error:
        raise ImageWriteError(f"cannot be written ({one_line(error)}): {path}") from error
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise ImageWriteError(f"cannot be written, because its folder is read-only: {path}")


def check_format(path: str | Path, pixels: Picture) -> Format:
    """The format that the extension says; ImageWriteError, the path last, if it cannot hold these pixels unharmed.

    Raises ValueError if `pixels` is no picture.
    """
    check_picture(pixels)
    path = Path(path)
    format = of_name(path)
    if format is None or not format.depths:
        raise ImageWriteError(f"has an extension that autoalign does not write ({_extensions()}): {path}")
    if not format.holds(pixels):
        others = " or ".join(other.name for other in FORMATS if other.holds(pixels))
        raise ImageWriteError(f"{format.name} cannot hold {_description(pixels)}; {others} can: {path}")
    return format


def default_output(moving_path: str | Path, pixels: Picture | None = None) -> Path:
    """Where the aligned picture goes if nobody says: `<moving>_aligned<ext>` beside the moving picture.

    Where the format of the moving picture cannot be written, or cannot hold `pixels`, the extension is .png, or .tif
    for what PNG cannot hold and for raw files of cameras.
    """
    path = Path(moving_path)
    format = of_name(path)
    extension = path.suffix
    if format is None or not (format.depths if pixels is None else format.holds(pixels)):
        extension = default_for(format, pixels).extensions[0]
    return path.with_name(f"{path.stem}_aligned{extension}")


@contextmanager
def _new_file(temporary: Path, path: Path) -> Iterator[BinaryIO]:
    """A file that was not there before; whatever goes wrong with it is said of `path`."""
    flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)  # the last one on Windows only
    with blaming(path):
        file = open(temporary, "w+b", opener=lambda name, _: os.open(name, flags, NEW_FILE_MODE))  # noqa: SIM115
    try:
        yield file
    finally:
        with blaming(path):  # closing writes too, once more where it failed before
            file.close()


@contextmanager
def blaming(path: Path) -> Iterator[None]:
    """Turns what an operating system raises into the error that names this file."""
    try:
        yield
    except (OSError, ValueError) as error:  # ValueError: a NUL in the path
        raise ImageWriteError(f"cannot be written ({one_line(error)}): {path}") from error


def _extensions() -> str:
    return ", ".join(extension for format in FORMATS if format.depths for extension in format.extensions)


def _description(pixels: Picture) -> str:
    w, h = size_of(pixels)
    return f"{w} x {h} {pixels.dtype} pixels{' with alpha' if has_alpha(pixels) else ''}"
