"""`autoalign pair`: one picture onto another."""

from __future__ import annotations

import shlex
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

from cyclopts import Group, Parameter

from autoalign.cli.files import SCREEN_PIXEL, check_mask_format, check_outputs
from autoalign.cli.terminal import ALIGNMENT, FILES, GENERAL, STYLE_OF, Common, Exit, note, progress, tell
from autoalign.cli.view import Viewing, check_viewing, recording_beside, show
from autoalign.files.formats import TIFF, of_name
from autoalign.files.points import CORRESPONDENCES, read_points
from autoalign.files.read import ReadOptions
from autoalign.files.ready import Both, Source, align_both, opened_source
from autoalign.files.record import record
from autoalign.files.result import ResultFiles, check_in_strips, write_result
from autoalign.files.sidecar import default_sidecar, sidecar_text, write_sidecar
from autoalign.files.write import default_output
from autoalign.geometry.ransac import RansacOptions
from autoalign.picture.border import like_bordered
from autoalign.picture.compose import STYLES
from autoalign.picture.pixels import Picture, size_of
from autoalign.registration.alignment import Alignment, AlignOptions
from autoalign.registration.drawing import Drawing
from autoalign.registration.refine import RefineOptions
from autoalign.registration.typed import align_points
from autoalign.registration.verdict import VerdictOptions
from autoalign.views.words import number

# One flag per field of every stage, under the field's own name and a heading of the stage's.
for stage, heading in ((RansacOptions, "Consensus"), (RefineOptions, "Refinement"), (VerdictOptions, "Verdict")):
    Parameter(name="*", group=Group(heading, sort_key=3))(stage)

STDOUT = Path("-")


@dataclass(frozen=True, kw_only=True)
class PairFiles:
    """What `pair` reads beside the two pictures, and what it writes."""

    output: Annotated[Path | None, Parameter(alias="-o")] = None
    """the aligned picture; by default <MOVING>_aligned<ext> beside MOVING"""
    save_mask: Path | None = None
    """also write where the result has data, in its frame: a PNG or TIFF, white for data"""
    overlay: Path | None = None
    """also write both pictures as one, to look at"""
    overlay_style: Annotated[str, Parameter(choices=tuple(STYLES))] = "mean"
    """how the overlay shows the two"""
    json: Annotated[Path | None, Parameter(allow_leading_hyphen=True)] = None
    """the record of the alignment, - for stdout; by default <output stem>.autoalign.json beside the output"""
    timings: bool = False
    """put the seconds of every stage into the record, which then differs from run to run"""
    points: Path | None = None
    """take these correspondences, and look for none: CSV with the columns fixed_x, fixed_y, moving_x, moving_y"""
    fixed_mask: Path | None = None
    """picture of FIXED's size that is not black where FIXED is to be ignored"""
    moving_mask: Path | None = None
    """picture of MOVING's size that is not black where MOVING is to be ignored"""
    fixed_page: int = 0
    """page of FIXED, a TIFF of several, counted from 0"""
    moving_page: int = 0
    """page of MOVING, a TIFF of several, counted from 0"""


