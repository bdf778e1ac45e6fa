"""Stanford-ORB, by its own rules: PYTHONPATH=tests python -m studies.orb [--data FOLDER]."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from studies.command import Command, main
from studies.orb.options import Options
from studies.orb.run import orb_study
from studies.orb.tables import orb_lines, write_csv
from svu_mi.bench.experiment import Record
from svu_mi.bench.study import Asked, Study
from svu_mi.cli.bench import Names, names


@dataclass(frozen=True, kw_only=True)
class Orb(Command):
    """Textures recovered from the captures of Stanford-ORB, relit, against its photographs.

    Writes orb.csv, too; finished captures are kept.
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

    def study(self) -> Study:
        """Return what is measured."""
        return orb_study(Options(
            data=self.data, captures=names(self.objects, "--objects"),
            rows=names(self.rows, "--rows"), environment_view=self.environment_view,
        ))  # fmt: skip

    def asked(self) -> Asked:
        """Nothing more: the data set has no objects and environments of its own."""
        return Asked()

    def lines(self, record: Record) -> list[str]:
        """Return the means of relighting."""
        return orb_lines(record)

    def write(self, study: Study, record: Record) -> None:
        """Write orb.csv, too."""
        super().write(study, record)
        write_csv(self.output / "orb.csv", record)


if __name__ == "__main__":
    raise SystemExit(main(Orb))
