"""What the commands of all studies have in common."""

from __future__ import annotations

import inspect
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from rich.console import Console

from svu_mi.bench.experiment import Bench, Record
from svu_mi.bench.study import Asked, Study, how_it_was_run, told_how
from svu_mi.cli import main as svu
from svu_mi.cli.bench import Measured
from svu_mi.cli.terminal import say
from svu_mi.files import prepare_folder, write_text
from svu_mi.output import write_manifest


@dataclass(frozen=True, kw_only=True)
class Command(Measured):
    """A study with the options of ``svu bench``; it writes NAME.json and NAME.md."""

    @classmethod
    def name(cls) -> str:
        """Return the name of its module in ``studies``, also where that is run as a program."""
        spec = sys.modules[cls.__module__].__spec__
        module = cls.__module__ if spec is None else spec.name
        return module.removesuffix(".__main__").rpartition(".")[2]

    def bench(self, console: Console) -> Bench:
        """Return where and how the study runs; its figures depend on the code of all studies."""
        return replace(super().bench(console), code=(Path(__file__).parent,))

    def study(self) -> Study:
        """Return what is measured."""
        raise NotImplementedError

    def asked(self) -> Asked:
        """Return what of it is run."""
        return Asked(cells=self.cells(), data=self.data)

    def lines(self, record: Record) -> list[str]:
        """Return what matters most of a record, for the terminal: the bars that are missed."""
        return self.missed(record)

    def write(self, study: Study, record: Record) -> None:
        """Write what is known so far.

        Raises:
            OutputError: a file cannot be written.
        """
        words = shlex.join(["python", "-m", f"studies.{self.name()}", *sys.argv[1:]])
        how = how_it_was_run(words)
        write_manifest(self.output / f"{self.name()}.json", {**how, **record})
        text = f"{told_how(how)}\n\n{study.markdown(record)}"
        write_text(self.output / f"{self.name()}.md", text)

    def run(self, console: Console) -> int:
        """Run the study."""
        prepare_folder(self.output)
        self.start()
        study = self.study()
        record = study.run(
            self.bench(console), self.asked(), lambda found: self.write(study, found)
        )
        self.write(study, record)
        for line in (*self.lines(record), f"Wrote {self.output}"):
            say(console, line)
        return 0


def main(command: type[Command], arguments: Sequence[str] | None = None) -> int:
    """Run a study as ``svu`` runs a command: 2 on bad input, said in one line."""
    program = f"python -m studies.{command.name()}"
    return svu.main(arguments, command, program, inspect.getdoc(command) or "")
