"""Time the kernels: PYTHONPATH=tests python -m studies.kernels [--quick]."""

from __future__ import annotations

from dataclasses import dataclass

from studies.command import Study, main, write_study
from studies.kernels.run import recall_kernels
from studies.kernels.tables import kernel_tables
from svu_mi.bench.accuracy import Bench


@dataclass(frozen=True, kw_only=True)
class Kernels(Study):
    """Speed and error of every kernel, what skipping saves, scaling, memory.

    The whole way, from files to a map, is that of the first object under the first light.
    Writes kernels.json and kernels.md.
    """

    def measure(self, bench: Bench) -> list[str]:
        """Measure, write what was found, and return the bars that are missed."""
        found = recall_kernels(bench, self.cells()[0])
        write_study(self.output, "kernels", found, "Kernels", kernel_tables(found))
        return self.missed(found)


if __name__ == "__main__":
    raise SystemExit(main(Kernels))
