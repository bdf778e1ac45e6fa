"""``svu view``: interactive viewer in a browser."""

from dataclasses import dataclass
from typing import Literal

from rich.console import Console

from svu_mi.cli import shared_options as opt
from svu_mi.cli.loading import EstimateCommand
from svu_mi.cli.streams import print_line
from svu_mi.core.progress import Progress

SIDE = 512  # texels


@dataclass(frozen=True, kw_only=True)
class View(EstimateCommand):
    """Show entropy, textures and photographs on the mesh in a browser.

    Click a texel to see its posterior, or a camera to look through it. Ctrl-C stops. Needs
    pip install 'svu_mi[viewer]'.
    """

    first = "scene recovered resolution light images port up"
    recovered: opt.Recovered = None
    resolution: opt.Size = ()
    """Texels per side, or width and height (default: as --recovered, else 512)."""
    port: int = 8080
    """Port of the page on this machine, in [0, 65535], or the next free one; 0: any free port."""
    up: Literal["y", "z"] | None = None
    """Up axis of the world (default: inferred from the cameras)."""

    def run(self, console: Console) -> int:
        """Estimate, open the page, and serve it until Ctrl-C."""
        from svu_mi.output.viewer.access_control import require_port, require_viser
        from svu_mi.output.viewer.viewer import Viewer

        self.check()
        require_port(self.port)
        require_viser()
        self.start()
        progress = Progress(console)
        size, textures = opt.read_recovered(self.recovered, self.resolution, SIDE)
        capture, result = self.load_and_estimate(progress, size, "view", self.recovered)
        with progress.stage("Opening the viewer"):
            viewer = Viewer(capture, result, textures, port=self.port, up=self.up)
        print_line(console, f"Open {viewer.url} in a browser; press Ctrl-C to stop.")
        viewer.run()
        return 0
