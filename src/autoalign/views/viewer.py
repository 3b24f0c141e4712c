"""An Alignment in the rerun viewer. Only `viewer_batch` imports rerun, too.

Everything is logged in full pixels of its own picture. The half pixel: rerun's 2D views cover (0, 0) to (w, h), so that
the centre of the first pixel lies at (0.5, 0.5); autoalign has it at (0, 0). `_at` adds it, to every point.

Entities                                            The space of the root is the fixed picture's.
  /report                  Markdown                 /aligned                     layers' px -> fixed px
  /fixed/image             px -> full px            /aligned/{fixed,moving}      blended by `fade` and `blink`
  /fixed/{keypoints,matched}                        /aligned/{checkerboard,green_magenta,difference}
  /moving                  full px -> beside fixed  /outline/moving
  /moving/{image,keypoints,matched}                 /residuals/{points,vectors,histogram}
  /matches/{inliers,outliers}          all          /patches/{before,after}
  /matches/drawn/{inliers,outliers}    legible      /rungs/<n>/{inliers,outliers}
"""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from autoalign import __version__
from autoalign.files.read import LoadedPicture
from autoalign.geometry.homography import Array
from autoalign.picture.pixels import Picture
from autoalign.registration.alignment import Alignment, Attempt
from autoalign.registration.refine import Patches
from autoalign.views.evidence import (
    LINES,
    REJECTED_LINES,
    STATUS_COLOUR,
    Colours,
    MatchesSeen,
    legible,
    matches_seen,
    outline,
    patch_colours,
    residual_histogram,
)
from autoalign.views.pictures import Encoded, Layers, Shown, as_shown, layers, original_bytes
from autoalign.views.words import MARK_OF, checks, found_by, outcome, plain, report

APPLICATION = "autoalign"
MAGNIFIED = 20  # times that residuals are drawn
_SENT_WITHIN_S = 60.0
_STACKED = 1.9  # pictures wider than so many heights stand one above the other
_GAP = 0.03  # between them, of a side
_MARGIN = 0.04  # around the picture in a view, of a side
_DIMMED = 0.5  # opacity of a picture under marks
_NIGHT = (13, 16, 17)  # behind dimmed pictures: a light theme would wash them out
_CYAN, _DARK_RED, _MID_RED = (70, 190, 235), (120, 42, 38), (200, 60, 52)
_FADE_STEPS, _BLINK_STEPS, _PER_SECOND = 61, 15, 20.0
_FIXED_ORDER, _ABOVE_ORDER = -20.0, -10.0  # draw orders; rerun's own for images is -10 and for marks above


@dataclass(frozen=True, kw_only=True)
class _Place:
    """Where the moving picture stands beside the fixed one."""

    offset: tuple[float, float]  # of its top left corner, fixed px
    scale: float  # fixed px per moving px


@dataclass(frozen=True, kw_only=True)
class _Scene:
    """Everything that is drawn, computed once."""

    alignment: Alignment
    fixed: Shown
    moving: Shown
    layers: Layers | None  # None where there is no transform
    matches: MatchesSeen
    place: _Place


