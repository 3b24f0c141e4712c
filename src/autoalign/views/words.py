"""An Alignment in words: the verdict first, then what it rests on, as Markdown for whoever shows it."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from autoalign.files.row import RowStatus
from autoalign.geometry.family import MODELS
from autoalign.geometry.homography import Array, shown
from autoalign.registration.alignment import Alignment, Attempt
from autoalign.registration.verdict import Evidence, Sizes, Status, VerdictOptions, expected_error, judge
from autoalign.views.motion import Motion, motion

Mark = Literal["✓", "⚠", "✗", "!"]
MARK_OF: dict[RowStatus, Mark] = {"aligned": "✓", "doubtful": "⚠", "rejected": "✗", "failed": "!"}

# Options under which any evidence passes: with one group of the real ones put back, `judge` tells what that group says.
_LENIENT = VerdictOptions(
    max_log10_false_alarms=math.inf,
    sure_log10_false_alarms=math.inf,
    min_agreement=0.0,
    sure_agreement=0.0,
    max_expected_error_px=math.inf,
    max_expected_error_share=math.inf,
    max_stretch=math.inf,
    max_anisotropy=math.inf,
    min_overlap=0.0,
)


_HOW_TO_LOOK = """\
## How to look

- **Overlay**: drag the time bar, or press play: `fade` crosses over, `blink` flickers. The frame is the moving picture.
- **Matches**: green to orange by residual; dark red ones were not used.
- **Checkerboard**: the bluish squares are the moving picture.
- **Green/magenta**: fixed in green, moving in magenta, grey where they agree."""


@dataclass(frozen=True, kw_only=True)
class Check:
    """One thing that was asked of the evidence, and how it answered."""

    name: str
    status: Status  # what the verdict would be if this alone counted
    found: str
    needed: str


@dataclass(frozen=True, kw_only=True)
class _Question:
    """A group of the verdict's options that ask one thing, and its words."""

    name: str
    options: tuple[str, ...]
    found: Callable[[Evidence], str]
    needed: Callable[[VerdictOptions], str]


_QUESTIONS = (
    _Question(
        name="not by chance",
        options=("max_log10_false_alarms", "sure_log10_false_alarms"),
        found=lambda evidence: power(evidence.log10_false_alarms),
        needed=lambda options: f"≤ {power(options.max_log10_false_alarms)}",
    ),
    _Question(
        name="a camera can see it",
        options=("max_stretch", "max_anisotropy"),
        found=lambda evidence: f"× {number(evidence.stretch[0])} to {number(evidence.stretch[1])}",
        needed=lambda options: f"× 1/{options.max_stretch:g} to {options.max_stretch:g}",
    ),
    _Question(
        name="pictures overlap",
        options=("min_overlap",),
        found=lambda evidence: f"{evidence.overlap:.0%} of fixed",
        needed=lambda options: f"≥ {options.min_overlap:.0%}",
    ),
    _Question(
        name="pixels agree",
        options=("min_agreement", "sure_agreement"),
        found=lambda evidence: f"{min(evidence.agreement.share, evidence.agreement.core):.0%} of blocks",
        needed=lambda options: f"≥ {options.sure_agreement:.0%}",
    ),
    _Question(
        name="fit is precise",
        options=("max_expected_error_px", "max_expected_error_share"),
        found=lambda evidence: f"{number(expected_error(evidence))} px",
        needed=lambda options: f"≤ {options.max_expected_error_px:g} px or {options.max_expected_error_share:.1%}",
    ),
)


def checks(alignment: Alignment, attempt: Attempt | None = None) -> tuple[Check, ...]:
    """Every question that the verdict asks, each judged alone; where no transform was found, that one thing is missing,
    and about typed points nothing is asked.

    About the best attempt, unless another one of the alignment's is given.
    """
    attempt = attempt or alignment.best
    evidence, options = attempt.evidence, alignment.options.verdict
    if evidence is None:
        return () if attempt.fixed_features is None else (_consensus_check(alignment, attempt),)
    sizes = Sizes(fixed=alignment.fixed_size, moving=alignment.moving_size)
    return tuple(
        Check(
            name=question.name,
            status=judge(
                evidence, replace(_LENIENT, **{name: getattr(options, name) for name in question.options}), sizes
            ).status,
            found=question.found(evidence),
            needed=question.needed(options),
        )
        for question in _QUESTIONS
    )


def _consensus_check(alignment: Alignment, attempt: Attempt) -> Check:
    """What is missing where no transform was found; a sample of matches fixes one, so that more than it must agree."""
    model = alignment.options.model
    sample = MODELS["homography" if model == "auto" else model].sample_size
    return Check(
        name="matches agree",
        status="rejected",
        found=f"none of {len(attempt.pairs):,}",
        needed=f"> {sample} on one transform",
    )


