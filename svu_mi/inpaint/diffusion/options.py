"""Settings of filling by diffusion."""

from __future__ import annotations

from dataclasses import dataclass

from svu_mi.settings import require, require_ranges, require_types


@dataclass(frozen=True, kw_only=True)
class DiffusionOptions:
    """How a diffusion model is asked."""

    views: int = 8
    """Pictures that it is asked about, at most: fewer if they show all there is to fill. Of what
    photographs show, these are photographs; of what none shows, renders."""

    steps: int = 50
    """Steps of the diffusion."""

    free: int = 10
    """Of these, the last ones in which what is known is not put back."""

    side: int = 768
    """Pixels of the longer side of a picture, which is never larger than a photograph."""

    seed: int = 0
    """Of the noise: the same seed, the same textures."""

    device: str = "auto"
    """Where the model runs, as PyTorch names it: cpu, cuda, cuda:1; auto takes a GPU if there is
    one."""

    def __post_init__(self) -> None:
        require_types(self)
        require_ranges(self, views=(1, 100), steps=(1, 1000), side=(32, 4096))
        require(self, 0 <= self.free <= self.steps, "free", f"in [0, {self.steps}], the steps")
        require(self, 0 <= self.seed < 2**32, "seed", "in [0, 2^32)")
