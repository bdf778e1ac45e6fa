"""``svu compare``: differences between two results."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import tyro

from svu_mi.cli import shared_options as opt
from svu_mi.cli.base_command import ResultCommand
from svu_mi.cli.loading import read_capture, with_light_search
from svu_mi.core.io.output_folder import Claim
from svu_mi.core.memory import MODELS, Need
from svu_mi.core.progress import Progress

Result = Annotated[Path, tyro.conf.Positional]
Preset = Literal["default", "fixed", "fast", "paper"]
Presets = Annotated[tuple[Preset, ...], tyro.conf.arg(metavar="PRESET [PRESET]")]


@dataclass(frozen=True, kw_only=True)
class Compare(ResultCommand):
    """Compare two captures, results or folders of textures of one object.

    Each of A and B is a capture (which is estimated), a folder that svu entropy or svu recover
    wrote, or any folder with base_color, roughness and metallic (some of them) as EXR or PNG, over
    the same UVs. Writes compare.html, compare.json and a difference_*.exr of every map.
    """

    a: Annotated[Result, tyro.conf.arg(metavar="A")]
    """The first, such as before a change."""
    b: Annotated[Result, tyro.conf.arg(metavar="B")]
    """The second, which the first is subtracted from."""
    command, page = "compare", "compare.html"
    output: opt.Output = Path("out/compare")
    preset: Presets = ("default",)
    """Of estimates of captures: default, fixed, fast or paper; two for A and B."""
    resolution: opt.Size = ()
    """Texels per side, or width and height; by default those of the coarser textures, or 512."""
    tolerance: float = 0.05
    """Difference that counts where it is not known how certain both are."""
    memory: opt.Memory = ""
    """Memory that the photographs of a capture may take, such as 4G; beyond it they lie in a file.
    By default half of what is free."""

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
        # Of the one of the two estimates that takes more.
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