def report(
    alignment: Alignment,
    names: tuple[str, str] = ("fixed", "moving"),
    notes: Iterable[str] = (),
    *,
    timings: bool = False,
) -> str:
    """The whole record in Markdown. `names` of the fixed and the moving picture may hold anything; `notes` are
    sentences about how the pictures are shown. Without `timings` the same pair gives the same text."""
    parts = [
        _headline(alignment),
        _evidence(alignment),
        _transform(alignment),
        _stages(alignment),
        _climb(alignment),
        _HOW_TO_LOOK if alignment.best.fixed_from_moving is not None else "",
        _pictures(alignment, names, notes),
        _times(alignment) if timings else "",
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def found_by(attempt: Attempt) -> str:
    """What a rung came to, in a few words."""
    if attempt.consensus is None:
        return f"{len(attempt.pairs):,} matches, no consensus"
    return f"{attempt.consensus.count:,} of {len(attempt.pairs):,} matches agree"


def outcome(attempt: Attempt) -> str:
    """The verdict on a rung, if it was looked into."""
    return "set aside" if attempt.is_set_aside else f"{MARK_OF[attempt.verdict.status]} {attempt.verdict.status}"


def plain(name: str) -> str:
    """A file's name as text that any program takes: bytes that are no UTF-8, and control characters, become marks."""
    text = name.encode("utf-8", "surrogateescape").decode("utf-8", "replace")
    return "".join(letter if letter.isprintable() else "\N{REPLACEMENT CHARACTER}" for letter in text)


def literal(text: str) -> str:
    """Text that Markdown shows as it is."""
    return re.sub(r"([\\`*_{}\[\]()<>#+!|~$&-])", r"\\\1", plain(text))


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def number(value: float) -> str:
    """Three digits, as people read them."""
    return "∞" if math.isinf(value) else f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


def counted(count: int, thing: str) -> str:
    """So many things, of which one is no plural: "1 pair", "2,000 pairs"."""
    return f"{count:,} {thing}{'' if count == 1 else 's'}"


def moved(by: Motion) -> str:
    """What a transform does, but for the shift."""
    mirrored = "mirrored, " if by.mirrored else ""
    scale = number(by.scale)
    size = "of the same size" if scale == "1" else f"{scale} times as large"
    return f"{mirrored}turned by {math.degrees(by.turn_rad):z.1f}°, {size}"


def power(log10: float) -> str:
    """A probability by its logarithm; one that is not below 1 is no surprise."""
    return f"10^{log10:.0f}" if log10 < 0 else "1 (certain)"


def _headline(alignment: Alignment) -> str:
    verdict, error = alignment.verdict, alignment.expected_error_px
    lines = [f"# {MARK_OF[verdict.status]} {verdict.status}"]
    if error is not None:
        doubt = ", if it is right at all" if verdict.status == "doubtful" else ""
        lines.append(f"**Expected error {number(error)} px** of the fixed picture{doubt}.")
    lines.append(f"{literal(verdict.reason[:1].upper() + verdict.reason[1:])}.")
    if verdict.advice:
        lines.append(f"→ *What may help: {literal(verdict.advice)}.*")
    return "\n\n".join(lines)


def _evidence(alignment: Alignment) -> str:
    rows = [
        (f"{MARK_OF[check.status]} {check.name}", _strong_if(check.status != "aligned", check.found), check.needed)
        for check in checks(alignment)
    ]
    return table(("evidence", "found", "needed"), rows) if rows else ""


def _strong_if(strong: bool, text: str) -> str:
    return f"**{text}**" if strong else text


def _transform(alignment: Alignment) -> str:
    transform = alignment.best.fixed_from_moving
    if transform is None:
        return (
            "## No transform\n\nThere is nothing to lay over: the pictures are shown side by side, with what was found."
        )
    refused = "## The transform that was refused" if alignment.status == "rejected" else "## Moving → fixed"
    rows = [[f"{value:.6g}" for value in row] for row in _of_any_scale(transform)]
    words = moved(motion(transform, alignment.moving_size))
    return f"{refused}\n\n{alignment.model}: {words}\n\n{table(('x', 'y', '1'), rows)}"


def _of_any_scale(transform: Array) -> Array:
    try:
        return shown(transform)
    except ValueError:  # the origin lies at infinity: shown as it is
        return transform


def _stages(alignment: Alignment) -> str:
    best, counts = alignment.best, alignment.counts()
    rows = []
    if best.fixed_features is not None:
        rows.append(("keypoints", f"{counts['fixed_keypoints']:,} and {counts['moving_keypoints']:,}"))
    rows.append(("matches", f"{counts['matches']:,}"))
    if best.fixed_features is not None:
        rows.append(("agree", f"{counts['inliers']:,}" if best.consensus else "**no consensus**"))
    if counts["patches"]:
        used = "sharpened it" if counts["sharpened"] else "did not prove better"
        rows.append(("patches", f"{counts['patches_kept']:,} of {counts['patches']:,} {used}"))
    return f"## What was found\n\n{table(('stage', 'count'), rows)}"


def _climb(alignment: Alignment) -> str:
    if len(alignment.attempts) < 2:
        return ""
    rows = [
        (
            _strong_if(attempt is alignment.best, f"{step}. {attempt.rung}"),
            outcome(attempt),
            f"{attempt.consensus.count if attempt.consensus else 0:,} of {len(attempt.pairs):,}",
        )
        for step, attempt in enumerate(alignment.attempts, 1)
    ]
    return f"## What was tried\n\n{table(('effort', 'verdict', 'agree'), rows)}"


def _pictures(alignment: Alignment, names: tuple[str, str], notes: Iterable[str]) -> str:
    rows = [
        (role, literal(name), f"{w:,} × {h:,}")
        for role, name, (w, h) in zip(
            ("fixed", "moving"), names, (alignment.fixed_size, alignment.moving_size), strict=True
        )
    ]
    return "\n\n".join(
        ["## The pictures", table(("", "name", "pixels"), rows), *(f"⚠ {literal(note)}" for note in notes)]
    )


def _times(alignment: Alignment) -> str:
    rows = [(stage, f"{seconds:.2f}") for stage, seconds in alignment.seconds.items()]
    return f"## Time\n\n{table(('stage', 'seconds'), rows)}"
