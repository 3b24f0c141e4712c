"""Correspondences that a person typed -> Alignment, through the same solver."""

from __future__ import annotations

from numpy.typing import ArrayLike

from autoalign.geometry.family import MODELS, fit
from autoalign.geometry.homography import Array, as_points
from autoalign.geometry.least_squares import correspondences, polish
from autoalign.registration.alignment import Alignment, AlignOptions, Attempt
from autoalign.registration.verdict import Sizes, judge_typed, unfit_points

_RUNG = "typed points"


def align_points(
    fixed_points: ArrayLike,
    moving_points: ArrayLike,
    fixed_size: tuple[int, int],
    moving_size: tuple[int, int],
    options: AlignOptions | None = None,
) -> Alignment:
    """The alignment that typed correspondences (n, 2) give; sizes are (w, h). No pixel is looked at.

    A person's points are trusted: all of them are fitted, and the verdict is about how well they fit. `model="auto"`
    takes the most general model that so many points fix. Rejected where they do not fix it.
    Raises ValueError for points of a wrong shape.
    """
    options = options or AlignOptions()
    fixed_points, moving_points = as_points(fixed_points, "fixed_points"), as_points(moving_points, "moving_points")
    if len(fixed_points) != len(moving_points):
        raise ValueError(f"{len(fixed_points)} points in fixed, but {len(moving_points)} in moving")
    attempt = _typed(fixed_points, moving_points, Sizes(fixed=fixed_size, moving=moving_size), options)
    return Alignment(fixed_size=fixed_size, moving_size=moving_size, options=options, attempts=(attempt,), best=attempt)


def _typed(fixed_points: Array, moving_points: Array, sizes: Sizes, options: AlignOptions) -> Attempt:
    pairs = correspondences(src=moving_points, dst=fixed_points)
    enough = [name for name, model in MODELS.items() if 0 < model.sample_size <= len(pairs)]
    model = options.model if options.model != "auto" else (enough or ["translation"])[-1]
    try:
        transform = polish(MODELS[model], fit(model, pairs.src, pairs.dst), pairs, sigma_floor=1.0)
    except ValueError as unfit:
        return Attempt(rung=_RUNG, pairs=pairs, verdict=unfit_points(str(unfit)))
    verdict = judge_typed(model, transform, pairs, options.verdict, sizes)
    return Attempt(rung=_RUNG, pairs=pairs, model=model, fixed_from_moving=transform, verdict=verdict)
