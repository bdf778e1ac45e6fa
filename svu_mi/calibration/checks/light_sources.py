"""Sources of the light on an object: fractions of the irradiance of points on its surface.

Emitters are sampled with their shadows. Other shapes are path traced with the object black, and the
object has the photographed radiance of its nearest seen point.
"""

from __future__ import annotations

from collections import defaultdict

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy

from svu_mi.calibration.checks.surface_samples import Points
from svu_mi.capture.capture import Capture
from svu_mi.capture.surroundings import DIRECT, path_length, surroundings
from svu_mi.core.arrays import to_drjit
from svu_mi.errors import listed

ENVIRONMENT, ITSELF = "the environment", "the object itself"
RAYS = 64  # of each point, to emitters and to surfaces
LEAST = 0.005  # fraction of sources that are listed
BOUNCES = 0.05  # fraction from the object itself from which --bounces is recommended


def light_shares(
    capture: Capture, points: Points, shown: np.ndarray, rays: int = RAYS
) -> dict[str, float]:
    """Return the fraction of the irradiance from each source, largest first; empty without light.

    Args:
        capture: Capture whose axes fit.
        points: N points on the object.
        shown: (N, 3) radiance of the points; NaN if not seen.
        rays: Rays per point.
    """
    scene, integrator = surroundings(capture)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, len(points.position) * rays)
    lanes = dr.arange(mi.UInt32, len(points.position) * rays)
    surface = points.surface(lanes // rays)
    at = dr.zeros(mi.SurfaceInteraction3f, len(lanes))
    at.p, at.n = surface.position + surface.offset * surface.geometric_normal, mi.Normal3f(0)
    found, light = scene.sample_emitter_direction(at, sampler.next_2d(), True)
    cosine = dr.maximum(dr.dot(surface.normal, found.d), 0)
    lit = (cosine > 0) & (dr.dot(surface.geometric_normal, found.d) > 0)
    total: dict[str, float] = defaultdict(float)
    for emitter in scene.emitters() if capture.scene.emitters() else ():
        shape = emitter.get_shape()
        name = f"lamp `{(shape or emitter).id()}`"
        from_it = lit & (found.emitter == mi.EmitterPtr(emitter))
        total[ENVIRONMENT if emitter.is_environment() else name] += _sum(light * cosine, from_it)
    reflected = scene.shapes() if not 0 <= path_length(capture.scene) <= DIRECT else []
    toward = mi.Frame3f(surface.normal).to_world(
        mi.warp.square_to_cosine_hemisphere(sampler.next_2d())
    )
    ray = mi.RayDifferential3f(at.p, toward)
    met = scene.ray_intersect_preliminary(ray, active=dr.dot(surface.geometric_normal, toward) > 0)
    for shape in reflected[1:]:  # the object is the first
        if not shape.is_emitter():
            from_it = met.is_valid() & (met.shape == mi.ShapePtr(shape))
            color, _, _ = integrator.sample(scene, sampler, ray, None, from_it)
            total[f"shape `{shape.id()}`"] += _sum(color * dr.pi, from_it)
    if reflected:
        from_it = met.is_valid() & (met.shape == mi.ShapePtr(reflected[0]))
        color = to_drjit(mi.Color3f, _nearest(points, shown, ray(met.t), from_it))
        total[ITSELF] += _sum(color * dr.pi, from_it)
    whole = sum(total.values())
    names = sorted(total, key=total.__getitem__, reverse=True)
    return {name: total[name] / whole for name in names if whole}


def _sum(light: mi.Color3f, active: mi.Bool) -> float:
    """Return the sum over lanes and channels."""
    return float(dr.sum(dr.select(active & dr.all(dr.isfinite(light)), dr.sum(light), 0))[0])


def _nearest(points: Points, shown: np.ndarray, at: mi.Point3f, wanted: mi.Bool) -> np.ndarray:
    """Return the radiance (3, n) of the nearest seen point; 0 where it is not wanted."""
    known, wanted = np.isfinite(shown).all(axis=1), np.array(wanted)
    color = np.zeros((len(wanted), 3), np.float32)
    if known.any() and wanted.any():
        tree = scipy.spatial.cKDTree(points.position[known])
        color[wanted] = shown[known][tree.query(np.array(at).T[wanted])[1]]
    return color.T


def sentence(shares: dict[str, float]) -> str:
    """Return a sentence with all fractions of at least ``LEAST``."""
    parts = [f"{100 * part:.0f} % from {name}" for name, part in shares.items() if part >= LEAST]
    text = f"{listed(parts)}."
    if shares.get(ITSELF, 0) >= BOUNCES:
        text += " Estimates include light of the object itself with --bounces only."
    return text
