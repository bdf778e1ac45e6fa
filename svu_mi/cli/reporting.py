"""``svu report``: what photographs say, as one page to send."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

import tyro
from rich.console import Console

from svu_mi.cli.common import Overwriting
from svu_mi.cli.inputs import Resolution
from svu_mi.cli.terminal import say
from svu_mi.cli.textured import Textured
from svu_mi.cli.words import given
from svu_mi.errors import OptionError
from svu_mi.progress import Progress
from svu_mi.results.exchange import locked

if TYPE_CHECKING:
    from svu_mi.output.knowledge import Knowledge
    from svu_mi.recovery.textures import Textures

SUFFIXES = (".html", ".htm")
Page = Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FILE.html", help="The page.")]


@dataclass(frozen=True, kw_only=True)
class Report(Overwriting, Textured):
    """Write what photographs say as one HTML file, with all pictures inside.

    Photographs, entropy on a turntable, maps, probabilities, errors of views, settings, times and
    versions: readable without a network, and without knowing the method. Textures of --recovered
    are compared with the photographs.
    """

    work = "report"
    side: ClassVar[int] = 256  # of the maps on the page, in pixels: more texels are not shown
    resolution: Resolution = ()
    """Texels per side, or width and height; by default those of --recovered, else 256, as many as
    the maps on the page have pixels. The other commands take 512."""
    output: Page = Path("report.html")
    title: str | None = None
    """Title of the page; by default the name of the photographs' folder."""

    def run(self, console: Console) -> int:
        """Estimate, and write the page."""
        from svu_mi.files import clear_temporaries, prepare_folder
        from svu_mi.results.transaction import require_own_page

        self.check()
        prepare_folder(self.output.parent)
        if not self.overwrite:
            require_own_page(self.output)
        with locked(self.output.resolve()):
            clear_temporaries(self.output.parent)
            self.start()
            sized, textures = self.sized()
            knowledge = sized._write(Progress(console), textures)
        say(console, f"Wrote {self.output}")
        say(console, knowledge.summary())
        return 0

    def check(self) -> None:
        """Refuse options that make no sense, before any work (see ``Textured``)."""
        super().check()
        if self.output.is_dir():
            raise OptionError(f"{self.output}: is a folder; -o takes a file, such as report.html.")
        if self.output.suffix.lower() not in SUFFIXES:
            raise OptionError(
                f"-o takes the name of a page, which ends in .html, such as report.html; got "
                f"{self.output}."
            )

    def _write(self, progress: Progress, textures: Textures | None) -> Knowledge:
        from svu_mi.checking.brightness import warn_if_too_bright
        from svu_mi.output.report.report import write_report

        capture, texels = self.load(progress)
        found = self.estimate(progress, capture, texels)
        warn_if_too_bright(found)
        with progress.stage("Writing the report") as stage:
            return write_report(
                capture, found, self.output, textures=textures, title=self.title,
                settings=given(self), progress=stage.update,
            )  # fmt: skip

    @property
    def rendered(self) -> Path:
        """Where a scene without photographs is rendered to: beside the page."""
        return self.output.with_name(f"{self.output.stem}_capture")

    @property
    def own_light(self) -> Path:
        """Where light that was found is kept otherwise: beside the page, too."""
        return self.output.with_name(f"{self.output.stem}_light")
