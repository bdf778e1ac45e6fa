"""``svu check``: do poses, mesh, light and photographs belong together?"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from svu_mi.cli.common import Output, Overwriting, announce_sizes
from svu_mi.cli.inputs import Folder, Gained, Memory, Missing, OfScene, with_search
from svu_mi.cli.terminal import say
from svu_mi.cli.words import bytes_of, given
from svu_mi.needs import Need, Sizes
from svu_mi.progress import Progress
from svu_mi.results.transaction import claimed

if TYPE_CHECKING:
    from svu_mi.capture import Capture
    from svu_mi.checking.record import Check
    from svu_mi.illumination.record import FoundGains

SIDE = 1024  # pixels of large photographs, which are compared in far fewer
SHOWN = 5  # views that fit worst, in the table
WRONG = 3  # exit status with --strict
MARKS = {
    "fits": "fits", "wrong": "WRONG", "unclear": "UNCLEAR", "unknown": "unknown", "note": "note",
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class CheckCapture(Overwriting, OfScene):
    """Compare photographs with mesh, poses and light, and name the fix if axes are wrong.

    Tries every known mistake: axes of cameras and mesh, inverse poses, how the environment map
    is oriented, V of the texture; compares gains. Works without masks and without a light. Writes
    check.html and check.json.
    """

    output: Output = Path("out/check")
    images: Folder = None
    """Folder with the photographs: view_0000.exr, ... or named by the ids of their sensors, or as
    many as there are sensors, in the order of their names."""
    missing: Missing = "refuse"
    """What to do if sensors have no photograph: leave-out goes on with the others."""
    gains: Gained = "given"
    """estimate: find exposure and white balance of each photograph (and the light, if there is
    none), and say how they drift and which photographs do not fit the others."""
    strict: bool = False
    """Exit with status 3 if something does not fit."""
    memory: Memory = ""
    """Memory that photographs may take, such as 4G; beyond it they lie in a file. By default half
    of what is free."""

    def need(self, sizes: Sizes) -> Need:
        """Return what memory the command takes."""
        need = Need(
            "check", sizes.photographs, light=sizes.light, stored=sizes.stored,
            memory=sizes.memory,
        )  # fmt: skip
        return with_search(need, sizes) if self.gains == "estimate" else need

    def run(self, console: Console) -> int:
        """Check, print what was found, and write the page."""
        from svu_mi.capture.loading import plan_capture
        from svu_mi.capture.window import Detail
        from svu_mi.checking.run import check
        from svu_mi.output.check_page import write_check

        defines, memory = self.defines(), bytes_of(self.memory, "--memory")
        with claimed(self.output, "check", overwrite=self.overwrite) as place:
            self.start()
            progress = Progress(console)
            with progress.stage("Loading the capture"):
                plan = plan_capture(
                    self.scene, self.images, shape=self.shape, defines=defines, trust=self.trust,
                    missing=self.missing, light="optional",
                    detail=Detail(side=SIDE),  # nothing is cropped: poses may be wrong
                )  # fmt: skip
                label, sizes = str(self.images or self.scene), plan.sizes(memory)
                capture = plan.read(announce_sizes(progress, label, self.need, sizes))
            find = partial(self._gains, capture, progress) if self.gains == "estimate" else None
            found = check(capture, gains=find, progress=progress)
            with progress.stage("Writing the page"):
                write_check(capture, found, place, settings=given(self))
        _print(console, found, capture)
        say(console, f"Wrote {self.output / 'check.html'}")
        return WRONG if self.strict and not found.fits else 0

    def _gains(self, capture: Capture, progress: Progress) -> FoundGains:
        """Find gains, and light if there is none."""
        from svu_mi.illumination.resolve_light import found_gains

        return found_gains(capture, self.output / "light", progress)


def _print(console: Console, found: Check, capture: Capture) -> None:
    from svu_mi.output.check_page import remedy, verdict

    console.print(_views(found), markup=False)
    for one in found.findings:
        line = f"{one.question} ({MARKS[one.verdict]}): {one.sentence}"
        say(console, line)
    for line in (verdict(found), remedy(found, capture)):
        if line:
            say(console, line)


def _views(found: Check) -> Any:
    """Return a table of the views that fit worst, and of all of them, before and after."""
    from rich.table import Table

    from svu_mi.checking.record import Summary

    table = Table("", "IoU", "edges", "colour error", box=None)
    for view in found.worst[:SHOWN]:
        table.add_row(view.name, *_cells(view))
    table.add_row(f"all {len(found.views)}", *_cells(Summary.of(found.views)))
    if found.corrected is not found.views:
        table.add_row("all, corrected", *_cells(Summary.of(found.corrected)))
    return table


def _cells(one: Any) -> list[str]:
    values = (one.overlap, one.contrast, one.color_error)
    return ["-" if value is None else f"{value:.2f}" for value in values]
