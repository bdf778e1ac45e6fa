"""``svu view``: the object and all that is known of it, in a browser."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

from rich.console import Console

from svu_mi.cli.common import Common
from svu_mi.cli.loading import Loading
from svu_mi.cli.options import (
    CaptureOptions,
    EstimateOptions,
    GivenLight,
    Output,
    Recovered,
    Samples,
    Size,
    pair,
    recovered_textures,
)
from svu_mi.cli.terminal import say
from svu_mi.limits import require_texels
from svu_mi.memory import Need
from svu_mi.progress import Progress

SIDE = 512  # texels


@dataclass(frozen=True, kw_only=True)
class View(Common):
    """Look at entropy, textures and photographs on the object, in a browser.

    Click a texel for its posterior and a camera to look through it; Ctrl-C stops. Needs
    pip install 'svu_mi[viewer]'.
    """

    capture: CaptureOptions
    spp: Samples = 64
    estimation: EstimateOptions = EstimateOptions()
    light: GivenLight = None
    output: Output = Path("out")
    recovered: Recovered = None
    resolution: Size = ()
    """Texels per side, or width and height; by default those of --recovered, else 512."""
    port: int = 8080
    """Port of the page on this machine; the next free one if it is in use."""
    up: Literal["y", "z"] | None = None
    """Axis of the world that points up; by default that of the cameras."""

    def run(self, console: Console) -> int:
        """Estimate, open the page, and serve it until Ctrl-C."""
        from svu_mi.output.textures import require_textures_of
        from svu_mi.output.viewer.server import require_port, require_viser
        from svu_mi.output.viewer.viewer import Viewer

        require_texels(pair(self.resolution or (SIDE,), "--resolution"), "--resolution")
        self.capture.check(self.spp)
        self.estimation.check()
        require_port(self.port)
        require_viser()
        self.start()
        progress = Progress(console)
        size, textures = recovered_textures(self.recovered, self.resolution, SIDE)
        capture, texels = Loading(
            options=self.capture, resolution=size, trust=self.trust, spp=self.spp,
            need=partial(Need.of, "view", resolution=size, model=self.estimation.model),
            folder=self.output / "capture",
        ).load_lit(progress, self.light, self.output / "light")  # fmt: skip
        if self.recovered is not None:
            require_textures_of(capture, self.recovered)
        result = self.estimation.estimate(progress, capture, texels)
        with progress.stage("Opening the viewer"):
            viewer = Viewer(capture, result, textures, port=self.port, up=self.up)
        say(console, f"Open {viewer.url} in a browser; press Ctrl-C to stop.")
        viewer.run()
        return 0
