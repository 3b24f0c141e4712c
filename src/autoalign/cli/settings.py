"""Where an option comes from if the command line does not name it: AUTOALIGN_* first, then autoalign.toml.

Only options are looked up: a variable AUTOALIGN_FIXED must not stand in for a picture that was forgotten.
"""

from __future__ import annotations

from collections.abc import Iterator

from cyclopts import App, CycloptsError
from cyclopts.argument import ArgumentCollection
from cyclopts.config import Env, Toml

PREFIX, FILE = "AUTOALIGN_", "autoalign.toml"

_environment = Env(PREFIX, command=False)
# The table is shared by all commands, each of which takes what it knows: unknown names are found by `_check_names`.
_file = Toml(FILE, search_parents=True, use_commands_as_keys=False, allow_unknown=True)


def environment(app: App, commands: tuple[str, ...], arguments: ArgumentCollection) -> None:
    """Fill what the command line left open from AUTOALIGN_<OPTION>."""
    _environment(app, commands, _options(arguments))


def file(app: App, commands: tuple[str, ...], arguments: ArgumentCollection) -> None:
    """Fill what is still open from the autoalign.toml of the working folder or the nearest folder above it."""
    _check_names(app, arguments)
    _file(app, commands, _options(arguments))


def _options(arguments: ArgumentCollection) -> ArgumentCollection:
    options = arguments.copy()
    options[:] = [argument for argument in arguments if argument.index is None]
    return options


def _check_names(app: App, arguments: ArgumentCollection) -> None:
    """Refuse a name in the file that no command knows: it would be passed over in silence, misspelt as it is."""
    try:
        names = list(_file.config)
    except CycloptsError as error:
        raise CycloptsError(msg=f"{error}: {FILE}") from error
    for name in names:
        if not any(_knows(known, name) for known in (arguments, *_of_other_commands(app))):
            raise CycloptsError(msg=f"no command has the option {name!r} that is set: {FILE}")


def _knows(arguments: ArgumentCollection, name: str) -> bool:
    try:
        _options(arguments).match(f"--{name}")
    except ValueError:
        return False
    return True


def _of_other_commands(app: App) -> Iterator[ArgumentCollection]:
    root = app.app_stack.current_frame[0]
    for name in root:
        if not name.startswith("-"):
            yield root[name].assemble_argument_collection()
