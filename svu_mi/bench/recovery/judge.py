"""One recovery against the true textures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from svu_mi import metrics
from svu_mi.capture import Capture
from svu_mi.errors import CaptureError
from svu_mi.parameters import NAMES
from svu_mi.pipeline import estimate
from svu_mi.recovery.textures import Textures
from svu_mi.surface import Texels


@dataclass(frozen=True)
class Judge:
    """What is known of a cell before anything is recovered.

    Attributes:
        grid: T texels.
        truth: (T, C) or (T,) by parameter.
        coverage: (T,) number of views that see each texel.
        entropy: (T,) angular entropy, of the default preset.
        poor: most views of a texel that counts as hardly seen.
    """

    grid: Texels
    truth: dict[str, np.ndarray]
    coverage: np.ndarray
    entropy: np.ndarray
    poor: int

    @classmethod
    def of(cls, capture: Capture, grid: Texels, poor: int) -> Judge:
        """Look the truth up, and estimate the entropy.

        Raises:
            SceneError: the scene does not know the true parameters.
            CaptureError: no texel is seen.
        """
        known = metrics.ground_truth(capture, grid)
        found = estimate(capture, grid)
        coverage = np.array(found.coverage)
        if not (coverage > 0).any():
            raise CaptureError("No texel is seen in any photograph; there is nothing to compare.")
        return cls(
            grid=grid,
            truth={name: getattr(known, name) for name in NAMES},
            coverage=coverage,
            entropy=np.array(found.entropy, np.float64),
            poor=poor,
        )

    def figures(self) -> dict[str, Any]:
        """Return counts of texels: all, seen, hardly seen."""
        seen = self.coverage > 0
        return {
            "texels": self.grid.count,
            "seen": int(seen.sum()),
            "hardly_seen": int((seen & (self.coverage <= self.poor)).sum()),
            "mean_entropy": float(self.entropy[seen].mean()),
        }

    def judge(self, textures: Textures) -> dict[str, Any]:
        """Return ``psnr`` of seen texels, ``psnr_hardly_seen`` (None if there are none), and
        ``entropy_correlation``, Pearson's of a texel's mean absolute error with its entropy.
        """
        seen = self.coverage > 0
        hardly = seen & (self.coverage <= self.poor)
        found = {name: textures.at(self.grid, name) for name in NAMES}
        error = metrics.texel_error(_part(found, seen), _part(self.truth, seen))
        return {
            "psnr": self._psnr(found, seen),
            "psnr_hardly_seen": self._psnr(found, hardly) if hardly.any() else None,
            "entropy_correlation": metrics.pearson(error, self.entropy[seen]),
        }

    def _psnr(self, found: dict[str, np.ndarray], where: np.ndarray) -> dict[str, float]:
        return metrics.texture_psnr(_part(found, where), _part(self.truth, where))


def _part(values: dict[str, np.ndarray], where: np.ndarray) -> dict[str, np.ndarray]:
    return {name: value[where] for name, value in values.items()}
