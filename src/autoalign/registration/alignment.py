"""The record of a pair: its options, every attempt with the evidence of every stage, and the verdict.

The viewer, the report, the sidecar and the command line all read this one record; nobody runs the pipeline twice.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any, Literal, get_args

from autoalign.errors import AlignmentError
from autoalign.geometry.family import ModelName
from autoalign.geometry.homography import Array, shown
from autoalign.geometry.least_squares import Correspondences
from autoalign.geometry.ransac import Consensus, RansacOptions
from autoalign.registration.features import Features
from autoalign.registration.ladder import Effort
from autoalign.registration.matching import Matches
from autoalign.registration.refine import Refinement, RefineOptions
from autoalign.registration.verdict import Chance, Evidence, Status, Verdict, VerdictOptions

if TYPE_CHECKING:
    from skimage.transform import ProjectiveTransform

ModelChoice = Literal["auto", "homography", "affine", "similarity", "rigid", "translation"]
DetectorChoice = Literal["auto", "orb", "sift"]


@dataclass(frozen=True, kw_only=True)
class AlignOptions:
    """What kind of transform, how hard to look, and the options of every stage."""

    model: ModelChoice = "auto"
    """kind of transform; auto takes the simplest that explains the pictures"""
    detector: DetectorChoice = "auto"
    """kind of keypoints; auto begins with orb and goes on with sift where the verdict is not clear"""
    effort: Effort = "normal"
    """how hard to look before a pair is given up; max also looks from all sides, which takes seconds"""
    mirror: bool = False
    """also try the moving picture mirrored, as a slide put in the wrong way round"""
    time_limit: float | None = None
    """seconds after which no harder attempt is begun; the result then depends on the machine"""
    ransac: RansacOptions = field(default_factory=RansacOptions)
    refine: RefineOptions = field(default_factory=RefineOptions)
    verdict: VerdictOptions = field(default_factory=VerdictOptions)

    def __post_init__(self) -> None:
        for name, choices in (("model", ModelChoice), ("detector", DetectorChoice), ("effort", Effort)):
            if getattr(self, name) not in get_args(choices):
                raise ValueError(f"{name} is one of {', '.join(get_args(choices))}, not {getattr(self, name)}")
        if self.time_limit is not None and not self.time_limit >= 0:
            raise ValueError(f"time_limit must be 0 or more, not {self.time_limit}")


@dataclass(frozen=True, kw_only=True)
class Attempt:
    """What one rung of the ladder found; None where a stage was not reached."""

    rung: str
    verdict: Verdict
    pairs: Correspondences  # the matches as points, src moving px, dst fixed px, best first
    fixed_features: Features | None = None
    moving_features: Features | None = None
    matches: Matches | None = None
    consensus: Consensus | None = None
    chance: Chance | None = None  # of the consensus
    refinement: Refinement | None = None  # None also where the attempt was set aside for one that found more
    model: ModelName | None = None
    fixed_from_moving: Array | None = None  # (3, 3) of unit norm: the refinement's, in its simplest model
    evidence: Evidence | None = None
    seconds: dict[str, float] = field(default_factory=dict)  # per stage

    def __repr__(self) -> str:
        return f"<Attempt {self.rung}, {self.verdict.status}: {self.verdict.reason}>"

    @property
    def log10_false_alarms(self) -> float:
        """How often random matches agree as well, as a logarithm; inf where none do."""
        return self.chance.log10_false_alarms if self.chance else float("inf")

    @property
    def is_set_aside(self) -> bool:
        """Whether its consensus was neither refined nor judged, because another attempt found more."""
        return self.consensus is not None and self.evidence is None


@dataclass(frozen=True, kw_only=True)
class Alignment:
    """The whole record of a pair: the verdict, the transform, and the evidence of every stage of every attempt."""

    fixed_size: tuple[int, int]  # (w, h)
    moving_size: tuple[int, int]
    options: AlignOptions
    attempts: tuple[Attempt, ...]  # in the order they were made
    best: Attempt  # the one that the verdict is about

    def __repr__(self) -> str:  # with all evidence it would be pages of numbers
        return f"<Alignment {self.status}: {self.reason}>"

    @property
    def verdict(self) -> Verdict:
        return self.best.verdict

    @property
    def status(self) -> Status:
        return self.best.verdict.status

    @property
    def reason(self) -> str:
        """One sentence with the numbers."""
        return self.best.verdict.reason

    @property
    def expected_error_px(self) -> float | None:
        """Mean error to expect over the overlap, px of the fixed picture; None if rejected or not known."""
        return self.best.verdict.expected_error_px

    @property
    def model(self) -> ModelName | None:
        return self.best.model

    @property
    def fixed_from_moving(self) -> Array:
        """(3, 3) scaled to [2, 2] == 1: takes points (x, y, 1) of moving to fixed. AlignmentError if rejected."""
        if self.status == "rejected" or self.best.fixed_from_moving is None:
            raise AlignmentError(f"rejected: {self.reason}")
        return shown(self.best.fixed_from_moving)

    @property
    def transform(self) -> ProjectiveTransform:
        """`fixed_from_moving` for those who live in scikit-image. AlignmentError if rejected."""
        from skimage.transform import ProjectiveTransform

        return ProjectiveTransform(self.fixed_from_moving)  # type: ignore[no-untyped-call]

    @property
    def matches(self) -> int:
        return len(self.best.pairs)

    @property
    def inliers(self) -> int:
        return self.best.consensus.count if self.best.consensus else 0

    @property
    def overlap(self) -> float:
        """Share of the fixed picture that is covered, 0 to 1."""
        return self.best.evidence.overlap if self.best.evidence else 0.0

    @property
    def seconds(self) -> dict[str, float]:
        """Time of every stage, over all attempts."""
        total: dict[str, float] = {}
        for attempt in self.attempts:
            for stage, spent in attempt.seconds.items():
                total[stage] = total.get(stage, 0.0) + spent
        return total

    def counts(self) -> dict[str, Any]:
        """What every stage of the best attempt found, in numbers."""
        best = self.best
        patches = best.refinement.patches if best.refinement else None
        return {
            "rung": best.rung,
            "attempts": len(self.attempts),
            "fixed_keypoints": len(best.fixed_features) if best.fixed_features else 0,
            "moving_keypoints": len(best.moving_features) if best.moving_features else 0,
            "matches": self.matches,
            "trials": best.consensus.trials if best.consensus else 0,
            "inliers": self.inliers,
            "patches": len(patches.kept) if patches else 0,
            "patches_kept": int(patches.kept.sum()) if patches else 0,
            "sharpened": bool(best.refinement and best.refinement.sharpened),
        }

    def evidence(self) -> dict[str, Any]:
        """The evidence of the verdict as plain numbers; empty where no transform was found."""
        return asdict(self.best.evidence) if self.best.evidence else {}
