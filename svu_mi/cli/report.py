"""``svu report``: one HTML page of results."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rich.console import Console
from tyro.conf import arg

from svu_mi.cli import shared_options as opt
from svu_mi.cli.loading import EstimateCommand
from svu_mi.cli.streams import print_line
from svu_mi.core.io.folder_exchange import locked
from svu_mi.core.progress import Progress
from svu_mi.errors import OptionError

if TYPE_CHECKING:
    from svu_mi.output.interval_summary import IntervalSummary
    from svu_mi.recovery.svbrdf_textures import Textures

SUFFIXES = (".html", ".htm")
SIDE = 256  # texels per side: the maps on the page have 256 pixels
Page = Annotated[Path, arg(aliases=["-o"], metavar="FILE.html", help="Page to write.")]


@dataclass(frozen=True, kw_only=True)
class Report(EstimateCommand):
    """Write the results as one HTML page with all images included.

    Contains photographs, entropy on a turntable, maps, probabilities, residuals per view, settings,
    times and versions; with --recovered, also textures compared with the photographs.
    """

    first = "scene output recovered resolution light images title overwrite"
    recovered: opt.Recovered = None
    resolution: opt.Size = ()
    """Texels per side, or width and height (default: as --recovered, else 256)."""
    output: Page = Path("report.html")
    overwrite: opt.Overwrite = False
    title: str | None = None
    """Title of the page (default: name of the object, or of the folder of photographs)."""

    def run(self, console: Console) -> int:
        """Estimate, and write the page."""
        from svu_mi.core.io.files import clear_temporaries, prepare_folder
        from svu_mi.core.io.output_folder import require_own_page

        self.check()
        prepare_folder(self.output.parent)
        if not self.overwrite:
            require_own_page(self.output)
        with locked(self.output.resolve()):
            clear_temporaries(self.output.parent)
            self.start()
            size, textures = opt.read_recovered(self.recovered, self.resolution, SIDE)
            summary = self._write(Progress(console), size, textures)
        print_line(console, f"Wrote {self.output}")
        print_line(console, summary.summary())
        return 0

    @property
    def side_folders(self) -> tuple[Path, Path]:
        """Folders next to the page (see ``CaptureCommand``)."""
        name, stem = self.output.with_name, self.output.stem
        return name(f"{stem}_capture"), name(f"{stem}_light")

    def check(self) -> None:
        """Refuse invalid options (OptionError)."""
        super().check()
        if self.output.is_dir():
            raise OptionError(f"{self.output}: is a folder; -o takes a file, such as report.html.")
        if self.output.suffix.lower() not in SUFFIXES:
            raise OptionError(
                f"-o takes a file name that ends in .html, such as report.html; got {self.output}."
            )

    def _write(
        self, progress: Progress, size: tuple[int, int], textures: "Textures | None"
    ) -> "IntervalSummary":
        from svu_mi.calibration.checks.exposure_checks import warn_of_exposure
        from svu_mi.output.report.report import write_report

        capture, estimate = self.load_and_estimate(progress, size, "report", self.recovered)
        capture = warn_of_exposure(capture, estimate)
        with progress.stage("Writing the report") as stage:
            return write_report(
                capture, estimate, self.output, textures=textures, title=self.title,
                settings=opt.as_dict(replace(self, resolution=size)), progress=stage.update,
            )  # fmt: skip
