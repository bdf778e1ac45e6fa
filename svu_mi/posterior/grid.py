"""Where the posterior over (roughness, specular) is sampled."""

from __future__ import annotations

from dataclasses import dataclass, replace
from numbers import Integral

import numpy as np

from svu_mi.brdf.principled import F0
from svu_mi.errors import OptionError
from svu_mi.options import GridSpacing, Preset

MAX_NODES = 64


@dataclass(frozen=True)
class ParameterGrid:
    """A product grid of roughness and specular nodes.

    Attributes:
        roughness: number of nodes, uniform on [0, 1]; 8 as in the paper.
        specular: number of nodes of Ks.
        spacing: ``uniform``: Ks uniform on [0, 1]; ``dielectric``: Ks = 0.04 + 0.96 t^2 with t
            uniform on [0, 1], which resolves dielectrics and leaves out Ks = 0, where every
            roughness is the same. None takes the preset's.

    Raises:
        OptionError: fewer than 2 or more than 64 nodes, or an unknown spacing.
    """

    roughness: int = 8
    specular: int = 8
    spacing: GridSpacing | None = None

    def __post_init__(self) -> None:
        for name in ("roughness", "specular"):
            count = getattr(self, name)
            if not (isinstance(count, Integral) and 2 <= int(count) <= MAX_NODES):
                raise OptionError(
                    f"ParameterGrid: {name} needs 2 to {MAX_NODES} nodes, got {count!r}."
                )
        if self.spacing not in (None, "uniform", "dielectric"):
            raise OptionError(
                f"ParameterGrid: spacing must be uniform or dielectric, got {self.spacing!r}."
            )

    def resolved(self, preset: Preset) -> ParameterGrid:
        """Return the grid with the preset's spacing, unless it has its own."""
        return self if self.spacing else replace(self, spacing=preset.spacing)

    @property
    def roughness_nodes(self) -> np.ndarray:
        """(R,) float64 roughness of each row."""
        return np.linspace(0, 1, self.roughness)

    @property
    def specular_nodes(self) -> np.ndarray:
        """(S,) float64 Ks of each column."""
        t = np.linspace(0, 1, self.specular)
        return F0 + (1 - F0) * t**2 if self.spacing == "dielectric" else t
