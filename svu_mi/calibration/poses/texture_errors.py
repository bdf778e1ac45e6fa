"""Errors of textures: photographs beside their prediction from the estimated reflectance.

A camera that is off shows each texel a little beside its place: the error of a sample is the
gradient of the photograph times the shift. Errors of light and shading vary slowly over the
surface, so that patches of texels have an unknown brightness in each photograph.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.calibration.poses.pose_equations import NOTHING, PoseEquations, pixel_derivatives
from svu_mi.capture.capture import Capture
from svu_mi.core.arrays import to_drjit
from svu_mi.geometry.pixel_footprint import mean_over_texel, read_camera
from svu_mi.geometry.texels import Texels, texels
from svu_mi.parameters import MIXED
from svu_mi.pipeline import estimate
from svu_mi.posterior.estimate import Estimate
from svu_mi.posterior.held_out_samples import pack_values
from svu_mi.presets import AngularPreset
from svu_mi.reflection.mix_columns import interpolate_radiance
from svu_mi.reflection.roughness_levels import roughness_levels
from svu_mi.statistics.gather_statistics import GRAZING

PATCH = 8  # texels per side of a patch with an unknown brightness
STEEPEST = 0.25  # smallest cosine of the viewing angle
NOISE = 0.05  # standard deviation of the prediction, relative to radiance
ALIKE = 25.0  # neighbouring samples with the same error
FEWEST = 50  # samples of a photograph
SWITCHES = AngularPreset(folds=0, metal_share=0.5)


@dataclass(frozen=True)
class GradientSamples:
    """S samples, colour by colour.

    Attributes:
        view, texel: (S,) int64; the texel is a lane.
        cosine: (S,), of the viewing angle.
        error: (S, 3), predicted minus observed radiance.
        radiance: (S, 3), observed.
        gradient: (S, 2, 3), change of the observed radiance per pixel to the right and down.
    """

    view: np.ndarray
    texel: np.ndarray
    cosine: np.ndarray
    error: np.ndarray
    radiance: np.ndarray
    gradient: np.ndarray


def texture_equations(
    capture: Capture, side: int, spread: float, distances: np.ndarray
) -> PoseEquations:
    """Return equations of V cameras from ``side``^2 texels.

    Args:
        capture: capture with the cameras at which the errors are linearised.
        side: texels per side; fewer for larger errors.
        spread: pixels on both sides of a sample for its gradient, and expected error of the poses.
        distances: (V,), distance of each camera from the object.
    """
    grid = texels(capture.mesh, (side, side))
    known = estimate(capture, grid, preset=SWITCHES)
    assert known.observed is not None
    seen, unit = known.observed.seen, known.observed.unit
    samples = gradient_samples(known, seen, spread)
    points = np.stack([x.numpy() for x in grid.position], axis=1)[seen].astype(np.float64)
    patches = _patches(grid, side)[seen]
    of_views = []
    for view, sensor in enumerate(capture.used_sensors):
        own = np.flatnonzero((samples.view == view) & (samples.cosine > STEEPEST))
        if len(own) < FEWEST:
            of_views.append(NOTHING)
            continue
        slopes = pixel_derivatives(sensor, points[samples.texel[own]], distances[view])
        of_views.append(_equations(samples, own, slopes, patches[samples.texel[own]], unit, spread))
    return PoseEquations.of(of_views)


def _patches(grid: Texels, side: int) -> np.ndarray:
    """Return the patch of each texel, (T,) int64."""
    row, column = np.divmod(grid.index.numpy().astype(np.int64), side)
    return np.asarray(row // PATCH * side + column // PATCH)


def _equations(
    samples: GradientSamples, own: np.ndarray, slopes: np.ndarray, patch: np.ndarray, unit: float,
    spread: float,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return A and b of one photograph; the brightness of each patch and colour is unknown."""
    error, gradient = samples.error[own], samples.gradient[own]
    noise = NOISE * (samples.radiance[own].mean(axis=1) + SWITCHES.knee * unit)
    variance = noise**2 + 0.25 * spread**2 * np.square(gradient).sum(axis=1).mean(axis=1)
    weights = 1 / (variance + np.square(error).mean(axis=1) / 4)
    weights /= ALIKE * max(1.0, float(np.average(np.square(error).mean(axis=1), weights=weights)
                                      / np.average(variance, weights=weights)))  # fmt: skip
    _, place = np.unique(patch, return_inverse=True)
    total = np.bincount(place, weights)
    A, b = np.zeros((6, 6)), np.zeros(6)
    for color in range(3):
        columns = np.einsum("nk,nkj->nj", gradient[..., color], slopes)
        both = np.column_stack([columns, error[:, color]])
        means = np.stack([np.bincount(place, weights * x) / total for x in both.T], axis=1)
        both -= means[place]
        product = both.T @ (weights[:, None] * both) / 3
        A, b = A + product[:6, :6], b + product[:6, 6]
    return A, b


