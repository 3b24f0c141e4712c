"""An attempt told in other pixels than those it was made in: of the picture unmirrored, or of the full one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from autoalign.geometry.homography import Array, apply, invert, unit
from autoalign.geometry.least_squares import Correspondences
from autoalign.registration.alignment import Attempt
from autoalign.registration.features import Features
from autoalign.registration.refine import Patches, Refinement


def in_pixels_of(attempt: Attempt, fixed_from_own: Array, moving_from_own: Array) -> Attempt:
    """The attempt with all that lies on the pictures, and the transforms between them, mapped by two (3, 3) maps.

    These are similarities, with or without a mirror image. The verdict and its evidence stay as they are.
    """
    fixed_px, moving_px = (float(abs(np.linalg.det(of[:2, :2])) ** 0.5) for of in (fixed_from_own, moving_from_own))

    def pairs(of: Correspondences) -> Correspondences:
        return Correspondences(
            src=apply(moving_from_own, of.src),
            dst=apply(fixed_from_own, of.dst),
            src_sigma=of.src_sigma * moving_px,
            dst_sigma=of.dst_sigma * fixed_px,
            support_px=of.support_px * fixed_px,
        )

    def transform(of: Array) -> Array:
        return unit(fixed_from_own @ of @ invert(moving_from_own))

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
        pairs=pairs(attempt.pairs),
        fixed_features=attempt.fixed_features and _features(attempt.fixed_features, fixed_from_own, fixed_px),
        moving_features=attempt.moving_features and _features(attempt.moving_features, moving_from_own, moving_px),
        consensus=found and replace(found, dst_from_src=transform(found.dst_from_src)),
        refinement=attempt.refinement and refinement(attempt.refinement),
        fixed_from_moving=None if attempt.fixed_from_moving is None else transform(attempt.fixed_from_moving),
    )


def unmirrored(attempt: Attempt, moving_size: tuple[int, int]) -> Attempt:
    """An attempt on a moving picture of `moving_size` (w, h) that was mirrored, told of the picture as it is."""
    moving_from_mirrored = np.array([[-1.0, 0.0, moving_size[0] - 1.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    told = in_pixels_of(attempt, np.eye(3), moving_from_mirrored)
    return replace(told, rung=f"{attempt.rung}, mirrored")


def _features(found: Features, picture_from_own: Array, pixel: float) -> Features:
    directions = np.stack([np.cos(found.angles), np.sin(found.angles)]) if len(found) else np.zeros((2, 0))
    x, y = picture_from_own[:2, :2] @ directions
    return replace(
        found,
        points=apply(picture_from_own, found.points),
        sizes=found.sizes * pixel,
        angles=np.arctan2(y, x),
        sigmas=found.sigmas * pixel,
    )
