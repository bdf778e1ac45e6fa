"""Sizes of all benchmarks, in full and with ``--quick``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any


@dataclass(frozen=True, kw_only=True)
class RecoverySizes:
    """Sizes of the recovery benchmark alone; part of the keys of its results.

    Attributes:
        rows: labels of the rows that are run; all if there are none.
        even_cells: at most so many cases.
        relit_views: pictures under another light, per case.
        relit_spp: samples per pixel of these.
        even_views: at most so many photographs.
        poor: most views of a texel that counts as hardly seen.
        warm: whether kernels are compiled before a row is timed.
        repeats: warm runs of a short row; the median counts.
        long_s: a row that takes longer, in seconds, is timed once.
        scale: epochs of the path tracer and steps of the descent, as a part of the defaults.
    """

    rows: tuple[str, ...] = ()
    even_cells: int = 10_000
    relit_views: int = 4
    relit_spp: int = 64
    even_views: int = 40
    poor: int = 5
    warm: bool = True
    repeats: int = 3
    long_s: float = 15.0
    scale: float = 1.0


@dataclass(frozen=True, kw_only=True)
class GuidanceSizes:
    """Sizes of the guidance benchmark alone; part of the keys of its results.

    Attributes:
        lights: at most so many lights per object.
        texels: per side, of the textures that are recovered.
        looked_at: most texels that candidates are judged by.
        starts: sets of views to start from, per case and kind; each has random views of its own.
        kinds: of starts: ``even``, spread out from a view drawn at random, or ``one-sided``, those
            nearest to it.
        start: photographs of each.
        asked: candidates at which the forecast is compared with what their photographs change.
        marks: numbers of added views at which textures are recovered.
        strategies: what is compared.
        judged: those of them that are compared with all others.
        step: dB over the start that views are counted for.
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


@dataclass(frozen=True, kw_only=True)
class ProblemSizes:
    """Sizes of all benchmarks; the ``shared`` ones are part of every cache key.

    Attributes:
        views: photographs per capture, on a sphere around the object.
        film: pixels per side of each.
        spp: samples per pixel.
        texels: texels per side.
        speed_texels: the same, where run times are measured.
        reference_texels: texels of the reference posterior.
        reference_spp: samples per ray of the reference. Fewer do for its entropy, but at bright
            texels its posterior then gathers where the noise happens to fit.
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
    seed: int = 0
    speed_film: int = 512
    repeats: int = 5
    stride: int = 1
    recovery: RecoverySizes = field(default_factory=RecoverySizes)
    guidance: GuidanceSizes = field(default_factory=GuidanceSizes)

    @classmethod
    def read(cls, values: Mapping[str, Any]) -> ProblemSizes:
        """Return the sizes that a JSON file contains."""
        parts = {"recovery": RecoverySizes, "guidance": GuidanceSizes}
        read = {name: part(**{key: tuple(value) if isinstance(value, list) else value
                              for key, value in values[name].items()})
                for name, part in parts.items()}  # fmt: skip
        return cls(**{**values, **read})

    @property
    def shared(self) -> dict[str, Any]:
        """All but the sizes of single benchmarks."""
        parts = ("recovery", "guidance")
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name not in parts}


FULL = ProblemSizes()
QUICK = ProblemSizes(
    views=24, film=128, spp=16, texels=192, speed_texels=256, reference_texels=200,
    reference_spp=64, speed_film=128, repeats=3, stride=2,
    recovery=RecoverySizes(
        rows=("SH (ours)", "SH + sharing", "SH (paper)", "spectrum (paper)", "SH + path", "path"),
        even_cells=1, relit_views=1, relit_spp=8, repeats=1, scale=0.05, warm=False,
    ),
    guidance=GuidanceSizes(
        lights=1, texels=32, asked=4, marks=(1, 2), strategies=("entropy", "farthest", "random"),
        judged=("entropy",),
    ),
)  # fmt: skip
