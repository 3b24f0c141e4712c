"""The rows of a batch in the rerun viewer: one recording, whose time bar goes from pair to pair.

Entities                                             The timeline is `pair`: the number of the row, from 1 on.
  /summary            Markdown, static               /expected_error/{aligned,doubtful}   px of the fixed picture
  /pair               Markdown                       /inliers/{aligned,doubtful,rejected}
  /status             states                         /seconds                             only on request
  /thumbnails/{fixed,before,after}                   cleared where a pair has none

All batches have one application id: they have one layout, and the viewer lists the recordings of one id in one table,
to be sorted by their properties. The recordings of single pairs have an id each, as their layouts show that pair's
pictures and views, and a viewer keeps but one layout per id.
"""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from itertools import islice, pairwise
from pathlib import Path
from typing import Any

import rerun as rr
import rerun.blueprint as rrb

from autoalign import __version__
from autoalign.files.row import ROW_STATUSES, Row, RowStatus, Thumbnails
from autoalign.files.write import writing_atomically
from autoalign.views.evidence import STATUS_COLOUR
from autoalign.views.pictures import THUMBNAIL_SIDE
from autoalign.views.tally import Tally
from autoalign.views.viewer import APPLICATION, quiet_recording
from autoalign.views.words import MARK_OF, literal, number, plain, table

BATCH_APPLICATION = f"{APPLICATION} batch"
TIMELINE = "pair"
_TOGETHER = 100  # rows that are sent at a time: a few MB, and few enough chunks for a viewer
_COPIED = 1 << 20  # bytes
_PER_SECOND = 2.0  # pairs, when the time bar plays
_WITH_ERRORS: tuple[RowStatus, ...] = ("aligned", "doubtful")
_WITH_MATCHES: tuple[RowStatus, ...] = ("aligned", "doubtful", "rejected")
_PICTURES = ("fixed", "before", "after")  # fields of thumbnails

Illustrated = tuple[Row, Thumbnails | None]


def write_batch_recording(
    path: str | Path,
    title: str,
    rows: Iterable[Illustrated],
    about: Mapping[str, str],
    *,
    seconds: Callable[[str], float | None] | None = None,
    overwrite: bool = False,
) -> None:
    """Write the summary recording (.rrd) of a batch, in the order of the rows. `about` says what was run.

    Rows are taken by the hundred and not kept. Batches of equal rows give equal recordings, unless `seconds` says how
    long the pair of a name took. Title and about also make the id: two batches that a viewer shows at once must differ
    in them.

    Raises ImageWriteError, the path last, if the file cannot be written; then nothing is left behind.
    """
    with writing_atomically(path, overwrite) as write, tempfile.TemporaryDirectory() as folder:
        made = Path(folder) / "batch.rrd"
        recording = quiet_recording(BATCH_APPLICATION, _recording_id(title, about))
        recording.save(made)
        try:
            recording.send_blueprint(_blueprint())  # first: a viewer that waits for it guesses a layout of its own
            recording.send_recording_name(plain(title))
            _log_styles(recording)
            _log_summary(recording, title, about, _log_rows(recording, rows, seconds))
        finally:
            recording.disconnect()  # which writes the footer
        with made.open("rb") as file:
            for part in iter(partial(file.read, _COPIED), b""):
                write(part)


def _recording_id(title: str, about: Mapping[str, str]) -> str:
    return hashlib.sha256(repr((__version__, title, dict(about))).encode()).hexdigest()[:32]


def _log_rows(
    recording: rr.RecordingStream, rows: Iterable[Illustrated], seconds: Callable[[str], float | None] | None
) -> Tally:
    tally, left, first = Tally(), iter(rows), 1
    shown: dict[str, bytes | None] = dict.fromkeys(_PICTURES)
    while part := list(islice(left, _TOGETHER)):
        for row, _ in part:
            tally.add(row)
        numbers = range(first, first + len(part))
        _send_rows(recording, numbers, [row for row, _ in part])
        for name in _PICTURES:
            pictures = [None if thumbnails is None else getattr(thumbnails, name) for _, thumbnails in part]
            _send_pictures(recording, f"thumbnails/{name}", numbers, [shown[name], *pictures])
            shown[name] = pictures[-1]
        if seconds is not None:
            _send_numbers(recording, "seconds", numbers, [seconds(row.name) for row, _ in part])
        first += len(part)
    return tally


def _send_rows(recording: rr.RecordingStream, numbers: Sequence[int], rows: Sequence[Row]) -> None:
    time = rr.TimeColumn(TIMELINE, sequence=numbers)
    texts = [_told(row) for row in rows]
    markdown = rr.TextDocument.columns(text=texts, media_type=["text/markdown"] * len(rows))
    recording.send_columns("pair", [time], markdown)
    recording.send_columns("status", [time], rr.StateChange.columns(state=[row.status for row in rows]))
    for status in _WITH_ERRORS:
        errors = [row.expected_error_px if row.status == status else None for row in rows]
        _send_numbers(recording, f"expected_error/{status}", numbers, errors)
    for status in _WITH_MATCHES:
        inliers = [row.inliers if row.status == status and row.is_matched else None for row in rows]
        _send_numbers(recording, f"inliers/{status}", numbers, inliers)


def _send_numbers(
    recording: rr.RecordingStream, path: str, numbers: Sequence[int], values: Sequence[float | None]
) -> None:
    """Those values that there are."""
    known = [(at, value) for at, value in zip(numbers, values, strict=True) if value is not None]
    if known:
        at, there = zip(*known, strict=True)
        recording.send_columns(path, [rr.TimeColumn(TIMELINE, sequence=at)], rr.Scalars.columns(scalars=there))


