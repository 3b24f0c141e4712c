"""The README is held to the program: what it names exists, what exists it names, and its examples parse."""

from __future__ import annotations

import re
import shlex
from dataclasses import fields
from pathlib import Path

import pytest

import autoalign as aa
from autoalign.cli.main import COMMANDS, app
from autoalign.cli.terminal import Exit

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()
BLOCKS = re.findall(r"^```(\w*)\n(.*?)^```", README, re.MULTILINE | re.DOTALL)
SHELL_LINES = [line for language, block in BLOCKS if language == "sh" for line in block.splitlines()]
COMMAND_LINES = [line[line.index("autoalign ") :] for line in SHELL_LINES if re.search(r"(^|/| )autoalign ", line)]


def section(command: str) -> str:
    """What the README says about one command, and about all."""
    own = README.split(f"### autoalign {command}\n")[1].split("\n### ")[0]
    return own + README.split("## The commands\n")[1].split("\n### ")[0]


def flags(command: str) -> set[str]:
    with app.app_stack((command,)):  # which brings the defaults of the whole program
        arguments = app[command].assemble_argument_collection()
    return {name for argument in arguments if argument.show for name in argument.names if name.startswith("-")}


@pytest.mark.parametrize("command", COMMANDS)
def test_every_flag_is_documented_and_every_documented_flag_exists(command):
    mentioned = set(re.findall(r"(?<![\w-])--?[a-z][\w-]*", section(command)))
    everywhere = {"--help", "-h", "--version", "--install-completion"}
    assert mentioned - everywhere == flags(command)


@pytest.mark.parametrize("line", COMMAND_LINES)
def test_every_command_line_parses(line):
    app.parse_args(shlex.split(line)[1:], exit_on_error=False, print_error=False)


def test_the_readme_has_lines_to_try_for_every_command():
    assert {line.split()[1] for line in COMMAND_LINES} == set(COMMANDS)


def test_the_python_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(ROOT / "examples")
    names: dict[str, object] = {}
    for language, block in BLOCKS:
        if language == "python":
            exec(block, names)
    assert names["aligned"].shape == names["fixed"].shape


def test_every_exit_code_is_documented():
    table = README.split("### Exit codes\n")[1].split("\n#")[0]
    assert [int(code) for code in re.findall(r"^\| (\d+) \|", table, re.MULTILINE)] == sorted(Exit)


def test_every_key_of_the_sidecar_is_documented():
    table = README.split("## The sidecar\n")[1].split("\n## ")[0]
    keys = {
        key for row in table.splitlines() if row.startswith("| `") for key in re.findall(r"`(\w+)`", row.split("|")[1])
    }
    assert keys == {"format", *(field.name for field in fields(aa.Sidecar))}


def test_continuous_integration_runs_the_test_line_of_the_readme():
    lines = [line for line in SHELL_LINES if "-m pytest" in line]
    assert len(lines) == 1
    assert README.count("-m pytest") == 1
    script = (ROOT / ".ci" / "run").read_text()
    assert "grep --max-count=1 -- '-m pytest' README.md" in script
    assert 'bash -euo pipefail -c "$test_line"' in script


def test_no_package_registry_is_named():
    for path in ("README.md", "CHANGELOG.md", "examples/README.md", "pyproject.toml", ".ci/run"):
        assert not re.search(r"pypi|conda", (ROOT / path).read_text(), re.IGNORECASE)
