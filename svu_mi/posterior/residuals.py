"""Residuals of held-out samples, and the geometry of their photographs.

Radiance b is compressed to b / (b + u) with the mean radiance u, so that no highlight dominates.
View dependence is the deviation of samples from the mean of their texel.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from svu_mi.capture.mesh import unit_vectors
from svu_mi.capture.up_direction import is_seen_from_above, up_direction
from svu_mi.geometry.packed_views import CAMERA_FLOATS
from svu_mi.posterior.held_out_samples import HeldOutSamples
from svu_mi.posterior.observations import Observed


@dataclass(frozen=True)
class Surroundings:
    """Geometry of V photographs of t texels, in a frame whose second axis points up.

    Attributes:
        frame: (3, 3) axes of the frame in world space, as columns.
        normal: (t, 3) shading normals.
        position: (t, 3).
        cameras: (V, 3) positions.
        pixels: function of view (S,) and texel (S,): a function of shift (S, 2), which returns the
            radiance (S, C) there. Shifts are in hundredths of the size of the image.
        from_above: True if no camera is below the object.
    """

    frame: np.ndarray
    normal: np.ndarray
    position: np.ndarray
    cameras: np.ndarray
    pixels: Callable[[np.ndarray, np.ndarray], Callable[[np.ndarray], np.ndarray]]
    from_above: bool

    @staticmethod
    def of(observed: Observed, texels: np.ndarray) -> "Surroundings":
        """Return the geometry of texels in the used photographs."""
        up = up_direction(observed.capture)
        side = unit_vectors(np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))]))
        frame = np.stack([side, up, np.cross(side, up)], axis=1)
        position, normal = (
            np.stack([x.numpy()[texels] for x in values], axis=1).astype(float)
            for values in (observed.texels.position, observed.texels.normal)
        )
        views = observed.views
        cameras = views.cameras.numpy().reshape(-1, CAMERA_FLOATS).astype(float)
        width, height, offset = (x.numpy().astype(np.int64) for x in (
            views.width, views.height, views.offset))  # fmt: skip
        radiance = views.pixels.numpy().reshape(-1, 3)

        def pixels(view: np.ndarray, texel: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
            rows = cameras[view, :12].reshape(-1, 3, 4)
            x, y, w = np.einsum("sij,sj->is", rows[..., :3], position[texel]) + rows[..., 3].T
            size = np.stack([width[view], height[view]], axis=1)
            center, step = np.stack([x / w, y / w], axis=1), size.max(axis=1, keepdims=True) / 100
            first, across, last = offset[view], width[view], size - 1

            def shifted(shift: np.ndarray) -> np.ndarray:
                place = np.floor(center + shift * step).astype(np.int64)
                column, row = np.clip(place, 0, last).T
                return np.nan_to_num(radiance[first + row * across + column])

            return shifted

        return Surroundings(
            frame, normal @ frame, position @ frame, cameras[:, 12:15] @ frame, pixels,
            is_seen_from_above(observed.capture),
        )  # fmt: skip


def compressed(radiance: np.ndarray, unit: float) -> np.ndarray:
    """Return radiance b as b / (b + unit), on [0, 1)."""
    radiance = np.maximum(radiance, 0)
    return np.asarray(radiance / np.maximum(radiance + unit, 1e-30))


def explained(values: np.ndarray, predicted: np.ndarray, whole: np.ndarray | None = None) -> float:
    """Return 1 - |values - predicted|^2 / |whole|^2; ``whole`` is the deviation from the mean."""
    whole = values - values.mean(axis=0) if whole is None else whole
    return float(1 - np.square(values - predicted).sum() / max(np.square(whole).sum(), 1e-12))


@dataclass(frozen=True)
class Residuals:
    """Samples and their predictions, compressed."""

    samples: HeldOutSamples
    around: Surroundings

    @cached_property
    def unit(self) -> float:
        """Mean radiance."""
        return float(np.average(self.samples.radiance.mean(axis=1), weights=self.samples.weight))

    def compressed(self, radiance: np.ndarray) -> np.ndarray:
        """Return radiance on [0, 1)."""
        return compressed(radiance, self.unit)

    @cached_property
    def shown(self) -> np.ndarray:
        """Observed samples, compressed, (S, C)."""
        return self.compressed(self.samples.radiance)

    @cached_property
    def predicted(self) -> np.ndarray:
        """Predicted samples, compressed, (S, C)."""
        return self.compressed(self.samples.predicted)

    @cached_property
    def radiance_of_means(self) -> np.ndarray:
        """Means of the texels' samples in other folds, (S, C)."""
        return self.samples.scaled_to_others(np.ones_like(self.samples.radiance))

    @cached_property
    def means(self) -> np.ndarray:
        """``radiance_of_means``, compressed."""
        return self.compressed(self.radiance_of_means)

    @cached_property
    def error(self) -> float:
        """Part of the variance that the model leaves, 1 - R^2."""
        return 1 - explained(self.shown, self.predicted)

    @cached_property
    def error_of_means(self) -> float:
        """Part of the variance that ``means`` leave, 1 - R^2."""
        return 1 - explained(self.shown, self.means)

    def within(self, values: np.ndarray) -> np.ndarray:
        """Return (S, K) values minus their mean over the samples of each texel."""
        texel, count = self.samples.texel, np.bincount(self.samples.texel)
        sums = np.stack([np.bincount(texel, column) for column in values.T], axis=1)
        return np.asarray(values - (sums / np.maximum(count, 1)[:, None])[texel])

    @cached_property
    def change(self) -> np.ndarray:
        """View dependence of the grey samples, (S,)."""
        return self.within(self.shown.mean(axis=1, keepdims=True))[:, 0]

    @cached_property
    def missed(self) -> np.ndarray:
        """View dependence of the grey residuals, (S,)."""
        return self.within((self.shown - self.predicted).mean(axis=1, keepdims=True))[:, 0]