def log_alignment(
    recording: rr.RecordingStream,
    fixed: Picture,
    moving: Picture,
    alignment: Alignment,
    *,
    names: tuple[str, str] = ("fixed", "moving"),
    originals: tuple[bytes | None, bytes | None] = (None, None),
    timings: bool = False,
    blueprint: bool = True,
) -> None:
    """Draw what `align(fixed, moving)` found into a rerun recording: evidence, overlays and the verdict in words.

    Pictures are (h, w) or (h, w, 1..4), as `align` takes them. `names` are shown in the report. `originals` are the
    bytes of the files the pictures were read from, which a recording keeps where the viewer can decode them: that is
    faster and smaller than encoding the arrays. `timings` puts seconds into the report, which then differs from run to
    run. `blueprint` also sends the layout. Everything is static but the two timelines `fade` and `blink`.

    Raises ValueError if a picture has not the size of the one that was aligned.
    """
    scene = _scene(fixed, moving, alignment, originals)
    names = (plain(names[0]), plain(names[1]))
    if blueprint:  # first: a viewer that waits for it guesses a layout of its own
        recording.send_blueprint(_blueprint(scene))
    _log(recording, "report", _report(scene, names, timings))
    recording.send_recording_name(f"{MARK_OF[alignment.status]} {names[0]} ← {names[1]}")
    recording.send_property(APPLICATION, rr.AnyValues(**_properties(alignment)))
    _log_matches(recording, scene)
    _log_keypoints(recording, scene)
    _log_rungs(recording, scene)
    _log_residuals(recording, scene)
    if alignment.best.refinement and alignment.best.refinement.patches:
        _log_patches(recording, alignment.best.refinement.patches)
    _log_pictures(recording, scene)
    if scene.layers is not None:
        _log_layers(recording, scene, scene.layers)


def recorded(
    fixed: LoadedPicture,
    moving: LoadedPicture,
    alignment: Alignment,
    *,
    stream_to: str | None = None,
    timings: bool = False,
) -> bytes:
    """The recording of two files' alignment, as the bytes of an .rrd; also streamed to a viewer's URL if one is given.

    The same pair gives an equal recording, under the same id: sent twice, it is shown once. Raises OSError if it cannot
    be streamed.
    """
    recording_id = _recording_id(fixed, moving, alignment)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "recording.rrd"
        # A viewer keeps one layout per application: two pairs in one window would share that of the last one.
        recording = quiet_recording(f"{APPLICATION} {recording_id[:8]}", recording_id)
        recording.set_sinks(rr.FileSink(path), *([rr.GrpcSink(stream_to)] if stream_to else []))
        log_alignment(
            recording,
            fixed.pixels,
            moving.pixels,
            alignment,
            names=(fixed.path.name, moving.path.name),
            originals=(original_bytes(fixed), original_bytes(moving)),
            timings=timings,
        )
        try:
            recording.flush(timeout_sec=_SENT_WITHIN_S)
        except Exception as error:  # what it raises is nowhere promised
            raise OSError(f"the viewer did not take the recording ({error})") from error
        recording.disconnect()  # which writes the footer
        return path.read_bytes()


def quiet_recording(application: str, recording_id: str) -> rr.RecordingStream:
    """A recording of nothing but what is logged: when that was says nothing about a pair, would differ from run to run,
    and would fill the viewer's menu of timelines."""
    recording = rr.RecordingStream(application, recording_id=recording_id, send_properties=False)
    recording.set_log_time_enabled(False)
    recording.set_log_tick_enabled(False)
    return recording


def _recording_id(fixed: LoadedPicture, moving: LoadedPicture, alignment: Alignment) -> str:
    """Of the two files, the options and the matches: the points a person typed are not among the options."""
    pairs = alignment.best.pairs
    what = repr((__version__, fixed.sha256, moving.sha256, alignment.options)).encode()
    return hashlib.sha256(what + pairs.src.tobytes() + pairs.dst.tobytes()).hexdigest()[:32]


def _scene(
    fixed: Picture, moving: Picture, alignment: Alignment, originals: tuple[bytes | None, bytes | None]
) -> _Scene:
    for picture, size, name in ((fixed, alignment.fixed_size, "fixed"), (moving, alignment.moving_size, "moving")):
        if (picture.shape[1], picture.shape[0]) != size:
            raise ValueError(f"{name} has shape {picture.shape}, but a picture of size {size} was aligned")
    transform = alignment.best.fixed_from_moving
    return _Scene(
        alignment=alignment,
        fixed=as_shown(fixed, "fixed", originals[0]),
        moving=as_shown(moving, "moving", originals[1]),
        layers=None if transform is None else layers(fixed, moving, transform),
        matches=matches_seen(alignment, alignment.best),
        place=_place(alignment.fixed_size, alignment.moving_size),
    )


