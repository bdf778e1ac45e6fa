"""Synthetic samples of unoccluded texels with known light and materials."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from support.helpers import unit, unit_vectors
from svu_mi.calibration.light.light_samples import TexelSamples
from svu_mi.calibration.light.light_transport import Materials, Transport
from svu_mi.core.arrays import fibonacci, to_drjit
from svu_mi.geometry.sample_view import TexelLanes
from svu_mi.posterior.grid import PrincipledGrid
from svu_mi.presets import preset

SWITCHES = preset("default", method="angular")


def free_samples(normals: np.ndarray, directions: np.ndarray) -> TexelSamples:
    """Samples (n, V, 3) of texels that float in the open; they show no radiance yet."""
    texels, views = directions.shape[:2]
    normal = to_drjit(mi.Normal3f, normals.T.astype(np.float32))
    places = to_drjit(mi.Point3f, np.zeros((3, texels), np.float32))
    far = mi.ScalarTransform4f().translate([0, 0, -1e4]).scale(1e-3)
    scene = mi.load_dict({"type": "scene", "far": {"type": "rectangle", "to_world": far}})
    owner = np.repeat(np.arange(texels), views)
    direction = directions.reshape(-1, 3).astype(np.float32)
    return TexelSamples(
        scene=scene, surface=TexelLanes(places, normal, normal, dr.opaque(mi.Float, 1e-4)),
        owner=owner, view=np.tile(np.arange(views), texels), direction=direction,
        cosine=(direction * normals[owner]).sum(axis=1).astype(np.float32),
        radiance=np.zeros((texels * views, 3), np.float32), weight=np.ones(texels * views),
        contrast=np.zeros(texels * views, np.float32), unit=1.0, kappa=np.inf, edges=0.0,
        cameras=np.broadcast_to(np.eye(3), (views, 3, 3)), grid=PrincipledGrid(),
    )  # fmt: skip


def made_up(texels: int, views: int, seed: int = 31) -> tuple[TexelSamples, Materials]:
    """Samples of texels that face all ways, seen from above their horizons, and materials."""
    rng = np.random.default_rng(seed)
    normals = fibonacci(texels)
    directions = unit(unit_vectors(rng, texels, views) + 1.2 * normals[:, None])
    materials = Materials(
        rng.uniform(0.15, 0.9, texels), rng.choice([0.0, 0.3, 1.0], (texels, 1)),
        rng.uniform(0.1, 0.8, (texels, 3)),
    )  # fmt: skip
    return free_samples(normals, directions), materials


def smooth_light(number: int, seed: int = 7) -> np.ndarray:
    """(N, 3) logarithms of radiance: a lamp, and colours that differ."""
    rng, cells = np.random.default_rng(seed), fibonacci(number)
    lamp = np.exp(6 * (cells @ [0.48, 0.6, 0.64] - 1))
    tint = cells @ rng.normal(size=(3, 3)) * 0.3
    return np.log(0.3 + 5 * lamp)[:, None] + tint


def reflected(transport: Transport, light: np.ndarray, materials: Materials) -> np.ndarray:
    """(S, 3) radiance of the samples, by columns."""
    owner = transport.samples.owner
    parts = transport.columns(light, materials.roughness[:, None]).at(0)
    weights = materials.mixture(owner).at(materials.color[owner])
    return sum(a * b for a, b in zip(weights, parts, strict=True))


def photographed(
    texels: int, views: int, number: int, noise: float
) -> tuple[TexelSamples, np.ndarray]:
    """Samples of known materials under a light, and its logarithms."""
    samples, materials = made_up(texels, views)
    x, rng = smooth_light(number), np.random.default_rng(5)
    radiance = reflected(Transport.of(samples, number), np.exp(x), materials)
    radiance = radiance * (1 + noise * rng.normal(size=radiance.shape))
    shown = replace(samples, radiance=radiance.astype(np.float32), unit=float(radiance.mean()))
    return shown, x
