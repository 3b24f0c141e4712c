"""One job of a batch in a worker: its files, its row, and what it remembers."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

import autoalign as aa
from autoalign.batch.jobs import Job, JobOptions, key
from autoalign.batch.memory import PictureMemory
from autoalign.batch.work import Task, do_task
from autoalign.errors import ImageReadError
from autoalign.files import large
from autoalign.files.feature_store import recall_from
from autoalign.files.ready import Ready, Source
from autoalign.registration.alignment import AlignOptions
from autoalign.registration.features import FeatureOptions, detect
from autoalign.registration.prepared import prepare


@pytest.fixture
def job(folder, tmp_path) -> Job:
    return Job(
        name="sub/frame2.png",
        fixed=str(folder / "frame1.png"),
        moving=str(folder / "frame2.png"),
        out_dir=str(tmp_path / "out"),
    )


def test_an_aligned_pair_leaves_picture_sidecar_and_row(job, tmp_path):
    done = do_task(Task(job=job, key="k"))
    row = done.row
    assert row.status == "aligned"
    assert (row.output, row.sidecar, row.recording) == ("sub/frame2.png", "sub/frame2.png.autoalign.json", None)
    assert np.allclose(row.fixed_from_moving, [[1, 0, 5], [0, 1, 3], [0, 0, 1]], atol=0.02)
    assert (row.fixed_size, row.moving_size) == ((240, 180), (240, 180))
    assert aa.read_picture(tmp_path / "out/sub/frame2.png").pixels.shape == (180, 240)
    kept = json.loads((tmp_path / "out/sub/frame2.png.autoalign.json").read_text())
    assert kept["status"] == "aligned"
    assert kept["reason"] == row.reason
    assert done.thumbnails is not None
    assert done.thumbnails.after is not None


def test_a_rejected_pair_leaves_no_picture_and_takes_that_of_an_earlier_run_away(job, folder):
    do_task(Task(job=job, key="k"))
    assert job.output.exists()
    (folder / "frame2.png").write_bytes((folder / "stranger.png").read_bytes())
    done = do_task(Task(job=job, key="k2"))
    assert done.row.status == "rejected"
    assert done.row.output is None
    assert not job.output.exists()
    assert json.loads(job.sidecar.read_text())["status"] == "rejected"


@pytest.mark.parametrize(("moving", "reason"), [("damaged.png", "damaged"), ("nowhere.png", "does not exist")])
def test_a_bad_file_is_a_row(job, folder, moving, reason):
    row = do_task(Task(job=replace(job, moving=str(folder / moving)), key="k")).row
    assert row.status == "failed"
    assert reason in row.reason
    assert row.reason.endswith(moving)
    assert not job.sidecar.exists()


def test_recordings_of_those_that_were_asked_for(job):
    for recorded, expected in (("none", False), ("failed", False), ("all", True), ("none", False)):
        row = do_task(Task(job=replace(job, options=JobOptions(recorded=recorded)), key="k")).row
        assert (row.recording is not None) == job.recording.exists() == expected


def test_equal_keys_are_equal_jobs(job):
    def named(of: Job) -> str:
        return key(of, lambda path: f"hash of {path}")

    assert named(job) == named(replace(job, out_dir="elsewhere"))
    others = [
        replace(job, name="other.png"),
        replace(job, moving="other"),
        replace(job, fixed_mask="mask"),
        replace(job, moving_mask="mask"),
        replace(job, options=JobOptions(align=AlignOptions(model="affine"))),
    ]
    assert len({named(job), *map(named, others)}) == 6
    assert named(job) != key(job, lambda path: "another content")


def test_cameras_that_write_two_files_under_one_stem(job):
    raw, jpeg = (replace(job, name=name) for name in ("IMG_1.xyz", "IMG_1.JPG"))
    assert raw.output.name == "IMG_1.xyz.png"
    assert jpeg.output.name == "IMG_1.JPG"
    assert raw.sidecar != jpeg.sidecar


def opened(memory: PictureMemory, path: str) -> Ready:
    with memory.opened(Source(path=path)) as ready:
        return ready


def test_a_picture_is_read_once_until_it_changes_or_there_is_no_room(folder, monkeypatch):
    read = []
    monkeypatch.setattr(large, "read_picture", lambda path, *args, **named: read.append(path) or aa.read_picture(path))
    one, two = str(folder / "frame1.png"), str(folder / "frame2.png")
    roomy = PictureMemory()
    assert opened(roomy, one) is opened(roomy, one)
    opened(roomy, two)
    opened(roomy, one)
    assert read == [one, two]
    (folder / "frame1.png").write_bytes((folder / "frame10.png").read_bytes())
    opened(roomy, one)
    assert read == [one, two, one]
    tight = PictureMemory(max_bytes=1)
    for path in (one, two, one):
        opened(tight, path)
    assert read == [one, two, one, one, two, one]
    with pytest.raises(ImageReadError, match="does not exist"):
        opened(roomy, str(folder / "nowhere.png"))


def test_of_a_pair_the_fixed_picture_is_kept_longer(folder):
    one, two = str(folder / "frame1.png"), str(folder / "frame2.png")
    tight = PictureMemory(max_bytes=1)
    with tight.opened(Source(path=one)) as fixed, tight.opened(Source(path=two)) as moving:
        assert fixed is not moving
    assert opened(tight, one) is fixed
    assert opened(tight, two) is not moving


def test_features_are_kept_on_disk_and_found_again(folder, tmp_path):
    picture = aa.read_picture(folder / "frame1.png")
    options, found = FeatureOptions(detector="orb"), []

    def once():
        found.append(detect(picture.pixels, options))
        return found[-1]

    first = recall_from(tmp_path, picture.sha256)(options, once)
    again = recall_from(tmp_path, picture.sha256)(options, once)
    assert len(found) == 1
    assert again.detector == first.detector == "orb"
    for name in ("points", "sizes", "angles", "sigmas", "descriptors"):
        assert np.array_equal(getattr(again, name), getattr(first, name))
        assert getattr(again, name).dtype == getattr(first, name).dtype
    recall_from(tmp_path, "another picture")(options, once)
    recall_from(tmp_path, picture.sha256)(FeatureOptions(detector="orb", max_features=9), once)
    assert len(found) == 3
    for path in tmp_path.glob("*.npz"):
        path.write_bytes(path.read_bytes()[:100])  # damaged: found again
    recall_from(tmp_path, picture.sha256)(options, once)
    assert len(found) == 4
    assert not list(tmp_path.glob("*.lock"))
    nowhere = recall_from(tmp_path / "nowhere", picture.sha256)
    assert np.array_equal(nowhere(options, once).points, first.points)


def test_remembered_features_give_the_same_bits(job, tmp_path):
    plain = do_task(Task(job=job, key="k"))
    before = job.sidecar.read_bytes(), job.output.read_bytes()
    for _ in range(2):
        stored = do_task(Task(job=job, key="k", store=str(tmp_path), again=frozenset(job.inputs)))
        assert stored == plain
        assert (job.sidecar.read_bytes(), job.output.read_bytes()) == before
    picture = prepare(aa.read_picture(job.fixed).pixels)
    assert len(picture.features(FeatureOptions(detector="orb"))) > 50
