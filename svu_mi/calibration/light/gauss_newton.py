"""Gauss-Newton steps of light, gains and materials, with eliminated materials."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import scipy

from svu_mi.calibration.light.light_estimate import FoundGains
from svu_mi.calibration.light.light_prior import LightPrior, SeenCells
from svu_mi.calibration.light.light_samples import TexelSamples
from svu_mi.calibration.light.light_transport import LANES, Materials, Transport, materials_of
from svu_mi.errors import CaptureError
from svu_mi.parameters import MIXED
from svu_mi.posterior.calibrated import CalibratedKernel
from svu_mi.posterior.empirical_bayes import with_empirical_prior
from svu_mi.posterior.posterior import Posterior
from svu_mi.reflection.principled import mixture_derivative

ROUGHNESS_STEP = 0.04  # for finite differences
MAX_CHANGE = 2.0  # maximum change of log radiance per step
MATERIAL_SD = (0.3, 0.5)  # prior sd of roughness and of the parameters that mix the columns
FIXED_SD = 1e-4  # of known parameters
COLOR_SD = 0.35  # prior sd of base colour over the surface
EXPOSURE, BALANCE = 0.5, 0.2  # prior sd of log gains: common part and per channel


@dataclass(frozen=True)
class NormalEquations:
    """Normal equations of log radiance and log gains, with materials eliminated.

    Attributes:
        matrix: (3 M, 3 M) float64 precision, channel by channel. M is the number of unknown cells
            and gains per channel.
        gradient: (3 M,) float64 gradient of half the weighted squared residuals and the prior.
        predicted: (S, 3) float64 predicted samples.
    """

    matrix: np.ndarray
    gradient: np.ndarray
    predicted: np.ndarray

    def step(self) -> np.ndarray:
        """Return the change (M, 3) of the logarithms, limited to ``MAX_CHANGE``."""
        try:
            factor = scipy.linalg.cho_factor(self.matrix)
        except (np.linalg.LinAlgError, ValueError):
            raise CaptureError(
                "The light cannot be estimated: its normal equations are singular; check gains and "
                "masks of the photographs with svu check."
            ) from None
        change = -scipy.linalg.cho_solve(factor, self.gradient)
        return np.clip(change.reshape(3, -1).T, -MAX_CHANGE, MAX_CHANGE)


@dataclass(frozen=True)
class LightFit:
    """Current estimate of the light in N cells.

    Attributes:
        transport: Samples and cells.
        x: (N, 3) logarithms of radiance.
        system: Normal equations before the last step.
        misfit: Noise of the median texel before the last step, relative to the mean radiance.
        seen: True if background pixels show the light.
        gains: Gains that samples were divided by; None if known.
    """

    transport: Transport
    x: np.ndarray
    system: NormalEquations
    misfit: float
    seen: bool = False
    gains: FoundGains | None = None


class LightPriors(NamedTuple):
    """Prior of the light, and optional background pixels that show it."""

    prior: LightPrior
    seen: SeenCells | None = None

    def precision_and_gradient(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return precision (3 N, 3 N) and gradient (3, N) at log radiance x (N, 3)."""
        matrix, gradient = self.prior.precision(), self.prior.pull(x).T.copy()
        if self.seen is not None:
            matrix[np.diag_indices_from(matrix)] += np.tile(self.seen.precision, 3)
            gradient += self.seen.precision * (x - self.seen.logarithm).T
        return matrix, gradient


