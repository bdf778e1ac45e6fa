"""Stanford-ORB, by its own rules: PYTHONPATH=tests python -m studies.orb [--data FOLDER]."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

from studies.command import Study, main
from studies.orb.options import Options
from studies.orb.run import run_orb, write_orb_results
from studies.orb.tables import orb_lines
from svu_mi.bench.accuracy import Bench
from svu_mi.cli.bench import Names, names


@dataclass(frozen=True, kw_only=True)
class Orb(Study):
    """Textures recovered from the captures of Stanford-ORB, relit, against its photographs.

    Writes orb.json, orb.md and orb.csv; finished captures are kept.
    """

    data: Path | None = None
    """The data set, with blender_HDR/ and ground_truth/; without it, scenes of svu_mi in its
    layout."""
    objects: Names = ""
    """Objects or captures to run, such as teapot or teapot_scene001; without it all."""
    rows: Names = ""
    """Ways of recovery to run; without it those that trace no paths."""
    environment_view: str | None = None
    """Test photograph, such as 0003, whose environment map is the light of recovery; without it
    the first."""

    def measure(self, bench: Bench) -> list[str]:
        """Recover and compare, write after each capture, and return the means of relighting."""
        options = Options(
            data=self.data, captures=names(self.objects, "--objects"),
            rows=names(self.rows, "--rows"), environment_view=self.environment_view,
        )  # fmt: skip
        found = run_orb(bench, options, finished=partial(write_orb_results, self.output))
        return orb_lines(found)


if __name__ == "__main__":
    raise SystemExit(main(Orb))
