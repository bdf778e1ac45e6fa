"""Prediction of held-out photographs.

Posterior means without a fold of the views predict the samples of its photographs. Statistics add,
so the squared error of these samples is a quadratic form of the statistics of all views minus
those without the fold. The mean of a texel's other samples is a second prediction, which knows
nothing of the mesh, the light and the material: a model that predicts worse is wrong somewhere.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from svu_mi.parameters import MIXED
from svu_mi.reflection.principled import mixture
from svu_mi.reflection.roughness_levels import level_shares
from svu_mi.statistics.cholesky_factors import pair_weights
from svu_mi.statistics.statistics import Statistics

MARGIN = 1.3  # largest ratio of the variances that a sound model and the means leave unexplained
LEAST, GOOD = 0.5, 0.75  # R^2 below which a model is wrong, and above which it is sound


@dataclass(frozen=True)
class HeldOutPrediction:
    """How well held-out photographs are predicted.

    Attributes:
        r2: R^2 of the reflection model: 1 is perfect, 0 as good as the mean of all samples.
        r2_of_means: R^2 of the mean of each texel's other samples.
    """

    r2: float
    r2_of_means: float

    @property
    def reliable(self) -> bool:
        """True if the model explains most variance; in between, not much less than the means."""
        worse = 1 - self.r2 > MARGIN * (1 - self.r2_of_means)
        return self.r2 >= (GOOD if worse else LEAST)

    def sentence(self) -> str:
        """Return a sentence with both figures."""
        r2, means = f"R^2 {self.r2:.2f}", f"{self.r2_of_means:.2f}"
        if self.reliable:
            return f"Predicts held-out photographs: {r2} (means of texels: {means})."
        return (
            f"Unreliable: held-out photographs are predicted with {r2}, by means of texels with "
            f"{means}; the mesh, light, poses or exposures do not fit: run svu check."
        )


@dataclass(frozen=True)
class FoldTest:
    """Test of a posterior by folds of the views.

    Attributes:
        spread: factors of standard deviations by parameter (``spread_factors``).
        prediction: how well held-out photographs are predicted; None if not tested.
    """

    spread: Mapping[str, float] = field(default_factory=dict)
    prediction: HeldOutPrediction | None = None


def predict(
    statistics: Statistics, moments: np.ndarray, means: Mapping[str, np.ndarray],
    there: np.ndarray,
) -> HeldOutPrediction | None:  # fmt: skip
    """Return how well samples of F folds are predicted; None if no fold has a usable sample.

    Args:
        statistics: statistics of (1 + F) t texels: of all views, and without each fold.
        moments: sums of w, w b and w b^2 of the same texels, (1 + 2 C, (1 + F) t), per channel.
        means: posterior means of the same texels, ((1 + F) t, g) by parameter.
        there: (F, t) bool, pairs of fold and texel to compare.
    """
    groups, channels = 1 + len(there), statistics.channels
    table = statistics.table()
    table = table.reshape(*table.shape[:3], groups, -1)
    held_out = table[..., :1, :] - table[..., 1:, :]  # (R, C, P, F, t)
    of_folds = {name: values.reshape(groups, -1, values.shape[-1])[1:]
                for name, values in means.items()}  # fmt: skip
    mix = mixture(*(of_folds[name][..., 0] for name in MIXED))
    error = np.zeros(there.shape)
    roughness = of_folds["roughness"][..., 0]
    shares = level_shares(roughness.ravel(), statistics.levels).reshape(*roughness.shape, -1)
    for channel in range(channels):
        x = np.broadcast_arrays(*mix.at(of_folds["base_color"][..., channel]))
        error += np.einsum(
            "ftr,rpft,pft->ft", shares, held_out[:, channel], pair_weights(x), optimize=True
        )
    moments = moments.reshape(1 + 2 * channels, groups, -1)
    weight, first, second = np.split(moments[:, :1] - moments[:, 1:], [1, 1 + channels])
    others, of_others, _ = np.split(moments[:, 1:], [1, 1 + channels])
    mean = of_others / np.maximum(others, 1e-300)
    by_means = second - 2 * mean * first + mean**2 * weight
    weight, first, second, by_means = (x[:, there].sum(axis=1) for x in (
        weight, first, second, by_means))  # fmt: skip
    total = (second - first**2 / np.maximum(weight, 1e-300)).sum()
    if not total > 0:
        return None
    return HeldOutPrediction(
        float(1 - np.maximum(error[there], 0).sum() / total), float(1 - by_means.sum() / total)
    )
