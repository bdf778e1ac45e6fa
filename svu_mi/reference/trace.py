"""Radiance along camera rays, averaged over independent paths."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from svu_mi.reference.pairs import grey


def path_integrator(max_depth: int) -> Any:
    """Mitsuba's path tracer, which samples both the light and the material.

    Args:
        max_depth: longest path, in edges seen from the camera; 2 is direct light.
    """
    return mi.load_dict({"type": "path", "max_depth": max_depth})


def trace(scene: Any, integrator: Any, rays: Any, samples: int, seed: int) -> Any:
    """Average ``samples`` paths per ray: grey radiance, (P,) Float.

    Samples are taken one after the other in one kernel, so memory grows with the rays alone.
    Equal seeds give equal random numbers, whatever the material.
    """
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(dr.opaque(mi.UInt32, seed), dr.width(rays))
    number = dr.opaque(mi.UInt32, samples)

    def step(done: Any, total: Any, sampler: Any) -> tuple[Any, Any, Any]:
        radiance, _, _ = integrator.sample(scene, sampler, rays)
        return done + 1, total + grey(radiance), sampler

    _, total, _ = dr.while_loop(
        state=(mi.UInt32(0), dr.zeros(mi.Float, dr.width(rays)), sampler),
        cond=lambda done, *_: done < number,
        body=step,
        labels=("done", "total", "sampler"),
    )
    mean = total / mi.Float(number)
    # Now, since a lazy result would be computed with the material of a later call.
    dr.eval(mean)
    return mean
