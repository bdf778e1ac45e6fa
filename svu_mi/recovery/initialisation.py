"""Starting point of a recovery: an RGB estimate and its posterior means."""

from dataclasses import replace
from typing import Any

import numpy as np

from svu_mi.core.progress import Progress
from svu_mi.parameters import CHANNELS, NAMES
from svu_mi.pipeline import estimate, materialized
from svu_mi.posterior.calibrated import CalibratedKernel, calibrated_posterior
from svu_mi.posterior.estimate import Estimate
from svu_mi.posterior.grid import ParameterGrid, PrincipledGrid
from svu_mi.posterior.observations import Observed
from svu_mi.posterior.posterior import Posterior
from svu_mi.posterior.sample_statistics import sample_factors
from svu_mi.presets import AngularPreset, preset
from svu_mi.recovery.sh.likelihood import texel_moments, values_of
from svu_mi.recovery.svbrdf_textures import Textures, lay_out
from svu_mi.statistics.gather_statistics import Weighting


def estimate_for_textures(
    given: Estimate | None, observed: Observed, robust: int, progress: Progress
) -> Estimate:
    """Return an RGB estimate with a noise level per texel (``CalibratedKernel``).

    If ``given`` is not such an estimate, its posterior is recomputed with the same reflection model
    and known values; visibility is reused. ``robust`` is the number of re-weighting passes.
    """
    estimated = materialized(given or estimate(observed, whole=True, progress=progress), progress)
    if not supports_texture_field(estimated):
        estimated = _reestimated_in_color(estimated, observed, progress)
    for _ in range(robust):
        with progress.stage("Reweighting samples"):
            known = estimated.observed or observed  # with the plane, if one was found
            estimated = replace(estimated, posterior=_reweighted(estimated, known))
    return estimated


def supports_texture_field(estimated: Estimate) -> bool:
    """Return whether an estimate is RGB and has a noise level per texel."""
    kernel = estimated.posterior.kernel
    return isinstance(kernel, CalibratedKernel) and kernel.channels == CHANNELS["base_color"]


def _reestimated_in_color(estimated: Estimate, observed: Observed, progress: Progress) -> Estimate:
    switches = (
        estimated.preset
        if isinstance(estimated.preset, AngularPreset)
        else preset(method="angular")
    )
    name = f"{estimated.preset.name}, in colour with its noise"
    switches = replace(
        switches, name=name, channels="joint", noise="estimated", errors="mean",
        parameters="principled",
    )  # fmt: skip
    grid, prior = estimated.posterior.grid, estimated.prior
    if isinstance(grid, ParameterGrid):  # over (roughness, Ks): keep the settings of roughness
        prior = roughness_prior(estimated)
        grid = PrincipledGrid(roughness=grid.roughness, known=known_parameters(estimated))
    assert isinstance(grid, PrincipledGrid)
    return estimate(
        observed, preset=switches, grid=grid, prior=prior, whole=True, progress=progress
    )


def roughness_prior(estimated: Estimate) -> np.ndarray | None:
    """Return the marginal prior of roughness, or None if the estimate has no prior."""
    if estimated.prior is None:
        return None
    rows = estimated.posterior.grid.shape[0]
    return np.asarray(estimated.prior, np.float64).reshape(rows, -1).sum(axis=1)


def known_parameters(estimated: Estimate) -> dict[str, float]:
    """Return the values of the known parameters of an estimate, by name."""
    return {
        name: float(nodes[0])
        for name, nodes in estimated.posterior.axes.items()
        if len(nodes) == 1 and name in NAMES
    }


def _reweighted(estimated: Estimate, observed: Observed) -> Posterior[CalibratedKernel]:
    """Recompute the posterior with sample weights from the residuals at its means."""
    posterior, switches = estimated.posterior, estimated.switches
    assert isinstance(posterior.kernel, CalibratedKernel) and isinstance(switches, AngularPreset)
    factors = posterior.kernel.problem.factors
    means, _ = texel_moments(posterior)
    texels = factors.texel.numpy()
    texels = texels[observed.coverage[texels] > 0]  # re-weighting ignores saturated samples
    weighting = Weighting(switches.kappa(observed.unit), switches.edges, values_of(means, texels))
    model = observed.model(factors.roughness, switches, 3, texels)
    sums = sample_factors(observed, model, 3, weighting)
    return calibrated_posterior(
        sums,
        posterior.kernel.grid,
        observed.unit,
        switches,
        prior=estimated.prior,
        texels=posterior.count,
        light_uncertainty=observed.capture.light_uncertainty,
    )


def posterior_means(estimated: Estimate) -> Textures:
    """Return posterior means as textures; unseen texels take the mean of the seen ones."""
    posterior: Any = estimated.posterior
    means, _ = texel_moments(posterior)
    seen = posterior.observed
    for rows in means.values():
        rows[:, ~seen] = rows[:, seen].mean(axis=1, keepdims=True)
    return lay_out(estimated.texels, {name: rows.T for name, rows in means.items()})
