"""The posterior of T texels: what it says, computed when asked."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.errors import OptionError, ShapeError
from svu_mi.frequency import arrays
from svu_mi.interop import owned
from svu_mi.posterior import kernel
from svu_mi.posterior.grid import ParameterGrid

CHUNK = 1 << 16  # texels per pass of everything that is not the entropy
MAX_PROBABILITIES = 1 << 29  # floats; 2 GiB

Parameter = Literal["roughness", "specular"]


@dataclass(frozen=True)
class Posterior:
    """p(psi | B, L) on a grid for each of T texels (Eq. 3, 4, 11).

    Attributes:
        problem: spectra, noise and grid tables (see ``kernel``).
        grid: the parameter grid, R roughness and S specular nodes.
        observed: (T,) bool; a texel nobody saw has a uniform posterior and entropy 1.
        count: T.
    """

    problem: kernel.Problem
    grid: ParameterGrid
    observed: np.ndarray
    count: int

    @property
    def groups(self) -> int:
        """Number G of Ks per texel: 3 when each colour channel has its own, else 1."""
        return len(self.problem.groups)

    def entropy(self) -> Any:
        """Return H = -1/log(n) sum p log p, (T,) TensorXf in [0, 1] (Eq. 5).

        n = R * S. When each channel has its own Ks, the mean over channels of the entropy of
        (roughness, Ks of that channel). Computed in one kernel, without the probabilities.
        """
        return mi.TensorXf(self._entropy)

    @cached_property
    def _entropy(self) -> Any:
        if self.count == 0:
            return mi.Float()
        value = kernel.entropy(self.problem, self.count)
        value = dr.select(owned(mi.Bool, self.observed), value, 1)
        dr.eval(value)
        return value

    @property
    def probabilities(self) -> Any:
        """p, TensorXf (T, R, S); or (T, R, S, 3) when each channel has its own Ks.

        The last axis then holds one distribution of (roughness, Ks) per channel, each with
        the other channels marginalised.

        Raises:
            OptionError: it would take more than 2 GiB; ask for marginals instead.
        """
        shape = (self.count, self.grid.roughness, self.grid.specular, self.groups)
        if np.prod(shape, dtype=float) > MAX_PROBABILITIES:
            raise OptionError(
                f"Posterior.probabilities: {shape} values do not fit in 2 GiB; use entropy(), "
                "marginal() or map(), or estimate fewer texels."
            )
        result = np.empty(shape, np.float32)
        for span, rough, given in self._chunks_of_probabilities():
            result[span] = rough[:, :, None, None] * given
        result[~self.observed] = 1 / (self.grid.roughness * self.grid.specular)
        return _tensor(result if self.groups > 1 else result[..., 0])

    def marginal(self, name: Parameter) -> Any:
        """Return the marginal of one parameter.

        Args:
            name: ``roughness`` -> (T, R); ``specular`` -> (T, S), or (T, S, 3) when each
                channel has its own Ks.

        Raises:
            OptionError: an unknown parameter.
        """
        _check_parameter(name)
        return _tensor(self._marginals[name].copy())

    @cached_property
    def _marginals(self) -> dict[str, np.ndarray]:
        rough = np.empty((self.count, self.grid.roughness), np.float32)
        specular = np.empty((self.count, self.grid.specular, self.groups), np.float32)
        for span, weight, given in self._chunks_of_probabilities():
            rough[span] = weight
            specular[span] = np.einsum("tr,trsg->tsg", weight, given)
        rough[~self.observed] = 1 / self.grid.roughness
        specular[~self.observed] = 1 / self.grid.specular
        return {
            "roughness": rough,
            "specular": specular if self.groups > 1 else specular[..., 0],
        }

    def marginal_entropy(self, name: Parameter) -> Any:
        """Return the normalised entropy of a marginal: (T,), or (T, 3) per channel."""
        _check_parameter(name)
        p = self._marginals[name].astype(np.float64)
        bits = -np.where(p > 0, p * np.log(np.where(p > 0, p, 1)), 0).sum(axis=1)
        return _tensor(np.clip(bits / np.log(p.shape[1]), 0, 1))

    def map(self) -> dict[str, Any]:
        """Return the most probable cell: ``roughness`` (T,), ``specular`` (T,) or (T, 3).

        A texel nobody saw gets the middle of the grid.
        """
        rough = np.full(self.count, self.grid.roughness // 2)
        specular = np.full((self.count, self.groups), self.grid.specular // 2)
        for span, base, offsets in self._chunks():
            row = base.argmin(axis=1)
            rough[span] = row
            specular[span] = offsets[np.arange(len(row)), row].argmin(axis=-1)
        rough[~self.observed] = self.grid.roughness // 2
        specular[~self.observed] = self.grid.specular // 2
        values = self.grid.specular_nodes[specular]
        return {
            "roughness": _tensor(self.grid.roughness_nodes[rough]),
            "specular": _tensor(values if self.groups > 1 else values[:, 0]),
        }

    def kl(self, other: Posterior) -> Any:
        """Return KL(p || q) of every texel p to every texel q of another: (T, T') (Sec. 5.2).

        sum p log p - p . log q, one matrix product; the mean over channels when each has its
        own Ks. Probabilities below 1e-30 count as 1e-30.

        Raises:
            ShapeError: the grids differ.
        """
        cells = self.grid.roughness * self.grid.specular * self.groups
        if self.grid != other.grid or self.groups != other.groups:
            raise ShapeError(f"Posterior.kl(): the grids differ: {self.grid} and {other.grid}.")
        p = np.array(self.probabilities, np.float64).reshape(self.count, cells)
        q = np.array(other.probabilities, np.float64).reshape(other.count, cells)
        log_p, log_q = np.log(np.maximum(p, 1e-30)), np.log(np.maximum(q, 1e-30))
        divergence = (p * log_p).sum(axis=1)[:, None] - p @ log_q.T
        return _tensor(np.maximum(divergence, 0) / self.groups)

    def _chunks(self) -> Iterator[tuple[slice, np.ndarray, np.ndarray]]:
        for first in range(0, self.count, CHUNK):
            size = min(CHUNK, self.count - first)
            yield slice(first, first + size), *kernel.tables(self.problem, first, size)


    def _chunks_of_probabilities(self) -> Iterator[tuple[slice, np.ndarray, np.ndarray]]:
        """Yield p(roughness) (T, R), and p(Ks | roughness) per channel (T, R, S, G)."""
        for span, base, offsets in self._chunks():
            terms = np.exp(-np.swapaxes(offsets, 2, 3))
            z = terms.sum(axis=2)
            weight = np.exp(-base) * z.prod(axis=-1, dtype=np.float64)
            yield span, weight / weight.sum(axis=1, keepdims=True), terms / z[:, :, None]


def _tensor(values: np.ndarray) -> Any:
    return arrays.tensor(values, "Posterior", "a result", ["n"] * values.ndim)


def _check_parameter(name: str) -> None:
    if name not in ("roughness", "specular"):
        raise OptionError(f"Posterior: there is no parameter {name!r}; use roughness or specular.")
