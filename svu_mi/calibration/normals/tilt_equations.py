"""Least-squares equations of tilts of each texel's shading normal; materials are eliminated.

A tilt is a vector t in the tangent plane: the normal n becomes (n + t) / |n + t|. N samples have
errors e (observed minus predicted radiance), weights w, and derivatives of the prediction: G by
two coordinates of the tilt, H by the material. With a wide prior P of the material,

    A = G^T w G - C M^-1 C^T,  b = G^T w e - C M^-1 H^T w e,  C = G^T w H,  M = H^T w H + P.
"""

from dataclasses import replace
from itertools import chain
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import to_drjit
from svu_mi.geometry.texels import Texels
from svu_mi.parameters import CHANNELS, NAMES
from svu_mi.posterior.estimate import Estimate
from svu_mi.posterior.held_out_samples import PackedValues, Values, collect_samples
from svu_mi.posterior.observations import Observed
from svu_mi.presets import AngularPreset
from svu_mi.reflection.roughness_levels import roughness_levels
from svu_mi.statistics.gather_statistics import noise_weight

SWITCHES = AngularPreset(folds=0)
STEP = 0.05  # of finite differences by tilts [rad] and by parameters
WIDTH = 1.0  # standard deviation of the prior of material parameters
ALIKE = 1 / 48  # width within which texels have the same error, relative to the map
TILTS = 2  # coordinates of a tilt


def tilt_equations(known: Estimate, grid: Texels) -> tuple[np.ndarray, np.ndarray]:
    """Return A (T, 2, 2) and b (T, 2) along the ``tangents`` of ``grid``; 0 at unseen texels."""
    observed = known.observed
    assert observed is not None
    seen, count, means = observed.seen, known.texels.count, {}
    for name in NAMES:
        mean = np.array(known.posterior.mean(name), float)
        means[name] = mean.reshape(1, count, -1)[:, seen]
    steps = {name: np.where(mean > 0.5, -STEP, STEP) for name, mean in means.items()}
    moved = [{**means, name: means[name] + steps[name]} for name in NAMES]
    lane, weight, shown, (predicted, *others) = _predict(observed, [means, *moved])
    slopes = []
    for name, other in zip(NAMES, others, strict=True):
        slope = ((other - predicted) / steps[name][0, lane])[..., None]
        slopes.append(slope * np.eye(CHANNELS[name]))  # a colour changes its own channel only
    for axis in tangents(grid):
        sides = (tilted(known.texels, step * axis) for step in (STEP, -STEP))
        # Rays that were traced stay.
        ends = [_predict(replace(observed, texels=side), [means])[3][0] for side in sides]
        slopes.append((ends[0] - ends[1])[..., None] / (2 * STEP))
    noise = known.posterior.kernel.noise_of(seen)  # type: ignore[attr-defined]
    alike = max(ALIKE**2 * np.prod(grid.resolution), 1)  # texels with the same error
    weight = weight / (alike * SWITCHES.overdispersion * noise[lane] ** 2)
    columns = np.concatenate([*slopes, (shown - predicted)[..., None]], axis=2)
    return _reduced(columns, weight, seen[lane], count)


def _predict(observed: Observed, draws: list[Values]) -> tuple[np.ndarray, ...]:
    """Return lanes, weights (N,), radiance (N, 3), and radiance of D materials (D, N, 3)."""
    model = observed.model(roughness_levels(SWITCHES.levels), SWITCHES, 3)
    table = PackedValues.of(draws, model.levels)
    knee, eta = (dr.opaque(mi.Float, x) for x in (SWITCHES.kappa(observed.unit), SWITCHES.edges))

    def values(sample: Any, lobes: Any, _: Any) -> list[Any]:
        first = model.surface.lane * len(draws)
        weight = noise_weight(sum(sample.radiance) / 3, knee, sample.contrast, eta)
        of_draws = (table.radiance(lobes, first + k) for k in range(len(draws)))
        return [weight, *sample.radiance, *chain.from_iterable(of_draws)]

    _, lane, (weight, *parts) = collect_samples(observed, model, 4 + 3 * len(draws), values)
    shown, *predicted = np.reshape(parts, (1 + len(draws), 3, -1)).swapaxes(1, 2)
    return lane, weight, shown, np.array(predicted)


def _reduced(
    columns: np.ndarray, weight: np.ndarray, lane: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return A and b from columns (N, 3, K) of material, tilts and error, without the material."""
    each, fitted = np.moveaxis(columns, 2, 0), columns.shape[2] - TILTS - 1
    sums = [[np.bincount(lane, weight * (x * y).sum(axis=1), count) for y in each] for x in each]
    products = np.moveaxis(np.array(sums), 2, 0)
    M = products[:, :fitted, :fitted] + np.eye(fitted) / WIDTH**2
    explained = products[:, fitted:, :fitted] @ np.linalg.solve(M, products[:, :fitted, fitted:])
    rest = products[:, fitted:, fitted:] - explained
    return rest[:, :TILTS, :TILTS], rest[:, :TILTS, TILTS]


def tilted(texels: Texels, tilt: np.ndarray) -> Texels:
    """Return texels with normals tilted by tangential vectors (T, 3)."""
    normal = vectors(texels.normal) + tilt
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return replace(texels, normal=to_drjit(mi.Normal3f, normal.T.astype(np.float32)))


def vectors(values: Any) -> np.ndarray:
    """Return Dr.Jit vectors as (T, 3) float64."""
    return np.stack([np.array(x, np.float64) for x in values], axis=1)


def tangents(texels: Texels) -> list[np.ndarray]:
    """Return two unit vectors perpendicular to the normals of texels, (T, 3) each."""
    frame = mi.Frame3f(texels.normal)
    return [vectors(frame.s), vectors(frame.t)]
