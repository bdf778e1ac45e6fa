"""``svu scenes``: list and copy the included scenes."""

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

from rich.console import Console
from tyro.conf import Positional, arg

from svu_mi import scenes
from svu_mi.cli.base_command import Verbose
from svu_mi.cli.shared_options import Output
from svu_mi.cli.streams import print_line

Name = Annotated[str, Positional, arg(metavar="[NAME]")]
# Arguments of svu render that a scene needs.
NEEDS = {"object": "-D object=FOLDER -D environment=FILE"}


@dataclass(frozen=True, kw_only=True)
class Scenes:
    """List the included scenes, or copy one with its files.

    Each scene has 24 sensors and the parameters -D resolution=PIXELS and -D light=studio, overcast,
    clear or window.
    """

    uses_matplotlib: ClassVar[bool] = False
    first: ClassVar[str] = "name output"
    name: Name = ""
    """Scene to copy (default: list all)."""
    output: Output = Path("scenes")
    verbose: Verbose = False

    def run(self, console: Console) -> int:
        """List the scenes, or copy one."""
        if not self.name:
            for name, sentence in scenes.ABOUT.items():
                print_line(console, f"{name:8} {sentence}")
            print_line(console, "Copy one with: svu scenes NAME")
            return 0
        copy = scenes.copy(self.name, self.output)
        print_line(console, f"Wrote {copy}")
        more = NEEDS.get(self.name, "-D light=window")
        print_line(console, f"Next: svu render {shlex.quote(str(copy))} {more} -o capture")
        return 0
