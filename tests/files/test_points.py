"""Points as CSV: what people and spreadsheets write is read, what makes no sense is refused with its line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from autoalign.errors import ImageReadError, ImageWriteError
from autoalign.files.points import CORRESPONDENCES, PLANE_POINTS, POSITIONS, read_points, write_points


def refusal(path: Path, content: str | bytes) -> str:
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    with pytest.raises(ImageReadError) as caught:
        read_points(path, POSITIONS)
    message = str(caught.value)
    assert "\n" not in message
    assert message.endswith(f": {path}")
    return message


@pytest.mark.parametrize(
    "content",
    [
        "x,y\n1,2\n3.5,-4e2\n",
        "\ufeffx,y\r\n1,2\r\n3.5,-4e2",
        "# by hand\n\n Y , X\n2,1\n   # a comment\n\n-400,3.5\n",
        'name,x,note,y\nfirst,1,"a, b",2\n"second","3.5",,-400\n',
    ],
)
def test_ways_to_write_the_same(tmp_path: Path, content: str) -> None:
    (tmp_path / "a.csv").write_bytes(content.encode())
    points = read_points(tmp_path / "a.csv", POSITIONS)
    assert points.dtype == np.float64
    np.testing.assert_array_equal(points, [[1, 2], [3.5, -400]])


@pytest.mark.parametrize("columns", [CORRESPONDENCES, PLANE_POINTS])
def test_four_columns_in_the_order_asked_for(tmp_path: Path, columns: tuple[str, ...]) -> None:
    (tmp_path / "a.csv").write_text(",".join(reversed(columns)) + "\n4,3,2,1\n")
    np.testing.assert_array_equal(read_points(tmp_path / "a.csv", columns), [[1, 2, 3, 4]])


def test_header_alone_is_no_points(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("x,y\n")
    assert read_points(tmp_path / "a.csv", POSITIONS).shape == (0, 2)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", "line 1 lacks the column x (needed: x,y)"),
        ("1,2\n3,4\n", "line 1 lacks the column x"),
        ("# points\n\nx;y\n1;2\n", "line 3 lacks the column x"),
        ("x,y,x\n1,2,3\n", "line 1 names twice the column x"),
        ("x,y\n1,2\n\n3\n", "line 4 has 1 fields, the header has 2"),
        ("x,y\n1,2,3\n", "line 2 has 3 fields"),
        ("x,y\n1,two\n", "line 2: could not convert string to float: 'two'"),
        ("x,y\n1,\n", "line 2: could not convert"),
        ("x,y\n1,nan\n", "line 2 has a number that is not finite"),
        ("x,y\n-inf,1\n", "line 2 has a number that is not finite"),
        ("x,y\n1,1e13\n", "line 2 has a number that is not finite or too large"),
        (b"x,y\n\xff,1\n", "is not UTF-8"),
    ],
)
def test_refused(tmp_path: Path, content: str | bytes, words: str) -> None:
    assert words in refusal(tmp_path / "a.csv", content)


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(ImageReadError, match="does not exist"):
        read_points(tmp_path / "a.csv", POSITIONS)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(points=arrays(np.float64, st.tuples(st.integers(0, 5), st.just(2)), elements=st.floats(-1e12, 1e12)))
def test_round_trip_to_the_last_bit(tmp_path: Path, points: np.ndarray) -> None:
    write_points(tmp_path / "a.csv", points, POSITIONS, overwrite=True)
    np.testing.assert_array_equal(read_points(tmp_path / "a.csv", POSITIONS), points)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(body=st.binary(max_size=50) | st.text(max_size=50).map(lambda text: text.encode("utf-8", "ignore")))
def test_any_bytes(tmp_path: Path, body: bytes) -> None:
    for head in (b"", b"x,y\n", b'x,"y\n'):
        (tmp_path / "a.csv").write_bytes(head + body)
        try:
            points = read_points(tmp_path / "a.csv", POSITIONS)
        except ImageReadError:
            continue
        assert np.isfinite(points).all()


def test_what_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="shape"):
        write_points(tmp_path / "a.csv", [[1, 2, 3]], POSITIONS)
    with pytest.raises(ValueError, match="finite"):
        write_points(tmp_path / "a.csv", [[1, np.nan]], POSITIONS)
    write_points(tmp_path / "a.csv", [[1, 2]], POSITIONS)
    with pytest.raises(ImageWriteError, match="exists already"):
        write_points(tmp_path / "a.csv", [[1, 2]], POSITIONS)
    assert (tmp_path / "a.csv").read_text() == "x,y\n1.0,2.0\n"
