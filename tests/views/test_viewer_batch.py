"""The summary recording of a batch is read back and held to the rows it was made of."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recordings import Recording

from autoalign.errors import ImageWriteError
from autoalign.files.row import Row, RowStatus, Thumbnails
from autoalign.views import viewer_batch
from autoalign.views.evidence import STATUS_COLOUR
from autoalign.views.viewer_batch import write_batch_recording
from autoalign.views.window import viewer_program
from rows import ALIGNED

STATUSES: tuple[RowStatus, ...] = ("aligned", "aligned", "rejected", "failed", "doubtful", "aligned")
ERRORS_PX = (0.25, 0.5, None, None, 2.5, 0.125)
INLIERS = (400, 300, 4, 0, 30, 500)
ABOUT = {"options": "seed 0", "source": "in/"}


def rows() -> list[tuple[Row, Thumbnails | None]]:
    """Six pairs of every kind, all with one fixed picture."""
    return [
        (
            Row(
                name=f"{k}.jpg",
                fixed="reference.jpg",
                moving=f"in/{k}.jpg",
                status=status,
                reason=f"reason {k}",
                expected_error_px=error,
                inliers=inliers,
                matches=500,
                rung="sift",
            ),
            None if status == "failed" else pictures(k, status != "rejected"),
        )
        for k, (status, error, inliers) in enumerate(zip(STATUSES, ERRORS_PX, INLIERS, strict=True))
    ]


def pictures(number: int, laid: bool) -> Thumbnails:
    return Thumbnails(fixed=b"fixed", before=b"before %d" % number, after=b"after %d" % number if laid else None)


def recorded(
    folder: Path, pairs: list[tuple[Row, Thumbnails | None]], title: str = "title", **words: object
) -> Recording:
    path = folder / "batch.rrd"
    write_batch_recording(path, title, pairs, ABOUT, overwrite=True, **words)  # type: ignore[arg-type]
    return Recording(path)


def over_time(recording: Recording, entity: str, component: str) -> dict[int, list[object]]:
    """What was logged for a component, by the number of the pair."""
    found: dict[int, list[object]] = {}
    for chunk in recording.reader.stream().filter(content=entity):
        batch = chunk.to_record_batch()
        if {component, "pair"} <= set(batch.schema.names):
            times, values = (batch.column(name).to_pylist() for name in ("pair", component))
            found |= {int(time): value for time, value in zip(times, values, strict=True)}
    return dict(sorted(found.items()))


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return recorded(tmp_path_factory.mktemp("batch"), rows())


def test_every_pair_has_its_place_on_the_time_bar(recording: Recording) -> None:
    states = over_time(recording, "/status", "StateChange:state")
    assert states == {number: [status] for number, status in enumerate(STATUSES, 1)}
    texts = over_time(recording, "/pair", "TextDocument:text")
    assert [f"Reason {k}." in str(text[0]) for k, text in enumerate(texts.values())] == [True] * 6
    assert "expected error | 0.25 px" in str(texts[1][0])
    assert "matches" not in str(texts[4][0])


def test_a_frame_of_a_sequence_has_no_matches_of_its_own(tmp_path: Path) -> None:
    recording = recorded(tmp_path, [(replace(ALIGNED, rung=None), None)])
    (text,) = over_time(recording, "/pair", "TextDocument:text").values()
    assert "expected error | " in str(text[0])
    assert "matches | " not in str(text[0])
    assert not over_time(recording, "/inliers/aligned", "Scalars:scalars")


def test_numbers_stand_with_their_status(recording: Recording) -> None:
    assert over_time(recording, "/expected_error/aligned", "Scalars:scalars") == {1: [0.25], 2: [0.5], 6: [0.125]}
    assert over_time(recording, "/expected_error/doubtful", "Scalars:scalars") == {5: [2.5]}
    assert over_time(recording, "/inliers/aligned", "Scalars:scalars") == {1: [400], 2: [300], 6: [500]}
    assert over_time(recording, "/inliers/doubtful", "Scalars:scalars") == {5: [30]}
    assert over_time(recording, "/inliers/rejected", "Scalars:scalars") == {3: [4]}


def test_pictures_are_told_when_they_change_and_taken_away_when_there_are_none(recording: Recording) -> None:
    def told(name: str) -> dict[int, bytes | None]:
        blobs = over_time(recording, f"/thumbnails/{name}", "EncodedImage:blob")
        return {number: bytes(blob[0]) if blob else None for number, blob in blobs.items()}  # type: ignore[call-overload]

    assert told("fixed") == {1: b"fixed", 4: None, 5: b"fixed"}
    assert told("before") == {1: b"before 0", 2: b"before 1", 3: b"before 2", 4: None, 5: b"before 4", 6: b"before 5"}
    assert told("after") == {1: b"after 0", 2: b"after 1", 3: None, 5: b"after 4", 6: b"after 5"}


def test_rows_are_taken_part_by_part(recording: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(viewer_batch, "_TOGETHER", 2)
    parts = recorded(tmp_path, rows())
    for entity, component in (
        ("/status", "StateChange:state"),
        ("/expected_error/aligned", "Scalars:scalars"),
        *((f"/thumbnails/{name}", "EncodedImage:blob") for name in ("fixed", "before", "after")),
    ):
        assert over_time(parts, entity, component) == over_time(recording, entity, component)


def test_the_summary_counts(recording: Recording) -> None:
    summary = str(recording.values("/summary", "TextDocument:text")[0][0])
    for words in ("✓ aligned | 3", "⚠ doubtful | 1", "✗ rejected | 1", "! failed | 1", "all | 6", "options | seed 0"):
        assert words in summary
    assert "**0.25 px** in the median, 0.5 px at worst" in summary


def test_properties_can_be_sorted_by(recording: Recording) -> None:
    expected = {"aligned": 3, "doubtful": 1, "rejected": 1, "failed": 1, "median_error_px": 0.25, "worst_error_px": 0.5}
    found = {name: recording.values("/__properties/autoalign", name)[0][0] for name in expected}
    assert found == expected


def test_states_have_the_colours_of_the_outlines(recording: Recording) -> None:
    names = recording.values("/status", "StateConfiguration:values")[0]
    packed = np.array(recording.values("/status", "StateConfiguration:colors")[0], np.uint32)
    colours = np.stack([packed >> 24 & 255, packed >> 16 & 255, packed >> 8 & 255], 1).tolist()
    assert {name: tuple(colour) for name, colour in zip(names, colours, strict=True)} == STATUS_COLOUR


def test_views(recording: Recording) -> None:
    assert recording.views == {
        "Fixed",
        "Moving, before",
        "Moving, after",
        "Status",
        "Expected error, px",
        "Matches that agree",
        "Seconds",
        "This pair",
        "The batch",
    }


def test_seconds_are_told_only_on_request(recording: Recording, tmp_path: Path) -> None:
    assert over_time(recording, "/seconds", "Scalars:scalars") == {}
    timed = recorded(tmp_path, rows(), seconds={"0.jpg": 1.5, "4.jpg": 0.5}.get)
    assert over_time(timed, "/seconds", "Scalars:scalars") == {1: [1.5], 5: [0.5]}
    assert timed.views == recording.views  # a viewer keeps one layout for all batches


def test_equal_batches_give_equal_recordings(recording: Recording, tmp_path: Path) -> None:
    def compared(other: Recording) -> int:
        command = [viewer_program(), "rrd", "compare", "--unordered", recording.path, other.path]
        return subprocess.run(command, capture_output=True, check=False).returncode

    again = recorded(tmp_path, rows())
    assert compared(again) == 0
    assert again.reader.recordings() == recording.reader.recordings()
    assert compared(recorded(tmp_path, rows()[:-1])) != 0


def test_batches_share_their_layout_and_no_more(recording: Recording, tmp_path: Path) -> None:
    (first,), (other,) = recording.reader.recordings(), recorded(tmp_path, rows(), "another").reader.recordings()
    assert first.application_id == other.application_id == recording.reader.blueprints()[0].application_id
    assert first.recording_id != other.recording_id


@pytest.mark.parametrize("name", ["写真 №1 (é_*`|).png", "شاهد.png", "\udcff raw bytes.png", "new\nline | a.png"])
def test_names_in_any_script(name: str, tmp_path: Path) -> None:
    row = replace(rows()[0][0], name=name, moving=name, reason=name, output=name)
    found = recorded(tmp_path, [(row, None)], title=name)
    assert (
        subprocess.run([viewer_program(), "rrd", "verify", found.path], capture_output=True, check=False).returncode
        == 0
    )
    (text,) = over_time(found, "/pair", "TextDocument:text")[1]
    assert str(text).count("\n| ") == 2 + 6  # no name makes a row of its own


@pytest.mark.parametrize("pairs", [[], rows()[3:4]])
def test_batches_of_hardly_anything(pairs: list[tuple[Row, Thumbnails | None]], tmp_path: Path) -> None:
    found = recorded(tmp_path, pairs)
    assert f"all | {len(pairs)}" in str(found.values("/summary", "TextDocument:text")[0][0])


def test_a_batch_that_breaks_off_leaves_no_recording(tmp_path: Path) -> None:
    def broken() -> Iterator[tuple[Row, Thumbnails | None]]:
        yield rows()[0]
        raise ValueError("the ledger is gone")

    with pytest.raises(ValueError, match="the ledger is gone"):
        write_batch_recording(tmp_path / "batch.rrd", "title", broken(), ABOUT)
    assert list(tmp_path.iterdir()) == []


def test_a_recording_is_not_written_over_unasked(tmp_path: Path) -> None:
    (tmp_path / "batch.rrd").write_bytes(b"mine")
    with pytest.raises(ImageWriteError, match=r"exists already.*batch\.rrd"):
        write_batch_recording(tmp_path / "batch.rrd", "title", rows(), ABOUT)
    assert (tmp_path / "batch.rrd").read_bytes() == b"mine"
