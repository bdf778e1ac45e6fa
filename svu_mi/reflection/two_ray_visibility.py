"""Shadows of surface points, estimated by two rays per sample.

Directions are sampled from the light and the specular lobe. One is selected for diffuse and one for
specular reflection (resampled importance sampling [Talbot et al. 2005], balance heuristic). Their
visibility, 0 or 1, multiplies the known unshadowed integrals, which has low variance. The
weights of few samples are normalised, which makes surfaces up to 10 % too bright if their brightest
light is occluded.
"""

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

FROM_LIGHT, FROM_LOBE = 4, 2  # number of sampled directions


@dataclass(frozen=True)
class FacingFrame:
    """Shading normal and geometric normal, facing the camera, and direction to the camera."""

    normal: Any
    geometric: Any
    direction: Any


@dataclass
class _Reservoir:
    """Weighted reservoir of one direction."""

    direction: Any
    total: Any

    def offer(self, direction: Any, weight: Any, sample: Any) -> None:
        self.total = self.total + weight
        self.direction = dr.select(sample * self.total < weight, direction, self.direction)


def sample_light_visibility(
    scene: Any, sampler: Any, si: Any, side: FacingFrame, alpha: Any, active: Any
) -> tuple[Any, Any]:
    """Estimate the visibility of diffuse and specular light: two Floats, 0 or 1 per lane."""
    with dr.suspend_grad():
        frame, alpha = mi.Frame3f(side.normal), dr.detach(alpha)
        lobe = mi.MicrofacetDistribution(mi.MicrofacetType.GGX, alpha, True)
        outgoing = frame.to_local(side.direction)
        diffuse = _Reservoir(mi.Vector3f(side.normal), mi.Float(0))
        specular = _Reservoir(mi.Vector3f(mi.reflect(side.direction, side.normal)), mi.Float(0))
        for _ in range(FROM_LIGHT):
            ds, flux = scene.sample_emitter_direction(si, sampler.next_2d(active), False, active)
            flux, local = dr.mean(flux), frame.to_local(ds.d)
            sample = sampler.next_1d(active)
            diffuse.offer(ds.d, dr.maximum(local.z, 0) * flux, sample)
            density = _density(lobe, outgoing, local)
            mixed = FROM_LIGHT * ds.pdf + FROM_LOBE * density
            weight = dr.select(mixed > 0, flux * density * ds.pdf / mixed, 0)
            specular.offer(ds.d, weight, sampler.next_1d(active))
        for _ in range(FROM_LOBE):
            half, _ = lobe.sample(outgoing, sampler.next_2d(active))
            local = mi.reflect(outgoing, half)
            direction = frame.to_world(local)
            light, pdf = _light_from(scene, si, direction, active)
            density = _density(lobe, outgoing, local)
            mixed = FROM_LIGHT * pdf + FROM_LOBE * density
            weight = dr.select(mixed > 0, light * density / mixed, 0)
            specular.offer(direction, weight, sampler.next_1d(active))
        is_open = (
            _is_open(scene, si, side, each.direction, active) for each in (diffuse, specular)
        )
        first, second = (dr.select(free, mi.Float(1), mi.Float(0)) for free in is_open)
        return dr.select(diffuse.total > 0, first, 1), second


def _density(lobe: Any, outgoing: Any, incoming: Any) -> Any:
    """Return the sampling density [1/sr] of local directions (visible normal sampling)."""
    half = dr.normalize(outgoing + incoming)
    density = lobe.pdf(outgoing, half) / (4 * dr.dot(outgoing, half))
    return dr.select((incoming.z > 0) & (outgoing.z > 0), density, 0)


def _light_from(scene: Any, si: Any, direction: Any, active: Any) -> tuple[Any, Any]:
    """Return radiance (mean over channels) and sampling density of the environment."""
    emitter = scene.environment()
    away = dr.zeros(mi.SurfaceInteraction3f, dr.width(direction))
    away.wi = -direction
    ds = dr.zeros(mi.DirectionSample3f, dr.width(direction))
    ds.d = direction
    return dr.mean(emitter.eval(away, active)), emitter.pdf_direction(si, ds, active)


def _is_open(scene: Any, si: Any, side: FacingFrame, direction: Any, active: Any) -> Any:
    """Return True where a direction is unoccluded and above the horizon."""
    above = active & (dr.dot(side.geometric, direction) > 0)
    return above & ~scene.ray_test(si.spawn_ray(direction), above)
