"""Error of the model's radiance at centres of texels, compared with path tracing.

Lobes narrower than ``NARROWEST`` are left out. Medians need accurate references. Root mean squares
need many pairs, because a few mirror a lamp: the mean product of the errors relative to two halves
of the paths is the squared error without the reference's noise. Paths are stratified, which takes a
tenth of the noise of independent ones in direct light.
"""

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture.surroundings import path_length
from svu_mi.core.arrays import to_drjit
from svu_mi.geometry.texel_materials import parameters_at
from svu_mi.posterior.observations import Observed
from svu_mi.presets import AngularPreset
from svu_mi.reflection.mix_columns import interpolate_radiance
from svu_mi.reflection.principled import alpha_from_roughness
from svu_mi.reflection.roughness_levels import level_shares, roughness_levels

PAIRS, SIDE = 500, 64  # random pairs of texel and view; each half has SIDE^2 paths
MANY, COARSE = 8, 4  # times as many pairs, with SIDE divided by COARSE, for root mean squares
BATCH = 256  # paths of each pair per launch
OFTEN = 8  # draws of texel and view for each pair, of which few are visible
NARROWEST, GRAZING = 0.05, 0.05  # smallest alpha, and cosine of the viewing angle
WORST = 0.001  # share of pairs that the root mean square leaves out
START = 0.005  # distance of the origins of paths from the texel, relative to the object's extent


def radiance_error(
    observed: Observed, switches: AngularPreset, pairs: int = PAIRS, side: int = SIDE
) -> dict[str, float]:
    """Return the median relative error, and the root mean square relative to the mean radiance."""
    found, halves = _compared(observed, switches, pairs, side)
    right = halves.mean(axis=0)
    lit = right > 0  # lamps leave some pairs in the dark
    median = float(np.median(np.abs(found - right)[lit] / right[lit]))
    found, halves = _compared(observed, switches, MANY * pairs, side // COARSE)
    squares = np.prod(found - halves, axis=0)
    squares = squares[np.argsort(np.abs(squares))][: int(np.ceil((1 - WORST) * len(squares)))]
    rms = float(np.sqrt(max(squares.mean(), 0)) / halves.mean())
    return {"radiance median": median, "radiance rms": rms}


def _compared(
    observed: Observed, switches: AngularPreset, pairs: int, side: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the radiance of at most ``pairs`` of the model, (S,), and path traced, (2, S)."""
    truth = parameters_at(observed.capture, observed.texels)
    truth = {key: np.asarray(x).reshape(observed.texels.count, -1) for key, x in truth.items()}
    broad = alpha_from_roughness(truth["roughness"][observed.seen, 0]) >= NARROWEST
    random = np.random.default_rng(5417)
    draws = OFTEN * pairs // np.count_nonzero(broad) + 1
    texels = np.concatenate([random.permutation(observed.seen[broad]) for _ in range(draws)])
    slots = random.integers(dr.width(observed.visibility.order), size=len(texels)).astype(np.uint32)
    seen = observed.visibility.sample(
        observed.views, observed.lanes(texels), to_drjit(mi.UInt32, slots)
    )
    kept = np.flatnonzero(seen.cosine.numpy() > GRAZING)[:pairs]
    texels, chosen = texels[kept], observed.subset(texels[kept])
    slot, lanes = to_drjit(mi.UInt32, slots[kept]), to_drjit(mi.UInt32, kept.astype(np.uint32))
    direction = dr.gather(mi.Vector3f, seen.direction, lanes)
    shares = level_shares(truth["roughness"][texels, 0], switches.levels)
    known = shares, truth["base_color"][texels], truth["metallic"][texels]
    model = chosen.model(roughness_levels(switches.levels), switches, 3)
    free = chosen.mirrors.test(slot, chosen.surface.index)
    colors = interpolate_radiance(
        model.columns(direction, dr.dot(chosen.surface.normal, direction), free, slot),
        *([to_drjit(mi.Float, x.astype(np.float32)) for x in of_texels.T] for of_texels in known),
    )
    return np.mean([x.numpy() for x in colors], axis=0), _traced(chosen, direction, side * side)


def _traced(observed: Observed, direction: Any, paths: int) -> np.ndarray:
    """Return the mean radiance of R, G and B from two sets of stratified paths, (2, S)."""
    scene, surface = observed.capture.scene, observed.surface
    integrator = mi.load_dict({"type": "path", "max_depth": path_length(scene)})
    start = surface.position + START * observed.texels.extent * direction
    batch = min(BATCH, paths)
    lane, total = dr.repeat(surface.lane, batch), np.zeros((2, surface.count))
    for half in range(2):
        sampler = mi.load_dict({"type": "multijitter", "sample_count": paths})
        sampler.set_samples_per_wavefront(batch)
        sampler.seed(half, dr.width(lane))
        for _ in range(paths // batch):
            origin, toward = (dr.gather(mi.Vector3f, x, lane) for x in (start, direction))
            ray = mi.RayDifferential3f(origin, -toward)
            color = integrator.sample(scene, sampler, ray)[0]
            total[half] += dr.block_sum(sum(color) / 3, batch).numpy()
            sampler.advance()
    return total / paths
