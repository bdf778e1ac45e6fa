"""From a recovery to the field around it."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from svu_mi.errors import OptionError
from svu_mi.parameters import CHANNELS, NAMES
from svu_mi.pipeline import Estimate
from svu_mi.posterior import CalibratedPosterior
from svu_mi.progress import Progress
from svu_mi.recovery.field.field import TextureField
from svu_mi.recovery.field.smoother import Smoother
from svu_mi.recovery.options import ShOptions
from svu_mi.recovery.recover import Recovery
from svu_mi.recovery.run import HOLD
from svu_mi.recovery.sh.energy import information
from svu_mi.recovery.sh.objective import moments, nats, values_of
from svu_mi.surface.neighbors import neighbors

SUREST = 1e-3  # standard deviation that no texel is surer than


def texture_field(
    recovery: Recovery,
    estimate: Estimate | None = None,
    mesh: Any | None = None,
    *,
    progress: Progress | None = None,
) -> TextureField:
    """Return how sure recovered textures are.

    Args:
        recovery: the textures.
        estimate: what is known of every texel by itself; by default the one that the textures were
            recovered from.
        mesh: that the texels lie on (``capture.mesh``), where the recovery has not looked for their
            neighbours; without it, these are those in the map.
        progress: shows what is going on.

    Raises:
        OptionError: there is no estimate in colour that knows its noise.
    """
    found = recovery.estimate if estimate is None else estimate
    if found is None or not has_field(found):
        raise OptionError(
            "texture_field(): needs an estimate in colour that knows its noise; give "
            "estimate=svu.estimate(capture, texels)."
        )
    posterior = found.posterior
    assert isinstance(posterior, CalibratedPosterior)
    with (progress or Progress()).stage("How sure the textures are"):
        texels = recovery.texels
        around = recovery.around or neighbors(texels, mesh)
        options = _options(recovery)
        values = {name: np.atleast_2d(recovery.textures.at(texels, name).T).astype(np.float64)
                  for name in NAMES}  # fmt: skip
        deviation = _deviations(posterior)
        seen = int(posterior.observed.sum())
        # Total variation is a mean over pairs, in nats of the mean texel that is seen.
        pairs = max(int(dr.width(around.pairs[0])), 1)
        strength = options.tv * np.sqrt(texels.count) * seen / pairs / (1 + HOLD)
        smoother = Smoother.of(
            1 / deviation**2, np.concatenate(list(values.values())), around.table(), strength,
            max(options.tv_epsilon, SUREST),
        )  # fmt: skip
        return TextureField(
            texels=texels, textures=recovery.textures,
            names=tuple(recovery.settings["parameters"]), deviation=deviation,
            mixing=_mixing(posterior, values), scale=np.asarray(posterior.common),
            smoother=smoother,
        )  # fmt: skip


def has_field(estimate: Estimate) -> bool:
    """Return whether an estimate says enough for ``texture_field``."""
    posterior = estimate.posterior
    colors = CHANNELS["base_color"]
    return isinstance(posterior, CalibratedPosterior) and posterior.groups == colors


def _options(recovery: Recovery) -> ShOptions:
    """Return the weights of total variation: in nats, those of ours also for other losses."""
    used = recovery.settings.get("sh", {})
    if used.get("loss") != "statistics":
        return ShOptions()
    return ShOptions(tv=used["tv"], tv_epsilon=used["tv_epsilon"])


def _deviations(posterior: CalibratedPosterior) -> np.ndarray:
    """Return standard deviations of texels by themselves, (N, T); the prior's of those unseen."""
    rows = []
    _, sds = moments(posterior)
    for name in NAMES:
        usual = _of_prior(posterior, name)[:, None]
        rows.append(np.where(posterior.observed, sds[name], usual))
    return np.maximum(np.concatenate(rows), SUREST)


def _of_prior(posterior: CalibratedPosterior, name: str) -> np.ndarray:
    """Return the standard deviation of the prior of every value of a parameter."""
    return np.broadcast_to(np.ravel(posterior.prior_moments(name)[1]), CHANNELS[name])


def _mixing(posterior: CalibratedPosterior, values: dict[str, np.ndarray]) -> np.ndarray:
    """Return L of the correlations that photographs leave between values of a texel, (T, N, N)."""
    factors = posterior.problem.factors
    chosen = factors.texel.numpy()
    weight = 2 * np.array(nats(posterior), np.float64)
    matrix = information(factors, values_of(values, chosen))
    dr.eval(matrix)
    size = len(matrix)
    precision = np.stack([np.stack([np.array(x, np.float64) for x in row]) for row in matrix])
    precision = np.moveaxis(precision * weight, 2, 0)
    prior = np.concatenate([_of_prior(posterior, name) for name in NAMES])
    precision[:, range(size), range(size)] += 1 / np.maximum(prior, SUREST) ** 2
    covariance = np.linalg.inv(precision)
    width = np.sqrt(np.einsum("tii->ti", covariance))
    mixing = np.tile(np.eye(size, dtype=np.float32), (posterior.count, 1, 1))
    mixing[chosen] = np.linalg.cholesky(covariance / (width[:, :, None] * width[:, None, :]))
    return mixing
