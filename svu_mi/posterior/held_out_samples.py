"""Samples of held-out photographs, and their prediction from the photographs of other folds."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import to_drjit
from svu_mi.geometry.pixel_footprint import as_channels
from svu_mi.geometry.sample_view import ViewSample
from svu_mi.parameters import MIXED
from svu_mi.posterior.observations import Observed
from svu_mi.reflection.mix_columns import interpolate_radiance
from svu_mi.reflection.reflection_model import ReflectionModel
from svu_mi.reflection.roughness_levels import level_shares
from svu_mi.statistics.gather_statistics import GRAZING, Weighting, noise_weight

Values = Mapping[str, np.ndarray]
"""Parameters, (F, t, g) each."""


@dataclass(frozen=True)
class HeldOutSamples:
    """S samples of t texels, predicted without the photographs of their fold.

    Attributes:
        view: (S,) int64, photograph, in [0, V).
        texel: (S,) int64, in [0, t).
        fold: (S,) int64, fold of the photograph, in [0, F).
        weight: (S,) float64, weight of the sample (``noise_weight``).
        radiance: (S, C) float64, observed radiance.
        predicted: (S, C) float64, radiance at the posterior means.
        sd: (S, C) float64, standard deviation of the prediction: of draws, and noise.
        diffuse: (S, C) float64, radiance of a white diffuse surface.
    """

    view: np.ndarray
    texel: np.ndarray
    fold: np.ndarray
    weight: np.ndarray
    radiance: np.ndarray
    predicted: np.ndarray
    sd: np.ndarray
    diffuse: np.ndarray

    def scaled_to_others(self, base: np.ndarray, most: float = np.inf) -> np.ndarray:
        """Return c ``base``, (S, C); c in [0, ``most``] fits the texel's samples in other folds."""
        folds, texels = int(self.fold.max()) + 1, int(self.texel.max()) + 1
        group, factors = self.texel * folds + self.fold, []
        for x, b in zip(base.T, self.radiance.T, strict=True):
            sums = [np.bincount(group, self.weight * x * y, texels * folds).reshape(texels, folds)
                    for y in (b, x)]  # fmt: skip
            of_b, of_x = (each.sum(axis=1, keepdims=True) - each for each in sums)
            factors.append(np.clip(of_b / np.maximum(of_x, 1e-300), 0, most).ravel()[group])
        return np.stack(factors, axis=1) * base


