"""The rows of a batch -> one HTML page that opens from disk, needs no network, and holds thousands of pairs.

The page is written as the rows come: every picture once, then its row as JSON, and only after the last one the summary
and the table, which is where a reader's eye begins. A browser passes over a picture until a row that shows it is drawn.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
import math
import os
from collections.abc import Callable, Iterable, Mapping
from importlib.resources import files
from pathlib import Path, PurePath
from string import Template
from typing import Any
from urllib.parse import quote

from autoalign import __version__
from autoalign.files.row import ROW_STATUSES, Row, RowStatus, Thumbnails
from autoalign.files.write import writing_atomically
from autoalign.views.charts import log_histogram, over_frames, shares
from autoalign.views.motion import Motion, motion
from autoalign.views.tally import Tally
from autoalign.views.words import MARK_OF, counted, moved, number, plain

_ROWS = "<!-- rows -->"  # where they stand in the template
_FOUND = ("matches", "inliers", "overlap")  # fields of a row that has matches of its own
_LINKS = ("output", "sidecar", "recording")  # fields of a row: files relative to the folder of the report


def write_report(
    path: str | Path,
    title: str,
    rows: Iterable[tuple[Row, Thumbnails | None]],
    about: Mapping[str, str],
    *,
    sequence: bool = False,
    overwrite: bool = False,
) -> None:
    """Write the report of a batch, in the order of the rows. `about` says what was run, name by name.

    Links lead to what the rows name, relative to the folder of the report. Of a `sequence`, whose rows are its frames,
    the drift is plotted. Texts may hold anything. Rows are taken one by one, and their pictures are not kept.

    Raises ImageWriteError, the path last, if the file cannot be written; then nothing is left behind.
    """
    before, after = _template("report.html").split(_ROWS)
    style, script = _template("report.css"), _template("report.js")
    fixed = {
        "title": _text(title),
        "policy": f"default-src 'none'; img-src data:; style-src {_hash(style)}; script-src {_hash(script)};"
        " base-uri 'none'; form-action 'none'",
        "style": style,
        "script": script,
    }
    with writing_atomically(path, overwrite) as write:
        write(Template(before).substitute(fixed).encode())
        tally, motions = _write_rows(write, rows)
        summary = _summary(tally, about, motions if sequence else None)
        write(Template(after).substitute(fixed, **summary).encode())


def _write_rows(
    write: Callable[[bytes], None], rows: Iterable[tuple[Row, Thumbnails | None]]
) -> tuple[Tally, list[Motion | None]]:
    """Write them, and return what the summary needs: a motion per row, None where there is no transform."""
    tally, motions = Tally(), list[Motion | None]()
    numbers: dict[bytes, int] = {}  # of the pictures that are written, by what they hold

    def numbered(picture: bytes | None) -> int | None:
        """Writes a picture unless it stands in the file already."""
        if picture is None:
            return None
        digest = hashlib.sha256(picture).digest()
        if digest not in numbers:
            numbers[digest] = len(numbers)
            write(b'<script type="text/plain" id="p%d">%b</script>\n' % (numbers[digest], base64.b64encode(picture)))
        return numbers[digest]

    for row, pictures in rows:
        three = () if pictures is None else (pictures.fixed, pictures.before, pictures.after)
        shown = [numbered(picture) for picture in three] or None
        tally.add(row)
        motions.append(_motion(row))
        record = _record(row, motions[-1], shown)
        write(b'<script type="application/json" class="row">%b</script>\n' % _json(record))
    return tally, motions


def _record(row: Row, moves: Motion | None, pictures: list[int | None] | None) -> dict[str, Any]:
    """A row as the page's script takes it."""
    return {
        "name": plain(row.name),
        "fixed": plain(row.fixed),
        "moving": plain(row.moving),
        "status": row.status,
        "reason": plain(row.reason),
        "advice": plain(row.advice),
        "expected_error_px": _finite(row.expected_error_px),
        **dict.fromkeys(_FOUND),
        **({name: _finite(getattr(row, name)) for name in _FOUND} if row.is_matched else {}),
        "shift_px": None if moves is None else math.hypot(*moves.shift_px),
        "motion": None if moves is None else moved(moves),
        "model": row.model,
        "rung": row.rung,
        "fixed_from_moving": row.fixed_from_moving,
        "fixed_size": row.fixed_size,
        "moving_size": row.moving_size,
        "links": {name: _href(path) for name in _LINKS if (path := getattr(row, name)) is not None},
        "thumbnails": pictures,
    }