def _place(fixed_size: tuple[int, int], moving_size: tuple[int, int]) -> _Place:
    (w, h), (moving_w, moving_h) = fixed_size, moving_size
    if w > _STACKED * h:
        return _Place(offset=(0.0, h * (1 + 2 * _GAP)), scale=w / moving_w)
    return _Place(offset=(w * (1 + _GAP), 0.0), scale=h / moving_h)


def _at(points: Array) -> NDArray[np.float32]:
    """Points (..., 2) where rerun has them: 0.5 is the centre of its first pixel."""
    return (points + 0.5).astype(np.float32)


def _beside(points: Array, place: _Place) -> NDArray[np.float32]:
    """Points (n, 2) of the moving picture where it stands beside the fixed one, in rerun's coordinates."""
    return (_at(points) * place.scale + place.offset).astype(np.float32)


def _log(recording: rr.RecordingStream, path: str, *values: Any) -> None:
    recording.log(path, *values, static=True)


def _report(scene: _Scene, names: tuple[str, str], timings: bool) -> rr.TextDocument:
    notes = [*scene.fixed.notes, *scene.moving.notes]
    if scene.layers and scene.layers.size != scene.alignment.fixed_size:
        w, h = scene.layers.size
        notes.append(f"overlays are drawn at {w} × {h}")
    return rr.TextDocument(report(scene.alignment, names, notes, timings=timings), media_type="text/markdown")


def _properties(alignment: Alignment) -> dict[str, Any]:
    """What the viewer's table of recordings can be sorted by."""
    found: dict[str, Any] = {
        "status": alignment.status,
        "inliers": alignment.inliers,
        "matches": alignment.matches,
        "overlap": round(alignment.overlap, 3),
        "rung": alignment.best.rung,
    }
    if alignment.expected_error_px is not None:
        found["expected_error_px"] = round(alignment.expected_error_px, 3)
    return found


def _log_matches(recording: rr.RecordingStream, scene: _Scene) -> None:
    seen, size = scene.matches, scene.alignment.fixed_size
    outlier = ~seen.inliers
    few = REJECTED_LINES if seen.inliers.any() else LINES
    all_of_them = (np.flatnonzero(seen.inliers), np.flatnonzero(outlier))
    drawn = (legible(seen.fixed, seen.inliers, size, LINES), legible(seen.fixed, outlier, size, few))
    for path, (agreeing, rejected) in (("matches", all_of_them), ("matches/drawn", drawn)):
        lines = _lines(seen, agreeing, scene.place, seen.colours[agreeing], 1.1)
        _log(recording, f"{path}/inliers", lines, *_told("residual_px", seen.residuals_px[agreeing]))
        _log(recording, f"{path}/outliers", _lines(seen, rejected, scene.place, _DARK_RED, 0.6))


def _told(name: str, values: Array) -> list[rr.AnyValues]:
    """Numbers (n,) that the viewer tells of the mark under the mouse; rerun refuses none at all."""
    told: dict[str, Any] = {name: values.astype(np.float32)}
    return [rr.AnyValues(**told)] if len(values) else []


def _lines(
    seen: MatchesSeen, index: NDArray[np.int64], place: _Place, colours: Colours | tuple[int, int, int], width: float
) -> rr.LineStrips2D:
    """The chosen matches as lines from the fixed picture to the moving one beside it."""
    ends = np.stack([_at(seen.fixed[index]), _beside(seen.moving[index], place)], axis=1)
    return rr.LineStrips2D(ends, colors=colours, radii=rr.Radius.ui_points(width))


def _log_keypoints(recording: rr.RecordingStream, scene: _Scene) -> None:
    best, seen = scene.alignment.best, scene.matches
    colours = np.where(seen.inliers[:, None], seen.colours, np.array(_MID_RED, np.uint8))
    for name, features, points in (
        ("fixed", best.fixed_features, seen.fixed),
        ("moving", best.moving_features, seen.moving),
    ):
        found = features.points if features is not None else np.zeros((0, 2))
        _log(recording, f"{name}/keypoints", rr.Points2D(_at(found), colors=_CYAN, radii=rr.Radius.ui_points(1.2)))
        _log(recording, f"{name}/matched", rr.Points2D(_at(points), colors=colours, radii=rr.Radius.ui_points(3.0)))


