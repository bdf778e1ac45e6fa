"""Light and materials together: Gauss-Newton with the parameters of every texel eliminated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import scipy

from svu_mi.errors import CaptureError
from svu_mi.illumination.background import CellLooks
from svu_mi.illumination.found_gains import FoundGains, of_gains, with_gains
from svu_mi.illumination.materials import materials_of
from svu_mi.illumination.prior import Prior
from svu_mi.illumination.samples import Samples
from svu_mi.illumination.transport import Materials, Transport
from svu_mi.posterior import CalibratedPosterior
from svu_mi.posterior.object_prior import shared
from svu_mi.reflection.principled import slope

STEP = 0.04  # of roughness, between which slopes are taken
LARGEST = 2.0  # change of log radiance in a step
FREEDOM = (0.3, 0.5)  # prior sd of roughness and what mixes
ALIKE = 0.35  # sd of base colours over the surface: no paint knows where the light comes from


@dataclass(frozen=True)
class System:
    """Normal equations of logarithms of light and gains, materials eliminated.

    Attributes:
        matrix: (3 M, 3 M) float64, channel by channel: the posterior's precision. M is the number
            of cells, and of views if their gains are unknown.
        gradient: (3 M,) float64, of half the weighted sum of squared errors and of the prior.
        found: (S, 3) float64, what the samples should be.
    """

    matrix: np.ndarray
    gradient: np.ndarray
    found: np.ndarray

    def step(self) -> np.ndarray:
        """Return the change of the logarithms, (M, 3), no larger than ``LARGEST``.

        Raises:
            CaptureError: the matrix is not positive definite.
        """
        try:
            factor = scipy.linalg.cho_factor(self.matrix)
        except (np.linalg.LinAlgError, ValueError):
            raise CaptureError(
                "No light explains the photographs: the search for it broke down; look at their "
                "gains and masks with svu check."
            ) from None
        found = -scipy.linalg.cho_solve(factor, self.gradient)
        return np.clip(found.reshape(3, -1).T, -LARGEST, LARGEST)


@dataclass(frozen=True)
class Fit:
    """Light of N cells, and how well it explains the samples.

    Attributes:
        transport: samples and cells.
        x: (N, 3) logarithms of radiance.
        system: normal equations before the last step.
        misfit: noise of the median texel there, as a part of the mean radiance.
        seen: whether the photographs show the light itself, too.
        gains: of the photographs, which samples were divided by; None if they are as given.
    """

    transport: Transport
    x: np.ndarray
    system: System
    misfit: float
    seen: bool = False
    gains: FoundGains | None = None


@dataclass(frozen=True)
class Known:
    """What is known of the light without samples, and what beside it is not known.

    Attributes:
        prior: of the light.
        seen: what the photographs show of the light itself.
        gains: (V, 3) logarithms of gains that samples were divided by; if given, they are
            unknowns, too, and follow the cells of each channel.
    """

    prior: Prior
    seen: CellLooks | None = None
    gains: np.ndarray | None = None

    def start(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the precision (3 N, 3 N) and the gradient (3, N) of the light at x (N, 3)."""
        matrix, gradient = self.prior.precision(), self.prior.pull(x).T.copy()
        if self.seen is not None:
            matrix[np.diag_indices_from(matrix)] += np.tile(self.seen.precision, 3)
            gradient += self.seen.precision * (x - self.seen.logarithm).T
        return matrix, gradient


def system_of(
    transport: Transport, x: np.ndarray, posterior: CalibratedPosterior, overdispersion: float,
    known: Known,
) -> System:  # fmt: skip
    """Linearise the samples around a light and the materials that are most likely under it.

    Args:
        transport: samples and N cells.
        x: (N, 3) logarithms of radiance.
        posterior: of the parameters of the n texels.
        overdispersion: tau, how many samples say what one would alone.
        known: what is known beside the samples.
    """
    # Texels that are uncertain are like others: as one by one they would pull the light along.
    materials, light = materials_of(shared(posterior)), np.exp(x)
    J = transport.matrix(materials)
    J *= light.T[:, None].astype(np.float32)
    found = J.sum(axis=2).T.astype(np.float64)  # (S, 3)
    matrix, gradient = known.start(x)
    if known.gains is not None:
        J = np.concatenate([J, of_gains(transport.samples, found, len(known.gains))], axis=2)
        matrix, gradient = with_gains(matrix, gradient, known.gains)
    start = System(matrix, gradient.ravel(), found)
    slopes, _ = _slopes_and_samples(transport, light, materials)
    return _eliminated(
        start, transport.samples, J, _Texels(posterior, materials, slopes), overdispersion
    )


def gains_system(
    transport: Transport, light: np.ndarray, posterior: CalibratedPosterior,
    overdispersion: float, gains: np.ndarray,
) -> System:  # fmt: skip
    """Linearise the samples around gains alone (see ``system_of``), under a light (N, 3)."""
    materials = materials_of(shared(posterior))
    slopes, found = _slopes_and_samples(transport, light, materials)
    matrix, gradient = with_gains(np.zeros((0, 0)), np.zeros((3, 0)), gains)
    J = of_gains(transport.samples, found, len(gains))
    start = System(matrix, gradient.ravel(), found)
    return _eliminated(
        start, transport.samples, J, _Texels(posterior, materials, slopes), overdispersion
    )


