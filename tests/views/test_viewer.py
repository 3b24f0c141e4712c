"""Recordings are read back and held to what they should show."""

from __future__ import annotations

import subprocess
from pathlib import Path

import numpy as np
import pytest
import rerun as rr
from recordings import Case, Recording

import autoalign as aa
from autoalign.files.write import write_picture
from autoalign.geometry.homography import apply
from autoalign.views.evidence import LINES, REJECTED_LINES, STATUS_COLOUR
from autoalign.views.viewer import MAGNIFIED, recorded
from autoalign.views.window import MARK, viewer_program

ALWAYS = {
    "/report",
    "/__properties",
    "/__properties/autoalign",
    "/fixed/image",
    "/fixed/keypoints",
    "/fixed/matched",
    "/moving",
    "/moving/image",
    "/moving/keypoints",
    "/moving/matched",
    "/matches/inliers",
    "/matches/outliers",
    "/matches/drawn/inliers",
    "/matches/drawn/outliers",
    "/residuals/points",
    "/residuals/vectors",
}
OVERLAID = {
    "/aligned/moving",
    "/aligned/checkerboard",
    "/aligned/green_magenta",
    "/aligned/difference",
    "/outline/moving",
    "/residuals/histogram",
}
PATCHES = {"/patches/before", "/patches/after"}
CLIMB = {f"/rungs/{step}/{kind}" for step in (1, 2) for kind in ("inliers", "outliers")}


def rerun(*words: str | Path) -> int:
    return subprocess.run([viewer_program(), *words], capture_output=True, check=False).returncode


def test_the_cases_are_what_they_are_called(aligned: Case, doubtful: Case, rejected: Case, nothing_found: Case) -> None:
    statuses = [case.alignment.status for case in (aligned, doubtful, rejected, nothing_found)]
    assert statuses == ["aligned", "doubtful", "rejected", "rejected"]
    assert rejected.alignment.best.consensus is not None
    assert nothing_found.alignment.best.consensus is None


def test_entities(aligned: Case, doubtful: Case, rejected: Case, nothing_found: Case) -> None:
    assert aligned.recording.entities == ALWAYS | OVERLAID | PATCHES
    assert doubtful.recording.entities == ALWAYS | OVERLAID | PATCHES | CLIMB
    assert rejected.recording.entities == ALWAYS | OVERLAID | PATCHES
    assert nothing_found.recording.entities == ALWAYS


@pytest.mark.parametrize("name", ["aligned", "doubtful", "rejected", "nothing_found"])
def test_counts(name: str, request: pytest.FixtureRequest) -> None:
    case: Case = request.getfixturevalue(name)
    recording, found = case.recording, case.alignment.counts()
    assert len(recording.points("/fixed/keypoints")) == found["fixed_keypoints"]
    assert len(recording.points("/moving/keypoints")) == found["moving_keypoints"]
    assert len(recording.points("/fixed/matched")) == found["matches"]
    assert len(recording.lines("/matches/inliers")) == found["inliers"]
    assert len(recording.lines("/matches/outliers")) == found["matches"] - found["inliers"]
    assert len(recording.lines("/matches/drawn/inliers")) <= LINES
    assert len(recording.lines("/matches/drawn/outliers")) <= REJECTED_LINES
    if case.alignment.best.fixed_from_moving is not None:
        assert sum(recording.values("/residuals/histogram", "BarChart:values")[0][0]["buffer"]) == found["inliers"]
    if found["patches"]:
        assert len(recording.points("/patches/after")) == len(recording.points("/patches/before")) <= found["patches"]


def test_the_outline_says_the_status(aligned: Case, doubtful: Case, rejected: Case) -> None:
    for case in (aligned, doubtful, rejected):
        assert tuple(case.recording.colours("/outline/moving")[0]) == STATUS_COLOUR[case.alignment.status]


def test_the_better_a_match_the_greener_its_line(aligned: Case) -> None:
    recording = aligned.recording
    residual = np.array(recording.values("/matches/inliers", "residual_px")[0])
    red = recording.colours("/matches/inliers")[:, 0].astype(int)
    order = np.argsort(residual)
    assert (np.diff(red[order]) >= 0).all()
    assert red[order[0]] < 100 < 200 < red[order[-1]]


def test_patches_are_green_where_the_pictures_are_alike(rejected: Case) -> None:
    """The caption is shared, the pictures above it are not."""
    recording = rejected.recording
    at, colours = recording.points("/patches/after"), recording.colours("/patches/after", "Points2D").astype(int)
    green = colours[:, 1] > colours[:, 0]
    # Patches that lie in the caption whole, and those that do not reach into it.
    reach = rejected.alignment.options.refine.radius + 1
    below, above = at[:, 1] > 300 + reach, at[:, 1] < 300 - reach
    assert green[below].mean() > 0.9
    assert green[above].mean() < 0.1


