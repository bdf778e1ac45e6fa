"""Presets: named, frozen sets of the method's switches.

``paper`` is the method as printed; ``default`` is our best, one setting for all scenes;
``fast`` trades accuracy for time. Each difference between them is a single switch, so an
ablation is ``preset("paper", penalize_constant=False)``.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Literal

from svu_mi.errors import OptionError

GridSpacing = Literal["uniform", "dielectric"]
ChannelRule = Literal["sum", "joint", "minimum"]
NoiseRule = Literal["fixed", "relative", "marginal"]


@dataclass(frozen=True, kw_only=True)
class Preset:
    """Switches of the spectrum estimator; the defaults are those of ``default``."""

    name: str = "default"

    degree: int = 6
    """Highest degree l* of the fit and of the sum in Eq. 11; the paper uses 5 and 6."""

    regularizer: float = 1e-3
    """lambda of Eq. 12; the paper uses 1e-3 and 1e-2."""

    penalize_constant: bool = False
    """R_00 = e^0 = 1 as Eq. 12 prints it; False leaves l = 0, the diffuse term, free."""

    undo_prefilter: bool = True
    """Use alpha^2 - alpha'^2 in the likelihood: the photographs are not band-limited, the
    light is (alpha' = v^(-1/2))."""

    bounded_alpha: bool = True
    """alpha = max(roughness^2, 1e-3), as Mitsuba's BSDF has it; False leaves out the bound."""

    spacing: GridSpacing = "dielectric"
    """Nodes of Ks: ``uniform`` on [0, 1], or ``dielectric``: 0.04 + 0.96 t^2, t uniform."""

    channels: ChannelRule = "joint"
    """How R, G, B combine: ``sum`` adds them in d (one Ks); ``joint`` shares roughness and
    gives each channel its own Ks, the others marginalised; ``minimum`` keeps the smallest of
    three separate entropies."""

    noise: NoiseRule = "relative"
    """``fixed``: sigma in squared radiance (depends on exposure); ``relative``: sigma times
    the capture's mean observed power; ``marginal``: sigma unknown, p ~ d^(-nu/2)."""

    sigma: float = 0.01
    """Standard deviation of a degree's power, in the unit that ``noise`` says."""

    def __post_init__(self) -> None:
        _require(1 <= self.degree <= 9, "degree", "in [1, 9]", self.degree)  # dr.sh_eval
        # Beyond these, double precision ends: a singular fit, an infinite 1 / sigma^2.
        _require(1e-12 <= self.regularizer <= 1e12, "regularizer", "in [1e-12, 1e12]",
                 self.regularizer)  # fmt: skip
        _require(1e-30 <= self.sigma <= 1e30, "sigma", "positive, in [1e-30, 1e30]", self.sigma)
        _require(self.spacing in ("uniform", "dielectric"), "spacing", "uniform or dielectric",
                 self.spacing)  # fmt: skip
        _require(self.channels in ("sum", "joint", "minimum"), "channels",
                 "sum, joint or minimum", self.channels)  # fmt: skip
        _require(self.noise in ("fixed", "relative", "marginal"), "noise",
                 "fixed, relative or marginal", self.noise)  # fmt: skip


def _require(condition: bool, name: str, expected: str, got: object) -> None:
    if not condition:
        raise OptionError(f"Preset: {name} must be {expected}, got {got!r}.")


PRESETS: dict[str, Preset] = {
    "default": Preset(),
    "fast": Preset(name="fast", degree=4),
    "paper": Preset(
        name="paper", penalize_constant=True, undo_prefilter=False, bounded_alpha=False,
        spacing="uniform", channels="sum", noise="fixed", sigma=0.1,
    ),
}  # fmt: skip


def preset(base: str | Preset = "default", **switches: object) -> Preset:
    """Return a named preset, with single switches replaced.

    Args:
        base: ``paper``, ``default``, ``fast``, or a ``Preset`` to start from.
        **switches: fields of ``Preset`` to replace, such as ``degree=5``.

    Raises:
        OptionError: an unknown preset or switch, or a value outside its range.
    """
    if isinstance(base, str) and base not in PRESETS:
        raise OptionError(f"Unknown preset {base!r}; there are {', '.join(sorted(PRESETS))}.")
    known = {field.name for field in fields(Preset)}
    unknown = sorted(set(switches) - known)
    if unknown:
        names = ", ".join(sorted(known))
        raise OptionError(f"Unknown switch {unknown[0]!r}; a preset has {names}.")
    if not isinstance(base, str | Preset):
        raise OptionError(f"A preset is a name or a Preset, got {base!r}.")
    chosen = PRESETS[base] if isinstance(base, str) else base
    return replace(chosen, **switches) if switches else chosen  # type: ignore[arg-type]