def _send_pictures(
    recording: rr.RecordingStream, path: str, numbers: Sequence[int], pictures: Sequence[bytes | None]
) -> None:
    """Those pictures that differ from the one before, of which `pictures` has one more than there are numbers.

    The viewer goes on showing a picture until it is told another, or none.
    """
    new = [
        (at, picture) for at, (before, picture) in zip(numbers, pairwise(pictures), strict=True) if picture != before
    ]
    if not new:
        return
    there = [picture for _, picture in new if picture is not None]
    columns = rr.EncodedImage.columns(blob=there, media_type=["image/jpeg"] * len(there))
    columns = columns.partition([int(picture is not None) for _, picture in new])
    recording.send_columns(path, [rr.TimeColumn(TIMELINE, sequence=[at for at, _ in new])], columns)


def _told(row: Row) -> str:
    """A row in Markdown."""
    lines = [f"# {MARK_OF[row.status]} {row.status}", f"**{literal(row.name)}**"]
    lines.append(f"{literal(row.reason[:1].upper() + row.reason[1:])}.")
    if row.advice:
        lines.append(f"→ *What may help: {literal(row.advice)}.*")
    lines.append(table(("this pair", "found"), _facts(row)))
    return "\n\n".join(lines)


def _facts(row: Row) -> Iterator[tuple[str, str]]:
    if row.expected_error_px is not None:
        yield "expected error", f"{number(row.expected_error_px)} px"
    if row.is_matched:
        yield "matches", f"{row.inliers:,} of {row.matches:,} agree"
        yield "overlap", f"{row.overlap:.0%} of fixed"
    for name in ("fixed", "moving", "output", "sidecar", "recording"):
        if getattr(row, name) is not None:
            yield name, literal(getattr(row, name))


def _log_summary(recording: rr.RecordingStream, title: str, about: Mapping[str, str], tally: Tally) -> None:
    """What is known at the end only: static, so that it is there at every pair."""
    counts = [(f"{MARK_OF[status]} {status}", f"{tally.counts[status]:,}") for status in ROW_STATUSES]
    counts.append(("all", f"{tally.total:,}"))
    parts = [f"# {literal(title)}", table(("pairs", "count"), counts)]
    properties: dict[str, Any] = {status: tally.counts[status] for status in ROW_STATUSES}
    if tally.worst is not None:
        middle, worst = tally.median_px, tally.worst.error_px
        parts.append(
            f"Expected error of the aligned: **{number(middle)} px** in the median, {number(worst)} px at worst."
        )
        properties |= {"median_error_px": round(middle, 3), "worst_error_px": round(worst, 3)}
    if about:
        options = ((literal(name), literal(text)) for name, text in about.items())
        parts.append(f"## What was run\n\n{table(('option', 'value'), options)}")
    text = rr.TextDocument("\n\n".join(parts) + "\n", media_type="text/markdown")
    recording.log("summary", text, static=True)
    recording.send_property(APPLICATION, rr.AnyValues(**properties))


def _log_styles(recording: rr.RecordingStream) -> None:
    """How the numbers of each status are drawn."""
    colours = [STATUS_COLOUR[status] for status in ROW_STATUSES]
    states = rr.StateConfiguration(values=ROW_STATUSES, colors=colours)
    recording.log("status", states, static=True)
    for path, statuses in (("expected_error", _WITH_ERRORS), ("inliers", _WITH_MATCHES)):
        for status in statuses:
            points = rr.SeriesPoints(colors=STATUS_COLOUR[status], names=status, markers="circle", marker_sizes=2.5)
            recording.log(f"{path}/{status}", points, static=True)
    for name in _PICTURES:
        recording.log(f"thumbnails/{name}", rr.EncodedImage.from_fields(magnification_filter="linear"), static=True)
    recording.log("seconds", rr.SeriesPoints(names="seconds", markers="circle", marker_sizes=2.5), static=True)


def _blueprint() -> rrb.Blueprint:
    """The pictures of a pair above, all pairs below, words at the right: the same for every batch."""
    frame = rrb.VisualBounds2D(x_range=(0, THUMBNAIL_SIDE), y_range=(0, THUMBNAIL_SIDE))
    pictures = [
        rrb.Spatial2DView(origin=f"thumbnails/{name}", name=title, visual_bounds=frame)
        for name, title in (("fixed", "Fixed"), ("before", "Moving, before"), ("after", "Moving, after"))
    ]
    silent = rrb.PlotLegend(visible=False)  # it would hide points; the colours are those of the states above
    plots: list[Any] = [
        rrb.StateTimelineView(origin="status", name="Status"),
        rrb.TimeSeriesView(origin="expected_error", name="Expected error, px", plot_legend=silent),
        rrb.Tabs(
            rrb.TimeSeriesView(origin="inliers", name="Matches that agree", plot_legend=silent),
            rrb.TimeSeriesView(origin="seconds", name="Seconds", plot_legend=silent),
        ),
    ]
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(rrb.Horizontal(*pictures), *plots, row_shares=[2.2, 0.6, 1.3, 1.3]),
            rrb.Vertical(
                rrb.TextDocumentView(origin="pair", name="This pair"),
                rrb.TextDocumentView(origin="summary", name="The batch"),
            ),
            column_shares=[2.6, 1.0],
        ),
        rrb.TimePanel(timeline=TIMELINE, fps=_PER_SECOND, play_state="paused", state="collapsed"),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        auto_views=False,
    )