def _log_rungs(recording: rr.RecordingStream, scene: _Scene) -> None:
    for step, attempt in _climbed(scene.alignment):
        seen = matches_seen(scene.alignment, attempt)
        for name, chosen, colours in (("inliers", seen.inliers, seen.colours), ("outliers", ~seen.inliers, None)):
            index = legible(seen.fixed, chosen, scene.alignment.fixed_size, LINES // 2)
            colour = _DARK_RED if colours is None else colours[index]
            _log(recording, f"rungs/{step}/{name}", _lines(seen, index, scene.place, colour, 0.8))


def _climbed(alignment: Alignment) -> Iterator[tuple[int, Attempt]]:
    """The rungs by their number, if there was more than one."""
    return iter(list(enumerate(alignment.attempts, 1)) if len(alignment.attempts) > 1 else [])


def _log_residuals(recording: rr.RecordingStream, scene: _Scene) -> None:
    seen = scene.matches
    drawn = seen.inliers & np.isfinite(seen.residuals_px)
    start, end, colours = seen.fixed[drawn], seen.landed[drawn], seen.colours[drawn]
    vectors = np.stack([_at(start), _at(start + MAGNIFIED * (end - start))], axis=1)
    _log(recording, "residuals/points", rr.Points2D(_at(start), colors=colours, radii=rr.Radius.ui_points(1.6)))
    _log(recording, "residuals/vectors", rr.LineStrips2D(vectors, colors=colours, radii=rr.Radius.ui_points(1.0)))
    histogram = residual_histogram(seen)
    if histogram is not None:
        middles, widths = histogram.middles, np.full(len(histogram.counts), histogram.width, np.float32)
        bars = rr.BarChart(histogram.counts, abscissa=middles, widths=widths, color=STATUS_COLOUR["aligned"])
        _log(recording, "residuals/histogram", bars)


def _log_patches(recording: rr.RecordingStream, patches: Patches) -> None:
    compared = np.maximum(patches.before, patches.after) > -1
    for name, correlation in (("before", patches.before[compared]), ("after", patches.after[compared])):
        points = rr.Points2D(
            _at(patches.pairs.dst[compared]), colors=patch_colours(correlation), radii=rr.Radius.ui_points(2.6)
        )
        _log(recording, f"patches/{name}", points, *_told("correlation", correlation))


def _log_pictures(recording: rr.RecordingStream, scene: _Scene) -> None:
    place = scene.place
    beside = rr.Transform3D(translation=[*place.offset, 0.0], scale=[place.scale, place.scale, 1.0])
    _log(recording, "moving", beside)
    for name, shown, full_size in (
        ("fixed", scene.fixed, scene.alignment.fixed_size),
        ("moving", scene.moving, scene.alignment.moving_size),
    ):
        _log(recording, f"{name}/image", _image(shown.picture, _FIXED_ORDER), *_enlarged(shown.picture.size, full_size))


def _image(picture: Encoded, draw_order: float) -> rr.EncodedImage:
    return rr.EncodedImage(contents=picture.data, media_type=picture.media_type, draw_order=draw_order)


def _enlarged(size: tuple[int, int], full_size: tuple[int, int]) -> list[rr.Transform3D]:
    """What brings a shrunken picture back to its full pixels: edges on edges, as both rerun and shrinking have it."""
    if size == full_size:
        return []
    return [rr.Transform3D(scale=[full_size[0] / size[0], full_size[1] / size[1], 1.0])]


def _log_layers(recording: rr.RecordingStream, scene: _Scene, drawn: Layers) -> None:
    alignment = scene.alignment
    transform = alignment.best.fixed_from_moving
    assert transform is not None
    edges = [_at(line) for line in outline(alignment.moving_size, transform, alignment.fixed_size)]
    colour = STATUS_COLOUR[alignment.status]
    _log(recording, "outline/moving", rr.LineStrips2D(edges, colors=colour, radii=rr.Radius.ui_points(1.5)))
    for transform_of_layers in _enlarged(drawn.size, alignment.fixed_size):
        _log(recording, "aligned", transform_of_layers)
    if drawn.fixed is not None:
        _log(recording, "aligned/fixed", _image(drawn.fixed, _FIXED_ORDER))
    _log(recording, "aligned/moving", _image(drawn.moving, _ABOVE_ORDER))
    for name in ("checkerboard", "green_magenta", "difference"):
        _log(recording, f"aligned/{name}", _image(getattr(drawn, name), _FIXED_ORDER))
    # A wave that begins in the middle: a viewer opens at the start of a timeline, and should show both pictures there.
    fade = 0.5 + 0.5 * np.sin(np.linspace(0, 2 * np.pi, _FADE_STEPS))
    blink = np.repeat([0.0, 1.0], _BLINK_STEPS)
    for timeline, opacity in (("fade", fade), ("blink", blink)):
        steps = rr.TimeColumn(timeline, sequence=range(len(opacity)))
        recording.send_columns("aligned/moving", [steps], rr.EncodedImage.columns(opacity=opacity))


def _blueprint(scene: _Scene) -> rrb.Blueprint:
    """Matches above, the pictures in one frame below, the report at the right: the same for every verdict."""
    keypoints, overlays = _keypoint_views(scene), _overlay_views(scene) if scene.layers else []
    # Where nothing can be laid over, the keypoints take that place: what was found is what there is to see.
    top = rrb.Tabs(
        _matches_view(scene), *([keypoints] if overlays else []), _all_matches_view(scene), *_rung_views(scene)
    )
    bottom = rrb.Horizontal(*overlays) if overlays else keypoints
    side: list[Any] = [rrb.TextDocumentView(origin="report", name="Report")]
    if residual_histogram(scene.matches) is not None:
        of_inliers = "Residuals of the matches that agree, px"
        side.append(
            rrb.BarChartView(origin="residuals/histogram", name=of_inliers, plot_legend=rrb.PlotLegend(visible=False))
        )
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(top, bottom, row_shares=[1.0, 1.15]),
            rrb.Vertical(*side, row_shares=[3.6, 1.0][: len(side)]),
            column_shares=[2.9, 1.0],
        ),
        rrb.TimePanel(
            timeline="fade",
            fps=_PER_SECOND,
            play_state="paused",
            loop_mode="all",
            state="collapsed" if scene.layers else "hidden",
        ),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        auto_views=False,
    )