def test_views(aligned: Case, doubtful: Case, rejected: Case, nothing_found: Case) -> None:
    def names(case: Case) -> set[str]:
        found, total = case.alignment.inliers, case.alignment.matches
        return {name.replace(f"{found:,}", "N").replace(f"{total:,}", "M") for name in case.recording.views}

    keypoints = {"Fixed: 3,000 keypoints", "Moving: 3,000 keypoints"}
    details = {
        "Checkerboard",
        "Difference",
        "Residuals ×20",
        "Patches (green: alike)",
        "Patches before",
        "Green/magenta",
    }
    common = details | {"Report", "Residuals of the matches that agree, px", "All M matches"}
    matches = "Fixed | moving: N of M matches agree (green), the others do not (dark red)"
    assert names(aligned) == common | keypoints | {matches, "Overlay: the time bar blends"}
    assert names(doubtful) >= common | {matches, "Overlay: the time bar blends"}
    rungs = [attempt.rung for attempt in doubtful.alignment.attempts]
    for step, rung in enumerate(rungs, 1):
        assert any(
            name.startswith(f"{step}. {rung}: ") and name.endswith("⚠ doubtful") for name in doubtful.recording.views
        )
    assert names(rejected) >= common | {matches, "Overlay as refused: the time bar blends"}
    assert nothing_found.recording.views == {
        "Fixed | moving: 0 matches, no consensus",
        "All 0 matches",
        f"Fixed: {nothing_found.alignment.counts()['fixed_keypoints']:,} keypoints",
        "Moving: 0 keypoints",
        "Report",
    }


def test_the_tab_on_top_shows_what_failed(aligned: Case, doubtful: Case, rejected: Case) -> None:
    assert aligned.recording.active_views == {"Checkerboard"}
    assert doubtful.recording.active_views == {"Checkerboard"}
    assert rejected.recording.active_views == {"Patches (green: alike)"}


def test_everything_a_view_shows_is_there(doubtful: Case, nothing_found: Case) -> None:
    for case in (doubtful, nothing_found):
        for query in case.recording.blueprint("ViewContents:query"):
            for line in query.splitlines():
                path = line.removeprefix("+ ").removesuffix("/**")
                if not path.startswith("$"):
                    assert any(entity.startswith(path) for entity in case.recording.entities), path


def test_points_lie_half_a_pixel_on(aligned: Case) -> None:
    """rerun's views cover (0, 0) to (w, h); the centre of autoalign's first pixel is (0, 0)."""
    best, recording = aligned.alignment.best, aligned.recording
    assert best.fixed_features is not None
    assert best.moving_features is not None
    assert best.consensus is not None
    assert best.fixed_from_moving is not None
    np.testing.assert_allclose(recording.points("/fixed/keypoints"), best.fixed_features.points + 0.5, atol=1e-3)
    np.testing.assert_allclose(recording.points("/moving/keypoints"), best.moving_features.points + 0.5, atol=1e-3)
    np.testing.assert_allclose(recording.points("/moving/matched"), best.pairs.src + 0.5, atol=1e-3)
    agreeing = best.pairs[best.consensus.inliers]
    lines = np.stack(recording.lines("/matches/inliers"))
    (dx, dy, _), (scale, _, _) = (
        recording.values("/moving", f"Transform3D:{part}")[0][0] for part in ("translation", "scale")
    )
    np.testing.assert_allclose(lines[:, 0], agreeing.dst + 0.5, atol=1e-3)
    np.testing.assert_allclose(lines[:, 1], (agreeing.src + 0.5) * scale + (dx, dy), atol=1e-2)
    vectors = np.stack(recording.lines("/residuals/vectors"))
    off = apply(best.fixed_from_moving, agreeing.src) - agreeing.dst
    np.testing.assert_allclose(vectors[:, 0], agreeing.dst + 0.5, atol=1e-3)
    np.testing.assert_allclose(vectors[:, 1] - vectors[:, 0], MAGNIFIED * off, atol=2e-3)


def test_an_outline_covers_the_picture_it_is_the_outline_of(tmp_path: Path) -> None:
    points = [[0, 0], [29, 0], [29, 19], [0, 19]]
    alignment = aa.align_points(points, points, (30, 20), (30, 20))
    picture = np.zeros((20, 30), np.uint8)
    recording = logged(tmp_path, picture, picture, alignment)
    (outline,) = recording.lines("/outline/moving")
    np.testing.assert_allclose([outline.min(0), outline.max(0)], [(0, 0), (30, 20)], atol=1e-4)


def logged(folder: Path, fixed: np.ndarray, moving: np.ndarray, alignment: aa.Alignment, **words: object) -> Recording:
    """As a person with a recording of their own would."""
    stream = rr.RecordingStream("somebody's own", recording_id="x")
    stream.save(folder / "own.rrd")
    aa.log_alignment(stream, fixed, moving, alignment, **words)
    stream.flush()
    stream.disconnect()
    return Recording(folder / "own.rrd")


