"""How large everything is, beside what ``bench.cells.Settings`` says of the photographs."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Sizes:
    """Sizes of the guidance benchmark; part of every result's key.

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


FULL = Sizes()
QUICK = Sizes(
    lights=1, texels=32, asked=4, marks=(1, 2), strategies=("entropy", "farthest", "random"),
    judged=("entropy",), speed_texels=16, candidates=(4, 8), fewer=(8,), added=2, refits=(1, 1),
    repeats=1,
)  # fmt: skip
