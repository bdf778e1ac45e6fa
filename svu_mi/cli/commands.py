"""The commands: one dataclass each, its fields are the options."""

from __future__ import annotations

import dataclasses
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from rich.console import Console

from svu_mi.cli.common import (
    Common,
    Interrupted,
    Output,
    Overwriting,
    announce_sizes,
    was_interrupted,
)
from svu_mi.cli.inputs import Estimated, OfScene, Resolution, Scene, WithPictures
from svu_mi.cli.terminal import say
from svu_mi.cli.words import given, pair
from svu_mi.limits import require_spp, require_views
from svu_mi.needs import Need, Sizes
from svu_mi.progress import Progress
from svu_mi.results.transaction import Claim, claimed

if TYPE_CHECKING:
    from svu_mi.output import Knowledge


@dataclass(frozen=True, kw_only=True)
class Entropy(Overwriting, WithPictures, Estimated):
    """Compute how much photographs tell about every texel.

    Writes entropy.exr (1 = nothing known), coverage.exr (number of views), overview.png and
    run.json.
    """

    output: Output = Path("out/entropy")
    skip: bool = True
    """Skip work that changes no result (unseen texels, blind views, equal channels, ...)."""

    def run(self, console: Console) -> int:
        """Run the pipeline, write the four files, and say what is known."""

        self.check()
        with claimed(self.output, "entropy", overwrite=self.overwrite) as place:
            knowledge = self._run(console, place)
        say(console, f"Wrote {self.output}")
        say(console, knowledge.summary())
        return 0

    def _run(self, console: Console, place: Claim) -> Knowledge:
        from svu_mi.checking.brightness import warn_if_too_bright
        from svu_mi.options import NOTHING, Skip
        from svu_mi.output import Knowledge, Run, write_outputs

        self.start()
        progress = Progress(console)
        skip = Skip() if self.skip else NOTHING
        capture, grid = self.load(progress)
        result = self.estimate(progress, capture, grid, skip=skip)
        warn_if_too_bright(result)
        with progress.stage("Writing the results"):
            knowledge = Knowledge.of(result)
            run = Run(settings=given(self), kernels=progress.kernels)
            write_outputs(
                capture, result, place, run, knowledge=knowledge, pictures=self.pictures
            )
        return knowledge


@dataclass(frozen=True, kw_only=True)
class Render(Overwriting, OfScene):
    """Render every sensor of a scene into a capture folder.

    Unlike the mitsuba program, it knows the plugins of svu_mi.
    """

    draws = False
    scene: Scene
    """Mitsuba scene."""
    output: Output = Path("capture")
    spp: int = 64
    """Samples per pixel."""
    seed: int = 0
    views: int | None = None
    """Place this many sensors on a sphere around the object instead of the scene's own."""
    resolution: Resolution = (512,)
    """Film of those sensors: pixels per side, or width and height."""
    resume: bool = False
    """Go on with the views that an interrupted run has left in the output folder."""

    def run(self, console: Console) -> int:
        """Render the views."""
        from svu_mi.capture.rendering import VIEWS, plan_render

        self.check()
        with claimed(self.output, "render", overwrite=self.overwrite, keep=VIEWS) as place:
            self.start()
            try:
                progress = Progress(console)
                with progress.stage("Rendering photographs") as stage:
                    plan = plan_render(
                        self.scene, self.spp, self.seed, shape=self.shape, views=self.views,
                        resolution=pair(self.resolution, "--resolution"), defines=self.defines(),
                        trust=self.trust,
                    )  # fmt: skip
                    announce_sizes(progress, str(self.scene), self.need, plan.sizes)
                    capture = plan.render(place, progress=stage.update, resume=self.resume)
            except BaseException as error:
                if was_interrupted(error):
                    raise Interrupted(self._advice(len(list(place.draft.glob(VIEWS))))) from None
                raise
        say(console, f"Wrote {capture.count} photographs to {self.output}")
        return 0

    def need(self, sizes: Sizes) -> Need:
        """Return what memory the command takes."""
        return Need("render", sizes.photographs, light=sizes.light, model="")

    def _advice(self, views: int) -> str:
        if views:
            return (
                f"interrupted; {views} views are kept: continue with the same command and "
                "--resume"
            )
        return "interrupted before the first view; run the same command again"

    def check(self) -> None:
        """Refuse options that make no sense, before any work.

        Raises:
            OptionError: there is one.
        """
        pair(self.resolution, "--resolution")
        self.defines()
        require_spp(self.spp, "--spp")
        require_views(self.views or 0, "--views")


@dataclass(frozen=True, kw_only=True)
class Demo(Overwriting, Common):
    """Render the vase that comes with svu_mi and compute its entropy."""

    output: Output = Path("out/demo")
    light: Literal["studio", "overcast", "clear", "window"] = "window"
    spp: int = 32
    """Samples per pixel of the photographs."""
    resolution: Resolution = (256,)
    """Texels per side, or width and height."""

    def run(self, console: Console) -> int:
        """Run ``entropy`` on the vase."""
        from svu_mi import scenes

        with claimed(self.output, "entropy", overwrite=self.overwrite):
            pass  # refused before any work
        with tempfile.TemporaryDirectory(prefix="svu-demo-") as folder:
            capture = Path(folder) / "capture"
            common = {f.name: getattr(self, f.name) for f in dataclasses.fields(Common)}
            define = (f"light={self.light}",)
            try:
                status = Render(
                    scene=scenes.path("vase"), output=capture, define=define, spp=self.spp,
                    **common,
                ).run(console)  # fmt: skip
            except Interrupted:  # what it has kept goes with the folder
                raise KeyboardInterrupt from None
            return status or Entropy(
                scene=capture, output=self.output, overwrite=self.overwrite,
                resolution=self.resolution, **common,
            ).run(console)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Doctor(Common):
    """Say what is installed, what can run here, and what to do about the rest."""

    draws = False

    def run(self, console: Console) -> int:
        """Print the diagnosis."""
        from svu_mi.cli.doctor import doctor

        return doctor(console)
