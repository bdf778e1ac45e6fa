"""Errors of textures: photographs beside their prediction from the estimated reflectance.

A camera that is off shows each texel a little beside its place: the error of a sample is the
gradient of the photograph times the shift. Errors of light and shading vary slowly over the
surface, so that patches of texels have an unknown brightness in each photograph.
"""

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.calibration.poses.pose_equations import NOTHING, PoseEquations, pixel_derivatives
from svu_mi.capture.capture import Capture
from svu_mi.geometry.pixel_footprint import mean_over_texel, read_camera
from svu_mi.geometry.sample_view import ViewSample
from svu_mi.geometry.texels import Texels, texels
from svu_mi.pipeline import estimate
from svu_mi.posterior.estimate import Estimate
from svu_mi.posterior.held_out_samples import PackedValues, collect_samples
from svu_mi.presets import AngularPreset
from svu_mi.reflection.roughness_levels import roughness_levels

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
    # Sharp highlights: blurred ones hide how far they are off.
    flat = dr.zeros(mi.Vector3f, grid.count)
    grid = replace(grid, turns=(flat, flat))
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
    square = np.square(error).mean(axis=1)
    weights = 1 / (variance + square / 4)
    weights /= ALIKE * max(1.0, float(weights @ square / (weights @ variance)))
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
    table, step = PackedValues.of([values], model.levels), dr.opaque(mi.Float, spread)
    views, surface = observed.views, model.surface

    moves = (step, 0), (-step, 0), (0, step), (0, -step)

    def values_of(sample: ViewSample, lobes: Any, view: Any) -> list[Any]:
        place = read_camera(views, view), surface.position, surface.sides, sample.seen
        ends = [mean_over_texel(views, *place, moved=move)[0] for move in moves]
        slopes = [
            (a - b) / (2 * step) for k in (0, 2) for a, b in zip(*ends[k : k + 2], strict=True)
        ]
        return [sample.cosine, *sample.radiance, *table.radiance(lobes, surface.lane), *slopes]

    view, lane, (cosine, *parts) = collect_samples(observed, model, 13, values_of)
    radiance, predicted, right, down = np.reshape(parts, (4, 3, -1)).swapaxes(1, 2)
    return GradientSamples(
        view, lane, cosine, predicted - radiance, radiance, np.stack([right, down], axis=1)
    )
