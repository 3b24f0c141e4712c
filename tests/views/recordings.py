"""What a recording says when it is read back, and how the tests make one."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from rerun.chunk import RrdReader

import autoalign as aa
from autoalign.files.read import LoadedPicture
from autoalign.views.viewer import recorded

EXAMPLES = Path(__file__).parent.parent.parent / "examples"


@dataclass(frozen=True)
class Recording:
    """An .rrd file, read back."""

    path: Path

    @cached_property
    def reader(self) -> RrdReader:
        return RrdReader(self.path)

    @property
    def entities(self) -> set[str]:
        return {str(chunk.entity_path) for chunk in self.reader.stream()}

    def values(self, entity: str, component: str) -> list[Any]:
        """What was logged for a component, row by row over all chunks of an entity."""
        rows: list[Any] = []
        for chunk in self.reader.stream().filter(content=entity):
            batch = chunk.to_record_batch()
            if component in batch.schema.names:
                rows += batch.column(component).to_pylist()
        assert rows, f"{entity} has no {component}"
        return rows

    def points(self, entity: str) -> np.ndarray:
        return np.array(self.values(entity, "Points2D:positions")[0], np.float64).reshape(-1, 2)

    def lines(self, entity: str) -> list[np.ndarray]:
        return [np.array(strip, np.float64) for strip in self.values(entity, "LineStrips2D:strips")[0]]

    def colours(self, entity: str, archetype: str = "LineStrips2D") -> np.ndarray:
        """(n, 3); rerun keeps them as 0xRRGGBBAA."""
        packed = np.array(self.values(entity, f"{archetype}:colors")[0], np.uint32)
        return np.stack([packed >> 24 & 255, packed >> 16 & 255, packed >> 8 & 255], 1)

    @property
    def report(self) -> str:
        return str(self.values("/report", "TextDocument:text")[0][0])

    def blueprint(self, component: str) -> list[str]:
        """Every value of a component of the layout."""
        found = []
        for chunk in self.reader.stream(store=self.reader.blueprints()[0]):
            batch = chunk.to_record_batch()
            if component in batch.schema.names:
                found += [value for row in batch.column(component).to_pylist() for value in row or ()]
        return found

    @property
    def views(self) -> set[str]:
        return set(self.blueprint("ViewBlueprint:display_name"))

    @property
    def active_views(self) -> set[str]:
        """The views of the tabs that are set to be on top."""
        names = {}
        for chunk in self.reader.stream(store=self.reader.blueprints()[0]):
            batch = chunk.to_record_batch()
            if "ViewBlueprint:display_name" in batch.schema.names:
                names[str(chunk.entity_path)] = batch.column("ViewBlueprint:display_name").to_pylist()[0][0]
        return {names[f"/{path}"] for path in self.blueprint("ContainerBlueprint:active_tab")}


@dataclass(frozen=True)
class Case:
    """Two files, what was made of them, and the recording."""

    fixed: LoadedPicture
    moving: LoadedPicture
    alignment: aa.Alignment
    recording: Recording


def made(folder: Path, fixed: Path, moving: Path, options: aa.AlignOptions) -> Case:
    still, mover = aa.read_picture(fixed), aa.read_picture(moving)
    alignment = aa.align(still.pixels, mover.pixels, options)
    path = folder / "pair.rrd"
    path.write_bytes(recorded(still, mover, alignment))
    return Case(still, mover, alignment, Recording(path))
