"""Problem sizes of all benchmarks, full and quick."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any


@dataclass(frozen=True, kw_only=True)
class RecoverySizes:
    """Sizes of the recovery benchmark; part of the keys of its results.

    Attributes:
        rows: Labels of the rows to run; empty for the usual rows.
        even_cells: Largest number of cases.
        relit_views: Number of pictures under another light, per case.
        relit_spp: Samples per pixel of relit pictures.
        even_views: Largest number of photographs.
        poor: Largest number of views for which a texel counts as hardly seen.
        warm: Compile kernels before a row is timed.
        repeats: Number of timed runs of a short row; the median is used.
        long_s: Run time in seconds above which a row is timed once.
        scale: Factor of the default numbers of path tracing epochs and descent steps.
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
    """Sizes of the guidance benchmark; part of the keys of its results.

    Attributes:
        lights: Largest number of lights per object.
        texels: Texels per side of recovered textures.
        looked_at: Largest number of texels that candidates are scored on.
        starts: Number of initial sets of views per case and kind.
        kinds: Kinds of initial sets: ``even``, farthest-point samples after a random view, or
            ``one-sided``, the views nearest to it.
        start: Number of photographs of an initial set.
        asked: Number of candidates whose expected and measured changes are compared.
        marks: Numbers of added views after which textures are recovered.
        strategies: Names of the compared strategies.
        judged: Strategies that are compared with all others.
        step: Gain over the initial set in dB; the views needed for it are counted.
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
        views: Photographs per capture, on a sphere around the object.
        film: Pixels per side of a photograph.
        spp: Samples per pixel of a photograph.
        texels: Texels per side.
        speed_texels: Texels per side for run times.
        reference_texels: Number of texels of the reference posterior.
        reference_spp: Samples per ray of the reference. Fewer suffice for the entropy, but at
            bright texels the posterior would then fit the noise.
        seed: Seed of photographs and reference.
        speed_film: Pixels per side of a photograph for run times.
        repeats: Number of warm runs; the median is used.
        stride: Step between the measured points of each scaling curve.
        recovery: Sizes of the recovery benchmark.
        guidance: Sizes of the guidance benchmark.
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
        """Return sizes from the values of a JSON file."""
        parts = {"recovery": RecoverySizes, "guidance": GuidanceSizes}
        read = {name: part(**{key: tuple(value) if isinstance(value, list) else value
                              for key, value in values[name].items()})
                for name, part in parts.items()}  # fmt: skip
        return cls(**{**values, **read})

    @property
    def shared(self) -> dict[str, Any]:
        """All sizes except ``recovery`` and ``guidance``."""
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