def predict_samples(
    observed: Observed, model: ReflectionModel, weighting: Weighting, folds: np.ndarray,
    there: np.ndarray, draws: Sequence[Values], noise: np.ndarray,
) -> HeldOutSamples:  # fmt: skip
    """Predict samples of t texels.

    Args:
        observed: photographs and visibility.
        model: reflection model with the texels as lanes.
        weighting: weights of samples.
        folds: (V,) int64, fold of each view, in [0, F).
        there: (F, t) bool, pairs of fold and texel to predict.
        draws: posterior without each fold: the means, then draws.
        noise: (F, t) standard deviation of samples of weight 1 without each fold.
    """
    channels = draws[0]["base_color"].shape[-1]
    table = PackedValues.of(draws, model.levels)
    fold_of_view = to_drjit(mi.UInt32, folds.astype(np.uint32))
    lanes = dr.opaque(mi.UInt32, model.surface.count)
    knee, eta = dr.opaque(mi.Float, weighting.kappa), dr.opaque(mi.Float, weighting.edges)

    def values(sample: ViewSample, lobes: Any, view: Any) -> list[Any]:
        shown = as_channels(sample.radiance, channels)
        weight = noise_weight(sum(shown) / channels, knee, sample.contrast, eta)
        fold = dr.gather(mi.UInt32, fold_of_view, view)
        first = (fold * lanes + model.surface.lane) * len(draws)
        mean, *drawn = (table.radiance(lobes, first + k) for k in range(len(draws)))
        squares = [sum((one[c] - mean[c]) ** 2 for one in drawn) for c in range(channels)]
        level = lobes[model.levels // 2]
        white = [level[c % len(level)][0] for c in range(channels)]
        return [weight, *shown, *mean, *squares, *white]

    view, texel, found = collect_samples(observed, model, 1 + 4 * channels, values)
    fold = folds[view]
    held = there[fold, texel]
    view, texel, fold = view[held], texel[held], fold[held]
    weight, *parts = found[:, held]
    shown, mean, squares, white = np.reshape(parts, (4, channels, -1)).swapaxes(1, 2)
    variance = squares / max(len(draws) - 1, 1) + (noise[fold, texel] ** 2 / weight)[:, None]
    return HeldOutSamples(view, texel, fold, weight, shown, mean, np.sqrt(variance), white)


def collect_samples(
    observed: Observed, model: ReflectionModel, rows: int,
    values: Callable[[ViewSample, Any, Any], list[Any]],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Return view and lane (S,) int64 and values (rows, S) float64 of a model's samples.

    ``values`` is a function of a sample, the columns of its texel, and the view (UInt32).
    """
    visibility, surface = observed.visibility, model.surface
    order, count = visibility.order, surface.count
    slots = int(dr.width(order))
    lanes, stride = dr.opaque(mi.UInt32, count), dr.opaque(mi.UInt32, slots * count)
    mirrors = observed.mirrors if model.reads_mirrors else None
    found = dr.zeros(mi.Float, (1 + rows) * slots * count)

    def consume(sample: ViewSample, slot: Any, total: Any) -> tuple[Any]:
        free = mi.Bool(True) if mirrors is None else mirrors.test(slot, surface.index)

        def add(total: Any) -> Any:
            cosine = dr.maximum(sample.cosine, GRAZING)
            lobes = model.columns(sample.direction, cosine, free, slot, sample.bend)
            of_sample = values(sample, lobes, dr.gather(mi.UInt32, order, slot))
            for row, value in enumerate([mi.Float(1), *of_sample]):
                place = row * stride + slot * lanes + surface.lane
                dr.scatter(found, value, place, sample.seen)
            return total + 1

        return (dr.if_stmt((total,), visibility.needs_work(sample.seen), add, lambda total: total),)

    (total,) = visibility.over_views(observed.views, surface, consume, (dr.zeros(mi.Float, count),))
    dr.eval(total, found)
    table = found.numpy().reshape(1 + rows, slots, count)
    slot, lane = np.nonzero(table[0] > 0)
    return order.numpy().astype(np.int64)[slot], lane, table[1:, slot, lane].astype(np.float64)


@dataclass(frozen=True)
class PackedValues:
    """Parameters in rows of a table: base colour, mixing parameters, weights of levels."""

    table: Any
    width: int
    channels: int

    @staticmethod
    def of(draws: Sequence[Values], levels: int) -> "PackedValues":
        """Pack D draws (F, t, g) of each parameter; draws of a texel are neighbouring rows."""
        rows = []
        for values in draws:
            roughness = values["roughness"][..., 0]
            shares = level_shares(roughness.ravel(), levels).reshape(*roughness.shape, -1)
            mixed = [values[name] for name in MIXED]
            rows.append(np.concatenate([values["base_color"], *mixed, shares], axis=-1))
        packed = np.stack(rows, axis=2).astype(np.float32)
        channels = draws[0]["base_color"].shape[-1]
        return PackedValues(to_drjit(mi.Float, packed.ravel()), packed.shape[-1], channels)

    def radiance(self, lobes: Sequence[Any], row: Any) -> list[Any]:
        """Return the outgoing radiance for the parameters in a row (UInt32)."""
        values = [dr.gather(mi.Float, self.table, row * self.width + k) for k in range(self.width)]
        mixed, shares = values[self.channels : -len(lobes)], values[-len(lobes) :]
        return interpolate_radiance(lobes, shares, values[: self.channels], mixed)