def test_the_time_bar_blends(aligned: Case) -> None:
    opacity = [row[0] for row in aligned.recording.values("/aligned/moving", "EncodedImage:opacity") if row]
    fade, blink = opacity[:61], opacity[61:]
    assert fade[0] == pytest.approx(0.5)
    assert (min(fade), max(fade)) == pytest.approx((0, 1), abs=1e-3)
    assert sorted(set(blink)) == [0, 1]


def test_the_bytes_of_the_files_are_kept(aligned: Case) -> None:
    for name, loaded in (("fixed", aligned.fixed), ("moving", aligned.moving)):
        (blob,) = aligned.recording.values(f"/{name}/image", "EncodedImage:blob")[0]
        assert bytes(blob) == loaded.path.read_bytes()


@pytest.mark.parametrize("name", ["aligned", "doubtful", "rejected", "nothing_found"])
def test_recordings_are_sound(name: str, request: pytest.FixtureRequest) -> None:
    assert rerun("rrd", "verify", request.getfixturevalue(name).recording.path) == 0


def test_the_same_pair_gives_an_equal_recording(doubtful: Case, aligned: Case, tmp_path: Path) -> None:
    again = tmp_path / "again.rrd"
    alignment = aa.align(doubtful.fixed.pixels, doubtful.moving.pixels, doubtful.alignment.options)
    again.write_bytes(recorded(doubtful.fixed, doubtful.moving, alignment))
    assert rerun("rrd", "compare", "--unordered", doubtful.recording.path, again) == 0
    assert Recording(again).reader.recordings() == doubtful.recording.reader.recordings()
    assert rerun("rrd", "compare", "--unordered", doubtful.recording.path, aligned.recording.path) != 0


def test_each_pair_has_a_layout_of_its_own(aligned: Case, doubtful: Case) -> None:
    """A viewer keeps one layout per application."""
    ids = {case.recording.reader.recordings()[0].application_id for case in (aligned, doubtful)}
    assert len(ids) == 2
    for case in (aligned, doubtful):
        (blueprint,), (recording,) = case.recording.reader.blueprints(), case.recording.reader.recordings()
        assert blueprint.application_id == recording.application_id


def test_seconds_are_told_only_on_request(aligned: Case, tmp_path: Path) -> None:
    path = tmp_path / "timed.rrd"
    path.write_bytes(recorded(aligned.fixed, aligned.moving, aligned.alignment, timings=True))
    assert "| detect |" in Recording(path).report
    assert "detect" not in aligned.recording.report


def test_properties_can_be_sorted_by(aligned: Case, rejected: Case) -> None:
    def value(case: Case, name: str) -> object:
        return case.recording.values("/__properties/autoalign", name)[0][0]

    assert value(aligned, "status") == "aligned"
    assert value(aligned, "inliers") == aligned.alignment.inliers
    assert value(aligned, "expected_error_px") == pytest.approx(aligned.alignment.expected_error_px, abs=1e-3)
    assert value(rejected, "status") == "rejected"


@pytest.mark.parametrize("name", ["写真 №1 (é_*`|).png", "شاهد.png", "\udcff raw bytes.png", "new\nline.png"])
def test_names_in_any_script(name: str, tmp_path: Path, nothing_found: Case) -> None:
    pictures = []
    for role, picture in (("f", nothing_found.fixed), ("m", nothing_found.moving)):
        path = tmp_path / f"{role} {name}"
        write_picture(path, picture.pixels)
        pictures.append(aa.read_picture(path))
    path = tmp_path / "named.rrd"
    path.write_bytes(recorded(pictures[0], pictures[1], nothing_found.alignment))
    assert rerun("rrd", "verify", path) == 0
    assert "| f " in Recording(path).report.replace("fixed | f", "| f")


def test_sixteen_bits_are_stretched_and_the_report_says_so(nothing_found: Case, tmp_path: Path) -> None:
    deep = nothing_found.fixed.pixels.astype(np.uint16) * 16
    recording = logged(tmp_path, deep, nothing_found.moving.pixels, nothing_found.alignment)
    assert recording.values("/fixed/image", "EncodedImage:media_type")[0] == ["image/jpeg"]
    assert "fixed has uint16 pixels, whose range is stretched" in recording.report


def test_own_recordings_take_arrays(aligned: Case, tmp_path: Path) -> None:
    words = {"names": ("a", "b"), "blueprint": False}
    recording = logged(tmp_path, aligned.fixed.pixels, aligned.moving.pixels, aligned.alignment, **words)
    assert recording.entities == ALWAYS | OVERLAID | PATCHES
    assert recording.reader.blueprints() == []
    assert "| fixed | a |" in recording.report


def test_pictures_of_another_size_are_refused(aligned: Case, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="a picture of size"):
        logged(tmp_path, aligned.moving.pixels, aligned.moving.pixels, aligned.alignment)


def test_recordings_begin_with_the_mark_that_view_looks_for(aligned: Case) -> None:
    assert aligned.recording.path.read_bytes().startswith(MARK)
