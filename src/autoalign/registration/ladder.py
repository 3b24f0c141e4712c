"""The rungs of effort, as data: cheap first, harder only while the verdict is not clear."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, get_args

from autoalign.registration.features import Detector, FeatureOptions
from autoalign.registration.matching import MatchOptions

Effort = Literal["fast", "normal", "max"]
EFFORTS: tuple[Effort, ...] = get_args(Effort)


@dataclass(frozen=True, kw_only=True)
class Rung:
    """One way to look for correspondences."""

    name: str
    features: FeatureOptions
    matching: MatchOptions
    enough_px: float = float("inf")  # an aligned pair with a greater expected error climbs on,
    enough_log10: float = float("inf")  # and one whose consensus is thinner, in log10 of false alarms
    on_a_hint: bool = False  # climbed only after a consensus that is not quite chance
    either_contrast: bool = False  # a keypoint may match its own negative


_ORB = Rung(
    name="orb at 0.6 MP",
    features=FeatureOptions(detector="orb", working_pixels=0.6e6, max_features=3000),
    matching=MatchOptions(ratio=0.85),
    enough_px=1.5,
    enough_log10=-150.0,
)
_SIFT = Rung(
    name="sift at 1 MP",
    features=FeatureOptions(detector="sift", working_pixels=1e6, max_features=4000),
    matching=MatchOptions(ratio=0.9),
    enough_log10=-150.0,
)
_MORE_SIFT = Rung(
    name="sift at 2 MP, faint keypoints too",
    features=FeatureOptions(detector="sift", working_pixels=2e6, max_features=8000, contrast=0.005),
    matching=MatchOptions(ratio=0.95),
    on_a_hint=True,
)
_VIEWS = Rung(
    name="sift from all sides",
    features=FeatureOptions(detector="sift", working_pixels=0.5e6, max_features=1500, tilts=(2.0, 4.0)),
    matching=MatchOptions(ratio=0.9),
    on_a_hint=True,
)
_OTHER_LIGHT = Rung(
    name="sift in other light, either contrast",
    features=FeatureOptions(detector="sift", working_pixels=0.5e6, max_features=4000, contrast=0.01, equalise=True),
    matching=MatchOptions(ratio=0.95),
    on_a_hint=True,
    either_contrast=True,
)
_MORE_ORB = Rung(
    name="orb at 2 MP",
    features=FeatureOptions(detector="orb", working_pixels=2e6, max_features=8000),
    matching=MatchOptions(ratio=0.9),
)

LADDER: dict[Effort, tuple[Rung, ...]] = {
    "fast": (_ORB,),
    "normal": (_ORB, _SIFT, _VIEWS, _MORE_SIFT, _OTHER_LIGHT),
    "max": tuple(replace(rung, on_a_hint=False) for rung in (_ORB, _SIFT, _VIEWS, _MORE_SIFT, _OTHER_LIGHT)),
}
_ONLY_ORB: dict[Effort, tuple[Rung, ...]] = {"fast": (_ORB,), "normal": (_ORB, _MORE_ORB), "max": (_ORB, _MORE_ORB)}


def rungs(effort: Effort, detector: Detector | Literal["auto"]) -> tuple[Rung, ...]:
    """The rungs to climb, in order; with one detector, those that use it."""
    if detector == "orb":
        return _ONLY_ORB[effort]
    if detector == "sift":
        return tuple(r for r in LADDER[effort] if r.features.detector == "sift") or (_SIFT,)
    return LADDER[effort]
