"""Predictions of photographs in several ways, and their scores.

Exposure and white balance of a photograph that was left out are known to nobody. Each channel's
gain is taken from half of its texels, and the prediction judged on the other half, without that
gain and around the photograph's own mean: that one is brighter than another is no prediction.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import scipy

from svu_mi.bench.experiment import Record
from svu_mi.capture.image_io import srgb
from svu_mi.evaluation.image_metrics import WHITE, psnr
from svu_mi.evaluation.posterior_predictive import Prediction, diffuse_seen_from
from svu_mi.posterior.calibrated import CalibratedKernel

if TYPE_CHECKING:
    from svu_mi.bench.real import HoldoutCase


MASSES = (0.5, 0.8, 0.9, 0.95)  # of intervals
FEWEST = 20  # texels in each half of a photograph
FACING = 0.7  # cosine from which a texel faces the camera


@dataclass(frozen=True)
class PredictedView:
    """Predicted radiance of n texels in one photograph, without its gain.

    Attributes:
        radiance: (D, n, 3), draws.
        sd: (D, n), standard deviation of the noise around each; None if that is not said.
    """

    radiance: np.ndarray
    sd: np.ndarray | None = None

    def subset(self, texels: np.ndarray) -> PredictedView:
        """Return the same for some of the texels."""
        sd = None if self.sd is None else self.sd[:, texels]
        return PredictedView(self.radiance[:, texels], sd)


@dataclass(frozen=True)
class Score:
    """Predictions so far, a list entry per photograph.

    Attributes:
        first: (n,) bool, the texels that gains are taken from.
        predicted, shown: (m, 3), of the others, without gains.
        place: (m, 3), where the photograph lies in the predicted distribution, in [0, 1].
        facing: (m,) bool, texels that look at the camera.
    """

    first: np.ndarray
    predicted: list[np.ndarray] = field(default_factory=list)
    shown: list[np.ndarray] = field(default_factory=list)
    place: list[np.ndarray] = field(default_factory=list)
    facing: list[np.ndarray] = field(default_factory=list)

    @staticmethod
    def start(texels: int) -> Score:
        """Draw which half of the texels gains are taken from: always the same."""
        return Score(np.random.default_rng(0).random(texels) < 0.5)

    def add(
        self, texels: np.ndarray, radiance: np.ndarray, cosine: np.ndarray, expected: PredictedView
    ) -> None:
        """Compare a photograph with its prediction.

        Args:
            texels: (m,) that it shows.
            radiance: (m, 3).
            cosine: (m,) between normal and view.
            expected: of these texels.
        """
        first, mean = self.first[texels], expected.radiance.mean(axis=0, dtype=np.float64)
        if min(first.sum(), (~first).sum()) < FEWEST:
            return
        gain = fitted_gain(mean[first], radiance[first])
        if not gain.min() > 0:  # black, or nothing is expected there
            return
        even = radiance[~first] / gain
        self.predicted.append(mean[~first])
        self.shown.append(even)
        self.facing.append(cosine[~first] > FACING)
        if expected.sd is not None:
            off = even - expected.radiance[:, ~first]
            self.place.append(scipy.special.ndtr(off / expected.sd[:, ~first, None]).mean(axis=0))

    def record(self) -> Record:
        """Return R^2 of all samples, of those that face the camera and of others, and of each
        photograph; PSNR, and how intervals hold."""
        if not self.shown:
            nan = float("nan")
            return {"r2": nan, "facing": nan, "steep": nan, "views": [], "psnr": nan, "holds": {}}
        predicted, shown = np.concatenate(self.predicted), np.concatenate(self.shown)
        white = max(float(np.quantile(shown, WHITE)), 1e-12)
        steep = [~facing for facing in self.facing]
        pairs = zip(self.predicted, self.shown, strict=True)
        return {
            "r2": r_squared(self.predicted, self.shown),
            "facing": r_squared(_those(self.predicted, self.facing),
                                _those(self.shown, self.facing)),
            "steep": r_squared(_those(self.predicted, steep), _those(self.shown, steep)),
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
    """Return the factors (3,) of (m, 3) that leave the least squares."""
    return np.asarray(
        (predicted * shown).sum(axis=0) / np.maximum(np.square(predicted).sum(axis=0), 1e-300)
    )


def r_squared(predicted: Sequence[np.ndarray], shown: Sequence[np.ndarray]) -> float:
    """Return the part of the variance of photographs, (m, 3) each, that is predicted.

    Variance is around the mean of every channel of every photograph; NaN if there is none.
    """
    spread = sum(np.square(b - b.mean(axis=0)).sum() for b in shown if len(b))
    rest = sum(np.square(a - b).sum() for a, b in zip(predicted, shown, strict=True))
    return float(1 - rest / spread) if spread > 0 else float("nan")


def _those(values: Sequence[np.ndarray], chosen: Sequence[np.ndarray]) -> list[np.ndarray]:
    return [some[which] for some, which in zip(values, chosen, strict=True)]


DRAWS = 32
ROUNDS = 20  # in which gains and means take turns
Predict = Callable[[int], PredictedView]  # what a view should show of the texels


@dataclass(frozen=True)
class Predictor:
    """A way to predict.

    Attributes:
        label: its name.
        of: makes predictions from what is known of a capture.
    """

    label: str
    of: Callable[[HoldoutCase], Predict]


def _posterior(subject: HoldoutCase) -> Predict:
    """Draws from the posterior, each with the noise that photographs around it had."""
    texels, posterior, samples = subject.texels, subject.estimate.posterior, subject.samples
    assert isinstance(posterior.kernel, CalibratedKernel)
    prediction = Prediction.of(subject.estimate, texels, DRAWS)
    noise, kept = posterior.kernel.noise_of(texels), subject.kept
    squares = _sums(subject, np.square(samples.radiance.mean(axis=1)))
    # On edges the noise is larger: as much as in the photographs that are known.
    contrast = _sums(subject, samples.contrast * kept) / np.maximum(squares, 1e-300)
    kappa = subject.switches.kappa(subject.observed.unit)

    def predict(view: int) -> PredictedView:
        radiance = prediction.seen_from(subject.eye(view))
        relative = np.square(radiance.mean(axis=2) / kappa)
        sd = noise * np.sqrt(1 + relative * (1 + samples.edges * contrast))
        return PredictedView(radiance, sd)

    return predict


def _means(subject: HoldoutCase) -> Predict:
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
    return lambda _: PredictedView(mean[None])


def _diffuse(subject: HoldoutCase) -> Predict:
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
    return lambda view: PredictedView((color * seen_from(subject.eye(view)))[None])


def _sums(subject: HoldoutCase, values: np.ndarray) -> np.ndarray:
    """Sum values (S, ...) over the samples of every texel that are known."""
    kept = subject.kept.reshape(-1, *[1] * (values.ndim - 1))
    return subject.samples.sum(np.where(kept, values, 0).astype(np.float64))


POSTERIOR = Predictor("posterior", _posterior)
MEANS = Predictor("texel means", _means)
DIFFUSE = Predictor("diffuse only", _diffuse)
PREDICTORS = (POSTERIOR, MEANS, DIFFUSE)
