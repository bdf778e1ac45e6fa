"""Estimators that benchmarks compare; a new estimator is added here."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from svu_mi.capture.capture import Capture
from svu_mi.geometry.texels import Texels
from svu_mi.pipeline import estimate
from svu_mi.posterior.estimate import Estimate
from svu_mi.presets import preset


@dataclass(frozen=True)
class Variant:
    """An estimator.

    Attributes:
        label: Name in tables and plots, unique.
        method: Method of ``svu_mi.pipeline.estimate``.
        base: Name of the preset.
        switches: Fields of the preset to replace.
    """

    label: str
    method: Any  # a literal type of estimate()
    base: str
    switches: dict[str, Any] = field(default_factory=dict)

    @property
    def preset(self) -> Any:
        """Preset with the switches replaced."""
        return preset(self.base, method=self.method, **self.switches)

    def estimate(self, capture: Capture, layout: Texels, **options: Any) -> Estimate:
        """Estimate the posterior of texels; ``options`` are passed to ``estimate``."""
        return estimate(capture, layout, self.method, self.preset, **options)


# The reference assumes the same noise as ``fixed``.
VARIANTS = (
    Variant("spectrum paper", "spectrum", "paper"),
    Variant("spectrum paper, relative noise", "spectrum", "paper",
            {"noise": "relative", "sigma": 0.02}),
    Variant("spectrum default", "spectrum", "default"),
    Variant("angular default", "angular", "default"),
    Variant("angular fixed", "angular", "fixed"),
    Variant("angular fast", "angular", "fast"),
    Variant("angular SH model", "angular", "paper", {"errors": "mean", "sigma": 0.08}),
)  # fmt: skip
