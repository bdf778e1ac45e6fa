"""``svu compare``: differences between two results."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from svu_mi.cli import shared_options as opt
from svu_mi.cli.base_command import ResultCommand
from svu_mi.cli.loading import read_capture, with_light_search
from svu_mi.core.io.output_folder import Claim
from svu_mi.core.memory import MODELS, Need
from svu_mi.core.progress import Progress

Result = Annotated[Path, Positional]
Preset = Literal["default", "fixed", "fast", "paper"]
Presets = Annotated[tuple[Preset, ...], arg(metavar="PRESET [PRESET]")]


@dataclass(frozen=True, kw_only=True)
class Compare(ResultCommand):
    """Compare two captures, results or texture folders of one object.

    A and B are captures (estimated first), folders written by svu entropy or svu recover, or
    folders with base_color, roughness or metallic as EXR or PNG, all with the same UVs. Writes
    compare.html, compare.json and a difference_*.exr (B minus A) per map.
    """

    a: Annotated[Result, arg(metavar="A")]
    """First capture or result, such as before a change."""
    b: Annotated[Result, arg(metavar="B")]
    """Second capture or result; differences are B minus A."""
    command, page = "compare", "compare.html"
    first = "a b output resolution preset tolerance overwrite"
    output: opt.Output = Path("out/compare")
    preset: Presets = ("default",)
    """Preset for captures: default, fixed, fast or paper; or two presets, for A and for B."""
    resolution: opt.Size = ()
    """Texels per side, or width and height (default: of the coarser textures; captures: 512)."""
    tolerance: float = 0.05
    """Difference of a parameter, in [0, 1], that counts as a change where no standard
    deviation is known."""
    memory: opt.Memory = ""

    def check(self) -> None:
        """Refuse invalid options (OptionError)."""
        opt.parse_bytes(self.memory)
        if self.resolution:
            opt.parse_resolution(self.resolution)

    def work(self, progress: Progress, place: Claim) -> list[str]:
        """Compare, write the page, and summarise it."""
        from svu_mi.capture.crop import Detail
        from svu_mi.output.compare.compare_page import write_comparison
        from svu_mi.output.compare.differences import ComparisonPlan

        preset = self.preset[0] if len(self.preset) == 1 else self.preset
        size = opt.parse_resolution(self.resolution) if self.resolution else None
        plan = ComparisonPlan(
            self.a, self.b, preset=preset, resolution=size, tolerance=self.tolerance
        )
        # The memory of the larger of the two estimates.
        model = max(self.preset, key=MODELS.__getitem__)
        need = with_light_search(partial(Need, "compare", resolution=plan.size, model=model))
        for index, path in plan.captures:
            capture = read_capture(
                progress, opt.SceneOptions(scene=path), opt.PhotographOptions(memory=self.memory),
                need, Detail(texels=plan.size), trust=self.trust,
            )  # fmt: skip
            plan.estimate(index, capture, progress)
        comparison = plan.compared()
        with progress.stage("Writing the page"):
            write_comparison(comparison, place, settings=opt.as_dict(self))
        return [comparison.sentence()]
