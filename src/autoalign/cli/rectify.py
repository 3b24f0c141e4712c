"""`autoalign rectify`: a plane in a picture, seen upright."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from autoalign.cli.files import check_outputs
from autoalign.cli.terminal import FILES, GENERAL, Common, Exit, note, tell
from autoalign.files.metadata import without_grid
from autoalign.files.points import PLANE_POINTS, read_points
from autoalign.files.read import ReadOptions, read_picture
from autoalign.files.write import default_output, write_picture
from autoalign.geometry.family import fit
from autoalign.picture.canvas import plane_canvas
from autoalign.picture.pixels import size_of
from autoalign.picture.warp import warp


@dataclass(frozen=True, kw_only=True)
class RectifyOptions:
    """What `rectify` reads beside the picture, and what it makes."""

    points: Path
    """four or more points of the plane: CSV with the columns world_x, world_y (any unit, y down), image_x, image_y"""
    output: Annotated[Path | None, Parameter(alias="-o")] = None
    """the plane seen upright; by default <IMAGE>_rectified<ext> beside IMAGE"""
    scale: float | None = None
    """output pixels per world unit; by default as many as keep the picture's width"""


def rectify(
    image: Path,
    /,
    *,
    options: Annotated[RectifyOptions, Parameter(name="*", group=FILES)],
    reading: Annotated[ReadOptions, Parameter(name="*", group=FILES)] = ReadOptions(),
    common: Annotated[Common, Parameter(name="*", group=GENERAL)] = Common(),
) -> int:
    """Fit the plane, draw it, say how it went.

    Parameters
    ----------
    image
        the picture of a facade, a page, a floor; it stays as it is
    """
    loaded = read_picture(image, reading)
    if loaded.remark:
        note(f"{loaded.remark}: {image}", common)
    suffix = default_output(image, loaded.pixels).suffix
    output = options.output or image.with_name(f"{image.stem}_rectified{suffix}")
    check_outputs([(output, loaded.pixels)], inputs=[image, options.points], overwrite=common.overwrite)
    points = read_points(options.points, PLANE_POINTS)
    on_image, on_plane = points[:, 2:], points[:, :2]
    world_from_image = fit("homography", on_image, on_plane)
    x, y = on_image.mean(axis=0).tolist()
    plane = plane_canvas(size_of(loaded.pixels), world_from_image, options.scale, anchor=(x, y))
    drawn = warp(loaded.pixels, plane.size, plane.canvas_from_image, anchor=plane.anchor)
    write_picture(output, drawn.pixels, without_grid(loaded.metadata), overwrite=common.overwrite)
    if plane.cropped:
        note(plane.cropped, common)
    if not common.quiet:
        w, h = plane.size
        scale = plane.canvas_from_world[0, 0]
        tell(
            f"rectified: {len(points)} points, {w} x {h} pixels, {scale:.4g} pixels per world unit", style="bold green"
        )
    note(f"wrote {output}", common)
    return Exit.DONE
