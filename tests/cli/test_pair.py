"""`autoalign pair`: what it writes, what it says, how it ends."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
from dataclasses import fields, is_dataclass
from pathlib import Path

import numpy as np
import pytest
import tifffile

import autoalign as aa
from autoalign.cli import pair as pair_module
from autoalign.cli.main import app, main

TRUTH = np.array(
    [[0.665641239, -0.458139435, 262.0], [0.345193638, 0.551643241, 14.0], [3.97104849e-5, 1.46075672e-4, 1]]
)
CORNERS = np.array([[0.0, 0.0], [479.0, 0.0], [479.0, 419.0], [0.0, 419.0]])


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def error_px(matrix: object) -> float:
    found, true = aa.apply(np.array(matrix), CORNERS), aa.apply(TRUTH, CORNERS)
    return float(np.linalg.norm(found - true, axis=1).max())


def test_the_examples_are_aligned(pictures, run):
    outcome = run("pair", "fixed.jpg", "moving.jpg", "--overlay", "overlay.png")
    assert outcome.code == 0
    assert re.fullmatch(
        r"aligned: [\d,]+ of [\d,]+ matches agree, expected error 0\.\d*[1-9] px, overlap \d\d%, \d+\.\d s\n",
        outcome.out,
    )
    assert outcome.err == "wrote moving_aligned.jpg, overlay.png, moving_aligned.autoalign.json\n"
    assert names(pictures) == {
        "fixed.jpg",
        "moving.jpg",
        "moving_aligned.jpg",
        "overlay.png",
        "moving_aligned.autoalign.json",
    }
    record = json.loads((pictures / "moving_aligned.autoalign.json").read_text())
    assert record["status"] == "aligned"
    assert error_px(record["fixed_from_moving"]) < 0.5
    assert record["fixed"]["name"] == "fixed.jpg"
    assert record["options"]["model"] == "auto"
    assert record["options"]["canvas"] == "fixed"
    assert "timings_s" not in record
    fixed, moved = aa.read_picture("fixed.jpg").pixels, aa.read_picture("moving_aligned.jpg").pixels
    assert moved.shape == fixed.shape


def test_an_unrelated_pair_leaves_its_record_and_no_picture(folder, run, rng_pictures):
    outcome = run("pair", *rng_pictures, "--overlay", "overlay.png", "-o", "out.png")
    assert outcome.code == 1
    assert outcome.out.startswith("rejected: ")
    assert outcome.out.count("\n") == 1
    assert names(folder) == {"a.png", "b.png", "out.autoalign.json"}
    record = aa.read_sidecar("out.autoalign.json")
    assert (record.status, record.fixed_from_moving) == ("rejected", None)
    assert record.reason in outcome.out


@pytest.mark.parametrize("shape", [(1, 1), (48, 64)])
def test_a_black_or_tiny_picture_is_a_rejected_pair(folder, run, shape):
    aa.write_picture("black.png", np.zeros(shape, np.uint8))
    aa.write_picture("other.png", np.zeros((50, 40), np.uint8))
    outcome = run("pair", "black.png", "other.png", "--json", "record.json")
    assert outcome.code == 1
    assert outcome.out.startswith("rejected: ")
    assert names(folder) == {"black.png", "other.png", "record.json"}


def test_a_doubtful_pair_leaves_its_record_and_the_overlay_to_look_at(pictures, run):
    outcome = run("pair", "fixed.jpg", "moving.jpg", "--max-expected-error-px", "1e-9", "--max-expected-error-share",
                  "1e-12", "--overlay", "overlay.png", "-o", "it is.png")  # fmt: skip
    assert outcome.code == 1
    assert outcome.out.startswith("doubtful: ")
    assert "overlap" in outcome.out
    assert names(pictures) == {"fixed.jpg", "moving.jpg", "overlay.png", "it is.autoalign.json"}
    (command,) = re.findall("this makes the picture: autoalign (.*)", outcome.err)
    assert run(*shlex.split(command)).code == 0
    assert (pictures / "it is.png").exists()


def test_json_on_stdout_leaves_the_words_to_stderr(pictures, run):
    outcome = run("pair", "fixed.jpg", "moving.jpg", "--json", "-", "--timings", "-v")
    assert outcome.code == 0
    assert json.loads(outcome.out)["timings_s"].keys() >= {"detect", "consensus"}
    assert "aligned: " in outcome.err
    assert "matches: " in outcome.err
    assert "consensus: " in outcome.err
    assert names(pictures) == {"fixed.jpg", "moving.jpg", "moving_aligned.jpg"}


def test_typed_points_take_the_place_of_detection(sidecar):
    record = aa.read_sidecar(sidecar)
    assert record.status == "aligned"
    assert error_px(record.fixed_from_moving) < 1e-6


def test_quiet_says_nothing(sidecar, run):
    outcome = run("pair", "fixed.jpg", "moving.jpg", "--points", "typed.csv", "-q")
    assert (outcome.code, outcome.out, outcome.err) == (0, "", "")


@pytest.mark.parametrize("canvas", ["union", "moving"])
def test_a_larger_canvas_holds_more(sidecar, run, canvas):
    outcome = run("pair", "fixed.jpg", "moving.jpg", "--points", "typed.csv", "-o", "out.png", "--canvas", canvas,
                  "--overlay", "both.png", "--overlay-style", "checkerboard")  # fmt: skip
    assert outcome.code == 0
    # The moving picture lies wholly inside the fixed one.
    expected = (400, 600) if canvas == "union" else (367, 505)
    for name in ("out.png", "both.png"):
        height, width = aa.read_picture(name).pixels.shape[:2]
        assert (height, width) == pytest.approx(expected, abs=2)


@pytest.mark.parametrize("canvas", ["fixed", "intersection", "inner"])
def test_the_mask_is_white_where_the_result_has_data(sidecar, run, canvas):
    outcome = run("pair", "fixed.jpg", "moving.jpg", "--points", "typed.csv", "-o", "out.png", "--canvas", canvas,
                  "--save-mask", "data.png", "--border", "transparent")  # fmt: skip
    assert outcome.err.startswith("wrote out.png, data.png, out.autoalign.json")
    pixels, mask = aa.read_picture("out.png").pixels, aa.read_picture("data.png").pixels
    assert mask.dtype == np.uint8
    assert np.array_equal(mask, pixels[..., 3])
    # The moving picture lies wholly inside the fixed one: 40 % of this are data, and 51 % of the box around these.
    shares = {"fixed": (0.39, 0.4), "intersection": (0.51, 0.52), "inner": (1.0, 1.0)}
    low, high = shares[canvas]
    assert low <= (mask == 255).mean() <= high
    record = aa.read_sidecar("out.autoalign.json")
    assert (record.options["canvas"], record.options["border"]) == (canvas, "transparent")


def test_replicate_leaves_no_pixel_black(sidecar, run):
    white = np.full((420, 480, 3), 255, np.uint8)
    aa.write_picture("white.png", white)
    run("pair", "fixed.jpg", "white.png", "--points", "typed.csv", "-o", "out.png", "--border", "replicate")
    assert (aa.read_picture("out.png").pixels == 255).all()


def test_what_cannot_be_see_through_is_refused_before_any_work(sidecar, run, monkeypatch):
    monkeypatch.setattr(pair_module, "align_points", lambda *_, **__: pytest.fail("worked in vain"))
    words = ("pair", "fixed.jpg", "moving.jpg", "--points", "typed.csv", "--border", "transparent")
    refused = run(*words, "-o", "out.jpg")
    assert refused.code == 3
    assert re.fullmatch(r"autoalign: JPEG cannot hold .* with alpha; PNG or TIFF or .* can: out\.jpg\n", refused.err)
    refused = run(*words, "--save-mask", "mask.jpg")
    assert (refused.code, refused.err) == (3, "autoalign: a mask is written as PNG or TIFF: mask.jpg\n")


def test_masks_are_white_where_to_ignore(pictures, run):
    mask = np.zeros((400, 600), np.uint8)
    mask[:, :250] = 255
    aa.write_picture("mask.png", mask)
    seen = {}

    def align(both, options):
        seen.update(zip(("fixed", "moving"), (of.prepared.usable for of in both.seen()), strict=True))
        raise ValueError("seen enough")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pair_module, "align_both", align)
        assert run("pair", "fixed.jpg", "moving.jpg", "--fixed-mask", "mask.png").code == 2
    assert np.array_equal(seen["fixed"], mask == 0)
    assert seen["moving"] is None


def test_an_output_is_refused_before_any_work(pictures, run, monkeypatch):
    monkeypatch.setattr(pair_module, "align_both", lambda *_, **__: pytest.fail("worked in vain"))
    (pictures / "out.png").write_bytes(b"precious")
    assert run("pair", "fixed.jpg", "moving.jpg", "-o", "out.png").code == 3
    assert (pictures / "out.png").read_bytes() == b"precious"
    assert run("pair", "fixed.jpg", "moving.jpg", "--overlay", "no_folder/overlay.png").code == 3
    assert run("pair", "fixed.jpg", "moving.jpg", "--overlay", "overlay.xyz").code == 3
    for clash in (["-o", "moving.jpg"], ["--overlay", "fixed.jpg"], ["-o", "a.png", "--overlay", "./a.png"]):
        assert run("pair", "fixed.jpg", "moving.jpg", "--overwrite", *clash).code == 2


def test_an_interrupt_leaves_nothing(pictures, run, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(pair_module, "align_both", interrupted)
    outcome = run("pair", "fixed.jpg", "moving.jpg")
    assert (outcome.code, outcome.out, outcome.err) == (130, "", "autoalign: interrupted\n")
    assert names(pictures) == {"fixed.jpg", "moving.jpg"}


def test_a_bug_is_called_one(pictures, run, monkeypatch):
    monkeypatch.setattr(pair_module, "align_both", lambda *_, **__: 1 / 0)
    outcome = run("pair", "fixed.jpg", "moving.jpg")
    assert outcome.code == 70
    assert outcome.err == "autoalign: this is a bug (ZeroDivisionError: division by zero); -v shows where\n"
    assert "Traceback" in run("pair", "fixed.jpg", "moving.jpg", "-v").err


def test_the_same_pair_gives_the_same_bytes_with_any_number_of_threads(pictures):
    results = []
    for threads, out in (("1", "one"), ("2", "two"), ("2", "again")):
        (pictures / out).mkdir()
        limits = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), threads)
        script = (
            f"import cv2, sys; cv2.setNumThreads({threads}); from autoalign.cli.main import app, main; sys.exit(main())"
        )
        words = ["pair", "fixed.jpg", "moving.jpg", "-o", f"{out}/out.png", "--overlay", f"{out}/overlay.jpg"]
        subprocess.run([sys.executable, "-c", script, *words], env=os.environ | limits, check=True, capture_output=True)
        results.append({path.name: path.read_bytes() for path in (pictures / out).iterdir()})
    assert len(results[0]) == 3
    assert results[0] == results[1] == results[2]


def test_every_option_of_the_library_is_a_flag_with_its_default():
    """No flag is forgotten or named twice, and no default is written a second time."""

    def leaves(options):
        for field in fields(options):
            value = getattr(options, field.name)
            yield from leaves(value) if is_dataclass(value) else [(field.name, value)]

    arguments = app["pair"].assemble_argument_collection(parse_docstring=True)
    names = [name for argument in arguments for name in argument.names if name != "*"]
    assert len(names) == len(set(names))
    flags = {name: argument for argument in arguments for name in argument.names}
    for name, value in leaves(aa.AlignOptions()):
        argument = flags["--" + name.replace("_", "-")]
        assert argument.field_info.default == value
        assert argument.parameter.help, f"{name} has no docstring"


def test_main_returns_what_the_process_ends_with(pictures, capsys):
    assert main(["pair", "fixed.jpg", "missing.jpg"]) == 3
    done = subprocess.run(
        [sys.executable, "-m", "autoalign.cli.main", "pair", "fixed.jpg", "missing.jpg"], capture_output=True, text=True
    )
    assert (done.returncode, done.stdout, done.stderr) == (3, "", capsys.readouterr().err)


def test_a_damaged_picture_is_taken_only_on_request(pictures, run):
    data = (pictures / "moving.jpg").read_bytes()
    (pictures / "moving.jpg").write_bytes(data[: len(data) * 4 // 5])
    assert run("pair", "fixed.jpg", "moving.jpg").code == 3
    outcome = run("pair", "fixed.jpg", "moving.jpg", "--lenient")
    assert "is damaged (" in outcome.err.splitlines()[0]
    assert outcome.err.splitlines()[0].endswith(": moving.jpg")
    record = json.loads((pictures / "moving_aligned.autoalign.json").read_text())
    assert list(record["stages"]["reading"]) == ["moving"]
    assert record["options"]["lenient"] is True


def test_pages_and_the_size_that_is_allowed(pictures, run):
    pages = np.stack([aa.read_picture("fixed.jpg").pixels] * 2)
    pages[0] = 0
    tifffile.imwrite("pages.tif", pages, photometric="rgb")
    words = ("pair", "pages.tif", "moving.jpg", "--fixed-page", "1", "-q")
    assert "megapixels" in run(*words, "--max-pixels", "1e4").err
    assert run(*words).code == 0
    assert "no page 2" in run("pair", "pages.tif", "moving.jpg", "--fixed-page", "2").err
    stack = np.stack([aa.read_picture("moving.jpg").pixels] * 2)
    stack[0] = 0
    tifffile.imwrite("stack.tif", stack, photometric="rgb")
    assert run("apply", "moving_aligned.autoalign.json", "stack.tif", "--page", "1", "-q").code == 0
    assert aa.read_picture("stack_aligned.tif").pixels.max() > 0
