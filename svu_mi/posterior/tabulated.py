"""Posterior from tabulated energies."""

from dataclasses import dataclass

import numpy as np

from svu_mi.errors import OptionError, ShapeError
from svu_mi.posterior.grid import Grid
from svu_mi.posterior.kernel import GridKernel, Pair, Prior
from svu_mi.posterior.posterior import Posterior
from svu_mi.posterior.row_entropy import nats, prior_table, probabilities


@dataclass(frozen=True)
class TabulatedKernel(GridKernel):
    """Posterior p ~ exp(-energy) from (T, *grid) float64 energies."""

    grid: Grid
    energies: np.ndarray
    channels = 1

    @property
    def count(self) -> int:  # type: ignore[override]
        """Number of texels T."""
        return len(self.energies)

    @property
    def prior(self) -> Prior:
        """Uniform prior."""
        return Prior(prior_table(None, self.grid.shape), self.grid.axes)

    def entropy(self, texels: np.ndarray) -> np.ndarray:
        """Return the normalised entropy (see ``Kernel``)."""
        flat = self.energies[texels].reshape(len(texels), -1)
        x = flat - flat.min(axis=1, keepdims=True)
        p = np.exp(-x)
        # Bins with infinite energy contribute 0, not NaN.
        zx = np.einsum("tn,tn->t", p, np.minimum(x, 1e4))
        return np.clip(nats(p.sum(axis=1), zx) / np.log(x.shape[1]), 0, 1).astype(np.float32)

    def tables(self, texels: np.ndarray) -> Pair:
        """Return bin probabilities and the most probable nodes (see ``GridKernel``)."""
        energies = self.energies[texels].reshape(len(texels), -1, self.grid.shape[-1])
        low = energies.min(axis=2, keepdims=True)
        # Rows of infinite energy have the weight 0, whatever the energies relative to it.
        offsets = energies - np.where(np.isfinite(low), low, 0)
        offsets = np.where(np.isfinite(low), offsets, 0)[:, :, None]
        return probabilities(low[..., 0], offsets, self.grid.shape)


def tabulated_posterior(
    energies: np.ndarray, grid: Grid, observed: np.ndarray
) -> Posterior[TabulatedKernel]:
    """Return the posterior of (T, *grid) energies -log p; ``observed`` ones must be finite."""
    shape = (len(observed), *grid.shape)
    if energies.shape != shape:
        raise ShapeError(f"tabulated_posterior(): energies must be {shape}, got {energies.shape}.")
    finite = np.isfinite(energies).reshape(len(observed), -1).all(axis=1)
    if not finite[observed].all():
        texel = int(np.flatnonzero(observed & ~finite)[0])
        raise OptionError(f"tabulated_posterior(): texel {texel} has a non-finite energy.")
    known = np.where(observed.reshape(-1, *(1,) * len(grid.shape)), energies, 0.0)
    return Posterior(kernel=TabulatedKernel(grid, known), observed=observed)