def gradient_samples(known: Estimate, seen: np.ndarray, spread: float) -> GradientSamples:
    """Return samples of all photographs at the texels in ``seen``, with their gradients."""
    observed = known.observed
    assert observed is not None
    model = observed.model(roughness_levels(SWITCHES.levels), SWITCHES, 3)
    values = {name: np.array(known.posterior.mean(name)).reshape(1, known.texels.count, -1)[:, seen]
              for name in known.posterior.axes}  # fmt: skip
    views, visibility, surface = observed.views, observed.visibility, model.surface
    packed = pack_values([values], model.levels)
    table, width = to_drjit(mi.Float, packed.ravel()), packed.shape[-1]
    count, slots = surface.count, int(dr.width(visibility.order))
    lanes, stride = dr.opaque(mi.UInt32, count), dr.opaque(mi.UInt32, slots * count)
    mirrors = observed.mirrors if model.reads_mirrors else None
    step, found = dr.opaque(mi.Float, spread), dr.zeros(mi.Float, 14 * slots * count)

    def consume(sample: Any, slot: Any, total: Any) -> tuple[Any]:
        free = mi.Bool(True) if mirrors is None else mirrors.test(slot, surface.index)

        def add(total: Any) -> Any:
            lobes = model.columns(sample.direction, dr.maximum(sample.cosine, GRAZING), free, slot)
            row = [dr.gather(mi.Float, table, surface.lane * width + k) for k in range(width)]
            shares = row[-model.levels :]
            predicted = interpolate_radiance(lobes, shares, row[:3], row[3 : 3 + len(MIXED)])
            camera = read_camera(views, dr.gather(mi.UInt32, visibility.order, slot))
            place = surface.position, surface.sides
            values = [mi.Float(1), sample.cosine, *sample.radiance, *predicted]
            for move in ((step, 0), (0, step)):
                ends = [mean_over_texel(views, camera, *place, sample.seen, moved=(s * move[0],
                        s * move[1]))[0] for s in (1, -1)]  # fmt: skip
                values += [(a - b) / (2 * step) for a, b in zip(*ends, strict=True)]
            for number, value in enumerate(values):
                target = number * stride + slot * lanes + surface.lane
                dr.scatter(found, value, target, sample.seen)
            return total + 1

        return (dr.if_stmt((total,), visibility.needs_work(sample.seen), add, lambda t: t),)

    (total,) = visibility.over_views(views, surface, consume, (dr.zeros(mi.Float, count),))
    dr.eval(total, found)
    values_of = found.numpy().reshape(14, slots, count)
    slot, lane = np.nonzero(values_of[0])
    _, cosine, *parts = values_of[:, slot, lane].astype(np.float64)
    radiance, predicted, right, down = np.reshape(parts, (4, 3, -1)).swapaxes(1, 2)
    return GradientSamples(
        visibility.order.numpy()[slot].astype(np.int64), lane, cosine, predicted - radiance,
        radiance, np.stack([right, down], axis=1),
    )  # fmt: skip
