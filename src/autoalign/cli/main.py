"""The program: its commands, and what becomes of every error.

Commands are imported when they are called, so that `autoalign --help` waits for no picture library.
"""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Sequence

from cyclopts import App, CycloptsError, Parameter

from autoalign import __version__
from autoalign.cli import settings
from autoalign.cli.terminal import Exit, complain
from autoalign.errors import AlignmentError, CanvasError, EngineError, ImageReadError, ImageWriteError

COMMANDS = {
    "pair": """\
Put MOVING onto FIXED, which stays as it is.

Says in one line how it went. An aligned pair gives the picture and its record. A doubtful one gives the record, from \
which `autoalign apply` makes the picture once you have looked, and the overlay if you ask for one. A rejected one \
gives the record only, with the reason.

Exit code: 0 aligned, 1 doubtful or rejected, 2 wrong usage, 3 a file could not be read or written.
""",
    "batch": """\
Align many pairs: a folder onto one picture, a time-lapse, brackets, or a manifest.

Each moving picture keeps its name and format in --out-dir; beside it lies its record, and there are report.html and a \
ledger of what is done. The same command again does only what is new or has changed, so it may be stopped at any time. \
A pair that is not aligned, or a file that cannot be read, is a line in the report and stops nothing.

Exit code: 0 all aligned, 1 some are not, 2 wrong usage, 3 some could not be read or written.
""",
    "watch": """\
Align pictures onto one reference as they arrive in a folder.

A picture counts as arrived when it was closed, renamed into place, or has not changed for two seconds. What `batch` \
says of results, records, report and ledger holds here, too: started again, it goes on where it was.

Exit code: 0 all aligned, 1 some are not, 2 wrong usage, 3 the folder or the reference cannot be read.
""",
    "status": """\
Say how far a batch is, and name those pairs that need a person most.

OUT_DIR is the --out-dir of `autoalign batch` or `watch`, which may be at work meanwhile.

Exit code: 0 done, 2 wrong usage, 3 there is no batch, or a file could not be written.
""",
    "rectify": """\
Show a plane in IMAGE upright and to scale, from four or more points on it.

IMAGE stays as it is. Ground that is far away, towards the horizon of the plane, is cropped, and this is said.

Exit code: 0 done, 1 no canvas can hold it, 2 wrong usage, 3 a file could not be read or written.
""",
    "apply": """\
Put other pictures or points through a transform that `autoalign pair` saved.

The pictures must have the size of the MOVING picture of that pair: its mask, another channel, its neighbour in a \
burst. They stay as they are; the results lie on FIXED. A doubtful pair is applied without a question.

Exit code: 0 done, 1 the pair was rejected, 2 wrong usage, 3 a file could not be read or written.
""",
    "view": """\
Open the viewer on recordings that `autoalign pair --save-rrd` made.

The record of a pair stands for the recording beside it, <output stem>.autoalign.rrd. The viewer can be reached from \
this machine only.

Exit code: 0 done, 2 wrong usage, 3 a file could not be read, or there is no display.
""",
}
"""Command to help text, whose first line `autoalign --help` shows; each lives in the module of its name."""

USAGE = {
    "batch": "Usage: autoalign batch --out-dir FOLDER [OPTIONS] FOLDER|MANIFEST.csv|-",
    "apply": "Usage: autoalign apply [OPTIONS] SIDECAR [IMAGES...]",
    "view": "Usage: autoalign view [OPTIONS] FILE.rrd|SIDECAR...",
}  # what cannot be told from the signature

EPILOGUE = """\
Every option can also be set as AUTOALIGN_<OPTION> in the environment or in an autoalign.toml here or in a folder \
above. The command line wins over the environment, and the environment over the file.
"""


def _shown_default(value: object) -> str | None:
    """Flags are off and paths are absent unless given: saying so for each would only make the help longer."""
    return None if value is None or value is False else str(value)


app = App(
    name="autoalign",
    help="Put one picture onto another, without hands, and say when it cannot be done.",
    help_format="plaintext",
    help_epilogue=EPILOGUE,
    version=f"autoalign {__version__}",
    version_format="plaintext",
    default_parameter=Parameter(negative=(), show_default=_shown_default),
    config=(settings.environment, settings.file),
    suppress_keyboard_interrupt=False,
)
for position, (name, text) in enumerate(COMMANDS.items()):
    app.command(f"autoalign.cli.{name}:{name}", name=name, help=text, sort_key=position, usage=USAGE.get(name))
app.register_install_completion_command(help="Install completion for this shell and exit.")

EXIT_OF: dict[type[BaseException], Exit] = {
    KeyboardInterrupt: Exit.INTERRUPTED,
    AlignmentError: Exit.NOT_ALIGNED,
    CanvasError: Exit.NOT_ALIGNED,
    MemoryError: Exit.NOT_ALIGNED,
    EngineError: Exit.NOT_ALIGNED,
    ImageReadError: Exit.FILE,
    ImageWriteError: Exit.FILE,
    OSError: Exit.FILE,  # the terminal or the pipe behind stdout is gone or full
    CycloptsError: Exit.USAGE,
    ValueError: Exit.USAGE,
}


def main(tokens: Sequence[str] | None = None) -> int:
    """Run one command line, by default this process's, and return its exit code."""
    tokens = sys.argv[1:] if tokens is None else tokens
    _open_closed_streams()
    try:
        done: Exit | None = app(tokens, exit_on_error=False, print_error=False, result_action="return_value")
        sys.stdout.flush()
        return Exit.DONE if done is None else done
    except (Exception, KeyboardInterrupt) as error:
        code = next((code for kind, code in EXIT_OF.items() if isinstance(error, kind)), Exit.BUG)
        # A wrong call is a ValueError, and so is many a fault in a library: -v tells them apart.
        if isinstance(error, ValueError) or code == Exit.BUG:
            _trace(tokens)
        complain(_reason(error, code))
        return code


def _open_closed_streams() -> None:
    """Streams that whoever called has closed lead nowhere: else the next file opened would take their place."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode, encoding="utf-8"))  # noqa: SIM115 - for the life of the process


def _reason(error: BaseException, code: Exit) -> str:
    if code == Exit.INTERRUPTED:
        return "interrupted"
    if isinstance(error, OSError) and error.strerror:
        return f"cannot be used ({error.strerror}): {error.filename or 'stdout'}"
    reason = str(error) or type(error).__name__
    return reason if code != Exit.BUG else f"this is a bug ({type(error).__name__}: {reason}); -v shows where"


def _trace(tokens: Sequence[str]) -> None:
    if not {"-v", "--verbose"}.isdisjoint(tokens):
        traceback.print_exc()


if __name__ == "__main__":
    sys.exit(main())
