"""How often ``svu check`` is right: PYTHONPATH=tests python -m studies.conventions [--quick]."""

from __future__ import annotations

from dataclasses import dataclass

from studies.command import Study, main, write_study
from studies.conventions.run import conventions_tables, run_conventions
from svu_mi.bench.accuracy import Bench
from svu_mi.cli.bench import Names, names


@dataclass(frozen=True, kw_only=True)
class Conventions(Study):
    """How often svu check finds axes that were imported wrongly.

    Writes conventions.json and conventions.md; finished imports are kept.
    """

    rows: Names = ""
    """Ways that photographs come, such as COLMAP; without it all."""

    def measure(self, bench: Bench) -> list[str]:
        """Measure, and write what was found."""
        rows = run_conventions(bench, self.cells(), names(self.rows, "--rows"))
        tables = conventions_tables(rows)
        write_study(self.output, "conventions", rows, "Mistakes about axes", tables)
        return []


if __name__ == "__main__":
    raise SystemExit(main(Conventions))
