"""What the commands of all studies have in common."""

from __future__ import annotations

import inspect
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from svu_mi.bench.accuracy import Bench
from svu_mi.bench.run import how_it_was_run
from svu_mi.bench.tables import told_how
from svu_mi.cli import main as svu
from svu_mi.cli.bench import Measured
from svu_mi.cli.inputs import say
from svu_mi.files import prepare_folder, write_text
from svu_mi.output import write_manifest


@dataclass(frozen=True, kw_only=True)
class Study(Measured):
    """A command with the options of ``svu bench``."""

    def run(self, console: Console) -> int:
        """Run the study."""
        prepare_folder(self.output)
        self.start()
        for line in (*self.measure(self.bench(console)), f"Wrote {self.output}"):
            say(console, line)
        return 0

    def measure(self, bench: Bench) -> list[str]:
        """Measure, write what was found, and return lines about what matters most."""
        raise NotImplementedError


def main(study: type[Study], arguments: Sequence[str] | None = None) -> int:
    """Run a study as ``svu`` runs a command: 2 on bad input, said in one line."""
    program = f"python -m studies.{study.__name__.lower()}"
    return svu.main(arguments, study, program, inspect.getdoc(study) or "")


def write_study(folder: Path, name: str, found: Any, title: str, tables: str) -> None:
    """Write NAME.json and NAME.md.

    Args:
        folder: of the files.
        name: of the study.
        found: what it found, for JSON.
        title: of the tables.
        tables: the same as Markdown.

    Raises:
        OutputError: a file cannot be written.
    """
    words = ["python", "-m", f"studies.{name}", *sys.argv[1:]]
    how = how_it_was_run(shlex.join(words))
    write_manifest(folder / f"{name}.json", {**how, name: found})
    write_text(folder / f"{name}.md", "\n\n".join([f"# {title}", told_how(how), tables]))
