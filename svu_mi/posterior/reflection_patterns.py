"""Patterns of residuals by mirror direction: an error of the light, or of what surrounds it."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from svu_mi.light.environment import basis_at
from svu_mi.posterior.residuals import Residuals, explained

HORIZON = -0.1  # vertical component below which a mirror direction points down
SHARP, SMOOTH = 4, 2  # degrees of harmonics for reflections and for diffuse shading


@dataclass(frozen=True)
class ReflectionPatterns(Residuals):
    """View dependence of residuals."""

    @cached_property
    def normal(self) -> np.ndarray:
        """Normals of the samples, (S, 3)."""
        return self.around.normal[self.samples.texel]

    @cached_property
    def mirrored(self) -> np.ndarray:
        """Mirrored directions of view, (S, 3)."""
        toward = self.around.cameras[self.samples.view] - self.around.position[self.samples.texel]
        toward /= np.maximum(np.linalg.norm(toward, axis=1, keepdims=True), 1e-30)
        return 2 * (toward * self.normal).sum(axis=1, keepdims=True) * self.normal - toward

    def fit(self, values: np.ndarray, columns: np.ndarray) -> float:
        """Return the part of a view dependence that a combination of columns explains."""
        columns = self.within(columns)
        # Normal equations: an SVD of all samples takes seven times as long.
        best = np.linalg.lstsq(columns.T @ columns, columns.T @ values, rcond=None)[0]
        return explained(values, columns @ best, values)

    @cached_property
    def static_light(self) -> float:
        """Part of the missed view dependence that depends on the mirror direction."""
        return self.fit(self.missed, basis_at(self.mirrored, SHARP)[:, 1:])

    @cached_property
    def moving_light(self) -> float:
        """Part of the view dependence that a light explains which turns with the camera.

        Minus the part that a static light explains; of samples, or residuals if that is less.
        """
        away = self.around.cameras - self.around.position.mean(axis=0)
        angle = np.arctan2(away[:, 0], away[:, 2])[self.samples.view]
        cos, sin = np.cos(angle), np.sin(angle)

        def turned(v: np.ndarray) -> np.ndarray:
            return np.stack([cos * v[:, 0] - sin * v[:, 2], v[:, 1],
                             sin * v[:, 0] + cos * v[:, 2]], axis=1)  # fmt: skip

        shaded = basis_at(turned(self.normal), SMOOTH)[:, 1:] * self.means.mean(1, keepdims=True)
        moving = np.concatenate([basis_at(turned(self.mirrored), SHARP)[:, 1:], shaded], axis=1)
        static = basis_at(self.mirrored, SHARP)[:, 1:]
        return min(
            self.fit(values, moving) - self.fit(values, static)
            for values in (self.change, self.missed)
        )

    @cached_property
    def from_below(self) -> float:
        """Correlation of the missed view dependence with mirror directions that point down."""
        down = self.within((self.mirrored[:, 1:2] < HORIZON).astype(float))[:, 0]
        length = np.linalg.norm(down) * np.linalg.norm(self.missed)
        return float(down @ self.missed / max(length, 1e-12))
