"""Drawings are parsed and their shapes held to the numbers they show."""

from __future__ import annotations

import math
from xml.etree import ElementTree

import numpy as np
import pytest

from autoalign.views.charts import BOTTOM, LEFT, RIGHT, SHOWN, TOP, log_histogram, over_frames, shares


def drawn(svg: str, tag: str, name: str | None = None) -> list[ElementTree.Element]:
    """The elements of a kind, and of a class."""
    found = ElementTree.fromstring(svg).iter(tag)
    return [element for element in found if name is None or element.get("class") == name]


def number(element: ElementTree.Element, name: str) -> float:
    return float(element.attrib[name])


def texts(svg: str) -> list[str]:
    return [element.text or "" for element in drawn(svg, "text")]


def test_shares_fill_the_bar_in_proportion() -> None:
    svg = shares({"aligned": 6, "doubtful": 0, "rejected": 2})
    widths = [number(rect, "width") for rect in drawn(svg, "rect")]
    assert widths == [75, 0, 25]
    assert [number(rect, "x") for rect in drawn(svg, "rect")] == [0, 75, 75]
    assert ElementTree.fromstring(svg).get("aria-label") == "6 aligned, 0 doubtful, 2 rejected"


def test_shares_of_nothing_are_empty() -> None:
    assert [number(rect, "width") for rect in drawn(shares({"aligned": 0}), "rect")] == [0]


def test_bars_count_values_where_the_axis_has_them() -> None:
    rng = np.random.default_rng(0)
    values = (10 ** rng.normal(-1, 0.5, 500)).tolist()
    svg = log_histogram({"aligned": values}, "px")
    bars = drawn(svg, "rect", "aligned")
    heights = np.array([number(bar, "height") for bar in bars])
    tallest = int(texts(svg)[1])
    np.testing.assert_allclose(heights.sum() / (BOTTOM - TOP) * tallest, 500, rtol=0.01)
    # The axis says which units are which values: the heaviest bar stands over the median.
    decades = {
        float(text.removesuffix(" px")): number(at, "x")
        for text, at in zip(texts(svg), drawn(svg, "text"), strict=True)
    }
    del decades[0], decades[tallest]
    low, high = min(decades), max(decades)
    assert (decades[low], decades[high]) == (LEFT, RIGHT)
    middle = number(bars[heights.argmax()], "x") + number(bars[heights.argmax()], "width") / 2
    shown = low * (high / low) ** ((middle - LEFT) / (RIGHT - LEFT))
    assert math.log10(shown) == pytest.approx(math.log10(np.median(values)), abs=0.35)


def test_stacked_bars_stand_on_each_other() -> None:
    svg = log_histogram({"aligned": [0.5, 0.5, 0.5], "doubtful": [0.5]}, "px")
    (below,), (above,) = drawn(svg, "rect", "aligned"), drawn(svg, "rect", "doubtful")
    assert number(below, "y") + number(below, "height") == BOTTOM
    assert number(above, "y") == TOP
    assert number(above, "y") + number(above, "height") == pytest.approx(number(below, "y"), abs=0.2)
    assert [title.text for title in drawn(svg, "title")] == [
        "0.464 to 0.681 px: 3 aligned",
        "0.464 to 0.681 px: 1 doubtful",
    ]


def test_values_beyond_the_axis_are_counted_at_its_ends() -> None:
    svg = log_histogram({"aligned": [0.0, 1e-9, 1e9]}, "px")
    assert [round(number(bar, "x") - 0.5) for bar in drawn(svg, "rect")] == pytest.approx([LEFT, RIGHT], abs=8)
    assert f"{SHOWN[1]:g} px" in texts(svg)


@pytest.mark.parametrize("values", [{}, {"aligned": []}])
def test_a_histogram_of_nothing_is_not_drawn(values: dict[str, list[float]]) -> None:
    assert log_histogram(values, "px") == ""


def test_a_line_goes_through_its_values() -> None:
    line = [0.0, 10.0, 5.0, 20.0]
    svg = over_frames({"turn": line}, "told")
    (polyline,) = drawn(svg, "polyline")
    points = np.array([point.split(",") for point in polyline.attrib["points"].split()], float)
    np.testing.assert_allclose(points[:, 0], np.linspace(LEFT, RIGHT, 4), atol=0.1)
    assert np.corrcoef(points[:, 1], line)[0, 1] == pytest.approx(-1, abs=1e-5)  # upwards is less
    rules = {float(text): number(at, "y") - 4 for text, at in zip(texts(svg)[:3], drawn(svg, "text"), strict=False)}
    assert rules == pytest.approx({0.0: points[0, 1], 10.0: points[1, 1], 20.0: points[3, 1]}, abs=0.2)


def test_gaps_are_left_out_and_marked() -> None:
    svg = over_frames({"x": [1.0, 2.0, None, 3.0, None, 4.0, 5.0], "y": [1.0, 2.0, None, 3.0, None, 4.0, 5.0]}, "told")
    assert len(drawn(svg, "polyline", "x")) == len(drawn(svg, "polyline", "y")) == 2
    assert len(drawn(svg, "circle", "x")) == 1
    marks = [number(mark, "x") + 0.75 for mark in drawn(svg, "rect", "rejected")]
    np.testing.assert_allclose(marks, np.linspace(LEFT, RIGHT, 7)[[2, 4]], atol=0.1)
    assert [name.text for name in drawn(svg, "tspan")] == ["x", "y"]


@pytest.mark.parametrize("line", [[1.0, 1.0, 1.0], [0.0], [-3.5, -3.5], [1.0, 1 + 2e-16, 1 - 5e-16]])
def test_a_constant_is_a_line_in_the_middle(line: list[float]) -> None:
    svg = over_frames({"scale": line}, "told")
    (rule,) = drawn(svg, "line")
    assert len(texts(svg)[0]) <= len("-3.500")
    assert number(rule, "y1") == pytest.approx((TOP + BOTTOM) / 2, abs=0.1)


def test_small_changes_are_told_apart() -> None:
    assert len(set(texts(over_frames({"scale": [1.0001, 1.0002, 1.0003]}, "told"))[:3])) == 3


def test_lines_without_values_are_not_drawn() -> None:
    assert over_frames({"scale": [None, None]}, "told") == ""
