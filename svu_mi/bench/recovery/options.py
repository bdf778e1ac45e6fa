"""What of the recovery benchmark is run, and how large, beside ``bench.cells.Settings``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from svu_mi.bench.recovery.cells import GROUPS
from svu_mi.settings import require_known

COSTS = "costs"
PARTS = (*GROUPS, COSTS)


@dataclass(frozen=True, kw_only=True)
class Sizes:
    """Sizes of the recovery benchmark; part of every result's key.

    Attributes:
        rows: labels of the rows that are run; all if there are none.
        even_cells: at most so many cells with photographs from everywhere.
        relit_views: pictures under another light, per cell.
        relit_spp: samples per pixel of these.
        even_views: at most so many photographs of the other cells.
        dense_views: photographs that uneven ones are chosen from.
        front, back: how many of them from one side, and from everywhere else.
        poor: most views of a texel that counts as hardly seen.
        path_cells: at most so many cells per group are recovered by the path tracer for sharing.
        warm: whether kernels are compiled before a row is timed.
        repeats: warm runs of a short row; the median counts.
        long_s: a row that takes longer, in seconds, is timed once.
        step_views: few and many views, whose steps must cost the same.
        step_film: pixels per side of these photographs.
        step_steps: of the descents that this is measured on.
        turns: pairs of path steps, with sharing and without, that are compared.
        steps: of the long run that is watched for memory and kernels.
        soak_texels, soak_views, soak_film: texels per side and photographs of that run.
        scale: epochs of the path tracer and steps of the descent, as a part of the defaults.
        cold: whether rows are also timed in a new process with an empty kernel cache.
    """

    rows: tuple[str, ...] = ()
    even_cells: int = 10_000
    relit_views: int = 4
    relit_spp: int = 64
    even_views: int = 40
    dense_views: int = 80
    front: int = 36
    back: int = 5
    poor: int = 5
    path_cells: int = 2
    warm: bool = True
    repeats: int = 3
    long_s: float = 15.0
    step_views: tuple[int, int] = (20, 200)
    step_film: int = 128
    step_steps: int = 100
    turns: int = 15
    steps: int = 300
    soak_texels: int = 128
    soak_views: int = 24
    soak_film: int = 96
    scale: float = 1.0
    cold: bool = True


FULL = Sizes()
QUICK = Sizes(
    rows=("SH (ours)", "SH + sharing", "SH (paper)", "spectrum (paper)", "SH + path", "path"),
    even_cells=1, relit_views=1, relit_spp=8, dense_views=24, front=9, back=2, path_cells=0,
    repeats=1, step_views=(6, 24), step_film=48, step_steps=30, turns=1, steps=30,
    soak_texels=48, soak_views=6, soak_film=32, scale=0.05, cold=False, warm=False,
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Options:
    """What of the recovery benchmark is run, and what of earlier runs is taken up.

    Attributes:
        data: folder the cells come from, None for the scenes of svu_mi.
        rows: labels of the rows to run; all by default.
        groups: which parts: groups of cells, and ``costs``, the time of single steps.
        keep: take up results that another version of the code found.
        stored: run nothing; only gather what is there, of any version.
        sizes: None for those that fit ``Bench.quick``.

    Raises:
        OptionError: an unknown group.
    """

    data: Path | None = None
    rows: Sequence[str] = ()
    groups: Sequence[str] = PARTS
    keep: bool = False
    stored: bool = False
    sizes: Sizes | None = None

    def __post_init__(self) -> None:
        require_known(self.groups, PARTS, "group of recovery cells")

    @property
    def any_version(self) -> bool:
        """Whether results of another version of the code do, too."""
        return self.keep or self.stored
