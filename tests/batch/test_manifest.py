"""Manifests: what their rows say, and one clear line for what cannot be understood."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from autoalign.batch.jobs import JobOptions
from autoalign.batch.manifest import manifest_jobs
from autoalign.errors import ImageReadError
from autoalign.registration.alignment import AlignOptions

BASE = Path("/base")


def jobs(text: str, options: JobOptions | None = None):
    return manifest_jobs(text, "list.csv", BASE, Path("/out"), options or JobOptions())


def test_paths_are_relative_to_the_manifest_and_names_to_what_the_pictures_share():
    found = jobs("fixed,moving\nref.png,day1/a.jpg\n/else/ref.png,day2/a.jpg\n")
    assert [job.fixed for job in found] == ["/base/ref.png", "/else/ref.png"]
    assert [job.moving for job in found] == ["/base/day1/a.jpg", "/base/day2/a.jpg"]
    assert [job.name for job in found] == ["day1/a.jpg", "day2/a.jpg"]
    assert found[1].output == Path("/out/day2/a.jpg")


def test_comments_blank_lines_quotes_and_capitals():
    text = '\n# shot in May\nMoving , Fixed,name\n"a, b.jpg", r.jpg, "first one"\n\nb.jpg,r.jpg,two.png\n'
    assert [(job.moving, job.name) for job in jobs(text)] == [
        ("/base/a, b.jpg", "first one.jpg"),
        ("/base/b.jpg", "two.png"),
    ]


def test_options_of_a_row_stand_over_those_of_the_batch():
    options = JobOptions(align=AlignOptions(effort="fast", mirror=True))
    text = (
        "fixed,moving,model,max-trials,mirror,time_limit,canvas,threshold,moving_mask\n"
        "r.png,a.png,affine,77,no,2.5,union,1.5,mask.png\nr.png,b.png,,,,,,,\n"
    )
    changed, plain = jobs(text, options)
    assert plain.options == options
    assert plain.moving_mask is None
    align = changed.options.align
    assert (align.model, align.effort, align.mirror, align.time_limit) == ("affine", "fast", False, 2.5)
    assert (align.ransac.max_trials, align.ransac.threshold) == (77, 1.5)
    assert changed.options.drawing == replace(options.drawing, canvas="union")
    assert changed.moving_mask == "/base/mask.png"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "has no rows"),
        ("fixed,moving\n", "has no rows"),
        ("fixed\na.png\n", "lacks the column moving"),
        ("fixed,moving,moving\na,b,c\n", "names the column moving twice"),
        ("fixed,moving,modle\na,b,affine\n", "has the column modle, which is no option"),
        ("fixed,moving\na.png\n", "line 2 has 1 cells, the first line 2"),
        ("fixed,moving\na.png,b.png\n\n,b.png\n", "line 4: fixed is empty"),
        ("fixed,moving,model\na.png,b.png,cubic\n", "line 2: model is one of auto, homography, .*not cubic"),
        ("fixed,moving,mirror\na.png,b.png,maybe\n", "line 2: mirror is true or false, not maybe"),
        ("fixed,moving,seed\na.png,b.png,1.5\n", "line 2: seed is a number, not 1.5"),
        ("fixed,moving,threshold\na.png,b.png,-1\n", "line 2: .*threshold"),
        ("fixed,moving,name\na.png,b.png,../x.png\n", "line 2: '../x.png' is no name inside"),
        ("fixed,moving,name\na.png,b.png,/x.png\n", "line 2: '/x.png' is no name inside"),
        ('fixed,moving\na.png,"b.png\n', "unexpected end of data"),
    ],
)
def test_what_cannot_be_understood_is_named_with_its_line(text, message):
    with pytest.raises(ImageReadError, match=rf"is no manifest \(.*{message}.*\): list.csv"):
        jobs(text)


@given(st.text(alphabet=st.characters(codec="utf-8")) | st.from_regex(r"(fixed|moving|name|,|\n|\"|\.\.|/|x)*"))
def test_any_text_is_jobs_inside_the_folder_or_one_line(text):
    found = []
    with suppress(ImageReadError):
        found = jobs(text)
    for job in found:
        assert job.output.is_relative_to("/out")
        assert job.sidecar.is_relative_to("/out")
        assert ".." not in job.output.parts
