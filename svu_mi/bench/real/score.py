"""How far predictions of photographs hold.

Exposure and white balance of a photograph that was left out are known to nobody. Each channel's
gain is taken from half of its texels, and the prediction judged on the other half.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.special import ndtr

from svu_mi.bench.experiment import Record
from svu_mi.metrics.images import WHITE, srgb
from svu_mi.metrics.textures import psnr

LEVELS = (0.5, 0.8, 0.9, 0.95)  # of intervals
FEWEST = 20  # texels in each half of a photograph
FACING = 0.7  # cosine of texels that mirror who takes the photograph, or nearly


@dataclass(frozen=True)
class Shown:
    """What n texels should show in one photograph, but for its gain.

    Attributes:
        radiance: (D, n, 3), draws.
        sd: (D, n), standard deviation of the noise around each; None if that is not said.
    """

    radiance: np.ndarray
    sd: np.ndarray | None = None

    def some(self, texels: np.ndarray) -> Shown:
        """Return the same for some of the texels."""
        return Shown(self.radiance[:, texels], None if self.sd is None else self.sd[:, texels])


@dataclass(frozen=True)
class Score:
    """Predictions so far, a list entry per photograph.

    Attributes:
        first: (n,) bool, the texels that gains are taken from.
        predicted, shown: (m, 3), of the others, with gains.
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
        self, texels: np.ndarray, radiance: np.ndarray, cosine: np.ndarray, found: Shown
    ) -> None:
        """Compare a photograph with what it should show.

        Args:
            texels: (m,) that it shows.
            radiance: (m, 3).
            cosine: (m,) between normal and view.
            found: of these texels.
        """
        first, mean = self.first[texels], found.radiance.mean(axis=0, dtype=np.float64)
        if min(first.sum(), (~first).sum()) < FEWEST:
            return
        gain = gain_of(mean[first], radiance[first])
        self.predicted.append(gain * mean[~first])
        self.shown.append(radiance[~first].astype(np.float64))
        self.facing.append(cosine[~first] > FACING)
        if found.sd is not None:
            off = radiance[~first] / gain - found.radiance[:, ~first]
            self.place.append(ndtr(off / found.sd[:, ~first, None]).mean(axis=0))

    def record(self) -> Record:
        """Return R^2 of all samples, of those that face the camera and of others, and of each
        photograph; PSNR, and how intervals hold."""
        if not self.shown:
            nan = float("nan")
            return {"r2": nan, "facing": nan, "steep": nan, "views": [], "psnr": nan, "holds": {}}
        predicted, shown = np.concatenate(self.predicted), np.concatenate(self.shown)
        facing = np.concatenate(self.facing)
        white = float(np.quantile(shown, WHITE))
        return {
            "r2": r_squared(predicted, shown),
            "facing": r_squared(predicted[facing], shown[facing]),
            "steep": r_squared(predicted[~facing], shown[~facing]),
            "views": [r_squared(*pair) for pair in zip(self.predicted, self.shown, strict=True)],
            "psnr": float(psnr(srgb(predicted / white), srgb(shown / white))),
            **self._intervals(),
        }  # fmt: skip

    def _intervals(self) -> Record:
        if not self.place:
            return {"holds": {}}
        place = np.concatenate(self.place)
        inside = np.abs(place - 0.5)
        return {
            "holds": {str(level): float((inside <= level / 2).mean()) for level in LEVELS},
            "below": float((place < 0.05).mean()), "above": float((place > 0.95).mean()),
        }  # fmt: skip


def gain_of(predicted: np.ndarray, shown: np.ndarray) -> np.ndarray:
    """Return the factors (3,) of (m, 3) that leave the least squares."""
    return np.asarray(
        (predicted * shown).sum(axis=0) / np.maximum(np.square(predicted).sum(axis=0), 1e-300)
    )


def r_squared(predicted: np.ndarray, shown: np.ndarray) -> float:
    """Return the part of the variance of (m, 3) around each channel's mean that is predicted; NaN
    of nothing."""
    if not len(shown):
        return float("nan")
    spread = np.square(shown - shown.mean(axis=0)).sum()
    return float(1 - np.square(predicted - shown).sum() / max(spread, 1e-300))
