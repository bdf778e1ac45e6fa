"""How large everything is, beside what ``bench.cells.Settings`` says of the photographs."""

from __future__ import annotations

from dataclasses import dataclass

from svu_mi.guidance.options import Strategy


@dataclass(frozen=True, kw_only=True)
class Sizes:
    """Sizes of the guidance benchmark; part of every result's key.

    Attributes:
        lights: at most so many lights per object.
        texels: per side, of the textures that are recovered.
        starts: sets of views to start from, per cell; each has random views of its own.
        start: photographs of each, spread out from a view drawn at random.
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
    texels: int = 128
    starts: int = 2
    start: int = 4
    marks: tuple[int, ...] = (1, 2, 3, 4, 6, 8)
    strategies: tuple[Strategy, ...] = (
        "entropy", "error", "farthest", "coverage", "random", "d-optimal",
    )  # fmt: skip
    judged: tuple[Strategy, ...] = ("entropy", "error")
    step: float = 1.0
    speed_texels: int = 64
    candidates: tuple[int, ...] = (25, 50, 100)
    fewer: tuple[int, ...] = (32, 45)
    added: int = 5
    refits: tuple[int, int] = (2, 3)
    repeats: int = 5


FULL = Sizes()
QUICK = Sizes(
    lights=1, texels=32, starts=1, marks=(1, 2), strategies=("entropy", "farthest", "random"),
    judged=("entropy",), speed_texels=16, candidates=(4, 8), fewer=(8,), added=2, refits=(1, 1),
    repeats=1,
)  # fmt: skip
