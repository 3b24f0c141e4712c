"""The page is taken apart as a browser would, and held to the rows it was made of."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import tracemalloc
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote_to_bytes, urlsplit

import numpy as np
import pytest

from autoalign.errors import ImageWriteError
from autoalign.files.row import Row, Thumbnails
from autoalign.views.pictures import thumbnails
from autoalign.views.report import write_report
from rows import ALIGNED, FAILED

SHIFTED = ((1.0, 0.0, 3.0), (0.0, 1.0, -4.0), (0.0, 0.0, 1.0))
HOSTILE = (
    "</script><script>alert(1)</script>.png",
    "<!--<script>.png",
    "x\"' onerror=alert(1) .png",
    "javascript:alert(1)",
    "a\u202egnp.exe",
    "写真 №1 (é_*`|).png",
    "شاهد.png",
    "\udcff raw bytes.png",
    "new\nline &lt; ${title} $policy.png",
    "../up/#frag?query%41.png",
)


@dataclass
class Page(HTMLParser):
    """What a browser finds in the file."""

    text: str
    tags: list[tuple[str, dict[str, str | None]]] = field(default_factory=list)
    contents: list[tuple[str, dict[str, str | None], str]] = field(default_factory=list)  # of scripts and styles
    words: str = ""

    def __post_init__(self) -> None:
        super().__init__()
        self.feed(self.text)

    __hash__ = object.__hash__

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        if self.tags and self.tags[-1][0] in ("script", "style") and self.cdata_elem:
            self.contents.append((*self.tags[-1], data))
        else:
            self.words += data

    @property
    def rows(self) -> list[dict[str, object]]:
        return [json.loads(data) for _, attributes, data in self.contents if attributes.get("class") == "row"]

    def picture(self, number: object) -> bytes:
        (data,) = [data for _, attributes, data in self.contents if attributes.get("id") == f"p{number}"]
        return base64.b64decode(data, validate=True)


def page(folder: Path, *rows: tuple[Row, Thumbnails | None], title: str = "title", **words: bool) -> Page:
    path = folder / "report.html"
    write_report(path, title, rows, {"options": "seed 0"}, overwrite=True, **words)
    return Page(path.read_text(encoding="utf-8"))


def shown(seed: int) -> Thumbnails:
    rng = np.random.default_rng(seed)
    fixed, moving = np.full((40, 60), 90, np.uint8), rng.integers(0, 255, (40, 60), np.uint8)
    return thumbnails(fixed, moving, np.array(SHIFTED))


def test_a_row_is_all_there(tmp_path: Path) -> None:
    pictures, shifted = shown(0), replace(ALIGNED, fixed_from_moving=SHIFTED)
    found = page(tmp_path, (shifted, pictures))
    (row,) = found.rows
    for name in (
        "name",
        "fixed",
        "moving",
        "status",
        "reason",
        "expected_error_px",
        "model",
        "rung",
        "matches",
        "inliers",
    ):
        assert row[name] == getattr(shifted, name)
    assert row["shift_px"] == pytest.approx(5.0)
    assert row["motion"] == "turned by 0.0°, of the same size"
    assert row["links"] == {"output": "./a.jpg", "sidecar": "./a.jpg.autoalign.json"}
    assert isinstance(row["thumbnails"], list)
    assert [found.picture(number) for number in row["thumbnails"]] == [pictures.fixed, pictures.before, pictures.after]


def test_a_pair_that_failed_has_no_numbers(tmp_path: Path) -> None:
    (row,) = page(tmp_path, (FAILED, None)).rows
    assert {row[name] for name in ("matches", "inliers", "overlap", "expected_error_px", "shift_px", "thumbnails")} == {
        None
    }
    assert row["links"] == {}


def test_a_frame_of_a_sequence_has_no_matches_of_its_own(tmp_path: Path) -> None:
    (row,) = page(tmp_path, (replace(ALIGNED, rung=None, matches=0, inliers=0, overlap=0.0), None)).rows
    assert {row[name] for name in ("matches", "inliers", "overlap")} == {None}
    assert row["expected_error_px"] == ALIGNED.expected_error_px


def test_a_picture_that_rows_share_stands_once(tmp_path: Path) -> None:
    pairs = [(replace(ALIGNED, name=f"{k}.jpg"), shown(k)) for k in range(5)]
    found = page(tmp_path, *pairs)
    assert sum(attributes.get("type") == "text/plain" for _, attributes in found.tags) == 1 + 2 * 5
    for row, (_, pictures) in zip(found.rows, pairs, strict=True):
        assert isinstance(row["thumbnails"], list)
        assert [found.picture(number) for number in row["thumbnails"]] == [
            pictures.fixed,
            pictures.before,
            pictures.after,
        ]


def test_pictures_stand_before_the_row_that_shows_them(tmp_path: Path) -> None:
    """So that the file can be written, and read, from start to end."""
    found = page(tmp_path, (ALIGNED, shown(0)), (FAILED, None))
    kinds = [attributes.get("type") for tag, attributes in found.tags if tag == "script"]
    assert kinds == [*["text/plain"] * 3, *["application/json"] * 2, None]


def test_the_summary_counts(tmp_path: Path) -> None:
    worst = replace(ALIGNED, name="worst.jpg", expected_error_px=0.9)
    doubtful = replace(ALIGNED, name="c.jpg", status="doubtful", expected_error_px=7.0)
    found = page(tmp_path, (ALIGNED, None), (doubtful, None), (worst, None), (FAILED, None), (ALIGNED, None))
    filters = {attributes["data-status"]: attributes for _, attributes in found.tags if "data-status" in attributes}
    assert [name for name, attributes in filters.items() if "disabled" in attributes] == ["rejected"]
    words = " ".join(found.words.split())
    assert "5 pairs" in words
    assert "all 5 ✓ aligned 3 ⚠ doubtful 1 ✗ rejected 0 ! failed 1" in words
    assert "median of the aligned0.3 px" in words
    assert "worst of the aligned: worst.jpg0.9 px" in words
    assert [attributes["data-show"] for _, attributes in found.tags if "data-show" in attributes] == ["3"]
    assert "options" in words
    assert "seed 0" in words


def test_drift_is_plotted_for_sequences_only(tmp_path: Path) -> None:
    frames = [(replace(ALIGNED, name=f"{k}.jpg"), None) for k in range(4)]
    assert "Drift over the frames" not in page(tmp_path, *frames).words
    found = page(tmp_path, *frames, (replace(FAILED, name="4.jpg"), None), sequence=True)
    assert "Drift over the frames" in found.words
    lines = [attributes["class"] for tag, attributes in found.tags if tag == "polyline"]
    assert lines == ["x", "y", "turn", "scale"]
    assert sum(attributes.get("class") == "rejected" and tag == "rect" for tag, attributes in found.tags) == 3 + 1


def test_a_batch_of_nothing_is_a_page(tmp_path: Path) -> None:
    found = page(tmp_path)
    assert found.rows == []
    assert "0 pairs" in found.words


@pytest.mark.parametrize("name", HOSTILE)
def test_names_are_nothing_but_names(name: str, tmp_path: Path) -> None:
    row = replace(ALIGNED, name=name, fixed=name, moving=name, reason=name, advice=name, output=name)
    plain, hostile = page(tmp_path, (ALIGNED, None)), page(tmp_path, (row, None), title=name)
    assert [tag for tag, _ in hostile.tags] == [tag for tag, _ in plain.tags]
    (found,) = hostile.rows
    assert found["name"] == found["reason"]
    assert str(found["name"]).isprintable()
    href = str(found["links"]["output"])  # type: ignore[index]
    assert urlsplit(href)[:2] == ("", "")
    assert unquote_to_bytes(href.removeprefix("./")) == name.encode("utf-8", "surrogateescape")


def test_no_sign_of_a_row_means_anything_to_html(tmp_path: Path) -> None:
    row = replace(ALIGNED, name="<&>", reason="<&>")
    texts = [data for _, attributes, data in page(tmp_path, (row, None)).contents if attributes.get("class") == "row"]
    assert not re.search(r"[<>&]", "".join(texts))
    assert "".join(texts).isascii()


def test_the_page_asks_for_nothing_and_runs_nothing_else(tmp_path: Path) -> None:
    found = page(tmp_path, (ALIGNED, shown(0)))
    (policy,) = [attributes["content"] for _, attributes in found.tags if "http-equiv" in attributes]
    rules = dict(rule.split(maxsplit=1) for rule in str(policy).split("; "))
    assert rules["default-src"] == "'none'"
    assert rules["img-src"] == "data:"
    for tag in ("script", "style"):
        (source,) = [data for kind, attributes, data in found.contents if kind == tag and "type" not in attributes]
        digest = base64.b64encode(hashlib.sha256(source.encode()).digest()).decode()
        assert rules[f"{tag}-src"] == f"'sha256-{digest}'"
    for _, attributes in found.tags:
        assert not {"src", "style", "onclick", "onerror", "onload"} & attributes.keys()
        assert attributes.get("href", "./").startswith("./")


def test_every_column_is_made_by_the_script(tmp_path: Path) -> None:
    found = page(tmp_path, (ALIGNED, None))
    keys = [attributes["data-key"] for tag, attributes in found.tags if tag == "th"]
    (script,) = [data for kind, attributes, data in found.contents if kind == "script" and "type" not in attributes]
    cells = script.partition("const cells = {")[2].partition("};")[0]
    assert re.findall(r"^  (\w+): \(row\)", cells, re.MULTILINE) == keys
    assert set(keys) - {"order"} <= found.rows[0].keys()
    used = set(re.findall(r"byId\(\"(\w+)\"\)", script))
    assert used <= {attributes.get("id") for _, attributes in found.tags}


def test_numbers_that_json_has_no_word_for(tmp_path: Path) -> None:
    through_the_middle = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (1.0, 0.0, -149.5))
    row = replace(ALIGNED, expected_error_px=float("inf"), overlap=float("nan"), fixed_from_moving=through_the_middle)
    (found,) = page(tmp_path, (row, None), sequence=True).rows
    assert (found["expected_error_px"], found["overlap"], found["shift_px"]) == (None, None, None)


def test_the_same_rows_give_the_same_page(tmp_path: Path) -> None:
    assert page(tmp_path, (ALIGNED, shown(0))).text == page(tmp_path, (ALIGNED, shown(0))).text


def test_pictures_are_not_kept(tmp_path: Path) -> None:
    def rows() -> Iterator[tuple[Row, Thumbnails]]:
        for k in range(400):
            picture = k.to_bytes(4) * 5_000
            yield replace(ALIGNED, name=f"{k}.jpg"), Thumbnails(fixed=b"", before=picture, after=picture[::-1])

    tracemalloc.start()
    write_report(tmp_path / "report.html", "many", rows(), {})
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert (tmp_path / "report.html").stat().st_size > 20e6
    assert most < 3e6


def test_a_batch_that_breaks_off_leaves_no_page(tmp_path: Path) -> None:
    def rows() -> Iterator[tuple[Row, None]]:
        yield ALIGNED, None
        raise ValueError("the ledger is gone")

    with pytest.raises(ValueError, match="the ledger is gone"):
        write_report(tmp_path / "report.html", "title", rows(), {})
    assert list(tmp_path.iterdir()) == []


def test_a_page_is_not_written_over_unasked(tmp_path: Path) -> None:
    (tmp_path / "report.html").write_text("mine")
    with pytest.raises(ImageWriteError, match=r"exists already.*report\.html"):
        write_report(tmp_path / "report.html", "title", [], {})
    assert (tmp_path / "report.html").read_text() == "mine"
