"""``svu refine``: copy of a capture with refined camera poses."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from svu_mi.cli.base_command import ResultCommand
from svu_mi.cli.loading import read_capture, with_light_search
from svu_mi.cli.shared_options import GivenLight, Output, PhotographOptions, SceneOptions
from svu_mi.core.io.exr import read_header
from svu_mi.core.io.output_folder import Claim, is_kept, writing
from svu_mi.core.io.provenance import RUN
from svu_mi.core.memory import Need
from svu_mi.core.progress import Progress
from svu_mi.errors import OptionError

if TYPE_CHECKING:
    from svu_mi.capture.capture import Capture

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

    def work(self, progress: Progress, place: Claim) -> list[str]:
        """Refine the poses, and copy the capture."""
        from svu_mi.calibration.light.resolve_light import with_resolved_light
        from svu_mi.calibration.poses.refine_poses import refine_poses
        from svu_mi.capture.crop import Detail

        need = with_light_search(partial(Need, "entropy", resolution=TEXELS, model="default"))
        capture = read_capture(
            progress, self.source, self.photographs, need, Detail(texels=TEXELS), trust=self.trust
        )
        gains = self.photographs.estimates_gains
        lit = with_resolved_light(
            capture, self.light, elsewhere=self.output / "light", gains=gains, progress=progress
        )
        refined = refine_poses(lit, progress)
        with progress.stage("Copying the capture"):
            _write(self.source.scene, refined.capture, place)
        return [refined.sentence()]


def _run(folder: Path) -> str:
    """Return the run that wrote the photographs, which the copy must name; empty if unknown."""
    runs = (read_header(path).attributes.get(RUN) for path in sorted(folder.glob("*.exr")))
    return str(next(filter(None, runs), ""))


def _write(folder: Path, refined: Capture, place: Claim) -> None:
    """Write a copy of a capture folder with the poses of another capture."""
    from svu_mi.capture import capture_folder
    from svu_mi.capture.scene import find_sensors, to_world
    from svu_mi.capture.sensors import describe, make_sensor

    description = capture_folder.read(folder)
    assert description is not None
    own = description.make_sensors(folder) or find_sensors(refined.scene, str(folder))
    sensors = [
        make_sensor({**describe(old), "to_world": to_world(new).tolist()}, old.id())
        for old, new in zip(own, refined.sensors, strict=True)
    ]
    run = description.run or _run(folder)
    with writing(place, "refine", capture_folder.FILE, run=run) as draft:
        for path in sorted(folder.iterdir()):
            hidden = path.name.startswith(".") or is_kept(path.name)
            if not hidden and path.name != capture_folder.FILE:
                copy = shutil.copytree if path.is_dir() else shutil.copyfile
                copy(path, draft.folder / path.name)
        scene = description.scene
        if scene is not None and scene.is_relative_to(folder.resolve()):
            scene = draft.folder.resolve() / scene.relative_to(folder.resolve())
        capture_folder.write(draft, replace(description, scene=scene), sensors)
