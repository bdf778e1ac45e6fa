"""What a forecast expects of a texel: its entropy, or the error of its parameters.

Both are means over truths psi_0 of a number that sums over all cells psi make, weighted by
p ~ exp(-x) with the energies x = d(psi_0, psi) - log prior, relative to that of psi_0: its own
weight is 1, and with a uniform prior no other is larger.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.posterior.streaming import nats

FAR = 60.0  # exp(-FAR) adds nothing to the sum over cells, of which one is exp(0)

Cell = tuple[Any, Any, Any]
"""Roughness in [0, 1], metallic, base colour: Floats."""
Row = tuple[Any, Any]
"""Roughness in [0, 1] and metallic: what the cells of a row share."""


class Measure(Protocol):
    """A number that is the smaller, the more is known."""

    @property
    def unseen(self) -> float:
        """Of a texel that no view sees."""

    def start(self) -> list[Any]:
        """Sums of no cell."""

    def add(self, sums: list[Any], row: Row, energies: list[Any], nodes: list[Any]) -> list[Any]:
        """Add the cells of a row, which differ in base colour (``nodes``) alone."""

    def value(self, sums: list[Any], truth: Cell) -> Any:
        """The number, if ``truth`` is."""


@dataclass(frozen=True)
class Entropy:
    """Normalised entropy of Eq. 5: H = ``nats`` / log n.

    Attributes:
        cells: n.
    """

    cells: int

    @property
    def unseen(self) -> float:
        """1: nothing is known."""
        return 1.0

    def start(self) -> list[Any]:
        """Z and sum exp(-x) x."""
        return [mi.Float(0), mi.Float(0)]

    def add(
        self, sums: list[Any], row: Row | None, energies: list[Any], nodes: list[Any]
    ) -> list[Any]:
        """Add a row, whatever its parameters."""
        del row, nodes
        z, zx = sums
        for x in energies:
            term = dr.exp(-x)
            z, zx = z + term, dr.fma(x, term, zx)
        return [z, zx]

    def value(self, sums: list[Any], truth: Cell | None) -> Any:
        """H, whatever the truth."""
        del truth
        return nats(*sums) * dr.opaque(mi.Float, float(1 / np.log(self.cells)))


@dataclass(frozen=True)
class SquaredError:
    """Squared error of the posterior's mean, each parameter in units of its present one.

    Decibels of a texture fall with the logarithm of its mean squared error, so it is the
    relative change of each parameter's that counts.

    Attributes:
        present: mean variance of roughness, metallic and base colour over texels, as it is now.
        prior: their variance where nothing is known.
    """

    present: tuple[float, float, float]
    prior: tuple[float, float, float]

    @property
    def unseen(self) -> float:
        """The variance of the prior."""
        return sum(p / v for p, v in zip(self.prior, self.present, strict=True))

    def start(self) -> list[Any]:
        """Z and the sums of exp(-x) times each parameter."""
        return [mi.Float(0) for _ in range(4)]

    def add(self, sums: list[Any], row: Row, energies: list[Any], nodes: list[Any]) -> list[Any]:
        """Add a row."""
        z, roughness, metallic, color = sums
        of_row = mi.Float(0)
        for x, node in zip(energies, nodes, strict=True):
            term = dr.exp(-x)
            of_row, color = of_row + term, dr.fma(node, term, color)
        roughness = dr.fma(row[0], of_row, roughness)
        return [z + of_row, roughness, dr.fma(row[1], of_row, metallic), color]

    def value(self, sums: list[Any], truth: Cell) -> Any:
        """Squared distance of the means from the truth, over ``present``."""
        z, *moments = sums
        total = mi.Float(0)
        for moment, exact, variance in zip(moments, truth, self.present, strict=True):
            scale = dr.opaque(mi.Float, 1 / variance)
            total = dr.fma(dr.square(moment / z - exact), scale, total)
        return total
