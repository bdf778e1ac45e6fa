"""How large everything is, and how small with ``--quick``."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any


@dataclass(frozen=True, kw_only=True)
class RecoverySizes:
    """Sizes of the recovery benchmark alone; part of the keys of its results.

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


@dataclass(frozen=True, kw_only=True)
class GuidanceSizes:
    """Sizes of the guidance benchmark alone; part of the keys of its results.

    Attributes:
        lights: at most so many lights per object.
        texels: per side, of the textures that are recovered.
        looked_at: most texels that candidates are judged by.
        starts: sets of views to start from, per cell and kind; each has random views of its own.
        kinds: of starts: ``even``, spread out from a view drawn at random, or ``one-sided``, those
            nearest to it.
        start: photographs of each.
        asked: candidates at which the forecast is compared with what their photographs change.
        marks: numbers of added views at which textures are recovered.
        strategies: what is compared.
        judged: those of them that are compared with all others.
        step: dB over the start that views are counted for.
        speed_texels: per side, where steps are timed.
        candidates: numbers of candidates that steps are timed with, the last for the bars.
        fewer: texels per side that steps are timed with, too.
        added: views chosen in a timed run.
        refits: candidates and truths that are evaluated by refitting, as a sample.
        repeats: warm runs, of which the median counts.
    """

    lights: int = 2
    texels: int = 96
    looked_at: int = 1024
    starts: int = 1
    kinds: tuple[str, ...] = ("even", "one-sided")
    start: int = 4
    asked: int = 15
    marks: tuple[int, ...] = (1, 2, 4, 6)
    strategies: tuple[str, ...] = ("entropy", "error", "farthest", "coverage", "random")
    judged: tuple[str, ...] = ("entropy", "error")
    step: float = 1.0
    speed_texels: int = 64
    candidates: tuple[int, ...] = (25, 50, 100)
    fewer: tuple[int, ...] = (32, 45)
    added: int = 5
    refits: tuple[int, int] = (2, 3)
    repeats: int = 5


@dataclass(frozen=True, kw_only=True)
class Sizes:
    """Sizes of all benchmarks; what is not of one of them alone is part of every result's key.

    Attributes:
        views: photographs per capture, on a sphere around the object.
        film: pixels per side of each.
        spp: samples per pixel.
        texels: texels per side.
        speed_texels: the same, where run times are measured.
        reference_texels: texels of the reference posterior.
        reference_spp: samples per ray of the reference. Fewer do for its entropy, but at bright
            texels its posterior then gathers where the noise happens to fit.
        brute_texels, brute_spp: texels and samples where every psi is rendered.
        checked: number of objects this is done for.
        seed: of photographs and reference.
        speed_film: pixels per side of the photographs that run times are measured on.
        repeats: warm runs of which the median is taken.
        stride: of the points of each scaling curve, only every so many-th is measured.
        recovery: what only the recovery benchmark asks for.
        guidance: what only the guidance benchmark asks for.
    """

    views: int = 60
    film: int = 256
    spp: int = 32
    texels: int = 256
    speed_texels: int = 512
    reference_texels: int = 1000
    reference_spp: int = 128
    brute_texels: int = 150
    brute_spp: int = 32
    checked: int = 4
    seed: int = 0
    speed_film: int = 512
    repeats: int = 5
    stride: int = 1
    recovery: RecoverySizes = field(default_factory=RecoverySizes)
    guidance: GuidanceSizes = field(default_factory=GuidanceSizes)

    @property
    def shared(self) -> dict[str, Any]:
        """All but the sizes of single benchmarks."""
        parts = ("recovery", "guidance")
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name not in parts}


FULL = Sizes()
QUICK = Sizes(
    views=24, film=128, spp=16, texels=192, speed_texels=256, reference_texels=200,
    reference_spp=64, brute_texels=40, brute_spp=8, checked=1, speed_film=128, repeats=3,
    stride=2,
    recovery=RecoverySizes(
        rows=("SH (ours)", "SH + sharing", "SH (paper)", "spectrum (paper)", "SH + path", "path"),
        even_cells=1, relit_views=1, relit_spp=8, dense_views=24, front=9, back=2, path_cells=0,
        repeats=1, step_views=(6, 24), step_film=48, step_steps=30, turns=1, steps=30,
        soak_texels=48, soak_views=6, soak_film=32, scale=0.05, cold=False, warm=False,
    ),
    guidance=GuidanceSizes(
        lights=1, texels=32, asked=4, marks=(1, 2), strategies=("entropy", "farthest", "random"),
        judged=("entropy",), speed_texels=16, candidates=(4, 8), fewer=(8,), added=2, refits=(1, 1),
        repeats=1,
    ),
)  # fmt: skip
