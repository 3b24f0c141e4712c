"""The order of the rooms and the homes of the heavy imports, as data; what is not in it fails."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from autoalign.files.formats import FORMATS

PACKAGE = Path(__file__).parent.parent / "src" / "autoalign"

# Rooms from the ground up: a module may import from lower floors, and from those before it in its own room. Rooms on
# one floor do not know each other. So there is no circle anywhere.
FLOORS: tuple[dict[str, tuple[str, ...]], ...] = (
    {"": ("errors",)},
    {
        "geometry": (
            "homography",
            "family",
            "least_squares",
            "ransac",
            "selection",
            "chance",
            "uncertainty",
            "graph",
            "network",
        )
    },
    {"picture": ("pixels", "warp", "border", "canvas", "compose")},
    {
        "registration": (
            "simulate",
            "features",
            "matching",
            "ladder",
            "patches",
            "refine",
            "agreement",
            "verdict",
            "alignment",
            "typed",
            "prepared",
            "frames",
            "align",
            "large",
            "sequence",
            "drawing",
        )
    },
    {
        "files": (
            "boxes",
            "exif",
            "georeference",
            "microscope",
            "metadata",
            "codec",
            "jpeg",
            "png",
            "tiff",
            "pillow",
            "avif",
            "jpeg2000",
            "jpegxl",
            "heic",
            "raw",
            "formats",
            "read",
            "write",
            "remote",
            "tiled",
            "pyramid",
            "points",
            "large",
            "feature_store",
            "ready",
            "sidecar",
            "result",
            "record",
            "row",
            "export",
        )
    },
    {
        "views": (
            "motion",
            "tally",
            "words",
            "evidence",
            "pictures",
            "charts",
            "report",
            "viewer",
            "viewer_batch",
            "window",
        )
    },
    {
        "batch": (
            "jobs",
            "sources",
            "arrivals",
            "manifest",
            "memory",
            "work",
            "slot",
            "engine",
            "cluster",
            "schema",
            "ledger",
            "run",
            "chain",
            "telling",
        )
    },
    {
        "cli": (
            "terminal",
            "settings",
            "files",
            "progress",
            "running",
            "view",
            "pair",
            "rectify",
            "apply",
            "batch",
            "watch",
            "status",
            "main",
        )
    },
)

# Where a package outside the standard library may be imported. NumPy is everywhere.
HOMES: dict[str, tuple[str, ...]] = {
    "PIL": ("files.pillow",),
    "cv2": (
        "picture.pixels",
        "picture.warp",
        "picture.border",
        "picture.compose",
        "registration.simulate",
        "registration.features",
        "registration.patches",
        "registration.refine",
        "registration.agreement",
        "registration.large",
        "files.feature_store",  # its version only
        "files.record",  # its version only
        "batch.slot",  # its threads only
    ),
    "cyclopts": (
        "cli.terminal",
        "cli.settings",
        "cli.pair",
        "cli.rectify",
        "cli.apply",
        "cli.batch",
        "cli.running",
        "cli.watch",
        "cli.status",
        "cli.view",
        "cli.main",
    ),
    "distributed": ("batch.cluster",),
    "imagecodecs": ("files.avif", "files.jpeg2000", "files.jpegxl", "files.png"),
    "lazy_loader": ("",),
    "obstore": ("files.remote",),
    "pillow_heif": ("files.heic",),
    "rawpy": ("files.raw",),
    "psutil": ("batch.slot", "batch.ledger"),
    "pyarrow": ("files.export",),
    "rerun": ("views.viewer", "views.viewer_batch"),
    "rich": ("cli.terminal", "cli.progress"),
    "scipy": ("geometry.graph", "geometry.network"),
    "simplejpeg": ("files.jpeg",),
    "skimage": ("registration.alignment",),  # its ProjectiveTransform, for those who live there
    "threadpoolctl": ("batch.slot",),
    "watchdog": ("batch.arrivals",),
    "tifffile": ("files.tiff", "files.tiled", "files.pyramid"),
}

NOT_LOADED_BY_IMPORT = ("rerun", "typer", "cyclopts", "rich", "fastapi", "dask", "cv2", "skimage", "numpy")


def modules() -> dict[str, Path]:
    """Dotted name inside the package to file; the package and the rooms themselves go by their folder."""
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def placed() -> dict[str, tuple[int, str, int]]:
    """Dotted name to floor, room and place in the room; a room's own name lies under its modules."""
    places: dict[str, tuple[int, str, int]] = {"": (-1, "", -1)}
    for floor, rooms in enumerate(FLOORS):
        for room, names in rooms.items():
            places.setdefault(room, (floor, room, -1))
            for place, name in enumerate(names):
                places[f"{room}.{name}".lstrip(".")] = (floor, room, place)
    return places


def imports(path: Path) -> Iterator[str]:
    """Every module that a file names in an import, also inside functions and under TYPE_CHECKING."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative imports hide what they name"
            assert node.module is not None
            for alias in node.names:  # what is imported may be a module of a package or a name in a module
                whole = f"{node.module}.{alias.name}"
                inside = whole.removeprefix("autoalign.")
                yield whole if whole.startswith("autoalign.") and inside in modules() else node.module


def test_the_table_lists_the_modules_there_are() -> None:
    assert sorted(placed()) == sorted(modules())


@pytest.mark.parametrize("name", sorted(modules()))
def test_imports_go_downwards(name: str) -> None:
    places = placed()
    floor, room, place = places[name]
    for imported in imports(modules()[name]):
        if not imported.startswith("autoalign"):
            continue
        other_floor, other_room, other_place = places[imported.removeprefix("autoalign").removeprefix(".")]
        below = other_floor < floor or (other_room == room and other_place < place)
        assert below, f"{name} imports {imported}, which is not below it"


@pytest.mark.parametrize("name", sorted(modules()))
def test_outside_packages_are_imported_at_home_only(name: str) -> None:
    known = sys.stdlib_module_names | {"autoalign", "numpy"}
    for imported in imports(modules()[name]):
        package = imported.partition(".")[0]
        assert package in known or name in HOMES.get(package, ()), f"{name or 'the package'} imports {package}"


def test_every_home_is_lived_in() -> None:
    for package, homes in HOMES.items():
        for name in homes:
            lived_in = {imported.partition(".")[0] for imported in imports(modules()[name])}
            assert package in lived_in, f"{name} does not import {package} any more"


def test_codecs_are_below_the_formats_that_name_them() -> None:
    places = placed()
    for format in FORMATS:
        for function in filter(None, (format.decoder, format.encoder)):
            module = f"files.{function.partition(':')[0]}"
            assert places[module] < places["files.formats"], f"{format.name} names {module}, which is not below it"


def test_importing_autoalign_loads_nothing_heavy() -> None:
    script = f"import sys, autoalign; print(*(set(sys.modules) & set({NOT_LOADED_BY_IMPORT!r})))"
    loaded = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout
    assert loaded.split() == []


def test_every_public_name_is_there() -> None:
    import autoalign

    for name in autoalign.__all__:
        assert getattr(autoalign, name) is not None
