"""Batches whose pictures come by URL and whose results go to one: the same results as on a disk, and no secret told."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

import autoalign as aa
from autoalign.batch.engine import InlineEngine
from autoalign.batch.jobs import Job, JobOptions
from autoalign.batch.ledger import Ledger, LedgerReader
from autoalign.batch.manifest import manifest_jobs
from autoalign.batch.memory import PictureMemory
from autoalign.batch.run import PlanOptions, align_batch, by_key, carry_out, feature_store, planned
from autoalign.batch.telling import write_reports
from autoalign.errors import ImageReadError
from autoalign.files.ready import Source
from autoalign.files.row import Row

SECRET = "wJalrXUtnFEMI"  # as in conftest.py
NAMES = ("frame2.png", "frame10.png", "stranger.png", "damaged.png")


def jobs_of(rows: list[str], out: Path, upload: str | None = None) -> list[Job]:
    text = "\n".join(["fixed,moving,name,fixed_mask", *rows])
    jobs = manifest_jobs(text, "list.csv", Path("/"), out, JobOptions())
    return [replace(job, upload=upload) for job in jobs]


def run(jobs: list[Job], out: Path, retry: bool = False) -> list[Row]:
    """Rows of what was done in this run; reports are written."""
    out.mkdir(exist_ok=True)
    with Ledger(out) as ledger, feature_store(out, None) as store:
        plan = planned(jobs, out, ledger, store, PlanOptions(retry=retry))
        rows = list(carry_out(plan, ledger, InlineEngine()))
        write_reports(out, ledger, {}, recorded=True)
    return rows


def results(out: Path) -> dict[str, bytes]:
    """Pictures and sidecars by name."""
    return {path.name: path.read_bytes() for path in (*out.glob("*.png"), *out.glob("*.json"))}


@pytest.fixture
def rows(server, folder) -> list[str]:
    """A manifest of the pictures in in/: the fixed one and its mask in a bucket, the moving ones by signed URLs."""
    aa.write_picture(folder / "mask.png", aa.read_picture(folder / "frame1.png").pixels[::-1].copy() // 200)
    for name in (*NAMES, "frame1.png", "mask.png"):
        place = "/bucket/below" if name in ("frame1.png", "mask.png") else "/day%201"
        server.files[f"{place}/{name}"] = (folder / name).read_bytes()
    signed = [f"{server.url}/day%201/{name}?sig={SECRET}" for name in NAMES]
    return [f"s3://bucket/below/frame1.png,{url},,s3://bucket/below/mask.png" for url in signed]


def test_results_are_those_of_the_same_pictures_on_a_disk(server, rows, folder, tmp_path):
    here = [f"{folder}/frame1.png,{folder}/{name},,{folder}/mask.png" for name in NAMES]
    near = {row.name: row for row in run(jobs_of(here, tmp_path / "near"), tmp_path / "near")}
    far = {row.name: row for row in run(jobs_of(rows, tmp_path / "far"), tmp_path / "far")}
    assert [far[name].status for name in NAMES] == ["aligned", "aligned", "rejected", "failed"]
    assert results(tmp_path / "far") == results(tmp_path / "near")
    assert len(results(tmp_path / "far")) == 5
    for name, row in far.items():
        assert (row.status, row.fixed_from_moving) == (near[name].status, near[name].fixed_from_moving)
        assert (row.fixed, row.moving) == ("s3://bucket/below/frame1.png", f"{server.url}/day%201/{name}")
    assert far["damaged.png"].reason.endswith(f": {server.url}/day%201/damaged.png")
    assert sum(asked == ("GET", "/bucket/below/frame1.png") for asked in server.asked) == 1


def test_no_secret_is_written(rows, tmp_path):
    out = tmp_path / "out"
    run(jobs_of(rows, out), out)
    written = [path for path in out.rglob("*") if path.is_file()]
    assert {"autoalign.sqlite", "report.html", "batch.rrd", "frame2.png.autoalign.json"} <= {p.name for p in written}
    assert not [path for path in written if SECRET.encode() in path.read_bytes()]


def test_only_what_has_changed_is_done_again(server, rows, folder, tmp_path):
    out = tmp_path / "out"
    assert len(run(jobs_of(rows[:2], out), out)) == 2
    renewed = [row.replace(SECRET, "a-new-signature") for row in rows[:2]]
    assert run(jobs_of(renewed, out), out) == []
    server.files["/day%201/frame2.png"] = (folder / "frame10.png").read_bytes()
    before = len(server.asked)
    (again,) = run(jobs_of(renewed, out), out)
    assert (again.name, again.fixed_from_moving[0][2]) == ("frame2.png", pytest.approx(15, abs=0.05))
    assert ("GET", "/day%201/frame10.png?sig=a-new-signature") not in server.asked[before:]


def test_a_worker_fetches_again_what_it_cannot_tell_to_be_the_same(server, folder):
    server.files["/a.png"] = (folder / "frame1.png").read_bytes()
    memory, source = PictureMemory(), Source(path=f"{server.url}/a.png")

    def opened():
        with memory.opened(source) as ready:
            return ready

    assert opened() is opened()
    server.files["/a.png"] = (folder / "frame2.png").read_bytes()
    assert opened().picture.sha256 == aa.read_picture(folder / "frame2.png").sha256
    server.manners["/a.png"] = "untagged"
    assert opened() is not opened()
    del server.files["/a.png"]
    with pytest.raises(ImageReadError, match="does not exist"):
        opened()


def test_results_are_put_into_a_bucket_and_what_could_not_be_is_tried_again(server, rows, tmp_path):
    out, bucket = tmp_path / "out", "/results/may"
    server.answers[f"{bucket}/frame10.png"] = 403
    jobs = jobs_of(rows[:3], out, "s3://results/may")
    first = {row.name: row for row in run(jobs, out)}
    assert [first[name].status for name in NAMES[:3]] == ["aligned", "failed", "rejected"]
    assert first["frame10.png"].reason == "cannot be uploaded (permission denied): s3://results/may/frame10.png"
    assert f"{bucket}/frame10.png.autoalign.json" not in server.files
    server.answers.clear()
    assert run(jobs, out) == []
    (second,) = run(jobs, out, retry=True)
    assert (second.name, second.status) == ("frame10.png", "aligned")
    assert {f"{bucket}/{name}": data for name, data in results(out).items()} == {
        path: data for path, data in server.files.items() if path.startswith(bucket)
    }
    assert len(run(jobs_of(rows[:1], out, "s3://results/june"), out)) == 1  # where nothing is yet
    with LedgerReader(out) as ledger:
        assert {row.name: row.status for row in ledger.rows()}["frame2.png"] == "aligned"


def test_nothing_is_uploaded_over_an_input(folder, tmp_path):
    for moving, upload in (
        ("s3://bucket/a b.png", "s3://bucket/"),
        ("s3://bucket/x/a%20b.png", "s3://bucket/x"),
        (f"{folder}/a b.png", f"file://{folder}"),
    ):
        jobs = jobs_of([f"{folder}/frame1.png,{moving},,"], tmp_path / "out", upload)
        with pytest.raises(ValueError, match=r"is an input, and a result would overwrite it: .*a( |%20)b\.png$"):
            by_key(jobs, str)


def test_jobs_of_the_library_may_have_urls(rows, tmp_path):
    (row,) = align_batch(jobs_of(rows[:1], tmp_path, f"file://{tmp_path}/up"), InlineEngine())
    assert row.status == "aligned"
    assert results(tmp_path / "up") == results(tmp_path)


def test_names_of_urls_and_of_paths_in_one_manifest():
    def names(*moving: str) -> list[str]:
        rows = "\n".join(f"s3://b/ref.png,{url}" for url in moving)
        return [job.name for job in manifest_jobs(f"fixed,moving\n{rows}", "l", Path("/base"), Path("o"), JobOptions())]

    assert names("s3://b/day%201/a.jpg", "s3://b/day%202/a.jpg") == ["day 1/a.jpg", "day 2/a.jpg"]
    assert names("https://h/a.jpg?sig=x/y.png", "file:///pictures/b.jpg") == ["https/h/a.jpg", "pictures/b.jpg"]
    assert names("gs://b/download") == ["download"]


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("ftp://h/a.png,b.png,,", "line 2: the URL begins with s3, .* not ftp"),
        ("a.png,https://h/,,", "line 2: the URL names no file"),
        (f"a.png,https://me:{SECRET}@h/b.png,,", "line 2: credentials are taken from the environment"),
        ("a.png,b.png,,s3://b/mask.png?v=1", "line 2: the URL has a # or"),
        ("a.png,s3://b/%2e%2e/x.png,../x.png,", "line 2: '../x.png' is no name inside"),
        ("a.png,,x,", "line 2: moving is empty"),
    ],
)
def test_what_cannot_be_understood_is_named_with_its_line(row, message):
    with pytest.raises(ImageReadError, match=rf"^is no manifest \({message}.*\): list.csv$") as caught:
        jobs_of([row], Path("/out"))
    assert SECRET not in str(caught.value)