def pair(
    fixed: Path,
    moving: Path,
    /,
    *,
    files: Annotated[PairFiles, Parameter(name="*", group=FILES)] = PairFiles(),
    drawing: Annotated[Drawing, Parameter(name="*", group=FILES)] = Drawing(),
    reading: Annotated[ReadOptions, Parameter(name="*", group=FILES)] = ReadOptions(),
    viewing: Annotated[Viewing, Parameter(name="*", group=Group("Viewer", sort_key=1.5))] = Viewing(),
    options: Annotated[AlignOptions, Parameter(name="*", group=ALIGNMENT)] = AlignOptions(),
    common: Annotated[Common, Parameter(name="*", group=GENERAL)] = Common(),
) -> int:
    """Align, draw, keep the record, say how it went.

    Parameters
    ----------
    fixed
        the picture that stays
    moving
        the picture that is put onto it
    """
    started = time.perf_counter()
    with (
        opened_source(_source(fixed, files.fixed_mask, files.fixed_page, reading)) as still,
        opened_source(_source(moving, files.moving_mask, files.moving_page, reading)) as mover,
    ):
        both = Both(fixed=still, moving=mover)
        for picture in both.pictures:
            if picture.remark:
                note(f"{picture.remark}: {picture.path}", common)
        drawn = like_bordered(mover.picture.pixels, drawing.border)
        output = files.output or _default_output(moving, drawn, both.is_large)
        sidecar = None if files.json == STDOUT else files.json or default_sidecar(output)
        beside = recording_beside(sidecar or default_sidecar(output))
        recording = check_viewing(viewing, beside)
        check_mask_format(files.save_mask)
        if both.is_large:
            check_in_strips(drawing, output, files.save_mask)
            _check_not_viewed(viewing)
        check_outputs(
            [
                (output, drawn),
                (files.save_mask, None),
                (files.overlay, SCREEN_PIXEL),
                (sidecar, None),
                (recording, None),
            ],
            inputs=[fixed, moving, files.points, files.fixed_mask, files.moving_mask],
            overwrite=common.overwrite,
        )
        alignment = _align(both, files, options)
        written = []
        if alignment.status != "rejected":
            results = ResultFiles(
                aligned=output if alignment.status == "aligned" else None,
                mask=files.save_mask if alignment.status == "aligned" else None,
                overlay=files.overlay,
                overlay_style=files.overlay_style,
            )
            watch = progress("drawing", common)
            written = write_result(results, both, alignment.fixed_from_moving, drawing, watch, common.overwrite)
        pages = {"fixed_page": files.fixed_page, "moving_page": files.moving_page}
        drawn_from = asdict(drawing) | asdict(reading) | pages
        kept = record(alignment, *both.pictures, drawn=drawn_from, timings=files.timings)
        if sidecar is None:
            sys.stdout.write(sidecar_text(kept))
        else:
            write_sidecar(sidecar, kept, common.overwrite)
            written.append(sidecar)
        if common.verbose:
            _tell_stages(alignment)
        if not common.quiet:
            line = verdict_line(alignment, time.perf_counter() - started)
            tell(line, style=STYLE_OF[alignment.status], to_stderr=sidecar is None)
        if alignment.verdict.advice:
            note(f"what may help: {alignment.verdict.advice}", common)
        if alignment.status == "doubtful" and sidecar is not None:
            note(f"once you have looked, this makes the picture: {_making(sidecar, moving, output, files)}", common)
        if output not in written and output.exists():
            note(f"left as it was, from an earlier run: {output}", common)
        if written:
            note(f"wrote {', '.join(map(str, written))}", common)
        if viewing and both.whole:
            show(alignment, both.whole, viewing, recording, beside, timings=files.timings, common=common)
        return Exit.DONE if alignment.status == "aligned" else Exit.NOT_ALIGNED


def verdict_line(alignment: Alignment, seconds: float) -> str:
    """The status and its numbers, and the reason where the pair is not aligned."""
    if alignment.status == "rejected":
        return f"rejected: {alignment.reason} ({seconds:.1f} s)"
    found = f"{alignment.inliers:,} of {alignment.matches:,} matches agree"
    numbers = [found if alignment.best.consensus else f"{alignment.matches} typed points"]
    if alignment.expected_error_px is not None:
        numbers.append(f"expected error {number(alignment.expected_error_px)} px")
    if alignment.best.evidence:
        numbers.append(f"overlap {alignment.overlap:.0%}")
    numbers.append(f"{seconds:.1f} s")
    why = f": {alignment.reason}" if alignment.status == "doubtful" else ""
    return f"{alignment.status}: {', '.join(numbers)}{why}"


def _making(sidecar: Path, moving: Path, output: Path, files: PairFiles) -> str:
    """The command that makes the picture of a doubtful pair."""
    page = ["--page", str(files.moving_page)] if files.moving_page else []
    return shlex.join(["autoalign", "apply", str(sidecar), str(moving), "-o", str(output), *page])


def _default_output(moving: Path, drawn: Picture, large: bool) -> Path:
    output = default_output(moving, drawn)
    return output.with_suffix(TIFF.extensions[0]) if large and of_name(output) is not TIFF else output


def _check_not_viewed(viewing: Viewing) -> None:
    if viewing:
        raise ValueError("pictures of so many pixels are not recorded for the viewer; --overlay shows them")


def _source(path: Path, mask: Path | None, page: int, reading: ReadOptions) -> Source:
    return Source(path=str(path), mask=None if mask is None else str(mask), page=page, reading=reading)


def _align(both: Both, files: PairFiles, options: AlignOptions) -> Alignment:
    if files.points is None:
        return align_both(both, options)
    if files.fixed_mask or files.moving_mask:
        raise ValueError("--points leaves nothing to look for, so that a mask has no use")
    points = read_points(files.points, CORRESPONDENCES)
    fixed_size, moving_size = (size_of(picture.pixels) for picture in both.pictures)
    return align_points(points[:, :2], points[:, 2:], fixed_size, moving_size, options)


def _tell_stages(alignment: Alignment) -> None:
    for name, found in alignment.counts().items():
        tell(f"{name.replace('_', ' ')}: {found}", to_stderr=True)
    for stage, seconds in alignment.seconds.items():
        tell(f"{stage}: {seconds:.2f} s", to_stderr=True)
