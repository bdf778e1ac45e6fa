"""``svu demo``: entropy of the included vase."""

from __future__ import annotations

import dataclasses
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from rich.console import Console

from svu_mi.cli.base_command import BaseCommand, Interrupted
from svu_mi.cli.entropy import Entropy
from svu_mi.cli.render import Render
from svu_mi.cli.shared_options import CaptureOptions, Output, Overwrite, Resolution, SceneOptions
from svu_mi.core.io.output_folder import claimed


@dataclass(frozen=True, kw_only=True)
class Demo(BaseCommand):
    """Render the vase that is included in svu_mi, and compute its entropy."""

    first = "output light resolution spp overwrite"
    output: Output = Path("out/demo")
    overwrite: Overwrite = False
    light: Literal["studio", "overcast", "clear", "window"] = "window"
    """Environment map of the photographs: studio and window are indoors, the others skies."""
    spp: int = 32
    """Samples per pixel of the photographs; more reduce noise."""
    resolution: Resolution = (256,)

    def run(self, console: Console) -> int:
        """Run ``entropy`` on the vase."""
        from svu_mi import scenes

        with claimed(self.output, "entropy", overwrite=self.overwrite):
            pass  # fail before any work
        with tempfile.TemporaryDirectory(prefix="svu-demo-") as folder:
            made = Path(folder) / "capture"
            common = {f.name: getattr(self, f.name) for f in dataclasses.fields(BaseCommand)}
            vase = SceneOptions(scene=scenes.path("vase"), define=(f"light={self.light}",))
            try:
                Render(source=vase, output=made, spp=self.spp, **common).run(console)
            except Interrupted:  # views in the temporary folder are lost
                raise KeyboardInterrupt from None
            capture = CaptureOptions(source=SceneOptions(scene=made))
            return Entropy(
                capture=capture, output=self.output, overwrite=self.overwrite,
                resolution=self.resolution, **common,
            ).run(console)  # fmt: skip
