"""The parameters that are estimated: those of Mitsuba's ``principled`` BSDF, in one table."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Parameter:
    """A parameter of the material.

    Attributes:
        name: what ``principled`` calls it.
        channels: values per texel.
        low: its smallest value.
        high: its largest value.
        default: what is assumed while nothing is known.
    """

    name: str
    channels: int = 1
    low: float = 0.0
    high: float = 1.0
    default: float = 0.5

    def holds(self, value: float) -> bool:
        """Return whether a value is in range; NaN is not."""
        return self.low <= value <= self.high


PARAMETERS = {p.name: p for p in (
    Parameter("base_color", channels=3),
    Parameter("roughness"),
    Parameter("metallic"),
)}  # fmt: skip
NAMES = tuple(PARAMETERS)
CHANNELS = {p.name: p.channels for p in PARAMETERS.values()}
