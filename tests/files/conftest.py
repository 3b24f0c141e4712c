"""Pictures for the tests of this folder: made here, never square."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

MakePicture = Callable[..., NDArray[Any]]


@pytest.fixture
def make_picture() -> MakePicture:
    """(dtype, channels, size) to a picture: a smooth ramp that JPEG keeps well, with noise where nothing is lost."""

    def make(dtype: type = np.uint8, channels: int = 3, size: tuple[int, int] = (37, 23), smooth: bool = False) -> Any:
        w, h = size
        y, x = np.mgrid[:h, :w]
        ramps = [x / w, y / h, (x + y) / (w + h), (x + 2 * y + 1) / (w + 2 * h + 1)]
        chosen = np.stack([*ramps[: channels - 1], ramps[3]] if channels in (2, 4) else ramps[:channels], axis=-1)
        if not smooth:
            chosen = 0.9 * chosen + 0.1 * np.random.default_rng(7).random(chosen.shape)
        top = 1.0 if dtype == np.float32 else float(np.iinfo(dtype).max)
        picture = (chosen * top).astype(dtype)
        return picture[..., 0] if channels == 1 else picture

    return make


@pytest.fixture
def damage_corpus(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The script that makes damaged files, under its own name, by which workers import it."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "scripts"))
    return importlib.import_module("damage_corpus")
