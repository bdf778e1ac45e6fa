"""Where posteriors are sampled: product grids over named BRDF parameters."""

from __future__ import annotations

from dataclasses import dataclass, replace
from numbers import Integral
from typing import Protocol

import numpy as np

from svu_mi.brdf.principled import F0
from svu_mi.errors import OptionError
from svu_mi.options import GridSpacing, Preset

MAX_NODES = 64


class Grid(Protocol):
    """What every grid has."""

    @property
    def axes(self) -> dict[str, np.ndarray]:
        """Float64 nodes by parameter, slowest axis first."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of nodes of each axis."""


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
            _require_nodes("ParameterGrid", name, getattr(self, name))
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

    @property
    def axes(self) -> dict[str, np.ndarray]:
        """Nodes by parameter: ``roughness`` and ``specular``."""
        return {"roughness": self.roughness_nodes, "specular": self.specular_nodes}

    @property
    def shape(self) -> tuple[int, int]:
        """(R, S)."""
        return self.roughness, self.specular


@dataclass(frozen=True)
class PrincipledGrid:
    """A product grid of Mitsuba's own parameters, each uniform on [0, 1].

    Attributes:
        roughness: number of nodes R; 8 as in the paper.
        metallic: number of nodes M.
        base_color: number of nodes C of a grey base colour.

    Raises:
        OptionError: fewer than 2 or more than 64 nodes.
    """

    roughness: int = 8
    metallic: int = 8
    base_color: int = 8

    def __post_init__(self) -> None:
        for name in ("roughness", "metallic", "base_color"):
            _require_nodes("PrincipledGrid", name, getattr(self, name))

    @property
    def roughness_nodes(self) -> np.ndarray:
        """(R,) float64."""
        return np.linspace(0, 1, self.roughness)

    @property
    def metallic_nodes(self) -> np.ndarray:
        """(M,) float64."""
        return np.linspace(0, 1, self.metallic)

    @property
    def base_color_nodes(self) -> np.ndarray:
        """(C,) float64, linear."""
        return np.linspace(0, 1, self.base_color)

    @property
    def axes(self) -> dict[str, np.ndarray]:
        """Nodes by parameter: ``roughness``, ``metallic`` and ``base_color``."""
        return {
            "roughness": self.roughness_nodes,
            "metallic": self.metallic_nodes,
            "base_color": self.base_color_nodes,
        }

    @property
    def shape(self) -> tuple[int, int, int]:
        """(R, M, C)."""
        return self.roughness, self.metallic, self.base_color


def _require_nodes(grid: str, name: str, count: object) -> None:
    if not (isinstance(count, Integral) and 2 <= int(count) <= MAX_NODES):
        raise OptionError(f"{grid}: {name} needs 2 to {MAX_NODES} nodes, got {count!r}.")
