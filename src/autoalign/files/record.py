"""An Alignment and the two files it came from -> the Sidecar that is kept of it."""

from __future__ import annotations

import math
import platform
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import cv2
import numpy as np

from autoalign import __version__
from autoalign.files.large import AnyPicture
from autoalign.files.sidecar import PictureRecord, Sidecar, as_shown
from autoalign.picture.pixels import size_of
from autoalign.registration.alignment import Alignment, AlignOptions
from autoalign.registration.sequence import SequenceFrame


def record(
    alignment: Alignment,
    fixed: AnyPicture,
    moving: AnyPicture,
    *,
    drawn: Mapping[str, Any] | None = None,
    timings: bool = False,
) -> Sidecar:
    """All that is kept of an alignment of two files; the same for the same pair unless `timings` are asked for.

    `drawn` are the options that say how the result is drawn; they stand beside those of the alignment.
    """
    rejected = alignment.status == "rejected"
    return Sidecar(
        status=alignment.status,
        reason=alignment.reason,
        fixed_from_moving=None if rejected else as_shown(alignment.fixed_from_moving),
        expected_error_px=alignment.expected_error_px,
        model=alignment.model,
        fixed=_picture(fixed),
        moving=_picture(moving),
        options=asdict(alignment.options) | dict(drawn or {}),
        versions=versions(),
        stages=alignment.counts() | _remarks(fixed, moving),
        evidence={name: _finite(value) for name, value in alignment.evidence().items()},
        timings_s=alignment.seconds if timings else None,
    )


def placed_record(
    frame: SequenceFrame,
    fixed: AnyPicture,
    moving: AnyPicture,
    options: AlignOptions,
    *,
    drawn: Mapping[str, Any],
) -> Sidecar:
    """All that is kept of a frame of a sequence, which the links of the whole sequence have put onto the reference."""
    transform = frame.reference_from_frame
    return Sidecar(
        status=frame.status,
        reason=frame.reason,
        fixed_from_moving=None if transform is None else as_shown(transform),
        expected_error_px=frame.expected_error_px,
        model=frame.model,
        fixed=_picture(fixed),
        moving=_picture(moving),
        options=asdict(options) | dict(drawn),
        versions=versions(),
        stages={"links_used": frame.used, "links_overruled": frame.overruled},
        evidence={},
    )


def versions() -> dict[str, str]:
    """Of everything that has a part in the numbers."""
    return {
        "autoalign": __version__,
        "numpy": np.__version__,
        "opencv": cv2.__version__,
        "python": platform.python_version(),
    }


def _remarks(fixed: AnyPicture, moving: AnyPicture) -> dict[str, Any]:
    """What of the files was overlooked; nothing where nothing was."""
    said = {name: loaded.remark for name, loaded in (("fixed", fixed), ("moving", moving)) if loaded.remark}
    return {"reading": said} if said else {}


def _finite(value: Any) -> Any:
    """The value with None for every number that is not finite, for which JSON has no word."""
    if isinstance(value, Mapping):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _picture(loaded: AnyPicture) -> PictureRecord:
    return PictureRecord(name=loaded.path.name, size=size_of(loaded.pixels), sha256=loaded.sha256)
