"""``svu check``: consistency of poses, mesh, light and photographs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from svu_mi.cli.base_command import BaseCommand
from svu_mi.cli.import_ import reimport_command
from svu_mi.cli.loading import NeedFunc, read_capture, with_light_search
from svu_mi.cli.shared_options import (
    GivenLight,
    MapOptions,
    Output,
    Overwrite,
    PhotographOptions,
    SceneOptions,
    as_dict,
)
from svu_mi.cli.streams import format_number, print_line
from svu_mi.core.io.output_folder import Claim, claimed
from svu_mi.core.memory import Need
from svu_mi.core.progress import Progress

if TYPE_CHECKING:
    from svu_mi.calibration.checks.check_result import Check
    from svu_mi.capture.capture import Capture
    from svu_mi.capture.importers.import_options import Light

SIDE = 1024  # maximum side of photographs in pixels; comparisons use far fewer
SHOWN = 5  # worst views in the table
WRONG = 3  # exit status with --strict
SERIOUS = ("wrong", "unclear")  # verdicts printed in capitals


@dataclass(frozen=True, kw_only=True)
class CheckCapture(BaseCommand):
    """Check that photographs match the mesh, the poses and the light.

    Tests camera and mesh axes, inverted poses, orientation of the environment map, texture V and
    exposure gains, and prints the command that corrects them. Writes check.html and check.json.
    """

    first = "scene output images light shape define missing gains strict overwrite"
    source: SceneOptions
    photographs: PhotographOptions = PhotographOptions()
    light: GivenLight = None
    convention: MapOptions = MapOptions()
    output: Output = Path("out/check")
    overwrite: Overwrite = False
    strict: bool = False
    """Exit with status 3 if a check fails, for scripts."""

    def run(self, console: Console) -> int:
        """Check, print the findings, and write the page."""
        light = self.convention.light(self.light)
        _ = self.source.defines(), self.photographs.bytes
        with claimed(self.output, "check", overwrite=self.overwrite) as place:
            self.start()
            capture, result = self._run(Progress(console), place, light)
        _print(console, result, capture)
        print_line(console, f"Wrote {self.output / 'check.html'}")
        return WRONG if self.strict and not result.fits else 0

    def _run(self, progress: Progress, place: Claim, light: Light | None) -> tuple[Capture, Check]:
        from svu_mi.calibration.checks.check import check
        from svu_mi.calibration.light.resolve_light import photo_gains, with_resolved_light
        from svu_mi.capture.crop import Detail
        from svu_mi.output.check_page import write_check

        need: NeedFunc = partial(Need, "check")
        estimates, find = self.photographs.estimates_gains, None
        if estimates:
            need = with_light_search(need)
        capture = read_capture(
            progress, self.source, self.photographs, need, Detail(side=SIDE), trust=self.trust
        )  # nothing is cropped: poses may be wrong
        if light is not None:
            capture = with_resolved_light(capture, light, progress=progress)
        if estimates:
            find = partial(photo_gains, capture, self.output / "light", progress)
        result = check(capture, gains=find, progress=progress)
        with progress.stage("Writing the page"):
            remedy = _remedy(result, capture)
            write_check(capture, result, place, settings=as_dict(self), remedy=remedy)
        return capture, result


def _print(console: Console, result: Check, capture: Capture) -> None:
    from svu_mi.output import check_page

    console.print(_view_table(result), markup=False)
    for finding in result.findings:
        verdict = finding.verdict.upper() if finding.verdict in SERIOUS else finding.verdict
        print_line(console, f"{finding.question} ({verdict}): {finding.sentence}")
    for line in (check_page.verdict(result), _remedy(result, capture)):
        if line:
            print_line(console, line)


def _remedy(check: Check, capture: Capture) -> str:
    """Return the command or the edit that corrects the capture; empty if there is none."""
    if check.fixes or check.mesh_scale != 1:
        correction = _correction(capture, check.fixes, check.mesh_scale)
        return correction[0].upper() + correction[1:]
    undecided = [one.fixes for one in check.findings if one.verdict == "unclear" and one.fixes]
    return f"To try a correction, {_correction(capture, undecided[0])}" if undecided else ""


def _correction(capture: Capture, names: Sequence[str], scale: float = 1.0) -> str:
    """Return the command or the edit that makes the named corrections, and scales the mesh."""
    from svu_mi.capture import capture_folder
    from svu_mi.capture.importers.axis_fixes import PLACES, find_fixes, scene_edit

    folder = None if capture.source is None else capture_folder.read(capture.source)
    if folder is not None and folder.imported:
        return f"import it again with: {reimport_command(capture, names, scale)}"
    edits = [scene_edit(fix) for fix in find_fixes(names)]
    if scale != 1:
        edits.append(f'<scale value="{scale:.6g}"/> {PLACES["mesh"]}')
    return f"correct the scene: {', '.join(edits)}."


def _view_table(result: Check) -> Any:
    """Return a table of the worst views and the mean of all views, before and after fixes."""
    from rich.table import Table

    from svu_mi.calibration.checks.check_result import ViewMeans

    shown = min(SHOWN, len(result.views))
    titles = "IoU", "outline contrast", "diffuse misfit"
    table = Table(f"worst {shown} of {len(result.views)}", *titles, box=None)
    for view in result.worst[:SHOWN]:
        table.add_row(view.name, *_fit_numbers(view))
    table.add_row(f"all {len(result.views)}", *_fit_numbers(ViewMeans.of(result.views)))
    if result.corrected is not result.views:
        table.add_row("all, corrected", *_fit_numbers(ViewMeans.of(result.corrected)))
    return table


def _fit_numbers(view: Any) -> list[str]:
    return [format_number(value) for value in (view.overlap, view.contrast, view.color_error)]
