"""Product grids of BRDF parameters."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from svu_mi.core.validation import require_ranges, require_types
from svu_mi.errors import OptionError
from svu_mi.parameters import AXES, MIXED
from svu_mi.presets import GridSpacing, Preset
from svu_mi.reflection.principled import F0

MAX_NODES = 64


class Grid(Protocol):
    """Interface of parameter grids."""

    @property
    def axes(self) -> dict[str, np.ndarray]:
        """Float64 nodes of each parameter by name, slowest axis first."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of nodes per axis."""


class _UnitGrid:
    """Nodes of parameters on [0, 1]."""

    known: Mapping[str, float]

    @property
    def axes(self) -> dict[str, np.ndarray]:
        """Nodes of each parameter, in the order of ``parameters.AXES``."""
        return {name: self._nodes(name) for name in AXES}

    @property
    def roughness_nodes(self) -> np.ndarray:
        """(R,) float64 roughness nodes."""
        return self._nodes("roughness")

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of nodes per axis."""
        return tuple(len(nodes) for nodes in self.axes.values())

    def _nodes(self, name: str) -> np.ndarray:
        """Return the nodes of a parameter: its known value, or uniform on [0, 1]."""
        if name in self.known:
            return np.array([self.known[name]], np.float64)
        return np.linspace(0, 1, getattr(self, name))


@dataclass(frozen=True)
class ParameterGrid(_UnitGrid):
    """Product grid of roughness and Ks (the paper's parameters).

    Attributes:
        roughness: number of nodes, uniform on [0, 1]; 8 as in the paper.
        specular: number of nodes of Ks.
        spacing: ``uniform``: Ks uniform on [0, 1]; ``dielectric``: Ks = 0.04 + 0.96 t^2 with t
            uniform on [0, 1], which resolves dielectrics and omits Ks = 0, where roughness has
            no effect. None: the preset's ``spacing``.
        known: known values by parameter name; their axes have one node. In the angular method, a
            new value of roughness compiles a new kernel.

    Raises:
        OptionError: fewer than 2 or more than 64 nodes, an unknown spacing, an unknown name in
            ``known``, a known value outside [0, 1], or no unknown parameter.

    Example:
        >>> svu.ParameterGrid(roughness=16).shape
        (16, 8)
        >>> svu.ParameterGrid(known={"roughness": 0.3}).axes["roughness"]
        array([0.3])
    """

    roughness: int = 8
    specular: int = 8
    spacing: GridSpacing | None = None
    known: Mapping[str, float] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        _require_valid(self, ("roughness", "specular"))

    def resolved(self, preset: Preset) -> "ParameterGrid":
        """Return the grid; a ``spacing`` of None is replaced by the preset's."""
        return self if self.spacing else replace(self, spacing=preset.spacing)

    @property
    def specular_nodes(self) -> np.ndarray:
        """(S,) float64 nodes of Ks."""
        t = self._nodes("specular")
        uneven = self.spacing == "dielectric" and "specular" not in self.known
        return F0 + (1 - F0) * t**2 if uneven else t

    @property
    def axes(self) -> dict[str, np.ndarray]:
        """Nodes of ``roughness`` and ``specular``."""
        return {"roughness": self.roughness_nodes, "specular": self.specular_nodes}


@dataclass(frozen=True)
class PrincipledGrid(_UnitGrid):
    """Product grid of the parameters of Mitsuba's ``principled`` BSDF, uniform on [0, 1].

    Attributes:
        roughness: number of nodes R; 8 as in the paper.
        metallic: number of nodes M.
        base_color: number of nodes K of one channel of base colour.
        known: known values by parameter name (see ``ParameterGrid``).

    Raises:
        OptionError: fewer than 2 or more than 64 nodes, an unknown name in ``known``, a known
            value outside [0, 1], or no unknown parameter.

    Example:
        >>> svu.PrincipledGrid(base_color=16).shape
        (8, 8, 16)
        >>> svu.PrincipledGrid(known={"metallic": 0.0}).shape
        (8, 1, 8)
    """

    roughness: int = 8
    metallic: int = 8
    base_color: int = 8
    known: Mapping[str, float] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        _require_valid(self, AXES)

    @property
    def mixed_nodes(self) -> list[np.ndarray]:
        """Float64 nodes of each mixing parameter (``parameters.MIXED``)."""
        return [self._nodes(name) for name in MIXED]

    @property
    def base_color_nodes(self) -> np.ndarray:
        """(K,) float64 base colour nodes, linear."""
        return self._nodes("base_color")


def _require_valid(grid: ParameterGrid | PrincipledGrid, names: tuple[str, ...]) -> None:
    kind = type(grid).__name__
    object.__setattr__(grid, "known", dict(grid.known))  # a copy: the caller may change its own
    require_types(grid)
    require_ranges(grid, **dict.fromkeys(names, (2, MAX_NODES)))
    for name, value in grid.known.items():
        if name not in names:
            raise OptionError(f"{kind}: known {name!r} is not a parameter; use {', '.join(names)}.")
        if not 0 <= value <= 1:
            raise OptionError(f"{kind}: known {name} must be in [0, 1], got {value!r}.")
    if len(grid.known) == len(names):
        raise OptionError(f"{kind}: {', '.join(names)} are all known; leave at least one unknown.")