class _Texels(NamedTuple):
    """What the texels of samples are made of, and how their samples (S, 3, P) change with it."""

    posterior: CalibratedPosterior
    materials: Materials
    slopes: np.ndarray


def _eliminated(
    prior: System, samples: Samples, J: np.ndarray, texels: _Texels, overdispersion: float
) -> System:
    """Return normal equations of unknowns, M per channel, whatever the texels are made of.

    Args:
        prior: what is known of the unknowns before.
        samples: S of them.
        J: (3, S, M) float32, their derivatives; it is overwritten.
        texels: n of them.
        overdispersion: tau.
    """
    w = samples.weight / (texels.posterior.noise[samples.owner] ** 2 * overdispersion)
    root, off = np.sqrt(w), samples.radiance - prior.found
    J *= root.astype(np.float32)[:, None]
    matrix, gradient = prior.matrix, prior.gradient.reshape(3, -1).copy()
    for c, block in enumerate(_channels(J.shape[2])):
        matrix[block, block] += J[c].T @ J[c]
        gradient[c] -= J[c].T @ (root * off[:, c])
    own, pull = _of_materials(texels.materials, samples, texels.slopes, off * w[:, None], w)
    inverse = np.linalg.inv(np.linalg.cholesky(own))  # (n, P, P)
    taken = _taken(samples, J, root[:, None, None] * texels.slopes, inverse)
    matrix -= taken.T @ taken
    flat = gradient.ravel() + np.einsum("tmk,tk->tm", inverse, pull).ravel() @ taken
    return System(matrix, flat, prior.found)


def _taken(
    samples: Samples, J: np.ndarray, slopes: np.ndarray, inverse: np.ndarray
) -> np.ndarray:
    """Return L^-1 H_(theta x), (n P, 3 M) float32: its square is the part of the precision of
    the unknowns that materials can take over.

    A texel at a time: J is large, and is read once.
    """
    count, size = inverse.shape[:2]
    taken = np.empty((count, size, 3 * J.shape[2]), np.float32)
    turned = np.einsum("scp,smp->csm", slopes, inverse[samples.owner]).astype(np.float32)
    ends = np.append(samples.first, samples.count)
    for t, (begin, end) in enumerate(pairwise(ends)):
        for c, block in enumerate(_channels(J.shape[2])):
            np.matmul(turned[c, begin:end].T, J[c, begin:end], out=taken[t, :, block])
    return taken.reshape(count * size, -1)


def _channels(number: int) -> list[slice]:
    """Where the M unknowns of each channel are among all 3 M."""
    return [slice(c * number, (c + 1) * number) for c in range(3)]


def _of_materials(
    materials: Materials, samples: Samples, slopes: np.ndarray, off: np.ndarray, w: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations of the materials: (n, P, P), and (n, P); ``off`` is weighted.

    Base colours are like each other: else those of the lit side could be bright and those of the
    other dark, instead of the light.
    """
    own = samples.sum(np.einsum("s,sci,scj->sij", w, slopes, slopes, optimize=True))
    roughness, mixed = FREEDOM
    freedom = [roughness, *[mixed] * (slopes.shape[2] - 4), *[ALIKE] * 3]
    own += np.diag(1 / np.square(freedom))
    pull = samples.sum(np.einsum("sci,sc->si", slopes, off, optimize=True))
    pull[:, -3:] -= (materials.color - materials.color.mean(axis=0)) / ALIKE**2
    return own, pull


def _slopes_and_samples(
    transport: Transport, light: np.ndarray, materials: Materials
) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives (S, 3, P) for roughness, what mixes, and the three colours; samples (S, 3)."""
    r, owner = materials.roughness, transport.samples.owner
    low, high = np.clip(r - STEP, 0, 1), np.clip(r + STEP, 0, 1)
    found = transport.columns(light, np.stack([low, r, high], axis=1))
    color, how = materials.color[owner], materials.mixture(owner)
    ends = [_total(how.at(color), found.at(level)) for level in (0, 2)]
    values = [x[owner, None] for x in materials.mixed.T]
    slopes = [
        (ends[1] - ends[0]) / (high - low)[owner, None],
        *(_total(slope(values, k).at(color), found.at(1)) for k in range(len(values))),
    ]
    of_color = _total(how.scaled, found.at(1))[..., None] * np.eye(3)
    samples = _total(how.at(color), found.at(1))
    return np.concatenate([np.stack(slopes, axis=-1), of_color], axis=-1), samples


def _total(x: Sequence[Any], parts: Sequence[Any]) -> Any:
    """Return the sum of products."""
    return sum(a * b for a, b in zip(x, parts, strict=True))
