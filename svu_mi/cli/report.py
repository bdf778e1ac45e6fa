"""``svu report``: what photographs say, as one page to send."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.console import Console

from svu_mi.cli.common import Common
from svu_mi.cli.loading import Loading
from svu_mi.cli.options import (
    CaptureOptions,
    EstimateOptions,
    GivenLight,
    Overwrite,
    Recovered,
    Samples,
    Size,
    given,
    pair,
    recovered_textures,
)
from svu_mi.cli.terminal import say
from svu_mi.errors import OptionError
from svu_mi.limits import require_texels
from svu_mi.memory import Need
from svu_mi.progress import Progress
from svu_mi.results.exchange import locked

if TYPE_CHECKING:
    from svu_mi.output.knowledge import Knowledge
    from svu_mi.recovery.textures import Textures

SUFFIXES = (".html", ".htm")
SIDE = 256  # texels: as many as the maps on the page have pixels
Page = Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FILE.html", help="The page.")]


@dataclass(frozen=True, kw_only=True)
class Report(Common):
    """Write what photographs say as one HTML file, with all pictures inside.

    Photographs, entropy on a turntable, maps, probabilities, errors of views, settings, times and
    versions: readable without a network, and without knowing the method. Textures of --recovered
    are compared with the photographs.
    """

    capture: CaptureOptions
    spp: Samples = 64
    estimation: EstimateOptions = EstimateOptions()
    light: GivenLight = None
    recovered: Recovered = None
    resolution: Size = ()
    """Texels per side, or width and height; by default those of --recovered, else 256, as many as
    the maps on the page have pixels. The other commands take 512."""
    output: Page = Path("report.html")
    overwrite: Overwrite = False
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
            size, textures = recovered_textures(self.recovered, self.resolution, SIDE)
            knowledge = self._write(Progress(console), size, textures)
        say(console, f"Wrote {self.output}")
        say(console, knowledge.summary())
        return 0

    def check(self) -> None:
        """Refuse options that make no sense, before any work.

        Raises:
            OptionError: there is one.
        """
        require_texels(pair(self.resolution or (SIDE,), "--resolution"), "--resolution")
        self.capture.check(self.spp)
        self.estimation.check()
        if self.output.is_dir():
            raise OptionError(f"{self.output}: is a folder; -o takes a file, such as report.html.")
        if self.output.suffix.lower() not in SUFFIXES:
            raise OptionError(
                f"-o takes the name of a page, which ends in .html, such as report.html; got "
                f"{self.output}."
            )

    def _write(
        self, progress: Progress, size: tuple[int, int], textures: Textures | None
    ) -> Knowledge:
        from svu_mi.checking.exposure import warn_if_too_bright
        from svu_mi.output.report.report import write_report
        from svu_mi.output.textures import require_textures_of

        beside = self.output.with_name(f"{self.output.stem}_capture")
        kept = self.output.with_name(f"{self.output.stem}_light")
        capture, texels = Loading(
            options=self.capture, resolution=size, trust=self.trust, spp=self.spp, folder=beside,
            need=partial(Need.of, "report", resolution=size, model=self.estimation.model),
        ).load_lit(progress, self.light, kept)  # fmt: skip
        if self.recovered is not None:
            require_textures_of(capture, self.recovered)
        found = self.estimation.estimate(progress, capture, texels)
        warn_if_too_bright(found)
        with progress.stage("Writing the report") as stage:
            return write_report(
                capture, found, self.output, textures=textures, title=self.title,
                settings=given(replace(self, resolution=size)), progress=stage.update,
            )  # fmt: skip
