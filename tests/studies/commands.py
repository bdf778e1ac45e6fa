"""How long whole commands take: new processes, pictures included, kernels in the cache.

    PYTHONPATH=tests python -m studies.commands -o out/commands

Photographs of the vase are rendered into the output folder, if they are not there yet.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from svu_mi import scenes
from svu_mi.bench.text import table
from svu_mi.cli import main as svu
from svu_mi.cli.terminal import say
from svu_mi.errors import SvuEnvironmentError
from svu_mi.files import write_text

REPEATS = 3


@dataclass(frozen=True)
class Timed:
    """A command that is timed.

    Attributes:
        name: for people.
        views: number of photographs of 512 x 512 pixels.
        words: of the command line; ``{capture}`` is their folder, ``{textures}`` recovered ones.
        most: seconds that it may take.
        recover: options of ``svu recover``, where ``{textures}`` are needed.
    """

    name: str
    views: int
    words: tuple[str, ...]
    most: float
    recover: tuple[str, ...] = ()


COMMANDS = (
    Timed("report, 60 photographs, 256 x 256 texels", 60, ("report", "{capture}"), 8),
    Timed("guide, 40 photographs, 256 x 256 texels, 100 candidates, 5 proposals", 40,
          ("guide", "{capture}", "--resolution", "256"), 8),
    Timed("recover, 40 photographs, 256 x 256 texels", 40,
          ("recover", "{capture}", "--resolution", "256"), 8),
    Timed("relight, one view of 512 x 512 in 16 draws", 40,
          ("relight", "{capture}", "--recovered", "{textures}", "--views", "1"), 60,
          recover=("--resolution", "256", "--draws", "16")),
    Timed("inpaint, 512 x 512 texels", 40,
          ("inpaint", "{capture}", "--recovered", "{textures}"), 60,
          recover=("--resolution", "512")),
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Commands:
    """Time svu report, guide, recover, relight and inpaint; writes commands.md."""

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("out/commands")
    """Folder for photographs and results."""
    draws = False

    def run(self, console: Console) -> int:
        """Run every command once to fill the kernel cache, then time it."""
        self.output.mkdir(parents=True, exist_ok=True)
        rows = []
        for one in COMMANDS:
            name = one.words[0]
            target = self.output / f"result_{name}{'.html' if name == 'report' else ''}"
            line = [*self._line(one), "-o", str(target)]
            runs = [_timed(line) for _ in range(1 + REPEATS)][1:]
            wall, processor = (statistics.median(column) for column in zip(*runs, strict=True))
            rows.append([one.name, f"{wall:.1f} s", f"{one.most:g} s", f"{processor:.1f} s"])
            say(console, f"{one.name}: {wall:.1f} s, {processor:.1f} s of processors")
        head = ["command", "wall", "at most", "processors"]
        write_text(self.output / "commands.md", table(head, rows))
        say(console, f"Wrote {self.output / 'commands.md'}")
        return 0

    def _line(self, one: Timed) -> list[str]:
        """Return the words of a command, and make what it needs."""
        capture, textures = self._photographs(one.views), self.output / f"textures_{one.words[0]}"
        if one.recover and not textures.exists():
            _timed(["recover", str(capture), *one.recover, "-o", str(textures)])
        return [word.format(capture=capture, textures=textures) for word in one.words]

    def _photographs(self, views: int) -> Path:
        folder = self.output / f"vase_{views}"
        if not folder.exists():
            _timed(["render", str(scenes.path("vase")), "-D", "light=window", "--views", str(views),
                    "--spp", "16", "-o", str(folder)])  # fmt: skip
        return folder


def _timed(words: list[str]) -> tuple[float, float]:
    """Run ``svu`` in a new process; returns seconds by the clock, start and imports included, and
    those of all processors, which other processes change less."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)  # modules that are installed are compiled
    start, before = time.perf_counter(), os.times()
    done = subprocess.run(
        [sys.executable, "-m", "svu_mi", *words], env=environment,
        capture_output=True, text=True, errors="replace",
    )  # fmt: skip
    if done.returncode != 0:
        raise SvuEnvironmentError(f"svu {words[0]} failed: {done.stderr.strip().splitlines()[-1]}")
    after = os.times()
    processor = sum(b - a for a, b in zip(before[2:4], after[2:4], strict=True))
    return time.perf_counter() - start, processor


if __name__ == "__main__":
    sys.exit(svu.main(None, Commands, "python -m studies.commands", Commands.__doc__ or ""))
