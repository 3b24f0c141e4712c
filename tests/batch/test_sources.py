"""The jobs of a folder: which pictures, in which order, onto which."""

from __future__ import annotations

from pathlib import Path

import pytest

from autoalign.batch.jobs import JobOptions
from autoalign.batch.sources import Selection, in_groups, natural, onto_reference, pictures
from autoalign.errors import ImageReadError


def test_pictures_come_in_the_order_that_people_count_in(folder):
    assert pictures(folder, Selection()) == ["damaged.png", "frame1.png", "frame2.png", "frame10.png", "stranger.png"]
    assert sorted(["b2", "B10", "b1", "a"], key=natural) == ["a", "b1", "b2", "B10"]
    assert sorted(["x", "1", "10", "2", "1x"], key=natural) == ["1", "1x", "2", "10", "x"]


def test_folders_below_only_if_asked_and_never_the_results(folder):
    recursive = pictures(folder, Selection(recursive=True))
    assert "below/frame3.png" in recursive
    assert pictures(folder, Selection(recursive=True), without=folder / "below") == pictures(folder, Selection())


@pytest.mark.parametrize(
    ("selection", "expected"),
    [
        (Selection(include=("frame*",)), ["frame1.png", "frame2.png", "frame10.png"]),
        (Selection(include=("*1.png", "s*")), ["frame1.png", "stranger.png"]),
        (Selection(exclude=("d*", "*r.png")), ["frame1.png", "frame2.png", "frame10.png"]),
        (Selection(include=("frame*",), exclude=("*2*",), recursive=True), ["frame1.png", "frame10.png"]),
    ],
)
def test_include_and_exclude(folder, selection, expected):
    assert pictures(folder, selection) == expected


def test_a_folder_without_pictures_and_no_folder(tmp_path):
    with pytest.raises(ValueError, match=rf"has no pictures: {tmp_path}"):
        pictures(tmp_path, Selection())
    with pytest.raises(ValueError, match="has no pictures that were asked for"):
        pictures(tmp_path, Selection(include=("*.png",)))
    with pytest.raises(ImageReadError, match="cannot be read"):
        pictures(tmp_path / "nowhere", Selection())


def test_everything_but_the_reference_goes_onto_it(folder, tmp_path):
    names = pictures(folder, Selection())
    jobs = onto_reference(folder, names, folder / "." / "frame2.png", tmp_path / "out", JobOptions())
    assert [job.name for job in jobs] == ["damaged.png", "frame1.png", "frame10.png", "stranger.png"]
    assert {job.fixed for job in jobs} == {str(folder / "frame2.png")}
    assert jobs[1].moving == str(folder / "frame1.png")
    assert jobs[1].output == tmp_path / "out" / "frame1.png"
    assert jobs[1].sidecar == tmp_path / "out" / "frame1.png.autoalign.json"


def test_groups_share_what_the_bracket_of_the_pattern_finds():
    names = ["a_1.jpg", "a_2.jpg", "a_3.jpg", "b_1.jpg", "b_2.jpg", "other.jpg"]
    first = in_groups(Path("in"), names, r"(\w)_\d", "first", Path("out"), JobOptions())
    assert [(Path(job.fixed).name, job.name) for job in first] == [
        ("a_1.jpg", "a_2.jpg"),
        ("a_1.jpg", "a_3.jpg"),
        ("b_1.jpg", "b_2.jpg"),
    ]
    middle = in_groups(Path("in"), names, r"(\w)_\d", "middle", Path("out"), JobOptions())
    assert [Path(job.fixed).name for job in middle] == ["a_2.jpg", "a_2.jpg", "b_2.jpg"]


@pytest.mark.parametrize(
    ("pattern", "reference", "message"),
    [
        ("(", "first", "is no regular expression"),
        ("zebra", "first", "is found in none of 2 names"),
        ("a", "last.jpg", "first or its middle"),
    ],
)
def test_patterns_that_make_no_groups(pattern, reference, message):
    with pytest.raises(ValueError, match=message):
        in_groups(Path("in"), ["a1.jpg", "a2.jpg"], pattern, reference, Path("out"), JobOptions())
