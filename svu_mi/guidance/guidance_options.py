"""Settings of capture guidance."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

from svu_mi.core.validation import require, require_types
from svu_mi.errors import OptionError
from svu_mi.guidance.strategies import StrategyName
from svu_mi.presets import AnyPreset, Preset

BandLimit = Literal["preset", "photographs", "growing"]


@dataclass(frozen=True, kw_only=True)
class GuidanceOptions:
    """How candidates are judged."""

    strategy: StrategyName = "entropy"
    """entropy: lowest expected entropy (Eq. 13); error: lowest expected squared error of
    the parameters, relative to the present one, which determines the PSNR of textures. Baselines:
    coverage: most texels that few views see; farthest: the direction farthest from all so far;
    random."""

    texels: int = 4096
    """Most texels to judge candidates by, evenly spread over the surface; gains then have a
    standard error, which is stated. More texels cost more time, in proportion."""

    hypotheses: int = 8
    """Most psi of Eq. 13 per texel, drawn from its posterior: cells of roughness and metallic, of
    the colour that the photographs then give; if there are no more cells, the sum is over all."""

    band_limit: BandLimit = "preset"
    """Band limit of the light in which candidates of a method="spectrum" estimate are judged; by
    default that of its preset, growing for paper. photographs: that of the estimate,
    alpha' = v^(-1/2) for v photographs, whatever is added, and truths as likely as the estimate
    has them. growing: Eq. 13 as printed; the light of v' views and a candidate has
    alpha' = (v' + 1)^(-1/2), sharper with every view chosen, and truths are as likely as
    the photographs make them in that light: a sum over all cells, whatever hypotheses is. A
    gain then compares both numbers of views in the same light. All candidates are evaluated
    again at every step, which takes about four times as long."""

    lazy: bool = True
    """By entropy, evaluate again only candidates that may be best: those whose last gain reaches
    the best, if it grows by a twentieth with every view. Right if no gain grows by more, which is
    usual but not guaranteed. Where the light changes at every step (growing), all are evaluated."""

    seed: int = 0
    """Seed of texels, hypotheses and random views."""

    def __post_init__(self) -> None:
        require_types(self)
        require(self, self.texels >= 1, "texels", "at least 1")
        require(self, 1 <= self.hypotheses <= 4096, "hypotheses", "in [1, 4096]")
        require(self, 0 <= self.seed < 2**32, "seed", "in [0, 2^32)")

    def resolved(self, preset: AnyPreset) -> GuidanceOptions:
        """Return the options with the band limit of an estimate's preset, if they have none."""
        if self.band_limit != "preset":
            return self
        own = preset.band_limit if isinstance(preset, Preset) else "photographs"
        return replace(self, band_limit=own)


def with_switches(options: GuidanceOptions | None, switches: dict[str, Any]) -> GuidanceOptions:
    """Return options, the defaults if there are none, with some of them replaced by name."""
    options = GuidanceOptions() if options is None else options
    if not isinstance(options, GuidanceOptions):
        raise OptionError(f"next_best_view(): options must be GuidanceOptions, got {options!r}.")
    known = asdict(options)
    for name in switches:
        if name not in known:
            raise OptionError(
                f"next_best_view(): unknown option {name!r}; use one of {', '.join(known)}."
            )
    return replace(options, **switches)
