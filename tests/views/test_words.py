"""The report says what the verdict says, and which evidence failed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from recordings import Case

import autoalign as aa
from autoalign.registration.verdict import VerdictOptions
from autoalign.views.motion import Motion
from autoalign.views.words import checks, counted, literal, moved, number, plain, power, report


def test_the_verdict_comes_first_in_words(aligned: Case, doubtful: Case, rejected: Case) -> None:
    for case, mark in ((aligned, "✓"), (doubtful, "⚠"), (rejected, "✗")):
        text = report(case.alignment)
        assert text.startswith(f"# {mark} {case.alignment.status}\n")
        assert literal(case.alignment.reason[1:]) in text
        assert literal(case.alignment.verdict.advice) in text
    assert "Expected error" not in report(rejected.alignment)


def test_every_check_of_an_aligned_pair_passes(aligned: Case) -> None:
    assert {check.status for check in checks(aligned.alignment)} == {"aligned"}


def test_the_check_that_failed_is_marked(doubtful: Case, rejected: Case, nothing_found: Case) -> None:
    def failed(case: Case) -> dict[str, str]:
        return {check.name: check.status for check in checks(case.alignment) if check.status != "aligned"}

    assert failed(doubtful) == {"fit is precise": "doubtful"}
    assert failed(rejected) == {"pixels agree": "rejected"}
    assert failed(nothing_found) == {"matches agree": "rejected"}
    assert "| ✗ pixels agree |" in report(rejected.alignment)


@pytest.mark.parametrize(
    ("name", "strict"),
    [
        ("not by chance", VerdictOptions(max_log10_false_alarms=-9999)),
        ("a camera can see it", VerdictOptions(max_stretch=1.01)),
        ("pictures overlap", VerdictOptions(min_overlap=0.99)),
    ],
)
def test_each_check_is_about_its_own_options(name: str, strict: VerdictOptions, aligned: Case) -> None:
    options = replace(aligned.alignment.options, verdict=strict)
    judged = checks(replace(aligned.alignment, options=options))
    assert [check.name for check in judged if check.status == "rejected"] == [name]


def test_the_checks_together_give_the_verdict(aligned: Case, doubtful: Case, rejected: Case) -> None:
    order = ("aligned", "doubtful", "rejected")
    for case in (aligned, doubtful, rejected):
        worst = max((check.status for check in checks(case.alignment)), key=order.index)
        assert worst == case.alignment.status


def test_typed_points_are_asked_nothing() -> None:
    points = np.array([[0, 0], [90, 0], [90, 60], [0, 60]])
    alignment = aa.align_points(points * 1.1, points, (100, 80), (100, 80))
    assert checks(alignment) == ()
    text = report(alignment)
    assert "1.1 times as large" in text
    assert "evidence" not in text


def test_what_is_hardly_turned_is_not_turned_back() -> None:
    still = Motion(shift_px=(3.0, 4.0), turn_rad=-1e-9, scale=1.0, mirrored=True)
    assert moved(still) == "mirrored, turned by 0.0°, of the same size"


def test_one_is_no_plural() -> None:
    assert [counted(count, "pair") for count in (0, 1, 2000)] == ["0 pairs", "1 pair", "2,000 pairs"]


def test_every_rung_is_told(doubtful: Case, aligned: Case) -> None:
    text = report(doubtful.alignment)
    for step, attempt in enumerate(doubtful.alignment.attempts, 1):
        assert f"{step}. {attempt.rung}" in text
    assert "What was tried" not in report(aligned.alignment)


def test_seconds_are_told_only_on_request(aligned: Case) -> None:
    assert report(aligned.alignment) == report(replace(aligned.alignment))
    assert "seconds" not in report(aligned.alignment)
    assert "| detect |" in report(aligned.alignment, timings=True)


def test_names_and_notes_are_shown_as_they_are(aligned: Case) -> None:
    text = report(aligned.alignment, ("a|b_*c*.png", "<b>.png"), ["it is *not* 8 bits"])
    assert r"a\|b\_\*c\*.png" in text
    assert r"\<b\>.png" in text
    assert r"it is \*not\* 8 bits" in text


def test_no_name_breaks_a_program_that_takes_text() -> None:
    assert plain("写真.png") == "写真.png"
    assert plain("a\nb\udcffc\x00") == "a�b�c�"


def test_numbers() -> None:
    assert [number(value) for value in (0.01234, 5.6789, 1234.5, float("inf"))] == ["0.0123", "5.68", "1,234", "∞"]
    assert [power(value) for value in (-291.4, 0.0, 3.0)] == ["10^-291", "1 (certain)", "1 (certain)"]
