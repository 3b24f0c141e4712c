"""Options from anywhere, holding anything: one clear line and a usage or file error, never a bug."""

from __future__ import annotations

import json
import os
import string
from typing import Any

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

NAMES = (
    *("canvas", "border", "model", "detector", "effort", "mirror", "time-limit", "seed", "threshold", "max_trials"),
    *("confidence", "patches", "min-overlap", "max_pixels", "lenient", "fixed-page", "overlay-style", "output"),
    *("json", "overwrite", "moving-mask", "timings", "ransac", "files", "unheard-of"),
)
SCALARS = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=12)
VALUES = SCALARS | st.lists(SCALARS, max_size=3) | st.dictionaries(st.sampled_from(NAMES), SCALARS, max_size=2)
FUZZ = settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def assert_one_line(run: Any, *words: str) -> None:
    """The pictures do not exist: sound options end there, with 3, others before, with 2."""
    outcome = run("pair", "none.png", "none either.png", *words)
    assert outcome.code in (2, 3), outcome.err
    assert outcome.out == ""
    assert outcome.err.startswith("autoalign: ")
    assert outcome.err.count("\n") == 1


def as_toml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list):
        return f"[{', '.join(map(as_toml, value))}]"
    if isinstance(value, dict):
        return f"{{{', '.join(f'{name} = {as_toml(item)}' for name, item in value.items())}}}"
    if isinstance(value, (int, float)):
        return str(value)
    return json.dumps(value, ensure_ascii=False)  # texts are written alike in both


@FUZZ
@given(table=st.dictionaries(st.sampled_from(NAMES), VALUES, max_size=4))
def test_any_value_in_the_file(folder: Any, run: Any, table: dict[str, Any]) -> None:
    lines = [f"{name} = {as_toml(value)}\n" for name, value in table.items()]
    (folder / "autoalign.toml").write_text("".join(lines), encoding="utf-8")
    assert_one_line(run)


@FUZZ
@given(content=st.binary(max_size=80) | st.text(string.printable, max_size=80).map(str.encode))
def test_any_file(folder: Any, run: Any, content: bytes) -> None:
    (folder / "autoalign.toml").write_bytes(content)
    assert_one_line(run)


@FUZZ
@given(name=st.sampled_from(NAMES), value=st.text(max_size=20).filter(lambda text: "\0" not in text))
def test_any_value_in_the_environment(folder: Any, run: Any, name: str, value: str) -> None:
    variable = f"AUTOALIGN_{name.upper().replace('-', '_')}"
    os.environ[variable] = value.encode("utf-8", "replace").decode()
    try:
        assert_one_line(run)
    finally:
        del os.environ[variable]


@FUZZ
@given(words=st.lists(st.sampled_from([f"--{name}" for name in NAMES]) | st.text(max_size=12), max_size=5))
def test_any_words(folder: Any, run: Any, words: list[str]) -> None:
    wanted = {"-h", "--help", "--version", "-q"}  # which do what they say
    assert_one_line(run, *(word for word in words if word not in wanted))
