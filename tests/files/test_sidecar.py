"""The sidecar: the same record out as in, the same bytes every time, and nothing hostile comes through."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from autoalign.errors import AlignmentError, ImageReadError, ImageWriteError
from autoalign.files.sidecar import (
    FORMAT,
    PictureRecord,
    Sidecar,
    as_shown,
    default_sidecar,
    read_sidecar,
    transform_of,
    write_sidecar,
)

ALIGNED = Sidecar(
    status="aligned",
    reason="212 of 431 matches agree",
    fixed_from_moving=((1.01, -0.02, 30.25), (0.02, 0.99, -1 / 3), (1e-5, -2e-6, 1.0)),
    expected_error_px=0.31,
    model="homography",
    fixed=PictureRecord(name="straße.jpg", size=(4000, 3000), sha256="0123456789abcdef" * 4),
    moving=PictureRecord(name="old.tif", size=(3000, 2000), sha256="f" * 64),
    options={"ransac": {"seed": 0, "threshold_px": 3.0}, "detector": None},
    versions={"autoalign": "0.1.0", "numpy": "2.4"},
    stages={"matches": 431, "inliers": 212, "octaves": [3, 4]},
    evidence={"log10_nfa": -112.5, "mirrored": False},
)
REJECTED = replace(
    ALIGNED, status="rejected", reason="7 of 31 agree", fixed_from_moving=None, expected_error_px=None, model=None
)


def as_json(**changes: Any) -> dict[str, Any]:
    record = {
        "format": FORMAT,
        "status": "aligned",
        "reason": "",
        "fixed_from_moving": [[1, 0, 3], [0, 1, 4.5], [0, 0, 1]],
        "expected_error_px": 0.5,
        "model": "translation",
        "fixed": {"name": "a", "size": [5, 3], "sha256": "0" * 64},
        "moving": {"name": "b", "size": [7, 4], "sha256": "1" * 64},
        "options": {},
        "versions": {},
        "stages": {},
        "evidence": {},
    }
    return record | changes


def refusal(path: Path, content: str | bytes | dict[str, Any]) -> str:
    if isinstance(content, dict):
        content = json.dumps(content)
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    with pytest.raises(ImageReadError) as caught:
        read_sidecar(path)
    message = str(caught.value)
    assert "\n" not in message
    assert message.endswith(f": {path}")
    return message


@pytest.mark.parametrize("record", [ALIGNED, REJECTED, replace(ALIGNED, timings_s={"detect": 0.25})])
def test_round_trip(tmp_path: Path, record: Sidecar) -> None:
    write_sidecar(tmp_path / "a.json", record)
    assert read_sidecar(tmp_path / "a.json") == record


def test_the_file(tmp_path: Path) -> None:
    write_sidecar(tmp_path / "a.json", ALIGNED)
    content = (tmp_path / "a.json").read_bytes()
    assert content.endswith(b"\n}\n")
    record = json.loads(content)
    assert list(record)[:4] == ["format", "status", "reason", "fixed_from_moving"]
    assert list(record["options"]) == ["detector", "ransac"]
    assert "timings_s" not in record
    turned_round = replace(ALIGNED, options=dict(reversed(ALIGNED.options.items())))
    write_sidecar(tmp_path / "b.json", turned_round)
    assert (tmp_path / "b.json").read_bytes() == content


def test_existing_file_is_refused(tmp_path: Path) -> None:
    write_sidecar(tmp_path / "a.json", ALIGNED)
    with pytest.raises(ImageWriteError, match="exists already"):
        write_sidecar(tmp_path / "a.json", REJECTED)
    write_sidecar(tmp_path / "a.json", REJECTED, overwrite=True)
    assert read_sidecar(tmp_path / "a.json") == REJECTED


def test_numpy_and_dataclasses_become_json(tmp_path: Path) -> None:
    evidence = {"spread": np.float64(0.5), "counts": np.arange(3), "which": ALIGNED.fixed, "pair": (1, 2)}
    write_sidecar(tmp_path / "a.json", replace(ALIGNED, evidence=evidence))
    assert read_sidecar(tmp_path / "a.json").evidence == {
        "spread": 0.5,
        "counts": [0, 1, 2],
        "which": {"name": "straße.jpg", "size": [4000, 3000], "sha256": "0123456789abcdef" * 4},
        "pair": [1, 2],
    }


def test_file_names_that_are_no_text(tmp_path: Path) -> None:
    name = b"scan-\xff.jpg".decode("utf-8", "surrogateescape")
    record = replace(ALIGNED, fixed=replace(ALIGNED.fixed, name=name))
    write_sidecar(tmp_path / "a.json", record)
    assert read_sidecar(tmp_path / "a.json").fixed.name == name


@pytest.mark.parametrize(
    "changes",
    [
        {"expected_error_px": float("nan")},
        {"expected_error_px": -1.0},
        {"evidence": {"a": {"b": [float("inf")]}}},
        {"evidence": {"a": np.array([np.nan])}},
        {"evidence": {"a": object()}},
        {"evidence": {1: 2}},
        {"timings_s": {"detect": float("nan")}},
        {"fixed_from_moving": ((1.0, 0.0, 0.0), (0.0, float("nan"), 0.0), (0.0, 0.0, 1.0))},
        {"fixed_from_moving": ((0.5, 0.0, 0.0), (0.0, 0.5, 0.0), (0.0, 0.0, 0.5))},
        {"fixed_from_moving": ((1.0, 0.0, 0.0), (2.0, 0.0, 0.0), (0.0, 0.0, 1.0))},
        {"fixed_from_moving": None},
        {"status": "rejected"},
        {"status": "good"},
        {"reason": None},
    ],
)
def test_what_could_not_be_read_again_is_not_written(tmp_path: Path, changes: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"."):
        write_sidecar(tmp_path / "a.json", replace(ALIGNED, **changes))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"format": "autoalign sidecar 2"}, '"format" is not'),
        ({"status": "fine"}, '"status" is none of'),
        ({"status": ["aligned"]}, '"status" is none of'),
        ({"status": "rejected"}, '"fixed_from_moving" is there but'),
        ({"fixed_from_moving": None}, '"fixed_from_moving" is missing but'),
        ({"fixed_from_moving": [[1, 0], [0, 1]]}, "3 rows of 3"),
        ({"fixed_from_moving": "eye"}, "3 rows of 3"),
        ({"fixed_from_moving": [[1, 0, 0], [0, 1, 0], [0, 0, True]]}, "is not a number"),
        ({"fixed_from_moving": [[1, 0, 0], [0, 1, 0], [0, 0, "1"]]}, "is not a number"),
        ({"fixed_from_moving": [[1, 0, 0], [0, 1, 0], [0, 0, 2]]}, "does not have a 1"),
        ({"fixed_from_moving": [[1, 2, 3], [2, 4, 6], [0, 0, 1]]}, "cannot be inverted"),
        ({"fixed_from_moving": [[0, 0, 0], [0, 0, 0], [0, 0, 1]]}, "cannot be inverted"),
        ({"fixed_from_moving": [[1, 0, 1e200], [0, 1, 0], [0, 0, 1]]}, "over 1e+12"),
        ({"fixed_from_moving": [[1, 0, 10**400], [0, 1, 0], [0, 0, 1]]}, "bearable size"),
        ({"expected_error_px": "small"}, '"expected_error_px" is not a number'),
        ({"expected_error_px": -0.1}, "below zero"),
        ({"reason": 5}, '"reason" is not text'),
        ({"fixed": []}, '"fixed" is not an object'),
        ({"fixed": {"name": "a", "size": [5, 0], "sha256": "0" * 64}}, '"size" of "fixed"'),
        ({"moving": {"name": "a", "size": [5.5, 3], "sha256": "0" * 64}}, '"size" of "moving"'),
        ({"moving": {"name": "a", "size": [5, 3], "sha256": "0" * 63}}, '"sha256" of "moving"'),
        ({"moving": {"size": [5, 3], "sha256": "0" * 64}}, '"name of moving" is not text'),
        ({"versions": {"numpy": 2}}, '"versions" is not text'),
        ({"timings_s": 0}, '"timings_s" is not an object'),
        ({"evidence": {"a": float("nan")}}, '"a" has a number that is not finite'),
        ({"options": {"a": [1, {"b": float("-inf")}]}}, '"b" has a number that is not finite'),
    ],
)
def test_refused(tmp_path: Path, changes: dict[str, Any], words: str) -> None:
    assert words in refusal(tmp_path / "a.json", as_json(**changes))


@pytest.mark.parametrize("field", [name for name in as_json() if name != "format"])
def test_missing_field(tmp_path: Path, field: str) -> None:
    record = as_json()
    del record[field]
    assert f'"{field}" is missing' in refusal(tmp_path / "a.json", record)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", "is no JSON"),
        ("[1, 2]", "not an object"),
        ("{", "is no JSON"),
        (b"\xff\xd8\xff\xe0", "not UTF-8"),
        ('{"format": "' + "x" * 20, "is no JSON"),
        ("[" * 100_000, "nested too deeply"),
        (json.dumps(as_json(evidence={"a": 0})).replace('"a": 0', '"a": ' + "[" * 30 + "]" * 30), "too deeply"),
        (json.dumps(as_json(evidence={"a": 0})).replace('"a": 0', '"a": 1e999'), "not finite"),
        (json.dumps(as_json(evidence={"a": 0})).replace('"a": 0', '"a": ' + "9" * 5000), "is no sidecar"),
        (" " * (2**24 + 1), "larger than"),
    ],
)
def test_no_sidecar(tmp_path: Path, content: str | bytes, words: str) -> None:
    assert words in refusal(tmp_path / "a.json", content)


def test_unknown_fields_are_passed_over(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text(json.dumps(as_json(later=[1])))
    assert read_sidecar(tmp_path / "a.json").status == "aligned"


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(ImageReadError, match="does not exist"):
        read_sidecar(tmp_path / "a.json")


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=200, deadline=None)
@given(
    name=st.sampled_from([*as_json(), "timings_s"]),
    value=st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
        max_leaves=9,
    ),
)
def test_any_value_anywhere(tmp_path: Path, name: str, value: Any) -> None:
    path = tmp_path / "a.json"
    path.write_text(json.dumps(as_json(**{name: value})))
    try:
        record = read_sidecar(path)
    except ImageReadError:
        return
    write_sidecar(path, record, overwrite=True)
    assert read_sidecar(path) == record


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=100, deadline=None)
@given(content=st.binary(max_size=60) | st.text(max_size=60).map(lambda text: text.encode("utf-8", "ignore")))
def test_any_bytes(tmp_path: Path, content: bytes) -> None:
    refusal(tmp_path / "a.json", content)


# Transforms


def test_transform_of() -> None:
    np.testing.assert_array_equal(transform_of(ALIGNED), np.array(ALIGNED.fixed_from_moving))
    with pytest.raises(AlignmentError, match="7 of 31 agree"):
        transform_of(REJECTED)


def test_as_shown() -> None:
    transform = np.array([[2.0, 0.5, 30.0], [-0.5, 2.0, 7.0], [1e-4, 0.0, 2.0]])
    shown = np.array(as_shown(-transform / np.linalg.norm(transform)))
    np.testing.assert_allclose(shown, transform / 2, rtol=1e-14)
    assert shown[2, 2] == 1


@pytest.mark.parametrize("transform", [np.eye(2), np.diag([1, 1, 0]), np.diag([1, 1, np.nan]), np.diag([1, 1, 1e-320])])
def test_transforms_that_cannot_be_shown(transform: Any) -> None:
    with pytest.raises(ValueError, match="transform"):
        as_shown(transform)


def test_default_sidecar() -> None:
    assert default_sidecar("out/b_aligned.png") == Path("out/b_aligned.autoalign.json")
