"""What a forecast expects of a texel: its entropy, or the variance of its parameters.

Both are means over truths psi_0 of a number that sums over rows (a roughness and a metallic) of
what their base colours sum to. Weights are relative to the row of psi_0.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import drjit as dr
import mitsuba as mi

from svu_mi.posterior.streaming import nats

FAR = 60.0  # exp(-FAR) adds nothing to the sum over cells, of which one is about exp(0)


class Row(NamedTuple):
    """What the base colours of a row sum to, for C channels.

    Attributes:
        weight: Float, of the row: exp(-energy), summed over its colours.
        entropy: Float, nats, of the cells of a channel's colour given the row; mean over channels.
        mean, variance: C Floats each, of colour given the row.
    """

    weight: Any
    entropy: Any
    mean: list[Any]
    variance: list[Any]


def row_of(energies: list[Any]) -> Row:
    """Sum over cells of a row, which have energies above 0, the smallest near it."""
    p = [dr.exp(-x) for x in energies]
    z = sum(p)
    zx = sum(a * x for a, x in zip(p, energies, strict=True))
    return Row(z, nats(z, zx), [], [])


class Measure(Protocol):
    """A number that is the smaller, the more is known."""

    @property
    def unseen(self) -> float:
        """Of a texel that no view sees."""

    def start(self) -> list[Any]:
        """Sums of no row."""

    def add(self, sums: list[Any], row: Row, shared: tuple[Any, ...]) -> list[Any]:
        """Add a row; ``shared`` are its roughness and the parameters that mix, Floats."""

    def value(self, sums: list[Any]) -> Any:
        """The number."""


@dataclass(frozen=True)
class Entropy:
    """Normalised entropy of Eq. 5, by the chain rule: that of rows, and of colours given these.

    Attributes:
        most: nats that it is a part of, those of the posterior's entropy: log n for n cells, or
            the prior's own (``Posterior.most``).
        unseen: that of the prior, in these units.
    """

    most: float
    unseen: float = 1.0

    def start(self) -> list[Any]:
        """Z, and the sum of w (H - log w) over rows of weight w."""
        return [mi.Float(0), mi.Float(0)]

    def add(self, sums: list[Any], row: Row, shared: tuple[Any, ...]) -> list[Any]:
        """Add a row, whatever its parameters."""
        del shared
        z, zx = sums
        w = row.weight
        return [z + w, dr.fma(w, row.entropy - dr.log(dr.maximum(w, 1e-37)), zx)]

    def value(self, sums: list[Any]) -> Any:
        """H."""
        z, zx = sums
        return (dr.log(z) + zx / z) * dr.opaque(mi.Float, 1 / self.most)


@dataclass(frozen=True)
class Variance:
    """Variance of the parameters, each in units of its present one: the squared error to expect.

    Decibels of a texture fall with the logarithm of its mean squared error, so it is the
    relative change of each parameter's that counts.

    Attributes:
        present: mean variance over texels of the axes of a grid, base colour last, as it is now.
        prior: their variance where nothing is known.
        channels: C, of base colour, whose mean counts.
    """

    present: tuple[float, ...]
    prior: tuple[float, ...]
    channels: int

    @property
    def unseen(self) -> float:
        """The variance of the prior."""
        return sum(p / v for p, v in zip(self.prior, self.present, strict=True))

    def start(self) -> list[Any]:
        """Z, and the sums of w x and w x^2 for all shared parameters and the colour of channels."""
        return [mi.Float(0) for _ in range(1 + 2 * (len(self.present) - 1 + self.channels))]

    def add(self, sums: list[Any], row: Row, shared: tuple[Any, ...]) -> list[Any]:
        """Add a row."""
        zero = mi.Float(0)
        values = [*((x, zero) for x in shared), *zip(row.mean, row.variance, strict=True)]
        added = [x for mean, spread in values for x in (mean, dr.fma(mean, mean, spread))]
        z, *moments = sums
        moments = [dr.fma(row.weight, x, old) for x, old in zip(added, moments, strict=True)]
        return [z + row.weight, *moments]

    def value(self, sums: list[Any]) -> Any:
        """Sum of the variances over ``present``."""
        _, *moments = (x / sums[0] for x in sums)
        *units, color = self.present
        total = mi.Float(0)
        units += [self.channels * color] * self.channels
        for mean, square, unit in zip(moments[::2], moments[1::2], units, strict=True):
            total = dr.fma(square - dr.square(mean), dr.opaque(mi.Float, 1 / unit), total)
        return total
