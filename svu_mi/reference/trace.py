"""Radiance along camera rays, averaged over independent paths."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

LANES = 1 << 20  # paths in memory at a time


def path_integrator(max_depth: int) -> Any:
    """Mitsuba's path tracer, which samples both the light and the material.

    Args:
        max_depth: longest path, in edges seen from the camera; 2 is direct light.
    """
    return mi.load_dict({"type": "path", "max_depth": max_depth})


def trace(
    scene: Any, integrator: Any, rays: Any, samples: int, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Average two independent halves of ``samples`` paths per ray.

    A lane traces one path, with random numbers of its own: for equal seeds they are the same
    for every material, even where that makes paths longer or shorter, so part of the noise
    cancels in the differences between materials, which are all that a posterior depends on.

    Args:
        scene: what is traced.
        integrator: how; see ``path_integrator``.
        rays: (P,) Ray3f.
        samples: paths per ray, even.
        seed: a whole number >= 0.

    Returns:
        (P, 3) and (P, 3) float64 radiance.
    """
    count, half = dr.width(rays.o), samples // 2
    result = np.zeros((count, 2, 3))
    size = max(LANES // samples, 1)
    sampler = mi.load_dict({"type": "independent"})
    number = dr.opaque(mi.UInt32, samples)
    for slot, first in enumerate(range(0, count, size)):
        span = slice(first, min(first + size, count))
        lanes = (span.stop - first) * samples
        own = np.random.default_rng((seed, slot)).integers(2**32)
        sampler.seed(dr.opaque(mi.UInt32, int(own)), lanes)
        index = dr.opaque(mi.UInt32, first) + dr.arange(mi.UInt32, lanes) // number
        ray = mi.RayDifferential3f(dr.gather(mi.Ray3f, rays, index))
        radiance, _, _ = integrator.sample(scene, sampler, ray)
        # Read now: a lazy result would be computed with the material of a later call.
        sums = [dr.block_sum(radiance[channel], half) for channel in range(3)]
        dr.eval(sums)
        result[span] = np.stack([x.numpy().reshape(-1, 2) for x in sums], axis=-1) / half
    return result[:, 0], result[:, 1]