def normal_equations(
    transport: Transport, light: np.ndarray, posterior: Posterior[CalibratedKernel],
    overdispersion: float, priors: LightPriors | None = None, gains: np.ndarray | None = None,
) -> NormalEquations:  # fmt: skip
    """Return normal equations at a light, gains, and the posterior mean materials.

    Args:
        transport: Samples and N cells.
        light: (N, 3) radiance.
        posterior: Posterior of the materials of n texels.
        overdispersion: Overdispersion tau (effective sample size: count / tau).
        priors: Prior of the light; None if the light is given.
        gains: (V, 3) log gains that samples were divided by; None if they are known.
    """
    samples = transport.samples
    # Use the shared prior, as independent uncertain texels would bias the light.
    materials = materials_of(with_empirical_prior(posterior))
    slopes, predicted = _linearized(transport, light, materials)
    matrix, gradient = np.zeros((0, 0)), np.zeros((3, 0))
    if priors is not None:
        matrix, gradient = priors.precision_and_gradient(np.log(light))
    if gains is not None:
        matrix, gradient = _with_gains(matrix, gradient, gains)
    w = samples.weight / (posterior.kernel.noise[samples.owner] ** 2 * overdispersion)
    root, off = np.sqrt(w), samples.radiance - predicted
    own, pull = _material_equations(materials, samples, slopes, off * w[:, None], w)
    inverse = np.linalg.inv(np.linalg.cholesky(own))  # (n, P, P)
    turned = np.einsum("s,scp,smp->csm", root, slopes, inverse[samples.owner]).astype(np.float32)
    eliminated = np.empty((*inverse.shape[:2], len(matrix)), np.float32)  # L^-1 H_(theta x)
    weighted, size = (root[:, None] * off).astype(np.float32), gradient.shape[1]
    for texels, chosen in samples.blocks(LANES // transport.number):
        J_of = [] if priors is None else transport.matrix(materials, light, root, chosen)
        if gains is not None:
            shown = root[chosen] * predicted[chosen].T
            of_gains = _gain_columns(samples.view[chosen], shown, len(gains))
            J_of = [np.concatenate(x) for x in zip(J_of or of_gains[:, :0], of_gains, strict=True)]
        bounds = np.append(samples.first, samples.count)[texels.start : texels.stop + 1]
        for c, J in enumerate(J_of):
            block = slice(c * size, (c + 1) * size)
            matrix[block, block] += J @ J.T
            gradient[c] -= J @ weighted[chosen, c]
            for t, (begin, end) in enumerate(pairwise(bounds), texels.start):
                at = slice(begin - chosen.start, end - chosen.start)
                np.matmul(turned[c, begin:end].T, J[:, at].T, out=eliminated[t, :, block])
    eliminated = eliminated.reshape(-1, len(matrix))
    matrix -= eliminated.T @ eliminated
    pulled = np.einsum("tmk,tk->tm", inverse, pull).ravel().astype(np.float32)
    return NormalEquations(matrix, gradient.ravel() + pulled @ eliminated, predicted)


def _with_gains(
    matrix: np.ndarray, gradient: np.ndarray, gains: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Extend matrix (3 N, 3 N) and gradient (3, N) by log gains (V, 3) and their prior."""
    number, views = gradient.shape[1], len(gains)
    own = np.linalg.inv(EXPOSURE**2 + BALANCE**2 * np.eye(3))
    whole = np.zeros((3, number + views, 3, number + views))
    whole[:, :number, :, :number] = matrix.reshape(3, number, 3, number)
    place = number + np.arange(views)
    whole[:, place, :, place] = own
    size = 3 * (number + views)
    return whole.reshape(size, size), np.concatenate([gradient, own @ gains.T], axis=1)


def _gain_columns(view: np.ndarray, shown: np.ndarray, views: int) -> np.ndarray:
    """Return derivatives (3, V, s) of radiance ``shown`` (3, s) by the log gains of V views."""
    columns = np.zeros((3, views, len(view)), np.float32)
    columns[:, view, np.arange(len(view))] = shown
    return columns


def _material_equations(
    materials: Materials, samples: TexelSamples, slopes: np.ndarray, off: np.ndarray, w: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return matrices (n, P, P) and gradients (n, P) of materials; ``off``: weighted residuals.

    Base colours have a prior around their mean; otherwise they would absorb errors of the light.
    """
    own = samples.sum(np.einsum("s,sci,scj->sij", w, slopes, slopes, optimize=True))
    roughness, mixed = MATERIAL_SD
    free = [FIXED_SD if name in samples.grid.known else mixed for name in MIXED]
    freedom = [roughness, *free, *[COLOR_SD] * 3]
    own += np.diag(1 / np.square(freedom))
    pull = samples.sum(np.einsum("sci,sc->si", slopes, off, optimize=True))
    pull[:, -3:] -= (materials.color - materials.color.mean(axis=0)) / COLOR_SD**2
    return own, pull


def _linearized(
    transport: Transport, light: np.ndarray, materials: Materials
) -> tuple[np.ndarray, np.ndarray]:
    """Return samples' derivatives (S, 3, P) by the material, and predicted samples (S, 3)."""
    r, owner = materials.roughness, transport.samples.owner
    low, high = np.clip(r - ROUGHNESS_STEP, 0, 1), np.clip(r + ROUGHNESS_STEP, 0, 1)
    columns = transport.columns(light, np.stack([low, r, high], axis=1))
    color, mixture = materials.color[owner], materials.mixture(owner)
    ends = [_dot(mixture.at(color), columns.at(level)) for level in (0, 2)]
    values = [x[owner, None] for x in materials.mixed.T]
    slopes = [
        (ends[1] - ends[0]) / (high - low)[owner, None],
        *(_dot(mixture_derivative(values, k).at(color), columns.at(1)) for k in range(len(values))),
    ]
    of_color = _dot(mixture.slope, columns.at(1))[..., None] * np.eye(3)
    samples = _dot(mixture.at(color), columns.at(1))
    return np.concatenate([np.stack(slopes, axis=-1), of_color], axis=-1), samples


def _dot(x: Sequence[Any], parts: Sequence[Any]) -> Any:
    """Return the sum of products of ``x`` and ``parts``."""
    return sum(a * b for a, b in zip(x, parts, strict=True))
