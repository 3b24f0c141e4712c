"""Which model of the family explains the correspondences: the simplest that fits no worse than chance allows.

Source: Schwarz 1978 (BIC), with a robust error, in the spirit of Torr's GRIC (1998). The scale of the noise is taken
from the most general model.
"""

from __future__ import annotations

import numpy as np

from autoalign.geometry.family import MODELS, Model, ModelName, fit
from autoalign.geometry.homography import Array, project, symmetric_transfer_error_squared
from autoalign.geometry.least_squares import Correspondences, polish, robust_scale

_CLIP_SIGMAS = 4.0


def simplest_model(general: ModelName, dst_from_src: Array, pairs: Correspondences) -> tuple[ModelName, Array]:
    """The model of least BIC among `general` and those inside it, and its transform (3, 3) fitted to `pairs`.

    `dst_from_src` is the fitted transform of the general model.
    """
    sigma, times_seen = robust_scale(_errors(dst_from_src, pairs), 0.01), pairs.times_seen()
    there, _ = project(dst_from_src, pairs.src)  # where no wrong pair leads the start astray

    def criterion(model: Model, transform: Array) -> float:
        misfit = np.minimum(_errors(transform, pairs) / sigma**2, _CLIP_SIGMAS**2).sum() / times_seen
        return float(misfit + model.degrees_of_freedom * np.log(2 * len(pairs) / times_seen))

    hopeless = 0.5 * _CLIP_SIGMAS**2 * len(pairs) / times_seen  # half of the pairs denied, where only a few may be
    best, chosen = criterion(MODELS[general], dst_from_src), (general, dst_from_src)
    for model in MODELS.values():
        if model.name == general:
            break
        transform = fit(model.name, pairs.src, there)
        if criterion(model, transform) > hopeless:
            continue
        transform = polish(model, transform, pairs, sigma_floor=sigma)
        value = criterion(model, transform)
        if value < best:
            best, chosen = value, (model.name, transform)
    return chosen


def _errors(transform: Array, pairs: Correspondences) -> Array:
    return symmetric_transfer_error_squared(transform, pairs.src, pairs.dst, pairs.src_sigma, pairs.dst_sigma)
