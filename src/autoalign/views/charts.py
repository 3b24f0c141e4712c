"""Numbers -> SVG for a page: a bar of shares, a histogram over a logarithmic axis, lines over frames.

Colours are the page's: what is drawn carries a class, and is drawn in the `--tone` of that. The keys of every mapping
are such classes, and no words of people get into the drawings.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from autoalign.geometry.homography import Array
from autoalign.views.words import number

Name = TypeVar("Name", bound=str)  # the class of a page

WIDTH, HEIGHT = 360, 150  # units of a chart; at about 1 px each, as on a phone, its letters are legible
LEFT, RIGHT, TOP, BOTTOM = 44, 342, 12, 128  # of what is plotted in it
BINS_PER_DECADE = 6
SHOWN = (1e-4, 1e4)  # values beyond are counted as these
SAME = 1e-4  # what differs by less over all frames is a constant, and its digits are those of rounding


@dataclass(frozen=True, kw_only=True)
class _Axes:
    """Ranges of values -> units of the chart."""

    x: tuple[float, float]
    y: tuple[float, float]

    def across(self, value: float) -> float:
        return LEFT + (RIGHT - LEFT) * (value - self.x[0]) / (self.x[1] - self.x[0])

    def up(self, value: float) -> float:
        return BOTTOM - (BOTTOM - TOP) * (value - self.y[0]) / (self.y[1] - self.y[0])


def shares(counts: Mapping[Name, int]) -> str:
    """One bar, divided by the counts."""
    total, left, parts = max(1, sum(counts.values())), 0.0, []
    for name, count in counts.items():
        width = 100 * count / total
        parts.append(f'<rect class="{name}" x="{left:.3f}" y="0" width="{width:.3f}" height="1"/>')
        left += width
    told = ", ".join(f"{count:,} {name}" for name, count in counts.items())
    return (
        f'<svg class="bar" viewBox="0 0 100 1" preserveAspectRatio="none" role="img" aria-label="{told}">'
        f"{''.join(parts)}</svg>"
    )


def log_histogram(values: Mapping[Name, Sequence[float]], unit: str) -> str:
    """How often positive values of many sizes occur, those of one key stacked on those before; empty without values."""
    logs = {name: np.log10(np.clip(np.array(each, np.float64), *SHOWN)) for name, each in values.items()}
    together = np.concatenate([*logs.values(), np.empty(0)])
    if not len(together):
        return ""
    low = math.floor(together.min())
    high = max(low + 1, math.ceil(together.max()))
    edges = np.linspace(low, high, (high - low) * BINS_PER_DECADE + 1)
    counts = {name: np.histogram(each, edges)[0] for name, each in logs.items()}
    most = int(np.sum([*counts.values()], axis=0).max())
    axes = _Axes(x=(low, high), y=(0, most))
    parts = [_level(axes, 0, "0"), _level(axes, most, f"{most:,}")]
    parts += [_below(axes, decade, f"{10.0**decade:g}") for decade in range(low, high)]
    parts.append(_below(axes, high, f"{10.0**high:g} {unit}"))
    parts += _bars(axes, edges, counts, unit)
    return _chart(parts, f"{len(together):,} values between {number(10.0**low)} and {number(10.0**high)} {unit}")


def over_frames(lines: Mapping[Name, Sequence[float | None]], told: str) -> str:
    """A line per key over the number of the frame, from 1 on, named if there are several; frames that have no value are
    gaps with a mark below. Empty without values."""
    known = [value for line in lines.values() for value in line if value is not None]
    if not known:
        return ""
    frames = max(map(len, lines.values()))
    low, high = min(known), max(known)
    if high - low < SAME:
        low = high = (low + high) / 2
    room = 0.05 * (high - low) or 0.01 * max(abs(high), 1.0)  # a constant is a line in the middle
    axes = _Axes(x=(1, max(frames, 2)), y=(low - room, high + room))
    decimals = max(0, 1 - math.floor(math.log10(axes.y[1] - axes.y[0])))
    parts = [_level(axes, value, f"{value:,.{decimals}f}") for value in sorted({low, (low + high) / 2, high})]
    parts += [_below(axes, frame, f"{frame:,}") for frame in sorted({1, (frames + 1) // 2, frames})]
    for name, line in lines.items():
        parts += _runs(axes, name, line)
    if len(lines) > 1:
        names = "".join(f'<tspan class="{name}" dx="6">{name}</tspan>' for name in lines)
        parts.append(f'<text x="{LEFT}" y="{TOP + 10}">{names}</text>')
    for frame, values in enumerate(zip(*lines.values(), strict=True), 1):
        if None in values:
            x = axes.across(frame) - 0.75
            parts.append(f'<rect class="rejected" x="{x:.1f}" y="{BOTTOM - 5}" width="1.5" height="5"/>')
    return _chart(parts, told)


def _bars(axes: _Axes, edges: Array, counts: Mapping[Name, NDArray[np.int64]], unit: str) -> Iterator[str]:
    base = np.zeros(len(edges) - 1, np.int64)
    for name, per_bin in counts.items():
        for bin in np.flatnonzero(per_bin).tolist():
            left, right = (axes.across(edge) for edge in edges[bin : bin + 2].tolist())
            bottom, top = axes.up(base[bin]), axes.up(base[bin] + per_bin[bin])
            ends = " to ".join(number(10**edge) for edge in edges[bin : bin + 2].tolist())
            yield (
                f'<rect class="{name}" x="{left + 0.5:.1f}" y="{top:.1f}" width="{right - left - 1:.1f}"'
                f' height="{bottom - top:.1f}"><title>{ends} {unit}: {per_bin[bin]:,} {name}</title></rect>'
            )
        base += per_bin


def _runs(axes: _Axes, name: str, line: Sequence[float | None]) -> Iterator[str]:
    """The parts of a line between its gaps; a lone frame is a dot."""
    points = [(axes.across(frame), None if value is None else axes.up(value)) for frame, value in enumerate(line, 1)]
    for gap, run in groupby(points, lambda point: point[1] is None):
        if gap:
            continue
        at = [f"{x:.1f},{y:.1f}" for x, y in run]
        x, y = at[0].split(",")
        yield (
            f'<polyline class="{name}" points="{" ".join(at)}"/>'
            if len(at) > 1
            else (f'<circle class="{name}" cx="{x}" cy="{y}" r="1.5"/>')
        )


def _level(axes: _Axes, value: float, text: str) -> str:
    """A rule across the plot, and what it stands at."""
    y = axes.up(value)
    return (
        f'<line class="rule" x1="{LEFT}" x2="{RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>'
        f'<text x="{LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{text}</text>'
    )


def _below(axes: _Axes, value: float, text: str) -> str:
    """What stands at a place of the axis below."""
    return f'<text x="{axes.across(value):.1f}" y="{HEIGHT - 6}" text-anchor="middle">{text}</text>'


def _chart(parts: Sequence[str], told: str) -> str:
    return f'<svg class="chart" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{told}">{"".join(parts)}</svg>'
