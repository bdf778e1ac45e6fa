"""``svu render``: render photographs of a scene."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

from rich.console import Console

from svu_mi.cli.base_command import BaseCommand, interruptible
from svu_mi.cli.loading import photograph_memory
from svu_mi.cli.shared_options import Count, Output, Overwrite, SceneOptions, Size, parse_size
from svu_mi.cli.streams import print_line
from svu_mi.core.io.output_folder import Claim, claimed
from svu_mi.core.memory import Need
from svu_mi.core.progress import Progress
from svu_mi.core.validation import require_spp, require_views
from svu_mi.errors import are, counted


@dataclass(frozen=True, kw_only=True)
class Render(BaseCommand):
    """Render the sensors of a Mitsuba scene, or of a capture, to a capture folder."""

    uses_matplotlib = False
    first = "scene output views resolution spp define shape seed resume overwrite"
    source: SceneOptions
    output: Output = Path("capture")
    overwrite: Overwrite = False
    spp: int = 64
    """Samples per pixel; more reduce noise."""
    seed: int = 0
    """Random seed, at least 0."""
    views: Count = None
    """Number of sensors to place on a sphere around the object (default: the existing sensors)."""
    resolution: Size = (512,)
    """Film size of --views sensors in pixels: one number, or width and height."""
    resume: bool = False
    """Continue an interrupted run: keep the views in the output folder."""

    def run(self, console: Console) -> int:
        """Render the views."""
        from svu_mi.capture.rendering import VIEWS

        size, defines = parse_size(self.resolution), self.source.defines()
        require_spp(self.spp, "--spp")
        require_views(self.views or 0, "--views")
        earlier = len(list(self.output.glob(VIEWS)))
        with claimed(self.output, "render", overwrite=self.overwrite, keep=VIEWS) as place:
            self.start()
            with interruptible(lambda: _advice(len(list(place.draft.glob(VIEWS))))):
                count = self._render(Progress(console), size, defines, place)
        replaced = f", in place of {earlier}" if earlier > count else ""
        print_line(console, f"Wrote {counted(count, 'photograph')} to {self.output}{replaced}")
        return 0

    def _render(
        self, progress: Progress, size: tuple[int, int], defines: dict[str, str], place: Claim
    ) -> int:
        from svu_mi.capture.rendering import plan_render

        with progress.stage("Rendering photographs") as stage:
            plan = plan_render(
                self.source.scene, self.spp, self.seed, shape=self.source.shape, views=self.views,
                resolution=size, defines=defines, trust=self.trust,
            )  # fmt: skip
            need = partial(Need, "render")
            photograph_memory(progress, str(self.source.scene), need, plan.sizes)
            return plan.render(place, progress=stage.update, resume=self.resume).count


def _advice(views: int) -> str:
    if views:
        kept = f"{counted(views, 'view')} {are(views)} kept"
        return f"interrupted; {kept}: continue with the same command and --resume"
    return "interrupted before the first view; run the same command again"
