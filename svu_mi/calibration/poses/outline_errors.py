"""Errors of outlines: how far a mask reaches beyond the outline of the mesh.

At points of the mesh's outline, the mask and the mesh are integrated along the normal of the
outline; the difference of both lengths is the distance between the outlines. Unlike distances of
edge pixels, it is exact to parts of a pixel. Masks may be wider or narrower than the object by the
same width everywhere: each photograph has an unknown width.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy

from svu_mi.calibration.poses.pose_equations import NOTHING, PoseEquations, pixel_derivatives
from svu_mi.capture.capture import Capture
from svu_mi.capture.film_rays import film_ray, ray_table
from svu_mi.capture.sensors import film_size
from svu_mi.core.arrays import evenly_spaced, to_drjit

Trace = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]

COARSE = 256  # pixels on the longer side of the image in which outlines are found
REACH = 6.0  # half the length of the integrals, in coarse pixels
STEP = 0.25  # of the integrals, in coarse pixels
MOST, FEWEST = 800, 40  # points of an outline
BLUR = 1.5  # of the outline's normals, in coarse pixels
ALIKE = 8.0  # neighbouring points with the same error
SHARPEST = 0.1  # least standard deviation of a point's error, in coarse pixels


def outline_equations(capture: Capture, distances: np.ndarray) -> tuple[PoseEquations, np.ndarray]:
    """Return equations of the V used cameras, and the rms distance of outlines (V,) in pixels.

    The distance is NaN for photographs without a mask, or whose outline is hidden.
    """
    sensors, of_views = capture.used_sensors, []
    masks = [mask for mask, used in zip(capture.masks, capture.used, strict=True) if used]
    table, distance = ray_table(sensors), np.full(len(sensors), np.nan)
    for view, (sensor, mask) in enumerate(zip(sensors, masks, strict=True)):
        equations = NOTHING
        if mask is not None:
            trace = partial(_trace, capture, table, view)
            points, normals, world = _outline(trace, film_size(sensor))
            if len(points) >= FEWEST:
                errors = _errors(trace, points, normals, mask)
                by_motion = pixel_derivatives(sensor, world, distances[view])
                slopes = np.einsum("nk,nkj->nj", normals, by_motion)
                equations, distance[view] = _equations(slopes, errors, _pixel(mask.shape))
        of_views.append(equations)
    return PoseEquations.of(of_views), distance


def _pixel(size: tuple[int, ...]) -> float:
    """Return the size of a coarse pixel, in pixels."""
    return max(1.0, max(size) / COARSE)


def _outline(trace: Trace, size: tuple[int, int]) -> tuple[np.ndarray, ...]:
    """Return the mesh's outline: points and outward normals (N, 2) pixels, world points (N, 3)."""
    step = _pixel(size)
    x, y = np.meshgrid(*((np.arange(int(side / step)) + 0.5) * step for side in size))
    distance, world = trace(x, y)
    inside = np.isfinite(distance).reshape(x.shape)
    edge = inside & ~scipy.ndimage.binary_erosion(inside, border_value=1)
    down, right = np.gradient(scipy.ndimage.gaussian_filter(inside.astype(float), BLUR))
    points = np.stack([x[edge], y[edge]], axis=1)
    normals = -np.stack([right[edge], down[edge]], axis=1)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    inner = (points > REACH * step) & (points < np.array(size) - REACH * step)
    chosen = np.flatnonzero((length[:, 0] > 0) & inner.all(axis=1))
    chosen = chosen[evenly_spaced(len(chosen), MOST)]
    return points[chosen], normals[chosen] / length[chosen], world[edge.ravel()][chosen]


def _errors(trace: Trace, points: np.ndarray, normals: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return how far the mask reaches beyond the mesh, (N,) pixels."""
    step = STEP * _pixel(mask.shape)
    along = (np.arange(-int(REACH / STEP), int(REACH / STEP)) + 0.5) * step
    x, y = (points[:, None] + along[:, None] * normals[:, None]).transpose(2, 0, 1)
    of_mesh = np.isfinite(trace(x, y)[0]).reshape(x.shape)
    of_mask = scipy.ndimage.map_coordinates(
        mask.astype(np.float32), [y - 0.5, x - 0.5], order=1, mode="nearest"
    )
    return np.asarray((of_mask - of_mesh).sum(axis=1) * step)


def _trace(
    capture: Capture, table: Any, view: int, x: np.ndarray, y: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Trace film positions: distances (N,), infinite for a miss, and world points (N, 3)."""
    u, v = (to_drjit(mi.Float, np.ravel(values).astype(np.float32)) for values in (x, y))
    ray = film_ray(table, dr.opaque(mi.UInt32, view), u, v)
    hit = capture.scene.ray_intersect_preliminary(ray, coherent=True)
    on_target = hit.is_valid() & (hit.shape == dr.opaque(mi.ShapePtr, capture.shape))
    distance, point = dr.select(on_target, hit.t, dr.inf), ray(dr.select(on_target, hit.t, 0))
    dr.eval(distance, point)
    # Component by component: Dr.Jit would compile a kernel for each number of points.
    return distance.numpy(), np.stack([x.numpy() for x in point], axis=1).astype(np.float64)


def _equations(
    slopes: np.ndarray, errors: np.ndarray, pixel: float
) -> tuple[tuple[np.ndarray, np.ndarray], float]:
    """Return A and b of one photograph, and the rms error; the width of the mask is unknown."""
    off = errors - np.median(errors)
    typical = max(1.5 * float(np.median(np.abs(off))), SHARPEST * pixel)
    weights = 1 / (1 + (off / typical) ** 2 / 4)
    total = weights.sum()
    slopes, errors = (each - weights @ each / total for each in (slopes, errors))
    root = np.sqrt(weights)
    fitted = slopes @ np.linalg.lstsq(slopes * root[:, None], errors * root, rcond=None)[0]
    variance = weights @ (errors - fitted) ** 2 / total
    weights = weights / (ALIKE * max(variance, (SHARPEST * pixel) ** 2))
    rms = float(np.sqrt(weights @ errors**2 / weights.sum()))
    return (slopes.T @ (weights[:, None] * slopes), slopes.T @ (weights * errors)), rms
