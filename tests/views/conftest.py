"""Four pairs, one for every kind of end, each recorded once."""

from __future__ import annotations

import numpy as np
import pytest
from recordings import EXAMPLES, Case, made
from skimage import data

import autoalign as aa
from autoalign.files.write import write_picture
from autoalign.registration.verdict import VerdictOptions


@pytest.fixture(scope="session")
def aligned(tmp_path_factory: pytest.TempPathFactory) -> Case:
    folder = tmp_path_factory.mktemp("aligned")
    return made(folder, EXAMPLES / "fixed.jpg", EXAMPLES / "moving.jpg", aa.AlignOptions(effort="fast"))


@pytest.fixture(scope="session")
def doubtful(tmp_path_factory: pytest.TempPathFactory) -> Case:
    """The example, asked for more precision than it has; two rungs are climbed for it."""
    folder = tmp_path_factory.mktemp("doubtful")
    strict = VerdictOptions(max_expected_error_px=1e-4, max_expected_error_share=0.0)
    options = aa.AlignOptions(detector="orb", verdict=strict)
    return made(folder, EXAMPLES / "fixed.jpg", EXAMPLES / "moving.jpg", options)


@pytest.fixture(scope="session")
def rejected(tmp_path_factory: pytest.TempPathFactory) -> Case:
    """Two pictures that share no more than the caption under them."""
    folder = tmp_path_factory.mktemp("rejected")
    caption = data.page()[:90, :384]
    for name, picture in (("fixed", data.camera()[:300, 60:444]), ("moving", data.brick()[100:400, :384])):
        write_picture(folder / f"{name}.png", np.concatenate([picture, caption]))
    return made(folder, folder / "fixed.png", folder / "moving.png", aa.AlignOptions(effort="fast"))


@pytest.fixture(scope="session")
def nothing_found(tmp_path_factory: pytest.TempPathFactory) -> Case:
    """A picture and an empty one."""
    folder = tmp_path_factory.mktemp("nothing")
    write_picture(folder / "fixed.png", data.camera()[:300, 60:444])
    write_picture(folder / "moving.png", np.full((200, 260), 99, np.uint8))
    return made(folder, folder / "fixed.png", folder / "moving.png", aa.AlignOptions(effort="fast"))
