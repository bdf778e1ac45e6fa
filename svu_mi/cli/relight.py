"""``svu relight``: render recovered textures under another light, with uncertainty."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import arg

from svu_mi.cli import shared_options as opt
from svu_mi.cli.base_command import ResultCommand
from svu_mi.cli.loading import CaptureCommand
from svu_mi.core.io.output_folder import Claim
from svu_mi.core.memory import Need
from svu_mi.core.progress import Progress
from svu_mi.errors import CaptureError, OptionError
from svu_mi.parameters import NAMES

if TYPE_CHECKING:
    from svu_mi.capture.capture import Capture

MOST_PIXELS = 8192  # per side of an image
From = Annotated[Path, arg(metavar="FOLDER")]
Map = Annotated[Path | None, arg(metavar="MAP")]
Poses = Annotated[Path | None, arg(metavar="FILE")]


@dataclass(frozen=True, kw_only=True)
class Relight(CaptureCommand, ResultCommand):
    """Render recovered textures under another light, with uncertainty.

    Renders the textures and their posterior samples (svu recover --draws 16) with the same random
    numbers. Writes a PNG and an EXR per view (the image; mean and standard deviation of each
    pixel over the samples), relight.png and run.json.
    """

    command = "relight"
    first = "scene recovered output environment sensors views known side spp overwrite"
    output: opt.Output = Path("out/relit")
    recovered: From
    """Folder written by svu recover --draws N."""
    environment: Map = None
    """Lat-long EXR or HDR map (default: the light of the capture)."""
    convention: opt.MapOptions = opt.MapOptions()
    sensors: Poses = None
    """File of poses: transforms.json, capture.json or Mitsuba XML (default: the poses of some
    photographs, see --views)."""
    views: int = 3
    """Without --sensors: number of photographs whose poses are used, far apart; at least 1."""
    known: opt.Known = ()
    side: int = 512
    """Maximum of the longer side of an image in pixels, in [1, 8192]; larger films are reduced."""
    spp: int = 16
    """Samples per pixel, rounded to a square; more reduce noise."""
    seed: int = 0
    """Random seed, at least 0."""
    pictures: opt.Pictures = True

    def check(self) -> None:
        """Refuse invalid options (OptionError)."""
        super().check()
        opt.parse_known(self.known)
        opt.require_range("--side", self.side, 1, MOST_PIXELS)
        opt.require_range("--views", self.views, 1)
        opt.require_range("--seed", self.seed, 0)
        light = self.convention.light(self.environment)
        if light is not None and not light.path.is_file():
            raise CaptureError(
                f"{self.environment}: no such file; --environment takes a lat-long map (EXR or "
                "HDR)."
            )

    def work(self, progress: Progress, place: Claim) -> list[str]:
        """Render, and write the results."""
        from svu_mi.calibration.light.resolve_light import with_map
        from svu_mi.output.relight_page import uncertainty_sentence, write_relighting
        from svu_mi.output.texture_files import capture_of_textures, read_textures
        from svu_mi.output.texture_samples import find_draws, read_draws
        from svu_mi.recovery.relighting import relight_draws

        textures, files = read_textures(self.recovered), find_draws(self.recovered)
        need = partial(Need, "relight", resolution=textures.resolution)
        capture, _ = self.load(progress, need, textures.resolution)
        capture = capture_of_textures(capture, self.recovered)
        if (light := self.convention.light(self.environment)) is not None:
            capture, notes = with_map(capture, light)
            for note in notes:
                progress.say(note)
        elif not capture.scene.emitters():
            raise OptionError(
                f"{self.capture.source.scene}: the capture has no light; give one with "
                "--environment."
            )
        sensors, names = self._sensors(capture)
        known = opt.known_values(self.known, capture.shape, NAMES)
        draws = (draw.with_constant(known) for draw in read_draws(files))
        with progress.stage("Rendering draws", len(files)) as stage:
            relit = relight_draws(
                capture, textures.with_constant(known), draws, None, sensors, self.spp,
                seed=self.seed, progress=lambda done: stage.update(done, len(files)),
            )  # fmt: skip
        with progress.stage("Writing the results"):
            run = self.run_info(progress)
            write_relighting(
                capture, relit, names, place, run, draws=len(files), pictures=self.pictures
            )
        return [uncertainty_sentence(relit)]

    def _sensors(self, capture: "Capture") -> tuple[list[Any], list[str]]:
        """Return the sensors of the images, and their names."""
        from svu_mi.capture.sensors import scaled_sensor
        from svu_mi.guidance.candidates import Candidates
        from svu_mi.output.object_views import distant_views

        if self.sensors is not None:
            read = Candidates.read(self.sensors)
            sensors, names = list(read.sensors), list(read.names)
        else:
            chosen = distant_views(capture, count=self.views)
            sensors = [capture.sensors[view] for view in chosen]
            names = [Path(capture.names[view]).stem for view in chosen]
        return [scaled_sensor(one, self.side) for one in sensors], names