def _view(
    name: str, contents: Iterable[str], bounds: rrb.VisualBounds2D, dimmed: Iterable[str] = (), origin: str = "/"
) -> rrb.Spatial2DView:
    """Pictures and marks, the `dimmed` pictures so that the marks stand out."""
    faint = rr.EncodedImage.from_fields(opacity=_DIMMED)
    return rrb.Spatial2DView(
        origin=origin,
        contents=[f"+ {path}" for path in contents],
        name=name,
        visual_bounds=bounds,
        background=_NIGHT,
        overrides=dict.fromkeys(dimmed, faint),
    )


def _bounds(low: tuple[float, float], high: tuple[float, float]) -> rrb.VisualBounds2D:
    (x0, y0), (x1, y1) = low, high
    x, y = _MARGIN * (x1 - x0), _MARGIN * (y1 - y0)
    return rrb.VisualBounds2D(x_range=(x0 - x, x1 + x), y_range=(y0 - y, y1 + y))


def _whole(size: tuple[int, int]) -> rrb.VisualBounds2D:
    return _bounds((0.0, 0.0), size)


def _both(scene: _Scene) -> rrb.VisualBounds2D:
    """Both pictures, one beside the other."""
    (w, h), (moving_w, moving_h), place = scene.alignment.fixed_size, scene.alignment.moving_size, scene.place
    right, bottom = place.offset[0] + moving_w * place.scale, place.offset[1] + moving_h * place.scale
    return _bounds((0.0, 0.0), (max(w, right), max(h, bottom)))


