"""``svu report``: what photographs say, as one page to send."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from svu_mi.cli.inputs import Estimated, given, say
from svu_mi.errors import OptionError
from svu_mi.progress import Progress
from svu_mi.results.lock import locked

Page = Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FILE.html", help="The page.")]


@dataclass(frozen=True, kw_only=True)
class Report(Estimated):
    """Write what photographs say as one HTML file, with all pictures inside.

    Photographs, entropy on a turntable, maps, probabilities, errors of views, settings, times and
    versions: readable without a network, and without knowing the method.
    """

    output: Page = Path("report.html")
    recovered: Path | None = None
    """Folder of svu recover; its textures are shown, and compared with the photographs."""
    title: str | None = None
    """Title of the page; by default the name of the photographs' folder."""

    def run(self, console: Console) -> int:
        """Estimate, and write the page."""
        from svu_mi.files import clear_temporaries, prepare_folder

        self.check()
        if self.output.is_dir():
            raise OptionError(f"{self.output}: is a folder; -o takes a file, such as report.html.")
        prepare_folder(self.output.parent)
        with locked(self.output, "svu report"):
            clear_temporaries(self.output.parent)
            self._write(Progress(console))
        say(console, f"Wrote {self.output}")
        return 0

    def _write(self, progress: Progress) -> None:
        from svu_mi.output.report.report import write_report
        from svu_mi.output.textures import read_textures

        self.start()
        textures = None if self.recovered is None else read_textures(self.recovered)
        capture, texels = self.load(progress)
        found = self.estimate(progress, capture, texels)
        with progress.stage("Writing the report") as stage:
            write_report(
                capture, found, self.output, textures=textures, title=self.title,
                settings=given(self), progress=stage.update,
            )  # fmt: skip

    @property
    def rendered(self) -> Path:
        """Where a scene without photographs is rendered to: beside the page."""
        return self.output.with_name(f"{self.output.stem}_capture")
