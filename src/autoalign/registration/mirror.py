"""An attempt on a mirrored moving picture, told in the pixels of the picture as it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from autoalign.geometry.homography import Array, unit
from autoalign.geometry.least_squares import Correspondences
from autoalign.registration.alignment import Attempt
from autoalign.registration.features import Features
from autoalign.registration.refine import Patches, Refinement


def unmirrored(attempt: Attempt, moving_size: tuple[int, int]) -> Attempt:
    """The attempt with everything that lies on the moving picture (w, h) put back from its mirror image."""
    mirrored_from_moving = np.array([[-1.0, 0.0, moving_size[0] - 1.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])

    def points(of: Array) -> Array:
        return np.stack([moving_size[0] - 1.0 - of[:, 0], of[:, 1]], axis=1)

    def pairs(of: Correspondences) -> Correspondences:
        return replace(of, src=points(of.src))

    def features(of: Features) -> Features:
        return replace(of, points=points(of.points), angles=np.pi - of.angles)

    def transform(of: Array) -> Array:
        return unit(of @ mirrored_from_moving)

    def patches(of: Patches) -> Patches:
        return replace(of, pairs=pairs(of.pairs))

    def refinement(of: Refinement) -> Refinement:
        return replace(
            of,
            fixed_from_moving=transform(of.fixed_from_moving),
            pairs=pairs(of.pairs),
            patches=of.patches and patches(of.patches),
        )

    found = attempt.consensus
    return replace(
        attempt,
        rung=f"{attempt.rung}, mirrored",
        pairs=pairs(attempt.pairs),
        moving_features=attempt.moving_features and features(attempt.moving_features),
        consensus=found and replace(found, dst_from_src=transform(found.dst_from_src)),
        refinement=attempt.refinement and refinement(attempt.refinement),
        fixed_from_moving=None if attempt.fixed_from_moving is None else transform(attempt.fixed_from_moving),
    )
