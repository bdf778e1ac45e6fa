"""Predictors of photographs, and scores of predictions.

Exposure and white balance of a held-out photograph are unknown. The gain of each channel is fitted
to half of its texels. The other half is divided by that gain and scored relative to the mean of the
photograph, so that differences in brightness between photographs do not count. R^2 is that of
compressed radiance, as in the verdict on results: few highlights, clipped in the photographs, would
decide on R^2 of radiance.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import scipy

from svu_mi.bench.experiment import Record
from svu_mi.bench.image_metrics import WHITE
from svu_mi.bench.real.posterior_predictive import Prediction, diffuse_seen_from
from svu_mi.capture.image_io import srgb
from svu_mi.evaluation.psnr import psnr
from svu_mi.posterior.calibrated import CalibratedKernel
from svu_mi.posterior.residuals import compressed

if TYPE_CHECKING:
    from svu_mi.bench.real import HoldoutCase


MASSES = (0.5, 0.8, 0.9, 0.95)  # probabilities of intervals
FEWEST = 20  # least number of texels in each half of a photograph
FACING = 0.7  # least cosine of a texel that faces the camera


@dataclass(frozen=True)
class PredictedView:
    """Predicted radiance of n texels in one photograph, before its gain is applied.

    Attributes:
        radiance: Draws of radiance, (D, n, 3).
        sd: Standard deviation of the noise around each draw, (D, n); None if not predicted.
    """

    radiance: np.ndarray
    sd: np.ndarray | None = None

    def subset(self, texels: np.ndarray) -> PredictedView:
        """Return the prediction of the given texels."""
        sd = None if self.sd is None else self.sd[:, texels]
        return PredictedView(self.radiance[:, texels], sd)


@dataclass(frozen=True)
class Score:
    """Scores of predictions, with one list entry per photograph.

    Attributes:
        first: Flags (n,) of texels that determine the gains.
        predicted: Predicted radiance of the m other texels, (m, 3).
        shown: Radiance in the photograph, divided by its gain, (m, 3).
        place: Quantile of ``shown`` in the predicted distribution, (m, 3).
        facing: Flags (m,) of texels that face the camera.
    """

    first: np.ndarray
    predicted: list[np.ndarray] = field(default_factory=list)
    shown: list[np.ndarray] = field(default_factory=list)
    place: list[np.ndarray] = field(default_factory=list)
    facing: list[np.ndarray] = field(default_factory=list)

    @staticmethod
    def start(texels: int) -> Score:
        """Return an empty score; texels for gains are chosen at random, by a fixed seed."""
        return Score(np.random.default_rng(0).random(texels) < 0.5)

    def add(
        self, texels: np.ndarray, radiance: np.ndarray, cosine: np.ndarray, expected: PredictedView
    ) -> None:
        """Compare a photograph with its prediction.

        Args:
            texels: Indices of the m visible texels.
            radiance: Radiance in the photograph, (m, 3).
            cosine: Cosine between normal and view direction, (m,).
            expected: Prediction of the m texels.
        """
        first, mean = self.first[texels], expected.radiance.mean(axis=0, dtype=np.float64)
        if min(first.sum(), (~first).sum()) < FEWEST:
            return
        gain = fitted_gain(mean[first], radiance[first])
        if not gain.min() > 0:  # black photograph or black prediction
            return
        even = radiance[~first] / gain
        self.predicted.append(mean[~first])
        self.shown.append(even)
        self.facing.append(cosine[~first] > FACING)
        if expected.sd is not None:
            off = even - expected.radiance[:, ~first]
            self.place.append(scipy.special.ndtr(off / expected.sd[:, ~first, None]).mean(axis=0))

    def record(self) -> Record:
        """Return R^2 (all, facing and steep texels; each view), PSNR, and coverage of intervals."""
        if not self.shown:
            nan = float("nan")
            return {"r2": nan, "facing": nan, "steep": nan, "views": [], "psnr": nan, "holds": {}}
        predicted, shown = np.concatenate(self.predicted), np.concatenate(self.shown)
        white = max(float(np.quantile(shown, WHITE)), 1e-12)
        unit, steep = float(shown.mean()), [~facing for facing in self.facing]
        ours, theirs = (
            [compressed(x, unit) for x in some] for some in (self.predicted, self.shown)
        )
        pairs = zip(ours, theirs, strict=True)
        return {
            "r2": r_squared(ours, theirs),
            "facing": r_squared(_select(ours, self.facing), _select(theirs, self.facing)),
            "steep": r_squared(_select(ours, steep), _select(theirs, steep)),
            "views": [r_squared([one], [other]) for one, other in pairs],
            "psnr": float(psnr(srgb(predicted / white), srgb(shown / white))),
            **self._intervals(),
        }  # fmt: skip

    def _intervals(self) -> Record:
        if not self.place:
            return {"holds": {}}
        place = np.concatenate(self.place)
        inside = np.abs(place - 0.5)
        return {
            "holds": {str(mass): float((inside <= mass / 2).mean()) for mass in MASSES},
            "below": float((place < 0.05).mean()), "above": float((place > 0.95).mean()),
        }  # fmt: skip


def fitted_gain(predicted: np.ndarray, shown: np.ndarray) -> np.ndarray:
    """Return factors (3,) that fit ``predicted`` to ``shown``, (m, 3), by least squares."""
    return np.asarray(
        (predicted * shown).sum(axis=0) / np.maximum(np.square(predicted).sum(axis=0), 1e-300)
    )


def r_squared(predicted: Sequence[np.ndarray], shown: Sequence[np.ndarray]) -> float:
    """Return the predicted fraction of the variance of photographs, (m, 3) compressed each.

    Variance is relative to the mean of each channel and photograph; NaN without variance.
    """
    spread = sum(np.square(b - b.mean(axis=0)).sum() for b in shown if len(b))
    rest = sum(np.square(a - b).sum() for a, b in zip(predicted, shown, strict=True))
    return float(1 - rest / spread) if spread > 0 else float("nan")


def _select(values: Sequence[np.ndarray], chosen: Sequence[np.ndarray]) -> list[np.ndarray]:
    return [some[which] for some, which in zip(values, chosen, strict=True)]


DRAWS = 32
ROUNDS = 20  # alternating updates of gains and means
Predict = Callable[[int], PredictedView]  # returns the prediction of a view


@dataclass(frozen=True)
class Predictor:
    """A predictor.

    Attributes:
        label: Name in tables and plots.
        of: Fits the predictor to the remaining photographs.
    """

    label: str
    of: Callable[[HoldoutCase], Predict]


def _posterior(subject: HoldoutCase) -> Predict:
    """Predict by draws from the posterior, with the estimated noise."""
    texels, posterior, samples = subject.texels, subject.estimate.posterior, subject.samples
    assert isinstance(posterior.kernel, CalibratedKernel)
    prediction = Prediction.of(subject.estimate, texels, DRAWS)
    noise, kept = posterior.kernel.noise_of(texels), subject.kept
    squares = _sums(subject, np.square(samples.radiance.mean(axis=1)))
    # The noise is larger on edges, as in the remaining photographs.
    contrast = _sums(subject, samples.contrast * kept) / np.maximum(squares, 1e-300)
    kappa = subject.switches.kappa(subject.observed.unit)

    def predict(view: int) -> PredictedView:
        radiance = prediction.seen_from(subject.eye(view))
        relative = np.square(radiance.mean(axis=2) / kappa)
        sd = noise * np.sqrt(1 + relative * (1 + samples.edges * contrast))
        return PredictedView(radiance, sd)

    return predict


def _means(subject: HoldoutCase) -> Predict:
    """Predict the mean of each texel's samples, after division by least-squares gains."""
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
    return lambda _: PredictedView(mean[None])


def _diffuse(subject: HoldoutCase) -> Predict:
    """Predict a diffuse surface under the same light, with the best-fitting base colour."""
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
    return lambda view: PredictedView((color * seen_from(subject.eye(view)))[None])


def _sums(subject: HoldoutCase, values: np.ndarray) -> np.ndarray:
    """Return the sums of values (S, ...) over the remaining samples of each texel."""
    kept = subject.kept.reshape(-1, *[1] * (values.ndim - 1))
    return subject.samples.sum(np.where(kept, values, 0).astype(np.float64))


POSTERIOR = Predictor("posterior", _posterior)
MEANS = Predictor("texel means", _means)
DIFFUSE = Predictor("diffuse only", _diffuse)
PREDICTORS = (POSTERIOR, MEANS, DIFFUSE)
