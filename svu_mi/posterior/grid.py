"""Where posteriors are sampled: product grids over named BRDF parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from numbers import Integral, Real
from typing import Protocol

import numpy as np

from svu_mi.errors import OptionError
from svu_mi.parameters import AXES, MIXED
from svu_mi.presets import GridSpacing, Preset
from svu_mi.reflection.principled import F0

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
        known: values of parameters that are not in question, by name; each is one node. Another
            roughness is another kernel of the angular method, other values are not.

    Raises:
        OptionError: fewer than 2 or more than 64 nodes, an unknown spacing, or known values
            that are not parameters, not in [0, 1], or all there is.
    """

    roughness: int = 8
    specular: int = 8
    spacing: GridSpacing | None = None
    known: Mapping[str, float] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        _require_valid(self, ("roughness", "specular"))
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
        return _nodes(self, "roughness")

    @property
    def specular_nodes(self) -> np.ndarray:
        """(S,) float64 Ks of each column."""
        t = _nodes(self, "specular")
        uneven = self.spacing == "dielectric" and "specular" not in self.known
        return F0 + (1 - F0) * t**2 if uneven else t

    @property
    def axes(self) -> dict[str, np.ndarray]:
        """Nodes by parameter: ``roughness`` and ``specular``."""
        return {"roughness": self.roughness_nodes, "specular": self.specular_nodes}

    @property
    def shape(self) -> tuple[int, ...]:
        """(R, S)."""
        return tuple(len(nodes) for nodes in self.axes.values())


@dataclass(frozen=True)
class PrincipledGrid:
    """A product grid of Mitsuba's own parameters, each uniform on [0, 1].

    Attributes:
        roughness: number of nodes R; 8 as in the paper.
        metallic: number of nodes M.
        base_color: number of nodes K of a grey base colour.
        known: values of parameters that are not in question, by name; each is one node. Another
            roughness is another kernel of the angular method, other values are not.

    Raises:
        OptionError: fewer than 2 or more than 64 nodes, or known values that are no
            parameters, not in [0, 1], or all there is.
    """

    roughness: int = 8
    metallic: int = 8
    base_color: int = 8
    known: Mapping[str, float] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        _require_valid(self, AXES)

    @property
    def roughness_nodes(self) -> np.ndarray:
        """(R,) float64."""
        return _nodes(self, "roughness")

    @property
    def mixed_nodes(self) -> list[np.ndarray]:
        """Float64 nodes of every parameter that mixes the columns, metallic first."""
        return [_nodes(self, name) for name in MIXED]

    @property
    def base_color_nodes(self) -> np.ndarray:
        """(K,) float64, linear."""
        return _nodes(self, "base_color")

    @property
    def axes(self) -> dict[str, np.ndarray]:
        """Nodes by parameter, in the order of ``parameters.AXES``."""
        return {name: _nodes(self, name) for name in AXES}

    @property
    def shape(self) -> tuple[int, ...]:
        """(R, M, K)."""
        return tuple(len(nodes) for nodes in self.axes.values())


def _nodes(grid: ParameterGrid | PrincipledGrid, name: str) -> np.ndarray:
    """Nodes of a parameter, uniform on [0, 1]; or what is known of it."""
    if name in grid.known:
        return np.array([grid.known[name]], np.float64)
    return np.linspace(0, 1, getattr(grid, name))


def _require_valid(grid: ParameterGrid | PrincipledGrid, names: tuple[str, ...]) -> None:
    kind = type(grid).__name__
    object.__setattr__(grid, "known", dict(grid.known))  # the caller's may change
    for name in names:
        count = getattr(grid, name)
        if not (isinstance(count, Integral) and 2 <= int(count) <= MAX_NODES):
            raise OptionError(f"{kind}: {name} needs 2 to {MAX_NODES} nodes, got {count!r}.")
    for name, value in grid.known.items():
        if name not in names:
            raise OptionError(f"{kind}: known {name!r} is not a parameter; use {', '.join(names)}.")
        number = isinstance(value, Real) and not isinstance(value, bool)
        if not (number and 0 <= float(value) <= 1):
            raise OptionError(f"{kind}: known {name} must be in [0, 1], got {value!r}.")
    if len(grid.known) == len(names):
        raise OptionError(f"{kind}: {', '.join(names)} are all known; leave at least one unknown.")
