"""What of Stanford-ORB is run, how large, and by which ways of recovery."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from svu_mi.bench.recovery import rows as ways
from svu_mi.bench.recovery.rows import Row
from svu_mi.bench.sizes import RecoverySizes
from svu_mi.recovery.options import PathOptions, ShOptions
from svu_mi.settings import require_known


@dataclass(frozen=True)
class OrbRow(Row):
    """A way of recovery for real photographs: paths have all the bounces of the scene."""

    def options(self, scale: float = 1.0) -> tuple[ShOptions, PathOptions]:
        """Return the presets' options (see ``Row``)."""
        sh, path = super().options(scale)
        return sh, replace(path, max_depth=None)


# Those of the paper's Table 1: SH model, power spectrum, SH and one epoch of paths, Mitsuba.
ROWS = tuple(
    OrbRow(row.label, row.method, row.sh, row.path, row.sharing)
    for row in (ways.SH, ways.SH_PATH, ways.PATH, ways.SH_PAPER, ways.SPECTRUM,
                ways.SH_PAPER_PATH, ways.PATH_PAPER)
)


@dataclass(frozen=True, kw_only=True)
class OrbSizes:
    """How large everything is; part of every result's key.

    Attributes:
        film: pixels of the longer side that photographs are reduced to, before anything else;
            512 is that of the data set's own evaluation.
        texels: texels per side.
        spp: samples per pixel of the pictures.
        recovery: whether runs are warm, and how often they are timed (``bench.sizes``).
    """

    film: int = 512
    texels: int = 512
    spp: int = 128
    recovery: RecoverySizes = field(default_factory=RecoverySizes)


FULL = OrbSizes()
QUICK = OrbSizes(film=128, texels=128, spp=64, recovery=RecoverySizes(warm=False, repeats=1))


@dataclass(frozen=True, kw_only=True)
class Options:
    """What of the data set is run.

    Attributes:
        data: its folder, with blender_HDR and ground_truth; None for a rendered set of svu_mi's own
            scenes in the same layout.
        captures: names of captures (``teapot_scene001``) or objects (``teapot``); all by default.
        rows: labels of ways of recovery; by default those that trace no paths.
        environment_view: test photograph whose environment map is the light of recovery; by
            default the first.
        sizes: None for those that fit ``Bench.quick``.
    """

    data: Path | None = None
    captures: Sequence[str] = ()
    rows: Sequence[str] = ()
    environment_view: str | None = None
    sizes: OrbSizes | None = None

    def chosen_rows(self) -> tuple[OrbRow, ...]:
        """Return the ways of recovery, in the order of the table.

        Raises:
            OptionError: there is none of a name.
        """
        require_known(self.rows, [row.label for row in ROWS], "row")
        return tuple(row for row in ROWS if row.label in self.rows or not (self.rows or row.traced))

    def chosen_captures(self, found: Sequence[Path]) -> tuple[Path, ...]:
        """Return the captures that are asked for, of those found.

        Raises:
            OptionError: there is none of a name.
        """
        names = {path: (path.name, object_of(path.name)) for path in found}
        known = dict.fromkeys(name for both in zip(*names.values(), strict=True) for name in both)
        require_known(self.captures, known, "capture or object")
        asked = set(self.captures)
        return tuple(path for path in found if not asked or asked & set(names[path]))


def object_of(capture: str) -> str:
    """Return the object of a capture: ``teapot`` of ``teapot_scene001``."""
    return capture.rpartition("_")[0] or capture
