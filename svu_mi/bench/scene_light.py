"""Path-traced posterior of single texels in the light of the true scene.

Only the material of a texel changes; the rest of the object, and other shapes, keep the scene's.
Incident light does not depend on that material then, so that all materials share its samples.
Their directions follow the lobes of all roughness levels, and the environment (balance heuristic
[Veach and Guibas 1995]).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture.scene import environment_of
from svu_mi.evaluation.path_trace import UniformScene
from svu_mi.evaluation.reference import Reference
from svu_mi.evaluation.reference_options import Noise, ReferenceOptions
from svu_mi.evaluation.traced_posterior import trace_tables
from svu_mi.evaluation.visible_pairs import VisiblePairs
from svu_mi.posterior.calibrated import calibrated_posterior
from svu_mi.posterior.grid import PrincipledGrid
from svu_mi.posterior.metal_share import learned_metal_share
from svu_mi.posterior.observations import Observed
from svu_mi.posterior.posterior import Posterior
from svu_mi.presets import AngularPreset
from svu_mi.reflection.near_lobes import INSIDE, LATTICE
from svu_mi.reflection.roughness_levels import roughness_levels

LOBES, SKY = 10, 10  # sets of directions from lobes and from the environment
SAMPLES = 256  # directions of each set and pair of texel and view
PAIRS = 1 << 10  # pairs per launch


def scene_light_posteriors(
    observed: Observed, texels: np.ndarray, noise: Sequence[Noise], depth: int,
    samples: int = SAMPLES,
) -> list[Reference]:  # fmt: skip
    """Return the posterior of (n,) texels for each noise model.

    Paths have at most ``depth`` edges, and the environment is the only emitter.
    """
    lights: dict[int, SceneLight] = {}

    def renderer(target: UniformScene, pairs: VisiblePairs, batch: tuple[int, int]) -> SceneLight:
        number, _ = batch
        if number not in lights:
            lights[number] = SceneLight.trace(
                observed.capture, target, pairs.rays, depth, samples, number
            )
        return lights[number]

    references = []
    for model in noise:
        options = ReferenceOptions(
            spp=samples, grid=PrincipledGrid(), sigma=0.08, max_depth=2, method="linear", seed=0,
            noise=model,
        )  # fmt: skip
        traced = trace_tables(observed, texels, options, renderer)
        references.append(replace(Reference.of(traced, options, cached=False), max_depth=depth))
    return references


def learned_posterior(reference: Reference) -> Posterior:
    """Return the posterior of estimated noise with the share of metals that its texels have."""
    options, grid, unit = AngularPreset(), PrincipledGrid(), reference.unit
    levels = roughness_levels(options.levels)
    factors = reference.statistics(reference.tables[0], levels).factor()
    share = learned_metal_share(factors, grid, unit, options)
    return calibrated_posterior(factors, grid, unit, replace(options, metal_share=share))


@dataclass(frozen=True)
class SceneLight:
    """Renders one material after the other at P pairs (a ``Render``), with S samples per set.

    Attributes:
        view: (P,) Vector3f, direction to the camera in the frame of the surface.
        sets: first pair, directions and light of (n S,) samples of n pairs. Light is divided by
            the sum of the densities of all sets.
    """

    target: UniformScene
    view: Any
    sets: list[tuple[int, Any, Any]]
    samples: int

    @staticmethod
    def trace(
        capture: Any, target: UniformScene, rays: Any, depth: int, samples: int, seed: int = 0
    ) -> SceneLight:
        """Trace paths in the scene of ``capture``."""
        surface = target.scene.ray_intersect(rays)
        path = mi.load_dict({"type": "path", "max_depth": depth - 1})
        directions = _Directions(target, environment_of(capture))
        count, sets = dr.width(rays.o), []
        for first in range(0, count, PAIRS):
            number = min(PAIRS, count - first) * samples
            lane = dr.arange(mi.UInt32, number)
            pair = dr.opaque(mi.UInt32, first) + lane // dr.opaque(mi.UInt32, samples)
            here = dr.gather(mi.SurfaceInteraction3f, surface, pair)
            for technique in range(LOBES + SKY):
                random = np.random.default_rng((seed, first, technique))
                sampler = mi.load_dict({"type": "independent"})
                sampler.seed(dr.opaque(mi.UInt32, int(random.integers(2**32))), number)
                toward = directions.sample(technique, here, sampler, samples // 2)
                density = directions.density(here, toward)
                up = (toward.z > 0) & (density > 0)
                ray = mi.RayDifferential3f(here.spawn_ray(here.to_world(toward)))
                light = path.sample(capture.scene, sampler, ray, None, up)[0]
                light = dr.select(up & dr.all(dr.isfinite(light)), light / density, 0)
                dr.eval(toward, light)
                sets.append((first, toward, light))
        return SceneLight(target, surface.wi, sets, samples)

    def __call__(self, psi: Mapping[str, float]) -> tuple[np.ndarray, np.ndarray]:
        """Return radiance (P, 3) from two halves of the samples."""
        self.target.paint(psi)
        bsdf, half = self.target.shape.bsdf(), self.samples // 2
        total = np.zeros((dr.width(self.view), 2, 3))
        for first, toward, light in self.sets:
            lane = dr.arange(mi.UInt32, dr.width(toward))
            surface = dr.zeros(mi.SurfaceInteraction3f, dr.width(toward))
            pair = dr.opaque(mi.UInt32, first) + lane // dr.opaque(mi.UInt32, self.samples)
            surface.wi = dr.gather(mi.Vector3f, self.view, pair)
            color = bsdf.eval(mi.BSDFContext(), surface, toward) * light
            # Evaluate now: a lazy result would use the material of a later call.
            sums = [dr.block_sum(x, half) for x in color]
            dr.eval(sums)
            of_pairs = np.stack([x.numpy().reshape(-1, 2) for x in sums], axis=-1)
            total[first : first + len(of_pairs)] += of_pairs / half
        return total[:, 0], total[:, 1]


@dataclass(frozen=True)
class _Directions:
    """Directions of incident light: sets from lobes, then from the environment."""

    target: UniformScene
    environment: Any

    def sample(self, number: int, surface: Any, sampler: Any, half: int) -> Any:
        """Return directions of a set in the frame of the surface, a lattice for each half."""
        lane, size = dr.arange(mi.UInt32, dr.width(surface)), dr.opaque(mi.UInt32, half)
        first = lane // size * size
        turn, step = dr.gather(mi.Point2f, sampler.next_2d(), first), mi.Float(lane - first)
        point = [x + step * y for x, y in zip(turn, LATTICE, strict=True)]
        point = mi.Point2f([dr.clip(x - dr.floor(x), INSIDE, 1 - INSIDE) for x in point])
        if number >= LOBES:
            return surface.to_local(self.environment.sample_direction(surface, point)[0].d)
        bsdf = self._painted(number)
        toward = bsdf.sample(mi.BSDFContext(), surface, sampler.next_1d(), point)[0].wo
        dr.eval(toward)  # before the material changes
        return toward

    def density(self, surface: Any, toward: Any) -> Any:
        """Return the sum of the densities of all sets."""
        ds = dr.zeros(mi.DirectionSample3f, dr.width(toward))
        ds.d = surface.to_world(toward)
        total = SKY * self.environment.pdf_direction(surface, ds)
        for number in range(LOBES):
            total += self._painted(number).pdf(mi.BSDFContext(), surface, toward)
            dr.eval(total)
        return total

    def _painted(self, number: int) -> Any:
        roughness = float(roughness_levels(LOBES)[number])
        self.target.paint({"roughness": roughness, "metallic": 0.5, "base_color": 0.5})
        return self.target.shape.bsdf()
