"""`autoalign apply`: other pictures, masks and points through the transform that `pair` found."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from cyclopts import Parameter

from autoalign.cli.files import SCREEN_PIXEL, check_mask_format, check_outputs
from autoalign.cli.terminal import FILES, GENERAL, Common, Exit, complain, note, progress
from autoalign.errors import ImageReadError, ImageWriteError
from autoalign.files.large import AnyPicture, check_sized, is_large, opened_picture
from autoalign.files.points import POSITIONS, read_points, write_points
from autoalign.files.read import ReadOptions
from autoalign.files.result import Placed, ResultFiles, check_in_strips, write_placed
from autoalign.files.sidecar import Sidecar, read_sidecar, transform_of
from autoalign.files.write import check_format, default_output
from autoalign.geometry.homography import invert, project
from autoalign.picture.border import Border, like_bordered
from autoalign.picture.canvas import CanvasKind
from autoalign.picture.warp import Interpolation
from autoalign.registration.drawing import Drawing


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
    border: Border | None = None
    """where there is no data: see-through, black, or the nearest pixel repeated; by default as `pair` was told"""
    save_mask: Path | None = None
    """also write where the result has data, in its frame: a PNG or TIFF, white for data; for one picture"""
    page: int = 0
    """page of each IMAGE that is a TIFF of several, counted from 0"""
    points: Path | None = None
    """map these points of MOVING to FIXED: CSV with the columns x, y; by default to <CSV>_on_fixed.csv beside it"""
    inverse: bool = False
    """map the points from FIXED to MOVING; by default to <CSV>_on_moving.csv beside the CSV"""


def apply(
    sidecar: Path,
    /,
    *images: Path,
    options: Annotated[ApplyOptions, Parameter(name="*", group=FILES)] = ApplyOptions(),
    reading: Annotated[ReadOptions, Parameter(name="*", group=FILES)] = ReadOptions(),
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
    if options.save_mask and len(images) != 1:
        raise ValueError("--save-mask names one file, and is for one picture")
    record = read_sidecar(sidecar)
    if options.points:
        return _map_points(record, options.points, options, common)
    drawing = _drawing(record, options)
    outputs = [_output(image, options, drawing) for image in images]
    check_mask_format(options.save_mask)
    check_outputs(
        [(path, None) for path in (*outputs, options.save_mask)],
        inputs=[sidecar, *images],
        overwrite=common.overwrite,
    )
    worst = Exit.DONE
    for image, output in zip(images, outputs, strict=True):
        try:
            with opened_picture(image, reading, page=options.page) as picture:
                check_sized(picture.pixels, record.moving.size, image)
                _put(record, picture, output, drawing, options, common)
        except (ImageReadError, ImageWriteError) as error:  # the others are still wanted
            complain(str(error))
            worst = Exit.FILE
    return worst


def _drawing(record: Sidecar, options: ApplyOptions) -> Drawing:
    """As `pair` was told, where nobody says otherwise."""
    told = {name: record.options[name] for name in ("canvas", "border") if name in record.options}
    asked = {name: value for name in ("canvas", "border") if (value := getattr(options, name)) is not None}
    return Drawing(**(told | asked))


def _output(image: Path, options: ApplyOptions, drawing: Drawing) -> Path:
    named = default_output(
        image, like_bordered(SCREEN_PIXEL, drawing.border) if drawing.border == "transparent" else None
    )
    if options.out_dir:
        return options.out_dir / f"{image.stem}{named.suffix}"
    return options.output or named


def _put(
    record: Sidecar, picture: AnyPicture, output: Path, drawing: Drawing, options: ApplyOptions, common: Common
) -> None:
    """One picture through the transform."""
    if picture.remark:
        note(f"{picture.remark}: {picture.path}", common)
    check_format(output, like_bordered(picture.pixels, drawing.border))
    if is_large(picture):
        check_in_strips(drawing, output, options.save_mask)
    files = ResultFiles(aligned=output, mask=options.save_mask)
    what = Placed(
        picture=picture,
        fixed_size=record.fixed.size,
        fixed_from_moving=transform_of(record),
        drawing=drawing,
        interpolation=options.interpolation,
    )
    watch = progress("drawing", common)
    write_placed(files, what, None, in_strips=is_large(picture), watch=watch, overwrite=common.overwrite)
    note(f"wrote {', '.join(map(str, files.wanted))}", common)


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
