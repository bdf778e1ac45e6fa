"""Photographs whose gain differs from that of the others.

Of a shiny object, honest photographs differ in brightness by half and more; what they differ by
beyond that is a gain. So every point gets the diffuse and the glossy part of its own, as they fit
its views best, and the gain of a view is what the median of its points is brighter than that.

Constants are chosen on our own objects and lights and eight uniform materials, in 8 to 24 views.
No gain is named in right captures; of single photographs x 1.5 and x 0.67 of our own textures,
9 of 10 are with 24 views, 8 of 10 with 12, 7 of 10 with 8.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.checking.brightness import Arriving
from svu_mi.checking.points import Points, Sightings
from svu_mi.checking.sky import Sky
from svu_mi.interop import owned
from svu_mi.light.cells import fibonacci
from svu_mi.reflection.principled import F0
from svu_mi.visibility.reach import is_open

GRAZING = 0.3  # cosine from which a point is looked at
VIEWS = 8  # fewer have too few points in common
LEAST = 3  # views of a point: two say nothing about two unknowns
STEPS = 8  # of gains and materials by turns
DARK = 0.05  # of the median radiance, that differences are relative to at least
TYPICAL = 0.3  # the same, of a point's mean; before anything is known of it
OUTLIER = 0.3  # logarithm of a ratio from which a sample counts half
EXPLAINED = 0.12  # median of it that a point may have over its views
SHARE = 0.65  # of the samples that have to be explained: reflections may be sharper than our lobes
SIDES = fibonacci(16)  # that normals are sorted by: the model errs alike for all points of one side
OF_SIDE = 4  # points
FEWEST = 3  # sides that a view has to show
LARGEST = 0.2  # logarithm of a gain that is put up with
CERTAIN = 4.0  # standard errors


@dataclass(frozen=True)
class Samples:
    """What is known of N points in V views, in grey.

    Attributes:
        seen: (V, N) bool.
        shown: (V, N) radiance, positive where seen.
        diffuse: (N,) radiance of a white diffuse surface.
        lobes: (L, V, N) radiance of glossy ones.
        side: (N,) number of the side that a point is on.
    """

    seen: np.ndarray
    shown: np.ndarray
    diffuse: np.ndarray
    lobes: np.ndarray
    side: np.ndarray

    @staticmethod
    def of(
        scene: Any, points: Points, sightings: Sightings, light: tuple[Sky, Arriving]
    ) -> Samples:
        """Look the light up that points mirror to the cameras."""
        sky, arriving = light
        cosine = np.einsum("vni,ni->vn", sightings.toward, points.normal)
        mirror = 2 * cosine[..., None] * points.normal - sightings.toward
        reflected = sky.reflected(mirror.reshape(-1, 3), np.eye(3)).mean(axis=2)
        reflected = reflected.reshape(-1, *cosine.shape)
        fresnel = F0 + (1 - F0) * (1 - np.clip(cosine, 0, 1)) ** 5
        seen = sightings.seen & (cosine > GRAZING)
        seen &= _sees_sky(scene, points, mirror, seen)
        kept = seen.sum(axis=0) >= LEAST
        return Samples(
            seen=seen[:, kept],
            shown=sightings.radiance.mean(axis=2)[:, kept],
            diffuse=arriving.white.mean(axis=1)[kept],
            lobes=np.concatenate([reflected, reflected * fresnel])[..., kept],
            side=(points.normal[kept] @ SIDES.T).argmax(axis=1),
        )


def _sees_sky(scene: Any, points: Points, mirror: np.ndarray, asked: np.ndarray) -> np.ndarray:
    """Return which of (V, N) samples mirror the light itself, not the object."""
    if not asked.any():
        return np.zeros(asked.shape, bool)
    view, point = np.nonzero(asked)
    surface = points.surface(owned(mi.UInt32, point.astype(np.uint32)))
    direction = owned(mi.Vector3f, mirror[view, point].T.astype(np.float32))
    above = dr.dot(surface.geometric_normal, direction) > 0
    free = np.zeros(asked.shape, bool)
    free[view, point] = is_open(scene, surface, direction, above, coherent=False).numpy()
    return free


@dataclass(frozen=True)
class Gains:
    """The gains of V photographs, relative to their median.

    Attributes:
        log: (V,) natural logarithms.
        noise: (V,) standard errors of those; infinite where nothing can be told.
        explained: part of the samples that the model explains at all, in [0, 1].
    """

    log: np.ndarray
    noise: np.ndarray
    explained: float

    @property
    def known(self) -> np.ndarray:
        """(V,) bool, the photographs that can be judged."""
        return np.isfinite(self.noise) & (self.explained >= SHARE)

    @property
    def odd(self) -> np.ndarray:
        """(V,) bool, the photographs whose gain differs by more than their noise allows."""
        limit = np.maximum(LARGEST, CERTAIN * np.where(self.known, self.noise, 0))
        return self.known & (np.abs(self.log) > limit)


def relative_gains(samples: Samples) -> Gains:
    """Find gains and materials by turns, starting from equal gains."""
    seen, shown = samples.seen, samples.shown
    log = np.zeros(len(shown))
    if not seen.any():
        return Gains(log, np.full(len(log), np.inf), 0.0)
    unit = DARK * max(float(np.median(shown[seen])), 1e-30)
    count = seen.sum(axis=0)
    mean = np.where(seen, shown, 0).sum(axis=0) / count
    weight = seen / (shown + unit + TYPICAL * mean) ** 2
    for _ in range(STEPS):
        even = shown * np.exp(-log)[:, None]
        model = _fitted(even, weight, samples)
        ratio = np.where(seen, np.log((even + unit) / (model + unit)), np.nan)
        weight = seen / (model + unit) ** 2 / (1 + (np.nan_to_num(ratio) / OUTLIER) ** 2)
        # Two of a point's views are always explained.
        error = _medians(np.abs(ratio - _medians(ratio, 1)[:, None]), 0) * np.sqrt(
            count / (count - 2)
        )
        known = np.where(error < EXPLAINED, ratio, np.nan)
        log = log + np.nan_to_num(_medians(known, 1))
        log = log - np.median(log)
    return Gains(log, _noise(known, samples.side), float(np.isfinite(known).sum() / seen.sum()))


def _fitted(shown: np.ndarray, weight: np.ndarray, samples: Samples) -> np.ndarray:
    """Return what (V, N) a diffuse part and the best lobe of each point explain, both positive."""
    least, model = np.full(shown.shape[1], np.inf), np.zeros_like(shown)
    diffuse = np.broadcast_to(samples.diffuse, shown.shape)
    for lobe in samples.lobes:
        found = _mixed(shown, weight, diffuse, lobe)
        error = (weight * (shown - found) ** 2).sum(axis=0)
        model, least = np.where(error < least, found, model), np.minimum(error, least)
    return model


def _mixed(
    shown: np.ndarray, weight: np.ndarray, diffuse: np.ndarray, lobe: np.ndarray
) -> np.ndarray:
    """Fit shown = a diffuse + b lobe at every point by weighted least squares, a and b positive."""

    def product(one: np.ndarray, other: np.ndarray) -> np.ndarray:
        return (weight * one * other).sum(axis=0)

    aa, bb, ab = product(diffuse, diffuse), product(lobe, lobe), product(diffuse, lobe)
    sa, sb = product(shown, diffuse), product(shown, lobe)
    determinant = aa * bb - ab * ab
    is_both = determinant > 1e-6 * aa * bb
    divisor = np.where(is_both, determinant, 1)
    a, b = (sa * bb - sb * ab) / divisor, (sb * aa - sa * ab) / divisor
    # Else one of them alone, that which explains more.
    alone_a, alone_b = sa / np.maximum(aa, 1e-30), sb / np.maximum(bb, 1e-30)
    is_both &= (a >= 0) & (b >= 0)
    is_diffuse = alone_a * sa >= alone_b * sb
    a = np.where(is_both, a, np.where(is_diffuse, alone_a, 0))
    b = np.where(is_both, b, np.where(is_diffuse, 0, alone_b))
    return a * diffuse + b * lobe


def _noise(ratio: np.ndarray, side: np.ndarray) -> np.ndarray:
    """Return standard errors (V,) of the medians of ratios (V, N), by how much sides differ."""
    medians = []
    for number in np.unique(side):
        of_side = ratio[:, side == number]
        enough = np.isfinite(of_side).sum(axis=1) >= OF_SIDE
        medians.append(np.where(enough, _medians(of_side, 1), np.nan))
    table = np.stack(medians, axis=1)
    count = np.isfinite(table).sum(axis=1)
    spread = 1.48 * _medians(np.abs(table - _medians(table, 1)[:, None]), 1)
    return np.where(count >= FEWEST, spread / np.sqrt(np.maximum(count, 1)), np.inf)


def _medians(values: np.ndarray, axis: int) -> np.ndarray:
    """Return medians of what is finite, NaN where nothing is."""
    return np.ma.median(np.ma.masked_invalid(values), axis=axis).filled(np.nan)
