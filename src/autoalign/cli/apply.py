"""`autoalign apply`: other pictures, masks and points through the transform that `pair` found."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from cyclopts import Parameter

from autoalign.cli.files import check_outputs, read_sized
from autoalign.cli.terminal import FILES, GENERAL, Common, Exit, complain, note
from autoalign.errors import ImageReadError, ImageWriteError
from autoalign.files.points import POSITIONS, read_points, write_points
from autoalign.files.sidecar import Sidecar, read_sidecar, transform_of
from autoalign.files.write import default_output, write_picture
from autoalign.geometry.homography import invert, project
from autoalign.picture.canvas import CanvasKind
from autoalign.picture.warp import Interpolation
from autoalign.registration.drawing import Drawing, draw


@dataclass(frozen=True, kw_only=True)
class ApplyOptions:
    """What `apply` makes, and where."""

    output: Annotated[Path | None, Parameter(alias="-o")] = None
    """the result, if it is only one; by default <IMAGE>_aligned<ext> beside each IMAGE"""
    out_dir: Path | None = None
    """an existing folder for the results, which keep the names of the pictures"""
    interpolation: Interpolation = "linear"
    """linear for pictures; nearest for masks and labels, whose values must not be mixed"""
    canvas: CanvasKind | None = None
    """frame of the results; by default the one that `pair` was told"""
    points: Path | None = None
    """map these points of MOVING to FIXED: CSV with the columns x, y; by default to <CSV>_on_fixed.csv beside it"""
    inverse: bool = False
    """map the points from FIXED to MOVING; by default to <CSV>_on_moving.csv beside the CSV"""


def apply(
    sidecar: Path,
    /,
    *images: Path,
    options: Annotated[ApplyOptions, Parameter(name="*", group=FILES)] = ApplyOptions(),
    common: Annotated[Common, Parameter(name="*", group=GENERAL)] = Common(),
) -> int:
    """Read the record, then one picture after the other, or the points.

    Parameters
    ----------
    sidecar
        the record that `pair` wrote
    images
        pictures to put onto FIXED
    """
    if bool(images) == bool(options.points):
        raise ValueError("needs either pictures or --points")
    if options.inverse and not options.points:
        raise ValueError("--inverse is for --points; pictures are always put onto the fixed one")
    if options.output and (options.out_dir or len(images) > 1):
        raise ValueError("--output names one file; use --out-dir for several")
    record = read_sidecar(sidecar)
    if options.points:
        return _map_points(record, options.points, options, common)
    outputs = [_output(image, options) for image in images]
    check_outputs([(path, None) for path in outputs], inputs=[sidecar, *images], overwrite=common.overwrite)
    worst = Exit.DONE
    for image, output in zip(images, outputs, strict=True):
        try:
            _put(record, image, output, options, common)
        except (ImageReadError, ImageWriteError) as error:  # the others are still wanted
            complain(str(error))
            worst = Exit.FILE
    return worst


def _output(image: Path, options: ApplyOptions) -> Path:
    named = default_output(image)
    if options.out_dir:
        return options.out_dir / f"{image.stem}{named.suffix}"
    return options.output or named


def _put(record: Sidecar, image: Path, output: Path, options: ApplyOptions, common: Common) -> None:
    """One picture through the transform."""
    loaded = read_sized(image, record.moving.size)
    transform = transform_of(record)
    drawing = Drawing(canvas=options.canvas or record.options.get("canvas", "fixed"))
    drawn = draw(loaded.pixels, record.fixed.size, transform, drawing, interpolation=options.interpolation)
    write_picture(output, drawn.warped.pixels, loaded.metadata, overwrite=common.overwrite)
    note(f"wrote {output}", common)


def _map_points(record: Sidecar, path: Path, options: ApplyOptions, common: Common) -> int:
    """The points of a CSV through the transform, one way or the other."""
    end = "moving" if options.inverse else "fixed"
    output = options.output or (options.out_dir or path.parent) / f"{path.stem}_on_{end}.csv"
    check_outputs([(output, None)], inputs=[path], overwrite=common.overwrite)
    transform = transform_of(record)
    if options.inverse:
        transform = invert(transform)
    mapped, w = project(transform, read_points(path, POSITIONS))
    beyond = int(np.count_nonzero(w <= 0))
    if beyond:
        raise ValueError(f"{beyond} of {len(w)} points lie beyond the horizon of the transform: {path}")
    write_points(output, mapped, POSITIONS, common.overwrite)
    note(f"wrote {output}", common)
    return Exit.DONE
