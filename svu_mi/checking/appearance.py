"""Whether what the photographs show of a surface makes sense: agreement of views, and textures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture import Capture
from svu_mi.checking.frames import tone
from svu_mi.checking.points import Points, Sightings
from svu_mi.interop import owned
from svu_mi.light.environment import basis_at

ENOUGH = 2  # views that have to see a point before they can disagree
FEWEST = 30  # points that a texture is compared at
PLAIN = 0.01  # standard deviation of a base colour that is not a texture
GLOSS = 0.04  # what a black surface reflects, too
DARK = 0.01  # of the photographs' unit, added before taking logarithms
SHADING_DEGREE = 2  # harmonics that hold 99 % of any irradiance [Ramamoorthi and Hanrahan 2001]


def agreement(sightings: Sightings, spread: float) -> float:
    """Return how much more points differ from each other than views of one point, 0 to 1.

    An intraclass correlation of the tone-mapped photographs: 1 if each point looks the same
    from everywhere and points differ; about 0 if the views show anything.

    Args:
        sightings: what the views show.
        spread: variance of the photographs' tone-mapped pixels; points must differ by some
            part of it, or an even background would agree perfectly.
    """
    kept = sightings.seen.sum(axis=0) >= ENOUGH
    if not kept.any():
        return 0.0
    seen, shown = sightings.seen[:, kept, None], tone(sightings.radiance[:, kept])
    count = seen.sum(axis=0)
    mean = np.where(seen, shown, 0).sum(axis=0) / count
    within = np.where(seen, (shown - mean) ** 2, 0).sum(axis=0) / (count - 1)
    between = max(float((mean.var(axis=0) - (within / count).mean(axis=0)).mean()), 0.0)
    return between / (between + float(within.mean()) + 0.02 * spread + 1e-12)


def typical(sightings: Sightings) -> tuple[np.ndarray, np.ndarray]:
    """Return the median (N, 3) of what views show of each point, and which points are known."""
    known = sightings.seen.sum(axis=0) >= 1
    values = np.where(sightings.seen[..., None], sightings.radiance, np.nan)
    result = np.zeros(values.shape[1:])
    result[known] = np.nanmedian(values[:, known], axis=0)
    return result, known


@dataclass(frozen=True)
class Texture:
    """The base colour that the scene gives an object, at N points.

    Attributes:
        albedo: (N, 3).
        flipped: (N, 3), if V of the texture coordinates runs the other way.
    """

    albedo: np.ndarray
    flipped: np.ndarray

    def turned(self) -> Texture:
        """Return the texture with V the other way round."""
        return Texture(self.flipped, self.albedo)


def read_texture(capture: Capture, points: Points) -> Texture | None:
    """Return the object's texture, or None where it has none that one could recognise."""
    if points.uv is None or capture.shape.bsdf() is None:
        return None
    albedo = base_color(capture.shape, points.uv)
    if not np.isfinite(albedo).all() or albedo.std(axis=0).mean() < PLAIN:
        return None
    return Texture(albedo, base_color(capture.shape, points.uv * [1, -1] + [0, 1]))


def base_color(shape: Any, uv: np.ndarray) -> np.ndarray:
    """Return the diffuse reflectance (N, 3) of a shape's material at texture coordinates."""
    si = dr.zeros(mi.SurfaceInteraction3f, len(uv))
    si.uv = owned(mi.Point2f, uv.T.astype(np.float32))
    si.wi = mi.Vector3f(0, 0, 1)
    color = shape.bsdf().eval_diffuse_reflectance(si)
    return np.stack(
        [np.broadcast_to(np.array(channel, float), len(uv)) for channel in color], axis=-1
    )


def texture_fit(
    sightings: Sightings, points: Points, albedo: np.ndarray
) -> tuple[float, np.ndarray]:
    """Compare a texture with the photographs, whatever the light is.

    Logarithms of both, after taking from each what smooth shading could explain: no light has
    to be known.

    Args:
        sightings: what the views show.
        points: N of them.
        albedo: (N, 3), base colour.

    Returns:
        Their correlation, and (N,) what is left of each point's variance when the one has
        been predicted by the other; 1 in the mean if nothing is explained, NaN where not seen.
    """
    shown, known = typical(sightings)
    misfit = np.full(len(albedo), np.nan)
    if known.sum() < FEWEST:
        return 0.0, misfit
    shading = basis_at(points.normal[known], SHADING_DEGREE)
    a, b = np.log(albedo[known] + GLOSS), np.log(shown[known] + DARK)
    # Colours as differences of channels, too: light moves them less than brightness.
    a, b = (np.concatenate([x, x - x.mean(axis=1, keepdims=True)], axis=1) for x in (a, b))
    a, b = (x - shading @ np.linalg.lstsq(shading, x, rcond=None)[0] for x in (a, b))
    a, b = (x / max(np.sqrt((x * x).sum()), 1e-12) for x in (a, b))
    correlation = float((a * b).sum())
    misfit[known] = known.sum() * ((b - max(correlation, 0.0) * a) ** 2).sum(axis=1)
    return correlation, misfit
