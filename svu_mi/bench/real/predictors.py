"""Ways to say what a photograph should show, from others of the same object."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from svu_mi.bench.real.scores import Shown
from svu_mi.posterior import CalibratedKernel
from svu_mi.prediction import Prediction, diffuse_seen_from

if TYPE_CHECKING:
    from svu_mi.bench.real import LeftOut

DRAWS = 32
ROUNDS = 20  # in which gains and means take turns
Predict = Callable[[int], Shown]  # what a view should show of the texels


@dataclass(frozen=True)
class Way:
    """A way to predict.

    Attributes:
        label: its name.
        of: makes predictions from what is known of a capture.
    """

    label: str
    of: Callable[[LeftOut], Predict]


def _posterior(subject: LeftOut) -> Predict:
    """Draws from the posterior, each with the noise that photographs around it had."""
    texels, found, samples = subject.texels, subject.estimate.posterior, subject.samples
    assert isinstance(found.kernel, CalibratedKernel)
    prediction = Prediction.of(subject.estimate, texels, DRAWS)
    noise, kept = found.kernel.noise_of(texels), subject.kept
    squares = _sums(subject, np.square(samples.radiance.mean(axis=1)))
    # On edges the noise is larger: as much as in the photographs that are known.
    contrast = _sums(subject, samples.contrast * kept) / np.maximum(squares, 1e-300)
    kappa = subject.switches.kappa(subject.observed.unit)

    def predict(view: int) -> Shown:
        radiance = prediction.seen_from(subject.eye(view))
        relative = np.square(radiance.mean(axis=2) / kappa)
        return Shown(radiance, noise * np.sqrt(1 + relative * (1 + samples.edges * contrast)))

    return predict


def _means(subject: LeftOut) -> Predict:
    """The mean of each texel's own samples, by gains of the photographs that fit them best."""
    samples, kept = subject.samples, subject.kept
    gain = np.ones((len(samples.cameras), 3))
    view, count = samples.view, np.maximum(_sums(subject, np.ones(samples.count)), 1)
    for _ in range(ROUNDS):
        mean = _sums(subject, samples.radiance / gain[view]) / count[:, None]
        of_sample = mean[samples.owner] * kept[:, None]
        for c in range(3):
            both, square = (
                np.bincount(view, of_sample[:, c] * other, len(gain))
                for other in (samples.radiance[:, c], of_sample[:, c])
            )
            gain[:, c] = np.where(square > 0, both / np.maximum(square, 1e-300), 1)
        gain = np.maximum(gain, 1e-6)
        gain /= np.exp(np.log(gain).mean(axis=0))
    return lambda _: Shown(mean[None])


def _diffuse(subject: LeftOut) -> Predict:
    """Diffuse texels under the same light, of the base colour that fits best."""
    samples, kept, gains = subject.samples, subject.kept, subject.lit[1]
    seen_from = diffuse_seen_from(subject.observed, subject.switches, subject.texels)
    factor = np.ones((len(samples.cameras), 3))
    factor[~subject.held] = gains.factor
    shading = np.zeros((samples.count, 3))
    for view in np.flatnonzero(~subject.held):
        mine = np.flatnonzero((samples.view == view) & kept)
        if len(mine):
            shading[mine] = seen_from(subject.eye(int(view)))[samples.owner[mine]]
    radiance = samples.radiance / factor[samples.view]
    both, square = _sums(subject, shading * radiance), _sums(subject, shading * shading)
    color = both / np.maximum(square, 1e-300)
    return lambda view: Shown((color * seen_from(subject.eye(view)))[None])


def _sums(subject: LeftOut, values: np.ndarray) -> np.ndarray:
    """Sum values (S, ...) over the samples of every texel that are known."""
    kept = subject.kept.reshape(-1, *[1] * (values.ndim - 1))
    return subject.samples.sum(np.where(kept, values, 0).astype(np.float64))


POSTERIOR = Way("posterior", _posterior)
MEANS = Way("texel means", _means)
DIFFUSE = Way("diffuse only", _diffuse)
WAYS = (POSTERIOR, MEANS, DIFFUSE)
