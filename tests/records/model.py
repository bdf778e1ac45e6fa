"""Hold the reflection model against converged direct light, by lobe width and light.

    python tests/records/model.py --data DATA [--work FOLDER] [-o FILE.json]

5000 random (texel, view, parameters) of the vase and the knot (our own sun, studio, window and
overcast sky) and of the king and the helmet of DATA (a sun, a studio, an interior with lamps, an
overcast sky). Roughness is one of 12 levels; base colour and metallic are anything. The truth is
Mitsuba's path tracer, direct light, 4096 paths for each of four corners of (metallic, base colour),
which at one roughness give all others; they share their random numbers. Takes 12 minutes on two
cores; truths are kept in the working folder.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import record

import svu_mi as svu  # isort: skip
import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip

SAMPLES, PATHS, LANES = 5000, 4096, 1 << 20
LEVELS = np.linspace(0, 1, 12)
BINS = ((0, 0.03), (0.03, 0.05), (0.05, 0.2), (0.2, 0.5), (0.5, 1.01), (0.05, 1.01))
LIGHTS = {"clear": "sun", "rural_asphalt_road": "sun", "studio": "studio", "photo_studio_01":
          "studio", "window": "lamps", "st_fagans_interior": "lamps", "overcast": "overcast",
          "potsdamer_platz": "overcast"}  # fmt: skip
OBJECTS = ("vase", "knot", "chess_king_black", "flight_helmet")


@dataclass(frozen=True)
class Samples:
    """N pairs of texel and view, and what they truly show.

    Attributes:
        observed: the capture.
        texel: (N,) numbers of texels.
        level: (N,) which of ``LEVELS``.
        rays: (N,) Ray3f from the camera.
        corners: (N, 4, 3) radiance for (metallic, base colour) 00, 01, 10, 11.
    """

    observed: Any
    texel: np.ndarray
    level: np.ndarray
    rays: Any
    corners: np.ndarray

    def mixed(self, corners: np.ndarray, seed: int = 1) -> np.ndarray:
        """Return the mean radiance (N,) of random metallic and base colours."""
        rng = np.random.default_rng(seed)
        m, c = rng.random((len(corners), 1)), rng.random((len(corners), 3))
        weights = (1 - m) * (1 - c), (1 - m) * c, m * (1 - c), m * c
        return sum(w * corners[:, k] for k, w in enumerate(weights)).mean(axis=1)


def samples(cell: Any, work: Path) -> Samples:
    """Draw the pairs of a cell; trace them, once."""
    from svu_mi.interop import owned
    from svu_mi.observed import observe
    from svu_mi.reference.pairs import visible_pairs
    from svu_mi.reference.uniform import UniformScene

    capture = svu.load_capture(record.photographs(cell, work, record.PHOTOGRAPHS["film"]))
    seen = observe(capture, svu.texels(capture.mesh, record.TEXELS))
    rng = np.random.default_rng(0)
    some = np.sort(rng.choice(seen.seen, min(1500, len(seen.seen)), replace=False))
    target = UniformScene.of(capture)
    pairs = visible_pairs(seen, owned(mi.UInt32, some.astype(np.uint32)), target)
    chosen = np.sort(rng.choice(pairs.count, min(SAMPLES, pairs.count), replace=False))
    level = rng.integers(0, len(LEVELS), len(chosen))
    rays = dr.gather(mi.Ray3f, pairs.rays, owned(mi.UInt32, chosen.astype(np.uint32)))
    dr.eval(rays)
    file = work / f"{cell.name}_direct.npy"
    if not file.exists():
        np.save(file, traced(target, rays, level))
    return Samples(seen, some[pairs.texel[chosen]], level, rays, np.load(file))


def traced(target: Any, rays: Any, level: np.ndarray) -> np.ndarray:
    """Path trace the four corners of every sample: (N, 4, 3)."""
    from svu_mi.interop import owned
    from svu_mi.reference.trace import path_integrator

    integrator, result = path_integrator(2), np.zeros((len(level), 4, 3))
    sampler = mi.load_dict({"type": "independent"})
    for number, roughness in enumerate(LEVELS):
        own = np.flatnonzero(level == number)
        for corner, psi in enumerate(((0, 0), (0, 1), (1, 0), (1, 1))):
            target.paint(float(roughness), *map(float, psi))
            for first in range(0, len(own), LANES // PATHS):
                part = own[first : first + LANES // PATHS]
                sampler.seed(1000 * number + first, len(part) * PATHS)
                index = dr.arange(mi.UInt32, len(part) * PATHS) // dr.opaque(mi.UInt32, PATHS)
                ray = dr.gather(mi.Ray3f, rays, owned(mi.UInt32, part.astype(np.uint32)))
                dr.eval(ray)
                ray = mi.RayDifferential3f(dr.gather(mi.Ray3f, ray, index))
                radiance = integrator.sample(target.scene, sampler, ray)[0]
                for channel in range(3):
                    mean = dr.block_sum(radiance[channel], PATHS).numpy() / PATHS
                    result[part, corner, channel] = mean
    return result


def predicted(found: Samples, preset: str) -> np.ndarray:
    """Return what the model says of the corners, (N, 4, 3)."""
    from svu_mi.visibility.observe import mirror_direction
    from svu_mi.visibility.reach import is_open

    seen, switches = found.observed, svu.preset(preset, method="angular")
    model = seen.model(LEVELS, switches, 3, found.texel)
    surface, direction = model.surface, -found.rays.d
    mirror = mirror_direction(surface.normal, direction)
    free = mi.Bool(True)
    if switches.traced:
        above = dr.dot(surface.geometric_normal, mirror) > 0
        free = is_open(seen.views.scene, surface, mirror, above, coherent=False)
    columns = model.columns(direction, dr.maximum(dr.dot(surface.normal, direction), 1e-3), free)
    dr.eval(columns)
    table = np.array([[[x.numpy() for x in channel] for channel in level] for level in columns])
    e, p, q, d = np.moveaxis(table[found.level, :, :, np.arange(len(found.level))], 2, 0)
    return np.stack([d, e + d, q, p + q], axis=1)


def errors(found: Samples, corners: np.ndarray) -> dict[str, list[float]]:
    """Return median relative error, rms and bias by bin of lobe width, rms and bias as parts of
    the mean radiance of the bin."""
    true, ours = found.mixed(found.corners), found.mixed(corners)
    alpha, result = np.maximum(LEVELS[found.level] ** 2, 1e-3), {}
    for low, high in BINS:
        own = (alpha >= low) & (alpha < high)
        off, mean = (ours - true)[own], true[own].mean()
        median = np.median(np.abs(off) / np.maximum(true[own], 1e-12))
        rms = np.sqrt(np.mean(off**2)) / mean
        result[f"{low:g} to {min(high, 1):g}"] = [
            round(float(value), 4) for value in (median, rms, off.mean() / mean)
        ]
    return result


def main() -> None:
    """Print a line per cell and preset."""
    asked = record.arguments(__doc__).parse_args()
    mi.set_variant("llvm_ad_rgb")
    cells = [cell for cell in record.cells_of(asked.data, asked.work, OBJECTS)
             if cell.object in OBJECTS]  # fmt: skip

    def prepare(cell: Any) -> Any:
        found = samples(cell, asked.work)
        return lambda preset: {"errors": errors(found, predicted(found, preset))}

    found = record.run("model", cells, asked, prepare, ("default", "fast"))
    table = {name: {preset: row["errors"] for preset, row in rows.items()}
             for name, rows in found.items()}  # fmt: skip
    for cell in cells:
        for preset, row in table.get(cell.name, {}).items():
            words = [f"{a:.1%} {b:.1%} ({c:+.1%})" for a, b, c in row.values()]
            print(f"{cell.name} [{LIGHTS[cell.light]}] {preset}: {' | '.join(words)}", flush=True)
    if asked.output:
        asked.output.write_text(json.dumps({"bins": BINS, "cells": table}, indent=1) + "\n")


if __name__ == "__main__":
    main()
