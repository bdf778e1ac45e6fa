"""How far two maps are apart, where that is certain, and figures of it.

Where standard deviations are known, a difference is certain if it is more than twice as large as
both sides together may be off, in the mean over the texels around. That mean takes the noise of
single texels out of the difference, but is not taken to be known any better than they are:
neighbours have errors in common.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from svu_mi.metrics import psnr
from svu_mi.output.compare_surface import Surface
from svu_mi.output.knowledge import part

CERTAIN = 2.0  # standard deviations
AROUND = 5  # texels, side of the square that differences are averaged over
LEAST = 1e-3  # standard deviation that anything is taken to have at least
CHARTS = 64  # of which figures are given, the largest


@dataclass(frozen=True, kw_only=True)
class Figures:
    """Figures of a difference on a part of the surface, by area.

    Attributes:
        mean: of the difference, with its sign, over channels too.
        median: of its size; of several channels, of that which differs most.
        rms: over channels too.
        psnr: dB, at most 100; the peak is 1.
        beyond: part of the area that differs by more than the tolerance.
        certain: part of it that differs certainly; None where no standard deviation is known.
        certain_mean: mean of the difference there, None if there is none.
    """

    mean: float
    median: float
    rms: float
    psnr: float
    beyond: float
    certain: float | None = None
    certain_mean: float | None = None

    @property
    def differs(self) -> float:
        """Part that differs: certainly, or by more than the tolerance where that is not known."""
        return self.beyond if self.certain is None else self.certain


@dataclass(frozen=True, kw_only=True)
class Difference:
    """How far two maps are apart.

    Attributes:
        values: (T, C) float32, the second minus the first; NaN where one of them has no value.
        deviations: (T,) float32, the same in standard deviations, averaged over the texels around,
            of the channel where it is largest, with its sign; NaN as above. None where no standard
            deviation is known.
        figures: of all texels that have a value.
        charts: of each of the largest UV charts; None where nothing of one can be compared.
    """

    values: np.ndarray
    deviations: np.ndarray | None
    figures: Figures
    charts: tuple[Figures | None, ...]

    @property
    def certain(self) -> np.ndarray:
        """(T,) bool, texels that certainly differ; none where no standard deviation is known."""
        if self.deviations is None:
            return np.zeros(len(self.values), bool)
        return np.abs(np.nan_to_num(self.deviations)) > CERTAIN


def difference(
    surface: Surface,
    first: np.ndarray,
    second: np.ndarray,
    *,
    sd: np.ndarray | None = None,
    tolerance: float = 0.0,
) -> Difference:
    """Compare two maps.

    Args:
        surface: T texels.
        first: (T, C) float32; NaN where there is no value.
        second: the same, of as many channels, or one of them has one: then the mean of the other's
            is compared.
        sd: (T, C) standard deviation of the difference, None if it is not known.
        tolerance: for ``Figures.beyond``.
    """
    if first.shape[1] != second.shape[1]:
        first, second = (x.mean(axis=1, keepdims=True) for x in (first, second))
        sd = None if sd is None else sd.mean(axis=1, keepdims=True)
    values = second - first
    compared = np.isfinite(values).all(axis=1)
    values[~compared] = np.nan
    deviations = None if sd is None else _deviations(surface, values, sd)
    both = first, second

    def figures(chosen: np.ndarray) -> Figures | None:
        chosen = chosen & compared
        if not chosen.any():
            return None
        found = values[chosen], None if deviations is None else deviations[chosen]
        area = surface.area[chosen]
        return _figures(*found, area, tolerance, psnr(*(x[chosen] for x in both)))

    every = figures(compared)
    assert every is not None
    count = min(int(surface.chart.max(initial=0)) + 1, CHARTS)
    return Difference(
        values=values, deviations=deviations, figures=every,
        charts=tuple(figures(surface.chart == chart) for chart in range(count)),
    )  # fmt: skip


def _figures(
    values: np.ndarray, deviations: np.ndarray | None, area: np.ndarray, tolerance: float,
    psnr_db: float,
) -> Figures:  # fmt: skip
    """Return figures of texels all of which have a value."""
    size, mean = np.abs(values).max(axis=1), values.mean(axis=1)
    order = np.argsort(size, kind="stable")
    below = np.cumsum(area[order])
    certain = certain_mean = None
    if deviations is not None:
        sure = np.abs(deviations) > CERTAIN
        certain = part(area, sure)
        certain_mean = float(np.average(mean[sure], weights=area[sure])) if sure.any() else None
    return Figures(
        mean=float(np.average(mean, weights=area)),
        median=float(size[order[np.searchsorted(below, below[-1] / 2)]]),
        rms=float(np.sqrt(np.average((values**2).mean(axis=1), weights=area))),
        psnr=psnr_db, beyond=part(area, size > tolerance), certain=certain,
        certain_mean=certain_mean,
    )  # fmt: skip


def _deviations(surface: Surface, values: np.ndarray, sd: np.ndarray) -> np.ndarray:
    """Return differences in standard deviations, averaged within each chart by 1 / sd^2."""
    columns = []
    for k in range(values.shape[1]):
        sure = np.isfinite(values[:, k]) & np.isfinite(sd[:, k])
        weight = np.where(sure, 1 / np.maximum(sd[:, k], LEAST) ** 2, 0)
        weighted = weight * np.where(sure, values[:, k], 0)
        weights, sums, count = _sums_around(surface, np.stack([weight, weighted, 1.0 * sure]))
        with np.errstate(divide="ignore", invalid="ignore"):
            found = sums / weights / np.sqrt(count / weights)
        columns.append(np.where(sure, found, np.nan))
    table = np.stack(columns, axis=1)
    largest = np.abs(np.nan_to_num(table)).argmax(axis=1)
    return np.take_along_axis(table, largest[:, None], axis=1)[:, 0].astype(np.float32)


def _sums_around(surface: Surface, values: np.ndarray) -> np.ndarray:
    """Return sums of (N, T) over the square around each texel, within its own chart: (N, T)."""
    chart = surface.to_image(surface.chart + 1, 0)
    images = [surface.to_image(row, 0.0) for row in values]
    found = np.zeros((len(images), *chart.shape))
    for number, box in enumerate(scipy.ndimage.find_objects(chart), 1):
        if box is None:
            continue
        own = chart[box] == number
        for image, sums in zip(images, found, strict=True):
            inside = np.where(own, image[box], 0)
            total = scipy.ndimage.uniform_filter(inside, AROUND, mode="constant")
            sums[box] += np.where(own, total * AROUND**2, 0)
    return found.reshape(len(images), -1)[:, surface.index]
