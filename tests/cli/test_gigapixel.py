"""What a pair of a gigapixel goes through, on a small one: the limit above which files are read by boxes is lowered.

The pair is the one that scripts/gigapixel.py makes.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest
import tifffile

import autoalign as aa
from autoalign.batch.chain import link_up, place
from autoalign.batch.engine import InlineEngine
from autoalign.batch.jobs import Job, JobOptions
from autoalign.batch.ledger import Ledger
from autoalign.batch.work import Task, do_task
from autoalign.files import large, ready
from autoalign.files.tiled import LargePicture
from autoalign.registration import large as large_module
from autoalign.registration.drawing import Drawing

SIZE = (1_500, 1_100)
SCRIPT = Path(__file__).parent.parent.parent / "scripts" / "gigapixel.py"


@pytest.fixture(scope="module")
def script():
    spec = importlib.util.spec_from_file_location("gigapixel", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.FINE = module.COARSE = 512  # texels: enough for so small a scene
    return module


@pytest.fixture(scope="module")
def made(script, tmp_path_factory):
    """The folder of the pair, and its truth."""
    folder = tmp_path_factory.mktemp("made")
    return folder, script.make_pair(folder, SIZE, 3)


@pytest.fixture
def both(made, folder, monkeypatch):
    """The pair in the working folder, where it counts as large."""
    for name in ("fixed.tif", "moving.tif"):
        (folder / name).symlink_to(made[0] / name)
    monkeypatch.setattr(large, "LARGE_PIXELS", 1e6)
    monkeypatch.setattr(ready, "WORKING_PIXELS", 4e5)
    monkeypatch.setattr(large_module, "WORKING_PIXELS", 4e5)
    return made[1]


def test_it_is_aligned_as_well_as_a_small_one_and_drawn_the_same(both, folder, run, script, monkeypatch):
    words = ("--border", "transparent", "--overlay", "look.jpg", "--save-mask", "data.tif")
    outcome = run("pair", "fixed.tif", "moving.tif", "-o", "out.tif", *words)
    assert outcome.code == 0
    assert outcome.err == "wrote out.tif, data.tif, look.jpg, out.autoalign.json\n"
    record = aa.read_sidecar("out.autoalign.json")
    assert record.fixed.size == record.moving.size == SIZE
    assert script.error_px(np.array(record.fixed_from_moving), both, SIZE) < 0.03
    assert record.expected_error_px < 0.1
    with tifffile.TiffFile("out.tif") as file:
        assert file.is_bigtiff
        assert [page.shape for page in file.pages] == [(1100, 1500, 4), (550, 750, 4)]
    assert aa.read_picture("look.jpg").pixels.shape[0] < SIZE[1] / 2

    monkeypatch.setattr(large, "LARGE_PIXELS", 1e9)
    assert (
        run("apply", "out.autoalign.json", "moving.tif", "-o", "whole.tif", "--save-mask", "whole_mask.tif").code == 0
    )
    by_strips, whole = (aa.read_picture(name).pixels for name in ("out.tif", "whole.tif"))
    difference = np.abs(by_strips.astype(int) - whole)
    assert difference.max() <= 1
    assert (difference > 0).mean() < 1e-3
    assert (folder / "data.tif").exists()
    assert np.array_equal(aa.read_picture("data.tif").pixels, by_strips[..., 3])
    assert np.array_equal(aa.read_picture("data.tif").pixels, aa.read_picture("whole_mask.tif").pixels)


def test_apply_draws_by_strips_what_pair_drew(both, folder, run):
    points = "fixed_x,fixed_y,moving_x,moving_y\n10,20,0,0\n1490,30,1400,0\n1480,1080,1400,1000\n5,1090,0,1000\n"
    (folder / "typed.csv").write_text(points)
    run("pair", "fixed.tif", "moving.tif", "--points", "typed.csv", "-o", "out.tif", "--canvas", "inner")
    assert run("apply", "out.autoalign.json", "moving.tif", "-o", "again.tif").code == 0
    assert np.array_equal(aa.read_picture("again.tif").pixels, aa.read_picture("out.tif").pixels)


def test_a_mask_hides_what_the_copies_show(both, run):
    blind = np.full((SIZE[1], SIZE[0]), 255, np.uint8)
    tifffile.imwrite("mask.tif", blind, tile=(256, 256))
    assert run("pair", "fixed.tif", "moving.tif", "--fixed-mask", "mask.tif").code == 1
    tifffile.imwrite("other.tif", blind[:-1], tile=(256, 256))
    outcome = run("pair", "fixed.tif", "moving.tif", "--fixed-mask", "other.tif", "--overwrite")
    assert outcome.code == 3
    assert outcome.err == "autoalign: is 1500 x 1099, and a picture of 1500 x 1100 is needed: other.tif\n"


@pytest.mark.parametrize(
    ("words", "code", "reason"),
    [
        (["-o", "out.png"], 3, "a picture of so many pixels is written as TIFF: out.png"),
        (["--save-mask", "mask.png"], 3, "a picture of so many pixels is written as TIFF: mask.png"),
        (
            ["--border", "replicate"],
            3,
            "--border replicate needs the whole result at once, which is too large: moving_aligned.tif",
        ),
        (
            ["--save-rrd", "a.rrd"],
            2,
            "pictures of so many pixels are not recorded for the viewer; --overlay shows them",
        ),
        (["--max-pixels", "1.5e6"], 3, "has 1.6 megapixels (1500 x 1100), more than the 1.5 allowed: fixed.tif"),
    ],
)
def test_what_cannot_be_done_by_strips_is_said_at_once(both, folder, run, words, code, reason):
    outcome = run("pair", "fixed.tif", "moving.tif", *words)
    assert (outcome.code, outcome.err) == (code, f"autoalign: {reason}\n")
    assert {path.name for path in folder.iterdir()} == {"fixed.tif", "moving.tif"}


def test_a_damaged_tile_leaves_nothing(both, folder, run):
    data = bytearray((folder / "moving.tif").read_bytes())
    with tifffile.TiffFile(folder / "moving.tif") as file:
        start = file.pages.first.dataoffsets[-1]
    data[start : start + 100] = bytes(100)
    (folder / "moving.tif").unlink()
    (folder / "moving.tif").write_bytes(data)
    outcome = run("pair", "fixed.tif", "moving.tif", "-o", "out.tif")
    assert outcome.code == 3
    assert outcome.err.startswith("autoalign: is damaged, or no TIFF that can be read (")
    assert outcome.err.endswith("): moving.tif\n")
    assert {path.name for path in folder.iterdir()} == {"fixed.tif", "moving.tif"}


def job_of(name: str, folder: Path = Path(), **words) -> Job:
    return Job(name=name, fixed=str(folder / "fixed.tif"), moving=str(folder / name), out_dir="out", **words)


def files_of(job: Job) -> set[str]:
    return {path.name for path in Path(job.out_dir).iterdir()}


def test_a_batch_does_what_pair_does(both, folder, run):
    hidden = np.zeros((SIZE[1], SIZE[0]), np.uint8)
    hidden[:, :400] = 255
    tifffile.imwrite("mask.tif", hidden, tile=(256, 256))
    assert run("pair", "fixed.tif", "moving.tif", "--moving-mask", "mask.tif", "--border", "transparent").code == 0
    job = job_of("moving.tif", moving_mask="mask.tif", options=JobOptions(drawing=Drawing(border="transparent")))
    for _ in range(2):  # the second time with what the worker remembers
        done = do_task(Task(job=job, key="k"))
        assert (done.row.status, done.row.output, done.row.moving_size) == ("aligned", "moving.tif", SIZE)
        assert done.thumbnails.after is not None
        assert job.output.read_bytes() == (folder / "moving_aligned.tif").read_bytes()
        assert job.sidecar.read_bytes() == (folder / "moving_aligned.autoalign.json").read_bytes()
        assert files_of(job) == {"moving.tif", "moving.tif.autoalign.json"}


def test_a_small_picture_goes_onto_a_large_one_as_tiff(both, folder, run):
    aa.write_picture("part.png", aa.read_picture("moving.tif").pixels[100:900, 100:1200].copy())
    assert run("pair", "fixed.tif", "part.png").code == 0
    job = job_of("part.png")
    assert do_task(Task(job=job, key="k")).row.output == "part.png.autoalign.tif"
    assert files_of(job) == {"part.png.autoalign.tif", "part.png.autoalign.json"}
    assert job.large_output.read_bytes() == (folder / "part_aligned.tif").read_bytes()
    assert job.sidecar.read_bytes() == (folder / "part_aligned.autoalign.json").read_bytes()


def test_a_worker_makes_one_copy_of_a_reference(both, folder, monkeypatch):
    copied = []
    whole = LargePicture.working_copy
    monkeypatch.setattr(
        LargePicture, "working_copy", lambda self, pixels: copied.append(self.path.name) or whole(self, pixels)
    )
    (folder / "same.tif").symlink_to(folder / "moving.tif")
    first, second = (do_task(Task(job=job_of(name, folder), key="k")).row for name in ("moving.tif", "same.tif"))
    assert copied == ["fixed.tif", "moving.tif", "same.tif"]
    assert first.fixed_from_moving == second.fixed_from_moving


def test_what_a_batch_cannot_do_by_strips_is_a_row(both, folder):
    replicated = job_of("moving.tif", options=JobOptions(drawing=Drawing(border="replicate")))
    row = do_task(Task(job=replicated, key="k")).row
    reason = "--border replicate needs the whole result at once, which is too large: out/moving.tif"
    assert (row.status, row.reason) == ("failed", reason)
    assert not (folder / "out").exists()
    recorded = job_of("moving.tif", options=JobOptions(recorded="all"))
    row = do_task(Task(job=recorded, key="k")).row
    assert (row.status, row.recording) == ("aligned", None)
    assert row.advice == "autoalign pair --overlay: there is no recording of pictures of so many pixels"
    broken = bytearray((folder / "moving.tif").read_bytes())
    with tifffile.TiffFile(folder / "moving.tif") as file:
        start = file.pages.first.dataoffsets[-1]
    broken[start : start + 100] = bytes(100)
    (folder / "broken.tif").write_bytes(broken)
    row = do_task(Task(job=job_of("broken.tif"), key="k")).row
    assert row.status == "failed"
    assert row.reason.startswith("is damaged, or no TIFF that can be read (")
    assert row.reason.endswith("): broken.tif")


def test_a_sequence_of_large_frames(both, folder, script):
    frames = [job_of(name) for name in ("fixed.tif", "moving.tif")]
    with Ledger(folder) as ledger:
        linked = list(link_up(frames, 0, ledger, InlineEngine(), folder))
    assert [one.moving_size for one in linked] == [SIZE]
    rows = [do_task(Task(job=job, key="k")).row for job in place(frames, 0, linked)]
    assert [row.status for row in rows] == ["aligned", "aligned"]
    assert script.error_px(np.array(rows[1].fixed_from_moving), both, SIZE) < 0.03
    assert aa.read_picture("out/moving.tif").pixels.shape == (SIZE[1], SIZE[0], 3)
