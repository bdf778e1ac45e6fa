"""``svu demo``: entropy of the included vase."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from rich.console import Console

from svu_mi.cli import shared_options as opt
from svu_mi.cli.base_command import BaseCommand
from svu_mi.cli.entropy import Entropy


@dataclass(frozen=True, kw_only=True)
class Demo(BaseCommand):
    """Render the vase that is included in svu_mi, and compute its entropy."""

    first = "output light resolution spp overwrite"
    output: opt.Output = Path("out/demo")
    overwrite: opt.Overwrite = False
    light: Literal["studio", "overcast", "clear", "window"] = "window"
    """Environment map of the photographs: studio and window are indoors, the others skies."""
    spp: int = 32
    """Samples per pixel of the photographs; more reduce noise."""
    resolution: opt.Resolution = (256,)

    def run(self, console: Console) -> int:
        """Run ``entropy --render`` on the vase, which keeps the photographs in ``capture``."""
        from svu_mi import scenes

        common = {f.name: getattr(self, f.name) for f in dataclasses.fields(BaseCommand)}
        vase = opt.SceneOptions(scene=scenes.path("vase"), define=(f"light={self.light}",))
        capture = opt.CaptureOptions(source=vase, rendering=opt.RenderOptions(render=True))
        return Entropy(
            capture=capture, output=self.output, overwrite=self.overwrite,
            resolution=self.resolution, spp=self.spp, **common,
        ).run(console)  # fmt: skip
