"""The rungs of effort: harder efforts hold the easier ones, and a chosen detector is the only one used."""

from __future__ import annotations

import pytest

from autoalign.registration.ladder import EFFORTS, rungs


@pytest.mark.parametrize("effort", EFFORTS)
@pytest.mark.parametrize("detector", ["orb", "sift"])
def test_a_chosen_detector_is_the_only_one(effort, detector):
    chosen = rungs(effort, detector)
    assert chosen
    assert {rung.features.detector for rung in chosen} == {detector}


@pytest.mark.parametrize("detector", ["auto", "orb", "sift"])
def test_more_effort_looks_in_all_the_ways_that_less_does(detector):
    fast, normal, most = ({rung.name for rung in rungs(effort, detector)} for effort in ("fast", "normal", "max"))
    assert fast <= normal <= most


@pytest.mark.parametrize("detector", ["auto", "orb", "sift"])
@pytest.mark.parametrize("effort", EFFORTS)
def test_the_first_rung_is_always_climbed_and_names_tell_rungs_apart(effort, detector):
    chosen = rungs(effort, detector)
    assert not chosen[0].on_a_hint
    assert len({rung.name for rung in chosen}) == len(chosen)


@pytest.mark.parametrize("detector", ["auto", "orb", "sift"])
def test_the_greatest_effort_waits_for_no_hint(detector):
    assert not any(rung.on_a_hint for rung in rungs("max", detector))


def test_auto_begins_with_the_cheapest():
    for effort in EFFORTS:
        assert rungs(effort, "auto")[0].features.detector == "orb"
    assert {rung.features.detector for rung in rungs("normal", "auto")} == {"orb", "sift"}


@pytest.mark.parametrize("effort", EFFORTS)
def test_only_sift_can_match_its_negative(effort):
    for rung in rungs(effort, "auto"):
        assert not rung.either_contrast or rung.features.detector == "sift"
