"""Settings of capture guidance."""

from __future__ import annotations

from dataclasses import dataclass

from svu_mi.guidance.strategies import Name
from svu_mi.settings import require, require_one_of, require_types


@dataclass(frozen=True, kw_only=True)
class GuidanceOptions:
    """How candidates are judged."""

    strategy: Name = "entropy"
    """``entropy``: lowest expected entropy (Eq. 13); ``error``: lowest expected squared error of
    the parameters, relative to the present one, which decibels of textures go by. Baselines:
    ``d-optimal``: most information on the most probable parameters, linearised; ``coverage``:
    most texels that few views see; ``farthest``: the direction farthest from all so far;
    ``random``."""

    texels: int = 4096
    """Most texels that candidates are judged by, evenly spread over the surface; gains then have a
    standard error, which is stated. More texels cost more time, in proportion."""

    hypotheses: int = 8
    """Most psi of Eq. 13 per texel, drawn from its posterior: cells of roughness and metallic, of
    the colour that the photographs then give; if there are no more cells, the sum is over all."""

    lazy: bool = False
    """Evaluate candidates again only while their last gain is above the best: right if a gain never
    grows when another view is added, which is the rule but no law."""

    seed: int = 0
    """Of texels, hypotheses and random views."""

    def __post_init__(self) -> None:
        require_types(self)
        require_one_of(self, "strategy", Name)
        require(self, self.texels >= 1, "texels", "at least 1")
        require(self, 1 <= self.hypotheses <= 4096, "hypotheses", "in [1, 4096]")
        require(self, 0 <= self.seed < 2**32, "seed", "in [0, 2^32)")
