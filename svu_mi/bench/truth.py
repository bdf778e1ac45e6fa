"""The true textures of a cell, which recovered ones are compared with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from svu_mi import metrics
from svu_mi.capture import Capture
from svu_mi.parameters import NAMES
from svu_mi.recovery.textures import Textures
from svu_mi.surface import Texels


@dataclass(frozen=True)
class Truth:
    """What the scene's own material is at every texel.

    Attributes:
        grid: T texels.
        values: (T, C) or (T,) by parameter.
    """

    grid: Texels
    values: dict[str, np.ndarray]

    @classmethod
    def of(cls, capture: Capture, grid: Texels) -> Truth:
        """Look it up.

        Raises:
            SceneError: the scene does not know the true parameters.
        """
        known = metrics.ground_truth(capture, grid)
        return cls(grid, {name: getattr(known, name) for name in NAMES})

    def psnr(self, textures: Textures, where: np.ndarray) -> dict[str, float]:
        """Return the PSNR of textures, by parameter and ``average``, where (T,) bool says."""
        return metrics.texture_psnr(*self._both(textures, where))

    def error(self, textures: Textures, where: np.ndarray) -> np.ndarray:
        """Return the mean absolute error of every texel where (T,) bool says."""
        return metrics.texel_error(*self._both(textures, where))

    def _both(self, textures: Textures, where: np.ndarray) -> list[dict[str, np.ndarray]]:
        found = {name: textures.at(self.grid, name) for name in NAMES}
        return [{name: x[where] for name, x in one.items()} for one in (found, self.values)]
