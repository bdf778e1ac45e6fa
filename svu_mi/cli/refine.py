"""``svu refine``: copy of a capture with refined camera poses."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

from svu_mi.cli.base_command import ResultCommand
from svu_mi.cli.loading import read_capture, with_light_search
from svu_mi.cli.shared_options import (
    GivenLight,
    MapOptions,
    Output,
    PhotographOptions,
    SceneOptions,
)
from svu_mi.core.io.output_folder import Claim
from svu_mi.core.memory import Need
from svu_mi.core.progress import Progress
from svu_mi.errors import OptionError

TEXELS = 512, 512  # large photographs are reduced to about one pixel per texel


@dataclass(frozen=True, kw_only=True)
class Refine(ResultCommand):
    """Refine the camera poses of a capture by outlines and textures.

    Writes a copy of the capture folder whose capture.json has the refined poses. Masks make poses
    more accurate; mesh, light and focal lengths are not changed.
    """

    command = "refine"
    uses_matplotlib = False
    first = "scene output images light overwrite"
    source: SceneOptions
    photographs: PhotographOptions = PhotographOptions()
    output: Output = Path("refined")
    light: GivenLight = None
    convention: MapOptions = MapOptions()

    def check(self) -> None:
        """Refuse invalid options (OptionError)."""
        from svu_mi.capture.capture_folder import FILE, FORMAT

        if not (self.source.scene / FILE).is_file():
            raise OptionError(
                f"{self.source.scene}: not a capture folder; svu refine writes a copy of one with "
                "new poses. Make it with svu import or svu render, or write a capture.json next to "
                f'the photographs: {{"format": "{FORMAT}", "scene": "PATH.xml"}}.'
            )
        if self.photographs.images is not None:
            raise OptionError("svu refine copies the photographs of a capture; omit --images.")
        self.convention.light(self.light)

    def work(self, progress: Progress, place: Claim) -> list[str]:
        """Refine the poses, and copy the capture."""
        from svu_mi.calibration.light.resolve_light import with_resolved_light
        from svu_mi.calibration.poses.refine_poses import refine_poses
        from svu_mi.capture.capture_folder import write_copy
        from svu_mi.capture.crop import Detail

        need = with_light_search(partial(Need, "entropy", resolution=TEXELS, model="default"))
        capture = read_capture(
            progress, self.source, self.photographs, need, Detail(texels=TEXELS), trust=self.trust
        )
        gains = self.photographs.estimates_gains
        lit = with_resolved_light(
            capture, self.convention.light(self.light), elsewhere=self.output / "light",
            gains=gains, progress=progress,
        )  # fmt: skip
        refined = refine_poses(lit, progress)
        with progress.stage("Copying the capture"):
            write_copy(self.source.scene, refined.capture, place)
        return [refined.sentence()]
