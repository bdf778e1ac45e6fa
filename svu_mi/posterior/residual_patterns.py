"""Patterns in the residuals of held-out photographs, which depend on what is wrong.

Radiance b is compressed to b / (b + u) with the mean radiance u, so that no highlight dominates.
View dependence is the deviation of samples from the mean of their texel.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from svu_mi.capture.mesh import unit_vectors
from svu_mi.capture.up_direction import up_direction
from svu_mi.geometry.packed_views import CAMERA_FLOATS
from svu_mi.light.environment import basis_at
from svu_mi.posterior.held_out_samples import HeldOutSamples
from svu_mi.posterior.observations import Observed

DARK = 0.05  # added before logarithms, in mean radiances
FEWEST, MANY = 20, 40  # samples of a photograph that give its gain, and its shift
HORIZON = -0.1  # vertical component below which a mirror direction points down
SHARP, SMOOTH = 4, 2  # degrees of harmonics for reflections and for diffuse shading
STEPS = (2, 1)  # of image shifts, coarse to fine
STARTS, ROUNDS = 8, 10  # of the search for two groups of photographs


@dataclass(frozen=True)
class Surroundings:
    """Geometry of V photographs of t texels, in a frame whose second axis points up.

    Attributes:
        frame: (3, 3) axes of the frame in world space, as columns.
        normal: (t, 3) shading normals.
        position: (t, 3).
        cameras: (V, 3) positions.
        pixel: function of view (S,), texel (S,) and shift (S, 2): radiance (S, C) there. Shifts are
            in hundredths of the size of the image.
    """

    frame: np.ndarray
    normal: np.ndarray
    position: np.ndarray
    cameras: np.ndarray
    pixel: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]

    @staticmethod
    def of(observed: Observed, texels: np.ndarray) -> Surroundings:
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
        pixels = views.pixels.numpy().reshape(-1, 3)

        def pixel(view: np.ndarray, texel: np.ndarray, shift: np.ndarray) -> np.ndarray:
            rows = cameras[view, :12].reshape(-1, 3, 4)
            x, y, w = np.einsum("sij,sj->is", rows[..., :3], position[texel]) + rows[..., 3].T
            size = np.stack([width[view], height[view]], axis=1)
            step = size.max(axis=1, keepdims=True) / 100
            place = np.stack([x / w, y / w], axis=1) + shift * step
            column, row = np.clip(np.floor(place).astype(np.int64), 0, size - 1).T
            index = offset[view] + row * width[view] + column
            return np.nan_to_num(pixels[index])

        return Surroundings(
            frame, normal @ frame, position @ frame, cameras[:, 12:15] @ frame, pixel
        )


def explained(values: np.ndarray, predicted: np.ndarray, whole: np.ndarray | None = None) -> float:
    """Return 1 - |values - predicted|^2 / |whole|^2; ``whole`` is the deviation from the mean."""
    whole = values - values.mean(axis=0) if whole is None else whole
    return float(1 - np.square(values - predicted).sum() / max(np.square(whole).sum(), 1e-12))


@dataclass(frozen=True)
class ResidualPatterns:
    """Residuals of samples, compressed, and statistics of them."""

    samples: HeldOutSamples
    around: Surroundings

    @cached_property
    def unit(self) -> float:
        """Mean radiance."""
        return float(np.average(self.samples.radiance.mean(axis=1), weights=self.samples.weight))

    def compressed(self, radiance: np.ndarray) -> np.ndarray:
        """Return radiance on [0, 1)."""
        radiance = np.maximum(radiance, 0)
        return np.asarray(radiance / np.maximum(radiance + self.unit, 1e-30))

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

    # --- factors of photographs ---------------------------------------------------------------

    def gains(self, predicted: np.ndarray) -> np.ndarray:
        """Return the median log ratio to predicted radiance of each photograph, (V,)."""
        view, views = self.samples.view, len(self.around.cameras)
        grey, expected = (np.maximum(x.mean(axis=1), 0) for x in (self.samples.radiance, predicted))
        ratio = np.log((grey + DARK * self.unit) / (expected + DARK * self.unit))
        return np.array([np.median(ratio[view == v]) if (view == v).sum() >= FEWEST else 0.0
                         for v in range(views)])  # fmt: skip

    @cached_property
    def gain(self) -> tuple[float, float]:
        """Standard deviation of log gains, and the part of the error that they explain."""
        of_means = self.gains(self.radiance_of_means)
        of_model = self.gains(self.samples.predicted)
        equal = self.samples.radiance / np.exp(of_model[self.samples.view])[:, None]
        left = np.square(self.compressed(equal) - self.predicted).sum()
        part = 1 - left / max(np.square(self.shown - self.predicted).sum(), 1e-12)
        return min(float(of_means.std()), float(of_model.std())), float(part)

    # --- reflections --------------------------------------------------------------------------

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

    @cached_property
    def change(self) -> np.ndarray:
        """View dependence of the grey samples, (S,)."""
        return self.within(self.shown.mean(axis=1, keepdims=True))[:, 0]

    @cached_property
    def missed(self) -> np.ndarray:
        """View dependence of the grey residuals, (S,)."""
        return self.within((self.shown - self.predicted).mean(axis=1, keepdims=True))[:, 0]

    def fit(self, values: np.ndarray, columns: np.ndarray) -> float:
        """Return the part of a view dependence that a combination of columns explains."""
        columns = self.within(columns)
        best = np.linalg.lstsq(columns, values, rcond=None)[0]
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

    # --- shifts and groups of photographs -----------------------------------------------------

    @cached_property
    def shift(self) -> tuple[float, float]:
        """Part of the error that the best shift of each photograph explains, and its median.

        Shifts are in hundredths of the size of the image.
        """
        view, views = self.samples.view, len(self.around.cameras)

        def errors(shift: np.ndarray) -> np.ndarray:
            there = self.around.pixel(view, self.samples.texel, shift[view])
            square = np.square(self.compressed(there) - self.predicted).mean(axis=1)
            return np.bincount(view, square, views)

        best = np.zeros((views, 2))
        first = least = errors(best)
        for step in STEPS:
            start = best
            for offset in np.moveaxis(np.mgrid[-2:3, -2:3], 0, -1).reshape(-1, 2) * float(step):
                error = errors(start + offset)
                better = error < least
                best = np.where(better[:, None], start + offset, best)
                least = np.where(better, error, least)
        many = np.bincount(view, minlength=views) >= MANY
        if not many.any():
            return 0.0, 0.0
        part = 1 - least[many].sum() / max(first[many].sum(), 1e-12)
        return float(part), float(np.median(np.abs(best[many]).max(axis=1)))

    @cached_property
    def groups(self) -> float:
        """Variance that means of texels in two groups of photographs explain.

        More than overall means; of samples, or residuals if that is less.
        """
        return min(self._grouped(self.shown), self._grouped(self.shown - self.predicted))

    def _grouped(self, off: np.ndarray) -> float:
        views, random = len(self.around.cameras), np.random.default_rng(0)
        whole = least = self._left_out(off, np.zeros(views, np.int64))[0]
        for _ in range(STARTS):
            group = random.permutation(np.arange(views) % 2)
            for _ in range(ROUNDS):
                error, of_groups = self._left_out(off, group)
                least = min(least, error)
                new = np.argmin(of_groups, axis=1)
                if (new == group).all() or min(new.sum(), views - new.sum()) < views / 5:
                    break
                group = new
        return (whole - least) / max(float(self.shown.var(axis=0).sum()) * len(self.shown), 1e-12)

    def _left_out(self, off: np.ndarray, group: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the error of means without the sample itself, and (V, 2) errors by group."""
        texel, own = self.samples.texel, group[self.samples.view]
        place, size = 2 * texel + own, 2 * (int(texel.max()) + 1)
        count = np.bincount(place, minlength=size)
        sums = np.stack([np.bincount(place, column, size) for column in off.T], axis=1)
        errors = []
        for other in range(2):
            mine = (own == other)[:, None]
            number = count[2 * texel + other][:, None] - mine
            mean = (sums[2 * texel + other] - mine * off) / np.maximum(number, 1)
            square = np.square(off - mean).sum(axis=1)
            errors.append(np.bincount(self.samples.view, square, len(group)))
        of_groups = np.stack(errors, axis=1)
        return float(of_groups[np.arange(len(group)), group].sum()), of_groups
