"""Materials of texels under a given light: the calibrated posterior of their samples."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from svu_mi.illumination.samples import Samples
from svu_mi.illumination.transport import Columns, Materials, Transport
from svu_mi.options import AngularPreset
from svu_mi.parameters import MIXED
from svu_mi.posterior import CalibratedKernel, Posterior, calibrated_posterior
from svu_mi.reflection.principled import columns
from svu_mi.statistics import Statistics
from svu_mi.statistics.factors import PAIRS

HEAT, COOLING = 12.0, 0.6  # factor of the first round's overdispersion, and its decay


def columns_of(transport: Transport, light: np.ndarray, switches: AngularPreset) -> Columns:
    """Return the columns of light (N, 3) at the roughness levels of the statistics."""
    return transport.columns(light, np.linspace(0, 1, switches.levels))


@dataclass(frozen=True)
class Moments:
    """Sums over the samples of n texels under a light, for any dimmer or brighter one.

    ``table``: (5, 5, n, K, 3) float64, weighted products of e, p, q, d and the observation at K
    roughnesses.
    """

    samples: Samples
    table: np.ndarray

    @staticmethod
    def of(samples: Samples, found: Columns) -> Moments:
        """Sum over samples, given ``columns_of`` a light."""
        observed = np.broadcast_to(samples.radiance[:, None].astype(np.float64), found.e.shape)
        parts, weight = (*found, observed), samples.weight[:, None, None]
        table = np.empty((len(parts), len(parts), samples.texels, *found.e.shape[1:]))
        for i, part in enumerate(parts):
            weighted = weight * part
            for j in range(i, len(parts)):
                table[i, j] = table[j, i] = samples.sum(weighted * parts[j])
        return Moments(samples, table)

    def posterior(
        self, switches: AngularPreset, factor: np.ndarray | float = 1.0
    ) -> Posterior[CalibratedKernel]:
        """Return the posterior of the texels under light brighter by a factor, also per channel."""
        samples, unit = self.samples, np.eye(len(self.table))[..., None]
        e, p, q, d, observed = (row * np.ones(3) for row in unit)
        mixed = columns(factor * e, factor * p, factor * q, factor * d, observed)
        table = np.stack(
            [np.einsum("ic,jc,ijnkc->nkc", mixed[i], mixed[j], self.table, optimize=True)
             for i, j in PAIRS]
        )  # fmt: skip
        statistics = Statistics.of(
            table.transpose(2, 3, 0, 1), samples.sum(samples.weight),
            np.bincount(samples.owner[samples.weight > 0], minlength=samples.texels),
            np.linspace(0, 1, switches.levels), samples.kappa,
        )  # fmt: skip
        return calibrated_posterior(statistics, scale=samples.unit, preset=switches)


def materials_of(posterior: Posterior[CalibratedKernel]) -> Materials:
    """Return the means of a posterior."""

    def mean(name: str) -> np.ndarray:
        return np.array(posterior.mean(name), np.float64)

    mixed = np.stack([mean(name) for name in MIXED], axis=1)
    return Materials(mean("roughness"), mixed, mean("base_color"))


def misfit_of(posterior: Posterior[CalibratedKernel], unit: float) -> float:
    """Return the noise of the median texel, relative to a radiance."""
    return float(np.median(posterior.kernel.noise)) / unit


def noise_of(posterior: Posterior[CalibratedKernel], unit: float) -> float:
    """Return the geometric mean of the texels' noise, relative to a radiance."""
    return float(np.exp(np.log(posterior.kernel.noise).mean())) / unit


def tempered(switches: AngularPreset, factor: float) -> AngularPreset:
    """Return switches with a likelihood annealed by a factor."""
    return replace(switches, overdispersion=switches.overdispersion * factor)
