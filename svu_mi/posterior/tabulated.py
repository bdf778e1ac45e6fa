"""A posterior from energies that something else has tabulated."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np

from svu_mi.errors import OptionError, ShapeError
from svu_mi.interop import owned
from svu_mi.posterior.cells import normalized
from svu_mi.posterior.record import Posterior
from svu_mi.posterior.streaming import nats


@dataclass(frozen=True, kw_only=True)
class TabulatedPosterior(Posterior):
    """p ~ exp(-energy), from a table of energies.

    Attributes:
        energies: (T, *grid) float64 of -log p up to a constant per texel; finite where
            ``observed``.

    Raises:
        ShapeError: the table does not fit the grid or the flags.
        OptionError: an observed texel has an energy that is not finite.
    """

    energies: np.ndarray

    def __post_init__(self) -> None:
        if self.energies.shape != (self.count, *self.grid.shape):
            raise ShapeError(
                f"TabulatedPosterior: energies must be {(self.count, *self.grid.shape)}, "
                f"got {self.energies.shape}."
            )
        finite = np.isfinite(self.energies).reshape(self.count, -1).all(axis=1)
        if not finite[self.observed].all():
            texel = int(np.flatnonzero(self.observed & ~finite)[0])
            raise OptionError(f"TabulatedPosterior: texel {texel} has a non-finite energy.")

    def _entropy_of_all(self) -> Any:
        flat = np.where(self.observed[:, None], self.energies.reshape(self.count, -1), 0.0)
        x = flat - flat.min(axis=1, keepdims=True)
        p = np.exp(-x)
        z = p.sum(axis=1)
        # An infinitely unlikely cell adds nothing.
        zx = np.einsum("tn,tn->t", p, np.minimum(x, 1e4))
        return owned(mi.Float, np.clip(nats(z, zx) / np.log(x.shape[1]), 0, 1))

    def _tables(self, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        seen = self.observed[chosen].reshape(-1, *(1,) * len(self.grid.shape))
        return normalized(np.where(seen, self.energies[chosen], 0.0))
