"""A sequence of pictures -> one transform each onto the reference: the pairs to align, and the network of them solved.

Links go from neighbour to neighbour, over spans of 2, 4, 8, ... frames, and from every frame straight onto the
reference. Chained neighbours alone drift; the long links hold them where the pictures still overlap, and where they do
not, they are rejected and the shorter ones carry on.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from autoalign.geometry.family import MODEL_NAMES, MODELS, Model, ModelName
from autoalign.geometry.graph import Indices, cheapest_tree, groups, hanging_in_dispute
from autoalign.geometry.homography import IDENTITY, Array, Mask, normalisation, shown
from autoalign.geometry.least_squares import polish
from autoalign.geometry.network import Adjustment, Ties, adjust_in_simplest
from autoalign.geometry.uncertainty import overlap_points, point_errors, uncertainty
from autoalign.registration.alignment import Alignment
from autoalign.registration.verdict import Status, VerdictOptions, error_limit

Rows = tuple[tuple[float, ...], ...]


@dataclass(frozen=True, kw_only=True)
class Link:
    """What is kept of an aligned pair of frames: plain numbers, under 3 kB as JSON; lists serve in place of tuples."""

    fixed: int  # number of the frame, from 0
    moving: int
    status: Status
    model: ModelName | None = None  # None, as all that follows, if rejected
    fixed_from_moving: Rows | None = None  # (3, 3), the homography, whatever the model
    norm: Rows | None = None  # (3, 3) of the moving plane, as in Uncertainty
    covariance: Rows | None = None  # (8, 8) along the generators of the homography, in the frame of `norm`
    expected_error_px: float | None = None


@dataclass(frozen=True, kw_only=True)
class SequenceOptions:
    """How links become transforms."""

    link_threshold: float = 3.0
    """standard deviations, as links claim or as they show where these are larger, off by which a link is overruled"""

    def __post_init__(self) -> None:
        if self.link_threshold <= 0:
            raise ValueError(f"SequenceOptions out of range: {self}")


@dataclass(frozen=True, kw_only=True)
class SequenceFrame:
    """One frame and what the whole sequence says of it."""

    status: Status
    reason: str  # one sentence
    model: ModelName
    reference_from_frame: Array | None  # (3, 3), [2, 2] == 1; None if rejected
    expected_error_px: float | None  # mean over the frame, px of the reference; None if rejected
    used: tuple[tuple[int, int], ...]  # (fixed, moving) of its links that agree
    overruled: tuple[tuple[int, int], ...]  # and of those that do not


def links(n: int, reference: int) -> list[tuple[int, int]]:
    """(fixed, moving) of the pairs to align, about 3 n: neighbours, wider spans, and all straight onto the reference.

    The one nearer to the reference is the fixed one. Spans of 2, 4, 8, ... follow each other without a gap, so any two
    frames are joined by a few links. Raises ValueError for a reference that is not among the n frames.
    """
    _check(n, reference)
    pairs = {}
    for side, reach in ((1, n - 1 - reference), (-1, reference)):
        for span in (2**k for k in range(reach.bit_length())):
            for start in range(0, reach - span + 1, span):
                pairs[reference + side * start, reference + side * (start + span)] = span
    straight = [(reference, frame) for frame in range(n) if frame != reference]
    return [*sorted(pairs, key=lambda pair: (pairs[pair], pair)), *(pair for pair in straight if pair not in pairs)]


def link_of(alignment: Alignment, fixed: int, moving: int) -> Link:
    """What a sequence needs of the alignment of two of its frames.

    The homography is fitted to all the evidence, whatever model explains this pair: its covariance says how little
    that is, and the sequence decides on one model for all. The covariance is that of the fit, scaled to the error that
    the verdict expects, which also knows of what the model cannot follow.
    """
    best = alignment.best
    if alignment.status == "rejected" or best.refinement is None or best.evidence is None or best.model is None:
        return Link(fixed=fixed, moving=moving, status="rejected")
    pairs, homography = best.refinement.pairs, MODELS["homography"]
    transform = polish(homography, alignment.fixed_from_moving, pairs, sigma_floor=0.02)
    known = uncertainty(homography, transform, pairs)
    error_px = float(alignment.expected_error_px or 0.0)
    inflation = max(error_px / max(best.evidence.fit_px, 1e-6), 1.0)
    return Link(
        fixed=fixed,
        moving=moving,
        status=alignment.status,
        model=best.model,
        fixed_from_moving=_rows(transform),
        norm=_rows(known.norm),
        covariance=_rows(inflation**2 * known.covariance),
        expected_error_px=error_px,
    )


def _rows(matrix: Array) -> Rows:
    return tuple(tuple(row) for row in matrix.tolist())


def solve_sequence(
    n: int,
    reference: int,
    links: Sequence[Link],
    sizes: Sequence[tuple[int, int]],
    options: SequenceOptions | None = None,
    verdict: VerdictOptions | None = None,
) -> tuple[SequenceFrame, ...]:
    """Every frame's transform onto the reference, from the links between them, whose order does not matter.

    `sizes` are (w, h) of the n frames. The frames move in the simplest model that all links agree on. Aligned are
    frames that aligned links hold to the reference; those that hang on a doubtful link are doubtful, and so are those
    that hang on one link alone where another contradicts it, and those whose expected error is over what `verdict`
    allows a pair. Raises ValueError for frames that are not there.
    """
    options, verdict = options or SequenceOptions(), verdict or VerdictOptions()
    _check(n, reference)
    if len(sizes) != n:
        raise ValueError(f"{len(sizes)} sizes for {n} frames")
    if any(not 0 <= frame < n for link in links for frame in (link.fixed, link.moving)):
        raise ValueError(f"a link names a frame that is not among the {n}")
    chosen = _needed(n, sorted(links, key=lambda link: (link.fixed, link.moving)))
    model, adjusted = adjust_in_simplest(
        _models(chosen), reference, _norms(sizes), _ties(chosen), threshold=options.link_threshold
    )
    standing = _standing(n, reference, chosen, adjusted)
    tried = Counter(frame for link in links for frame in (link.fixed, link.moving))
    return tuple(
        _frame(frame, tried[frame], model, adjusted, standing, (sizes[frame], sizes[reference]), verdict)
        for frame in range(n)
    )


def _check(n: int, reference: int) -> None:
    if not 0 <= reference < n:
        raise ValueError(f"frame {reference} cannot be the reference of {n} frames")


def _needed(n: int, links: Sequence[Link]) -> list[Link]:
    """The aligned links, and those doubtful ones whose frames hang together by no aligned ones."""
    aligned = [link for link in links if link.status == "aligned"]
    group = groups(n, *_ends(aligned))
    return aligned + [link for link in links if link.status == "doubtful" and group[link.fixed] != group[link.moving]]


def _models(links: Sequence[Link]) -> list[Model]:
    """Those of the links, and those between them, from simple to general."""
    found = sorted(MODEL_NAMES.index(link.model) for link in links if link.model) or [MODEL_NAMES.index("translation")]
    return [MODELS[name] for name in MODEL_NAMES[found[0] : found[-1] + 1]]


def _ends(links: Sequence[Link]) -> tuple[Indices, Indices]:
    return np.array([link.fixed for link in links], np.int64), np.array([link.moving for link in links], np.int64)


def _norms(sizes: Sequence[tuple[int, int]]) -> Array:
    """(n, 3, 3) that bring the points of each frame to mean 0 and a spread of about 1."""
    return np.stack([normalisation(overlap_points(IDENTITY, size, size)) for size in sizes])


def _ties(links: Sequence[Link]) -> Ties:
    fixed, moving = _ends(links)
    return Ties(
        fixed=fixed,
        moving=moving,
        fixed_from_moving=np.array([link.fixed_from_moving for link in links], np.float64).reshape(-1, 3, 3),
        norm=np.array([link.norm for link in links], np.float64).reshape(-1, 3, 3),
        covariance=np.array([link.covariance for link in links], np.float64).reshape(-1, 8, 8),
        error_px=np.array([link.expected_error_px for link in links], np.float64),
    )


@dataclass(frozen=True, kw_only=True)
class _Standing:
    """How the frames hang on the reference, by the links that were not overruled."""

    held: Mask  # (n,)
    doubtful: Mask  # (n,) by a doubtful link
    disputed: Mask  # (n,) by one link alone, which another contradicts
    used: list[list[tuple[int, int]]]  # of each frame
    overruled: list[list[tuple[int, int]]]


def _standing(n: int, reference: int, links: Sequence[Link], adjusted: Adjustment) -> _Standing:
    kept = [link for link, agrees in zip(links, adjusted.kept, strict=True) if agrees]
    overruled = [link for link, agrees in zip(links, adjusted.kept, strict=True) if not agrees]
    unsure = np.array([link.status == "doubtful" for link in kept], np.bool_)
    # A way without a doubtful link is better than any way with one.
    tree = cheapest_tree(n, reference, *_ends(kept), np.where(unsure, 2.0 * n, 1.0))
    doubtful = np.zeros(n, np.bool_)
    for frame in tree.order[1:]:
        doubtful[frame] = doubtful[tree.parent[frame]] or unsure[tree.edge[frame]]
    return _Standing(
        held=tree.reached,
        doubtful=doubtful,
        disputed=hanging_in_dispute(tree, *_ends(kept), *_ends(overruled)),
        used=_of_frames(n, kept),
        overruled=_of_frames(n, overruled),
    )


def _of_frames(n: int, links: Sequence[Link]) -> list[list[tuple[int, int]]]:
    found: list[list[tuple[int, int]]] = [[] for _ in range(n)]
    for link in links:
        for frame in (link.fixed, link.moving):
            found[frame].append((link.fixed, link.moving))
    return found


def _frame(
    frame: int,
    tried: int,
    model: Model,
    adjusted: Adjustment,
    standing: _Standing,
    sizes: tuple[tuple[int, int], tuple[int, int]],
    options: VerdictOptions,
) -> SequenceFrame:
    """The verdict on one frame; `sizes` are its own and the reference's."""
    transform, (own_size, reference_size) = adjusted.reference_from_frame[frame], sizes
    everywhere = overlap_points(IDENTITY, own_size, own_size)
    error_px = float(point_errors(model, transform, adjusted.known(frame), everywhere).mean())
    status, reason = _verdict(frame, tried, standing, error_px, error_limit(options, reference_size))
    rejected = status == "rejected"
    return SequenceFrame(
        status=status,
        reason=reason,
        model=model.name,
        reference_from_frame=None if rejected else shown(transform),
        expected_error_px=None if rejected else error_px,
        used=tuple(standing.used[frame]),
        overruled=tuple(standing.overruled[frame]),
    )


def _verdict(frame: int, tried: int, standing: _Standing, error_px: float, limit_px: float) -> tuple[Status, str]:
    used, overruled = len(standing.used[frame]), len(standing.overruled[frame])
    agree = f"{used} of {tried} links agree" + (f", {overruled} overruled" if overruled else "")
    if not standing.held[frame]:
        return "rejected", f"not connected to the reference: {agree}"
    if standing.disputed[frame]:
        return "doubtful", f"{agree}; one link alone holds it to the reference, and another contradicts that one"
    if standing.doubtful[frame]:
        return "doubtful", f"{agree}; a doubtful link is all that holds it to the reference"
    if error_px > limit_px:
        return "doubtful", f"{agree}, but they leave its transform open to {error_px:.1f} px"
    return "aligned", agree
