"""Prior of the light, and background pixels that show it.

Log radiance is a Gaussian field with two correlation lengths [log-Gaussian Cox fields, Moller et
al. 1998]:

    log L_c(w) = u(w) + v_c(w),    cov u(w) u(w') = l^2 + b^2 k(angle / 40 deg)
                                                    + n^2 k(angle / 12 deg) + o^2 [w = w'],

with k(t) = exp(-t^2 / 2). The colours v have the same covariance with smaller amplitudes. The
amplitudes were fitted to the lights included in svu_mi.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture.capture import Capture
from svu_mi.capture.film_rays import pixel_rays, ray_table, stratified
from svu_mi.capture.scene import to_world
from svu_mi.capture.sensors import film_size
from svu_mi.core.arrays import fibonacci, to_drjit
from svu_mi.errors import CaptureError
from svu_mi.light.light_tree import nearest_cells

BROAD, NARROW = np.radians(40), np.radians(12)


class Amplitudes(NamedTuple):
    """Standard deviations of the prior: scale, broad, narrow and independent part."""

    scale: float
    broad: float
    narrow: float
    own: float


BRIGHTNESS = Amplitudes(scale=3.0, broad=0.9, narrow=0.8, own=0.35)
SD = float(np.linalg.norm(BRIGHTNESS[1:]))  # of the channel mean of a cell, at fixed scale
COLOR = Amplitudes(scale=0.5, broad=0.25, narrow=0.15, own=0.05)
PIXELS = 4000  # approximate number of sampled pixels per photograph
BACKGROUND_SD = 0.1  # sd of mean log radiance of a cell, from parallax and subsampling
DARK = 1e-4  # radiance of black pixels, relative to the mean


@dataclass(frozen=True)
class LightPrior:
    """Precisions (N, N) float64 of log radiance in N cells: one for the channel mean, one
    for the difference between a channel and the mean."""

    brightness: np.ndarray
    color: np.ndarray

    def pull(self, x: np.ndarray) -> np.ndarray:
        """Return the gradient (N, 3) of the negative log prior at log radiance x (N, 3)."""
        u = x.mean(axis=1, keepdims=True)
        return self.brightness @ u / 3 + self.color @ (x - u)

    def precision(self) -> np.ndarray:
        """Return the precision of all channels, (3 N, 3 N) float64, channel by channel."""
        between = self.brightness / 9 - self.color / 3
        own = between + self.color
        return np.block([[own if i == k else between for k in range(3)] for i in range(3)])


@lru_cache(maxsize=2)
def prior_of(number: int) -> LightPrior:
    """Return the prior of N cells of equal size."""
    cells = fibonacci(number)
    brightness, color = (np.linalg.inv(_covariance(cells, cells, a)) for a in (BRIGHTNESS, COLOR))
    return LightPrior(brightness, color)


def refined(x: np.ndarray, number: int) -> np.ndarray:
    """Interpolate x (N, 3) to another number of cells, by the conditional mean of the prior."""
    old, new = fibonacci(len(x)), fibonacci(number)
    u = x.mean(axis=1, keepdims=True)
    parts = zip((u, x - u), (BRIGHTNESS, COLOR), strict=True)
    return sum(
        values.mean(axis=0)
        + _covariance(new, old, a, own=False)
        @ np.linalg.solve(_covariance(old, old, a), values - values.mean(axis=0))
        for values, a in parts
    )


def _covariance(a: np.ndarray, b: np.ndarray, of: Amplitudes, own: bool = True) -> np.ndarray:
    angle = np.arccos(np.clip(a @ b.T, -1, 1))
    covariance = of.scale**2 + of.broad**2 * np.exp(-0.5 * (angle / BROAD) ** 2)
    covariance += of.narrow**2 * np.exp(-0.5 * (angle / NARROW) ** 2)
    return covariance + of.own**2 * np.eye(len(a)) if own else covariance


class SeenCells(NamedTuple):
    """Log mean radiance (N, 3) of N cells, and its precision (N,); 0 for unseen cells."""

    precision: np.ndarray
    logarithm: np.ndarray


@dataclass(frozen=True)
class BackgroundPixels:
    """Radiance (P, 3) of background pixels, and unit directions (P, 3) in the light frame."""

    direction: np.ndarray
    radiance: np.ndarray

    def at(self, number: int) -> SeenCells:
        """Return averages of the pixels in each of N cells."""
        cells = nearest_cells(self.direction, number)
        count = np.bincount(cells, minlength=number)
        sums = [np.bincount(cells, channel, number) for channel in self.radiance.T]
        mean = np.stack(sums, axis=1) / np.maximum(count, 1)[:, None]
        logarithm = np.log(np.maximum(mean, DARK * self.radiance.mean()))
        return SeenCells((count > 0) / BACKGROUND_SD**2, np.where(count[:, None] > 0, logarithm, 0))

    @staticmethod
    def of(capture: Capture, *, moves: bool = False) -> "BackgroundPixels":
        """Sample pixels outside all shapes; ``moves``: the light moves with the cameras."""
        used = [k for k in range(capture.count) if capture.used[k]]
        pixels = [_grid(capture, k) for k in used]
        view = np.repeat(np.arange(len(used)), [len(rows) for rows, _ in pixels])
        rows, columns = (np.concatenate(part) for part in zip(*pixels, strict=True))
        numbers = (to_drjit(mi.UInt32, part) for part in (view, rows, columns))
        rays = pixel_rays(
            ray_table([capture.sensors[k] for k in used]), tuple(numbers), 1, stratified(1)
        )
        hit, towards = capture.scene.ray_test(rays), mi.Vector3f(rays.d)
        dr.eval(hit, towards)
        colors = np.concatenate([
            np.where(_beyond(capture, k)[..., None], capture.images[k], np.nan)[at]
            for k, at in zip(used, pixels, strict=True)
        ]).astype(np.float64)  # fmt: skip
        kept = ~hit.numpy() & np.isfinite(colors).all(axis=1)
        if not kept.any():
            raise CaptureError("No photograph shows background pixels; omit --background.")
        if not colors[kept].mean() > 0:
            raise CaptureError(
                "The background of all photographs is black, so it was probably removed; omit "
                "--background."
            )
        direction = towards.numpy().T.astype(np.float64)
        if moves:
            turned = np.stack([to_world(capture.sensors[k])[:3, :3] for k in used])
            direction = np.einsum("pi,pij->pj", direction, turned[view])
        return BackgroundPixels(direction[kept], colors[kept])


def _grid(capture: Capture, view: int) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and columns of evenly spaced pixels of a photograph."""
    width, height = film_size(capture.sensors[view])
    step = max(int(np.sqrt(width * height / PIXELS)), 1)
    rows, columns = np.mgrid[step // 2 : height : step, step // 2 : width : step]
    return rows.ravel(), columns.ravel()


def _beyond(capture: Capture, view: int) -> np.ndarray:
    mask = capture.masks[view]
    return np.ones(capture.images[view].shape[:2], bool) if mask is None else ~mask
