"""``svu scenes``: the scenes that come with svu_mi, and copies of them."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

import tyro
from rich.console import Console

from svu_mi import scenes
from svu_mi.cli.common import Verbose
from svu_mi.cli.options import Output
from svu_mi.cli.terminal import say

Name = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="[NAME]")]
# What else the next command must say.
NEEDS = {"object": "-D object=FOLDER -D environment=FILE"}


@dataclass(frozen=True, kw_only=True)
class Scenes:
    """List the scenes that come with svu_mi, or copy one, with all it needs.

    Each has 24 sensors, and takes -D light=NAME and -D resolution=PIXELS; the lights are studio,
    overcast, clear and window.
    """

    draws: ClassVar[bool] = False
    name: Name = ""
    """Scene to copy; without a name all are listed."""
    output: Output = Path("scenes")
    verbose: Verbose = False

    def run(self, console: Console) -> int:
        """List or copy."""
        if not self.name:
            for name, sentence in scenes.ABOUT.items():
                say(console, f"{name:8} {sentence}")
            say(console, "Copy one with: svu scenes NAME")
            return 0
        copy = scenes.copy(self.name, self.output)
        say(console, f"Wrote {copy}")
        more = NEEDS.get(self.name, "-D light=window")
        say(console, f"Next: svu render {shlex.quote(str(copy))} {more} -o capture")
        return 0
