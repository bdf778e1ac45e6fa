"""What a texel costs, of few and of many: ``svu entropy`` of the same photographs.

    PYTHONPATH=tests python -m studies.texels -o out/texels

Sixty views of the vase are rendered, if they are not there yet. Every run is a process of its own
in a control group (see ``studies.large``), one after the other; of few texels there are several,
of which the median counts. What does not depend on texels is in no figure of a texel: starting,
reading photographs, finding silhouettes, pictures, and the seconds that next to no texels take,
which are what kernels are traced and loaded in.
"""

from __future__ import annotations

import json
import re
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from studies.large import measured, run
from svu_mi import scenes
from svu_mi.bench.text import table
from svu_mi.cli import main as svu
from svu_mi.cli.terminal import say
from svu_mi.files import write_text
from svu_mi.output.manifest import RECORD

STAGE = re.compile(r"^(\w[\w ]+): ([\d.]+) s", re.MULTILINE)  # what a command says of its stages
FIXED = ("Loading the capture", "Finding silhouettes", "Reading the light")
SPP = 4
WITHIN = 0.2  # by which the cost of a texel may differ
MOST = 6.442  # GB, 6 GiB


@dataclass(frozen=True, kw_only=True)
class Texels:
    """Compare what a texel costs in a small and in a large texture; writes texels.md."""

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("out/texels")
    """Folder for photographs and results."""
    photographs: int = 60
    """How many there are."""
    pixels: int = 1024
    """Per side of each."""
    least: int = 64
    """Texels per side of next to none."""
    few: int = 512
    """Texels per side of the small texture."""
    many: int = 4096
    """Texels per side of the large one."""
    repeat: int = 3
    """Runs of few, and of next to none."""
    memory: float = MOST
    """GB that a command may take."""
    draws = False

    def run(self, console: Console) -> int:
        """Run both; 1 if a texel does not cost the same."""
        capture = self._capture()
        self._seconds(console, capture, self.few)  # kernels are compiled
        none, small = (self._median(console, capture, side) for side in (self.least, self.few))
        large = self._seconds(console, capture, self.many)
        ratio = large.each(none) / small.each(none)
        rows = [
            [f"{side} x {side}", f"{one.texels}", f"{one.wall:.0f} s", f"{one.peak:.2f} GB",
             f"{one.seconds:.1f} s", f"{one.each(none):.1f} us"]
            for side, one in ((self.few, small), (self.many, large))
        ]  # fmt: skip
        told = (
            f"{ratio:.2f} times as much per texel (bar {1 - WITHIN:g} to {1 + WITHIN:g}), less "
            f"{none.seconds:.1f} s of {none.texels} texels."
        )
        say(console, told)
        heading = [
            "texels", "on charts", "wall", "memory at its peak, without files",
            "stages that depend on texels", "per texel",
        ]  # fmt: skip
        write_text(self.output / "texels.md", f"{table(heading, rows)}\n\n{told}\n")
        return int(abs(ratio - 1) > WITHIN)

    def _capture(self) -> Path:
        folder = self.output / "capture"
        if not (folder / "capture.json").is_file():
            run(
                "render", str(scenes.path("vase")), "-D", "light=window",
                "--views", str(self.photographs), "--resolution", str(self.pixels),
                "--spp", str(SPP), "-o", str(folder),
            )  # fmt: skip
        return folder

    def _median(self, console: Console, capture: Path, side: int) -> _Run:
        runs = sorted(self._seconds(console, capture, side) for _ in range(self.repeat))
        return runs[len(runs) // 2]

    def _seconds(self, console: Console, capture: Path, side: int) -> _Run:
        target = self.output / f"entropy_{side}"
        log = self.output / f"entropy_{side}.log"
        words = ["entropy", str(capture), "--resolution", str(side), "--no-pictures"]
        wall, peak, _ = measured([*words, "-o", str(target)], log, self.memory)
        record = json.loads((target / RECORD).read_text(encoding="utf-8"))
        own = {
            name: float(seconds) for name, seconds in STAGE.findall(log.read_text(encoding="utf-8"))
            if name not in FIXED
        }  # fmt: skip
        found = _Run(sum(own.values()), wall, peak, record["result"]["texels"])
        stages = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in own.items())
        say(console, f"{side} x {side}: {wall:.0f} s, {peak:.2f} GB; {stages}")
        return found


@dataclass(frozen=True, order=True)
class _Run:
    """Seconds that texels took, and in all; GB; texels on charts."""

    seconds: float
    wall: float
    peak: float
    texels: int

    def each(self, none: _Run) -> float:
        """Return microseconds of a texel, less what next to none take."""
        return 1e6 * (self.seconds - none.seconds) / (self.texels - none.texels)


if __name__ == "__main__":
    sys.exit(svu.main(None, Texels, "python -m studies.texels", Texels.__doc__ or ""))
