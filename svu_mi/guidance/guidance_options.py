"""Options of ``next_best_view``."""

from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

from svu_mi.core.validation import require, require_types
from svu_mi.errors import OptionError
from svu_mi.guidance.strategies import TABLE, StrategyName
from svu_mi.presets import AnyPreset, Preset

BandLimit = Literal["preset", "photographs", "growing"]


@dataclass(frozen=True, kw_only=True)
class GuidanceOptions:
    """Options of ``next_best_view``: criterion, sample sizes, seed.

    Example:
        >>> options = svu.GuidanceOptions(strategy="coverage", texels=1024)
        >>> options.strategy, options.hypotheses
        ('coverage', 8)
    """

    strategy: StrategyName = "entropy"
    """Criterion of the ranking. entropy: lowest expected entropy (Eq. 13). error: lowest expected
    squared error of the parameters, relative to the present one; choose it to raise the PSNR of
    textures. Baselines: coverage (most texels that few views see), farthest (largest angle to the
    views so far) and random."""

    texels: int = 4096
    """Maximal number of texels to evaluate, at least 1, evenly spread over the surface. Gains are
    means over these, with a standard error. Time is proportional; lower it for large captures."""

    hypotheses: int = 8
    """Maximal number of hypotheses psi of Eq. 13 per texel, 1 to 4096, drawn from its posterior
    over roughness and metallic (base colour: the best fit). If the grid has no more cells, all
    are used. Raise it if proposals change with the seed."""

    band_limit: BandLimit = "preset"
    """Band limit of the light for estimates with method="spectrum". preset: as in the
    estimate's preset (growing for paper). photographs: alpha' = v^(-1/2) for v photographs,
    constant, with the probabilities of the estimate. growing: Eq. 13 as printed,
    alpha' = (v' + 1)^(-1/2) for v' views and a candidate, sharper with every chosen view; sums
    over all cells with their likelihood in that light and ignores hypotheses. It evaluates all
    candidates at every step and takes about four times as long."""

    lazy: bool = True
    """With strategy="entropy", skip candidates that are unlikely to be best: the last gain,
    increased by 5 % per chosen view, is below the best. The result is exact if no gain grows
    faster, which is usual but not guaranteed; disable it to be certain. Ignored for growing."""

    seed: int = 0
    """Seed of the drawn texels, hypotheses and random views, 0 to 2^32 - 1. Change it to measure
    how much the proposals depend on the draws."""

    def __post_init__(self) -> None:
        require_types(self)
        require(self, self.texels >= 1, "texels", "at least 1")
        require(self, 1 <= self.hypotheses <= 4096, "hypotheses", "in [1, 4096]")
        require(self, 0 <= self.seed < 2**32, "seed", "in [0, 2^32)")

    def resolved(self, preset: AnyPreset) -> "GuidanceOptions":
        """Return the options with the band limit "preset" replaced by the preset's value."""
        if self.band_limit != "preset":
            return self
        own = preset.band_limit if isinstance(preset, Preset) else "photographs"
        return replace(self, band_limit=own)


def with_switches(options: GuidanceOptions | None, switches: dict[str, Any]) -> GuidanceOptions:
    """Return ``options`` (None: the defaults) with fields replaced by ``switches``."""
    options = GuidanceOptions() if options is None else options
    known = asdict(options)
    for name in switches:
        if name not in known:
            raise OptionError(
                f"next_best_view(): unknown option {name!r}; use one of {', '.join(known)}."
            )
    return replace(options, **switches)


def require_method(options: GuidanceOptions, method: str) -> None:
    """Raise OptionError if options of guidance need an estimate by another method."""
    if options.band_limit == "growing" and method != "spectrum":
        raise OptionError(
            "next_best_view(): band_limit='growing' needs power spectra (Eq. 13); use "
            "method='spectrum' over (roughness, Ks), such as preset='paper', or omit band_limit.",
            shell="--band-limit growing needs --method spectrum with --preset paper (Eq. 13).",
        )
    needed = TABLE[options.strategy].method
    if needed not in (None, method):
        raise OptionError(
            f"next_best_view(): {options.strategy} needs an estimate by method={needed!r}.",
            shell=f"--strategy {options.strategy} needs --method {needed}.",
        )


def require_prediction(preset: AnyPreset) -> None:
    """Raise OptionError if estimates with a preset cannot predict new photographs."""
    words = f"--preset {preset.name} cannot predict new photographs"
    if isinstance(preset, Preset):
        if preset.principled:
            raise OptionError(
                "next_best_view(): power spectra of new photographs need parameters (roughness, "
                "Ks); use preset='paper', parameters='specular' or method='angular'.",
                shell=f"--method spectrum {words}; add --preset paper, or omit --method.",
            )
        return
    if preset.parameters != "principled":
        raise OptionError(
            "next_best_view(): an angular estimate of (roughness, Ks) cannot predict photographs; "
            "use parameters='principled', as in the default preset.", shell=f"{words}; omit it.",
        )  # fmt: skip
    if preset.fit is not None:
        raise OptionError(
            f"next_best_view(): the SH model (preset {preset.name!r}) contains the light only at "
            "photographed directions; use method='spectrum', preset='paper' for Eq. 13, or another "
            "preset.",
            shell=f"--preset {preset.name} is the SH model, which fits the light at the poses of "
            "the photographs only; add --method spectrum for Eq. 13, or omit --preset.",
        )
    if preset.channels == "joint" and preset.noise != "estimated":
        raise OptionError(
            "next_best_view(): an estimate with channels='joint' cannot predict photographs; use "
            "channels='grey'.", shell=f"{words}; omit it.",
        )  # fmt: skip
