"""A sequence as a batch: first the links between its frames, then every frame where all links together put it."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from autoalign.batch.engine import Engine
from autoalign.batch.jobs import Job, key, readable
from autoalign.batch.ledger import Ledger
from autoalign.batch.work import Task
from autoalign.errors import ImageReadError
from autoalign.files.ready import align_both
from autoalign.registration.drawing import Drawing
from autoalign.registration.sequence import Link, link_of, links, solve_sequence


@dataclass(frozen=True, kw_only=True)
class Linked:
    """What is known of a pair of frames, whose numbers count from 0."""

    link: Link
    fixed_size: tuple[int, int] | None = None  # (w, h); None where a frame could not be read
    moving_size: tuple[int, int] | None = None


@dataclass(frozen=True, kw_only=True)
class _Pair:
    """A pair of frames as it goes to a worker."""

    task: Task
    fixed: int
    moving: int


def link_up(frames: Sequence[Job], reference: int, ledger: Ledger, engine: Engine, store: Path) -> Iterator[Linked]:
    """The links that hold a sequence together, as they come, those first that the ledger knows from an earlier time.

    Each of the `frames` is a job with the frame as its moving picture.
    """
    new = []
    for fixed, moving in links(len(frames), reference):
        pair = _Pair(task=_task(frames, fixed, moving, ledger, store), fixed=fixed, moving=moving)
        text = ledger.link(pair.task.key)
        if text is None:
            new.append(pair)
        else:
            yield _from_text(text, pair)
    for outcome in engine.run(_link, new):
        text = outcome.result or _as_text(_unlinked(outcome.job))  # a pair that was its worker's end links nothing
        if outcome.casualty is None:
            ledger.keep_link(outcome.job.task.key, text)
        yield _from_text(text, outcome.job)


def place(frames: Sequence[Job], reference: int, linked: Sequence[Linked]) -> list[Job]:
    """The frames with the places that all links together give them.

    A frame of which no size is known, because it cannot be read, counts as large as the reference: it is rejected here,
    and fails when it is to be drawn.
    """
    known: dict[int, tuple[int, int]] = {}
    for one in linked:
        for frame, size in ((one.link.fixed, one.fixed_size), (one.link.moving, one.moving_size)):
            if size is not None:
                known[frame] = size
    sizes = [known.get(frame, known.get(reference, (1, 1))) for frame in range(len(frames))]
    verdict = frames[reference].options.align.verdict
    solved = solve_sequence(len(frames), reference, [one.link for one in linked], sizes, verdict=verdict)
    return [replace(job, placed=frame) for job, frame in zip(frames, solved, strict=True)]


def _task(frames: Sequence[Job], fixed: int, moving: int, ledger: Ledger, store: Path) -> Task:
    """The job of aligning two frames, without how they are drawn and kept, which has no part in where they go."""
    job = replace(
        frames[moving],
        fixed=frames[fixed].moving,
        fixed_mask=frames[fixed].moving_mask,
        options=replace(frames[moving].options, drawing=Drawing(), fixed_page=frames[moving].options.moving_page),
        upload=None,
    )
    return Task(job=job, key=key(job, readable(ledger.hash_of)), store=str(store), again=frozenset(job.inputs))


def _link(pair: _Pair) -> str:
    """Align two frames, and write nothing; frames that cannot be read are not linked."""
    try:
        with pair.task.opened() as both:
            alignment = align_both(both, pair.task.job.options.align)
    except (ImageReadError, ValueError):
        return _as_text(_unlinked(pair))
    link = link_of(alignment, pair.fixed, pair.moving)
    return _as_text(Linked(link=link, fixed_size=alignment.fixed_size, moving_size=alignment.moving_size))


def _unlinked(pair: _Pair) -> Linked:
    return Linked(link=Link(fixed=pair.fixed, moving=pair.moving, status="rejected"))


def _as_text(linked: Linked) -> str:
    return json.dumps(asdict(linked))


def _from_text(text: str, pair: _Pair) -> Linked:
    """As kept, but for the numbers of the frames: the same pictures may have had others."""
    found = json.loads(text)
    link = Link(**(found.pop("link") | {"fixed": pair.fixed, "moving": pair.moving}))
    return Linked(link=link, **{name: size and tuple(size) for name, size in found.items()})
