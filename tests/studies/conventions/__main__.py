"""How often ``svu check`` is right: PYTHONPATH=tests python -m studies.conventions [--quick]."""

from __future__ import annotations

from dataclasses import dataclass, replace

from studies.command import Command, main
from studies.conventions.run import checks_of, conventions_tables, experiment
from svu_mi.bench.study import Asked, Study
from svu_mi.cli.bench import Names, names

STUDY = Study(title="Mistakes about axes", experiment=experiment,
              tables=lambda record: [conventions_tables(checks_of(record))])  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Conventions(Command):
    """How often svu check finds axes that were imported wrongly; finished imports are kept."""

    rows: Names = ""
    """Ways that photographs come, such as COLMAP; without it all."""

    def study(self) -> Study:
        """Return what is measured."""
        return STUDY

    def asked(self) -> Asked:
        """Return what of it is run."""
        return replace(super().asked(), rows=names(self.rows, "--rows"))


if __name__ == "__main__":
    raise SystemExit(main(Conventions))
