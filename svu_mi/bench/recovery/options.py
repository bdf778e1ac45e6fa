"""What of the recovery benchmark is run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from svu_mi.bench.recovery.cells import GROUPS
from svu_mi.settings import require_known

COSTS = "costs"
PARTS = (*GROUPS, COSTS)


@dataclass(frozen=True, kw_only=True)
class Options:
    """What of the recovery benchmark is run, and what of earlier runs is taken up.

    Attributes:
        data: folder the cells come from, None for the scenes of svu_mi.
        rows: labels of the rows to run; all by default.
        groups: which parts: groups of cells, and ``costs``, the time of single steps.
        keep: take up results that another version of the code found.
        stored: run nothing; only gather what is there, of any version.

    Raises:
        OptionError: an unknown group.
    """

    data: Path | None = None
    rows: Sequence[str] = ()
    groups: Sequence[str] = PARTS
    keep: bool = False
    stored: bool = False

    def __post_init__(self) -> None:
        require_known(self.groups, PARTS, "group of recovery cells")

    @property
    def any_version(self) -> bool:
        """Whether results of another version of the code do, too."""
        return self.keep or self.stored
