"""Level of dim light, such as a room around its window.

Texels that see no bright cell can also be explained by too bright dim cells and darker, metallic
materials, which Gauss-Newton steps from constant light hardly leave. One factor of all dim cells is
chosen by texels that the light was not fitted to: their noise is small, and texels that mostly see
dim cells have the same distribution of materials as others. The latter is measured by the
Jensen-Shannon divergence [Lin 1991] of mean posteriors, weighted by the shares of both lights.
"""

import numpy as np
import scipy

from svu_mi.calibration.light.light_transport import Columns, SampleMoments, Transport, columns_of
from svu_mi.calibration.light.light_uncertainty import SHARPNESS
from svu_mi.posterior import calibrated_kernel as kernel
from svu_mi.presets import AngularPreset

BRIGHT = 0.8  # share of the flux of the bright cells
STEPS = np.linspace(-1.8, 0.6, 9)  # tested log factors of the dim cells
LEVELS = np.linspace(-0.8, 0.8, 9)  # log levels of the whole light, the best one for each factor
PATCHES = 20.0  # effective number of independent materials on an object


def with_level_of_dim_cells(
    transport: Transport, x: np.ndarray, switches: AngularPreset
) -> np.ndarray:
    """Return log radiance (N, 3) with another level of the dim cells; ``x``: that of all cells."""
    samples, kept = transport.samples.without_steep_views()
    flux = np.exp(x).mean(axis=1)
    order = np.argsort(-flux)
    dim = np.ones((len(x), 1))
    dim[order[: np.searchsorted(np.cumsum(flux[order]), BRIGHT * flux.sum())]] = 0
    bright, dull = (
        columns_of(transport, np.exp(x) * part, switches).subset(kept) for part in (1 - dim, dim)
    )
    lit, shaded = (samples.sum(part.e.mean(axis=(1, 2))) for part in (bright, dull))
    share = shaded / np.maximum(lit + shaded, 1e-30)
    levels = np.exp(np.repeat(LEVELS[:, None], 3, axis=1))

    def energy(step: float) -> float:
        parts = (a + np.exp(step) * b for a, b in zip(bright, dull, strict=True))
        moments = SampleMoments.of(samples, Columns(*parts))
        noise = moments.noise(switches, levels)
        problem = moments.posterior(switches, levels[noise.argmin()]).kernel.problem
        materials = kernel.bin_probabilities(problem, np.arange(len(share)))
        return SHARPNESS * float(np.log(noise.min())) + PATCHES * divergence(materials, share)

    fine = np.linspace(STEPS[0], STEPS[-1], 241)
    curve = scipy.interpolate.CubicSpline(STEPS, [energy(step) for step in STEPS])(fine)
    return np.asarray(x + fine[curve.argmin()] * dim)


def divergence(p: np.ndarray, share: np.ndarray) -> float:
    """Return the Jensen-Shannon divergence of means of p (n, R, M, K, C), averaged over channels.

    One mean has weights ``share`` (n,) in [0, 1], the other the rest of it.
    """
    two = np.array([np.tensordot(w / max(w.sum(), 1e-30), p, 1) for w in (share, 1 - share)])
    two = two.reshape(2, -1, two.shape[-1])
    entropy = scipy.special.entr(np.array([*two, two.mean(axis=0)])).sum(axis=1)
    return float((entropy[2] - entropy[:2].mean(axis=0)).mean())