def _motion(row: Row) -> Motion | None:
    if row.fixed_from_moving is None or row.moving_size is None:
        return None
    found = motion(row.fixed_from_moving, row.moving_size)
    known = all(map(math.isfinite, (*found.shift_px, found.turn_rad, found.scale)))
    return found if known else None


def _summary(tally: Tally, about: Mapping[str, str], drift: list[Motion | None] | None) -> dict[str, str]:
    """What stands above the table."""
    counts = {status: tally.counts[status] for status in ROW_STATUSES}
    total = tally.total
    cards = [_errors_card(tally), _about_card(about), "" if drift is None else _drift_card(drift)]
    return {
        "subtitle": f"{counted(total, 'pair')} · autoalign {__version__}",
        "bar": shares(counts),
        "filters": "\n".join(
            [
                f'<button type="button" id="all">all <b>{total:,}</b></button>',
                *(_filter(*counted) for counted in counts.items()),
            ]
        ),
        "cards": "\n".join(card for card in cards if card),
    }


def _filter(status: RowStatus, count: int) -> str:
    """A button that shows the pairs of one status, and tells the script of the page its mark."""
    mark = MARK_OF[status]
    return (
        f'<button type="button" class="{status}" data-status="{status}" data-mark="{mark}"'
        f"{'' if count else ' disabled'}>{mark} {status} <b>{count:,}</b></button>"
    )


def _errors_card(tally: Tally) -> str:
    chart = log_histogram(tally.errors_px, "px")
    figures = ""
    if tally.worst is not None:
        place, name = tally.worst.number, _text(tally.worst.name)
        worst = f'<button type="button" class="link" data-show="{place}" dir="auto">{name}</button>'
        figures = (
            '<dl class="figures">'
            f"<div><dt>median of the aligned</dt><dd>{number(tally.median_px)} px</dd></div>"
            f"<div><dt>worst of the aligned: {worst}</dt><dd>{number(tally.worst.error_px)} px</dd></div></dl>"
        )
    return f'<div class="card"><h2>Expected error</h2>{figures}{chart}</div>' if chart else ""


def _drift_card(motions: list[Motion | None]) -> str:
    def line(measure: Callable[[Motion], float]) -> list[float | None]:
        return [None if each is None else measure(each) for each in motions]

    lines = {
        "shift, px": {"x": line(lambda by: by.shift_px[0]), "y": line(lambda by: by.shift_px[1])},
        "turn, °": {"turn": line(lambda by: math.degrees(by.turn_rad))},
        "scale": {"scale": line(lambda by: by.scale)},
    }
    charts = [(words, over_frames(each, f"{words}, of every frame")) for words, each in lines.items()]
    drawn = "".join(f'<div><p class="faint">{words}</p>{chart}</div>' for words, chart in charts if chart)
    return (
        f'<div class="card whole" data-sequence><h2>Drift over the frames</h2><div class="charts">{drawn}</div></div>'
    )


def _about_card(about: Mapping[str, str]) -> str:
    words = "".join(f'<dt>{_text(name)}</dt><dd dir="auto">{_text(value)}</dd>' for name, value in about.items())
    return f'<div class="card"><h2>What was run</h2><dl class="words">{words}</dl></div>' if words else ""


def _finite(value: float | None) -> float | None:
    """JSON has no word for other numbers, and a page nothing to show for them."""
    return value if value is not None and math.isfinite(value) else None


def _text(words: str) -> str:
    return html.escape(plain(words))


def _json(value: Any) -> bytes:
    """JSON in ASCII, in which no sign means anything to HTML."""
    text = json.dumps(value, separators=(",", ":"), allow_nan=False)
    return text.replace("<", r"\u003c").replace(">", r"\u003e").replace("&", r"\u0026").encode("ascii")


def _href(path: str) -> str:
    """A relative link, whatever a name holds: "./" keeps a colon from making a scheme of it."""
    return "./" + quote(os.fsencode(PurePath(path).as_posix()))


def _template(name: str) -> str:
    return files("autoalign.views").joinpath(name).read_text(encoding="utf-8")


def _hash(source: str) -> str:
    """The source of a script or style, as a content security policy names it."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(source.encode()).digest()).decode()}'"