_PICTURES = ("/fixed/image", "/moving/image")


def _matches_view(scene: _Scene) -> rrb.Spatial2DView:
    contents = [*_PICTURES, "/matches/drawn/**"]
    found, best = found_by(scene.alignment.best), scene.alignment.best
    legend = " (green), the others do not (dark red)" if best.consensus else ""
    return _view(f"Fixed | moving: {found}{legend}", contents, _both(scene), _PICTURES)


def _all_matches_view(scene: _Scene) -> rrb.Spatial2DView:
    contents = [*_PICTURES, "/matches/inliers", "/matches/outliers"]
    return _view(f"All {len(scene.matches):,} matches", contents, _both(scene), _PICTURES)


def _keypoint_views(scene: _Scene) -> rrb.Horizontal:
    """Each picture alone with its keypoints."""
    counts, alignment = scene.alignment.counts(), scene.alignment
    views = [
        _view(
            f"{name.capitalize()}: {counts[f'{name}_keypoints']:,} keypoints",
            [f"/{name}/image", f"/{name}/keypoints", f"/{name}/matched"],
            _whole(size),
            [f"/{name}/image"],
            origin=f"/{name}",
        )
        for name, size in (("fixed", alignment.fixed_size), ("moving", alignment.moving_size))
    ]
    return rrb.Horizontal(*views, name="Keypoints")


def _rung_views(scene: _Scene) -> list[rrb.Grid]:
    """One small picture of the matches for every rung that was climbed, in one tab."""
    views = [
        _view(
            f"{step}. {attempt.rung}: {found_by(attempt)}, {outcome(attempt)}",
            [*_PICTURES, f"/rungs/{step}/**"],
            _both(scene),
            _PICTURES,
        )
        for step, attempt in _climbed(scene.alignment)
    ]
    columns = 2 if len(views) <= 4 else 3
    return [rrb.Grid(*views, grid_columns=columns, name=f"What was tried ({len(views)})")] if views else []


def _overlay_views(scene: _Scene) -> list[rrb.Tabs]:
    alignment, frame = scene.alignment, _whole(scene.alignment.fixed_size)
    outline = "/outline/moving"
    refused = " as refused" if alignment.status == "rejected" else ""
    below = "/aligned/fixed" if scene.layers and scene.layers.fixed else "/fixed/image"
    overlays: list[Any] = [
        _view(f"Overlay{refused}: the time bar blends", [below, "/aligned/moving", outline], frame),
        _view("Green/magenta", ["/aligned/green_magenta", outline], frame),
    ]
    details = [
        _view("Checkerboard", ["/aligned/checkerboard", outline], frame),
        _view("Difference", ["/aligned/difference", outline], frame),
        _view(f"Residuals ×{MAGNIFIED}", ["/fixed/image", "/residuals/**"], frame, ["/fixed/image"]),
        *_patch_views(scene),
    ]
    return [rrb.Tabs(*overlays), rrb.Tabs(*details, active_tab=_telling(scene))]


_PATCHES_TAB = 3


def _telling(scene: _Scene) -> int:
    """The tab that shows why a pair is not aligned: where the pixels do not agree, the patches show it."""
    failed = {check.name for check in checks(scene.alignment) if check.status != "aligned"}
    return _PATCHES_TAB if "pixels agree" in failed and _patch_views(scene) else 0


def _patch_views(scene: _Scene) -> list[rrb.Spatial2DView]:
    refinement = scene.alignment.best.refinement
    if refinement is None or refinement.patches is None:
        return []
    frame = _whole(scene.alignment.fixed_size)
    titles = (("after", "Patches (green: alike)"), ("before", "Patches before"))
    return [_view(title, ["/fixed/image", f"/patches/{name}"], frame, ["/fixed/image"]) for name, title in titles]
