"""Stability of whole estimates: light, paint and cameras at their ends."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from extremes.captures import METAL, around, ball, lamps, map_light
from extremes.cases import Axis, Case, Found, compared
from extremes.estimates import (
    METHODS,
    WAYS,
    Taken,
    agrees,
    both,
    photographed,
    refused_run,
    same_entropy,
)
from svu_mi.capture import Capture
from svu_mi.light.environment import quadrature
from svu_mi.light.levels import convolve
from svu_mi.options import Method, preset
from svu_mi.reflection.lobes import zonal_profile

MAPS = 24  # rows of the maps that the filter is tried on


# --- light ----------------------------------------------------------------------------------


def _exposure(folder: Path, quick: bool) -> Iterator[Case]:
    start = photographed(folder)
    rules: list[tuple[Method, str, dict[str, Any]]] = [(*way, {}) for way in WAYS]
    if not quick:
        rules += [
            ("angular", "fixed", {"noise": "marginal"}),
            ("angular", "fixed", {"noise": "heteroscedastic"}),
            ("angular", "fixed", {"channels": "joint"}),
            ("angular", "default", {"channels": "grey"}),
            ("spectrum", "default", {"noise": "marginal"}),
            ("spectrum", "default", {"channels": "joint"}),
        ]
    # Powers of two round nothing: whatever changes has left the range of single precision.
    for power in (-20, 20) if quick else (-33, -20, -7, 7, 20, 33):
        lit = cache(partial(_exposed, folder, start, 2.0**power))
        for method, named, switches in rules:
            chosen = preset(named, method=method, **switches)
            name = f"radiance times 2^{power}, {method}, {named}, {switches}"
            yield name, partial(same_entropy, start, lit, method, chosen)
    for power in (-100, 100):
        lit = cache(partial(_exposed, folder, start, 2.0**power))
        for method in METHODS:
            yield f"radiance times 2^{power}, {method}", partial(refused_run, lit, method)


def _exposed(folder: Path, start: Taken, gain: float) -> Capture:
    images = [image * np.float32(gain) for image in start().images]
    return ball(light=map_light(lamps() * np.float32(gain))).capture(folder, images)


def _light(folder: Path, quick: bool) -> Iterator[Case]:
    sun = lamps(1.0)
    sun[10, 20] = 1e5
    lights = {
        "a sun of 1e5": map_light(sun),
        "4096 : 1": map_light(lamps(4096.0)),
        "constant": {"type": "constant", "radiance": 1.0},
        "nothing but a sun": map_light(np.where(sun == 1e5, sun, 0).astype(np.float32)),
    }
    if quick:
        del lights["4096 : 1"], lights["nothing but a sun"]
    for name, light in lights.items():
        for roughness in (0.3,) if quick else (0.0, 0.3, 1.0):
            paint = {**METAL, "roughness": roughness}
            taken = photographed(folder, light=light, paint=paint)
            yield from both(f"{name}, roughness {roughness}", taken, quick)
    dark = photographed(folder, light={"type": "constant", "radiance": 0.0})
    for method in METHODS:
        yield f"no light, {method}", partial(refused_run, dark, method)
    black = cache(lambda: ball().capture(folder, [np.zeros((24, 24, 3))] * 12))
    yield from both("black photographs", black, quick)


def _filter(_: Path, quick: bool) -> Iterator[Case]:
    """Energy, constants and sign under lobes of every width."""
    for kind in ("ggx", "gaussian"):
        for roughness in (0.3, 1.0) if quick else (0.0, 0.1, 0.3, 0.6, 1.0):
            alpha = max(roughness**2, 1e-3)
            for value in (1e-6, 1e6):
                name = f"constant {value:g}, {kind}, roughness {roughness}"
                yield name, partial(_constant_level, kind, alpha, value)
            for peak in (4096.0, 1e5, 1e9):
                name = f"a sun of {peak:g}, {kind}, roughness {roughness}"
                yield name, partial(_sun_level, kind, alpha, peak)


def _constant_level(kind: Any, alpha: float, value: float) -> Found:
    grid = np.full((2 * MAPS + 1, 4 * MAPS, 3), value)
    grid[0, 0] *= 1 + 1e-9  # else it is recognised, and nothing is computed
    level = convolve(grid, alpha, partial(zonal_profile, kind, alpha))
    return compared(level / value, 1.0, 2e-9)


def _sun_level(kind: Any, alpha: float, peak: float) -> Found:
    """Where the sun's lobe does not reach, FFT rounding of the sun must not show."""
    grid = np.zeros((2 * MAPS + 1, 4 * MAPS, 1))
    grid[MAPS // 2, MAPS] = peak
    level = convolve(grid, alpha, partial(zonal_profile, kind, alpha))
    dim = convolve(grid / peak, alpha, partial(zonal_profile, kind, alpha))
    negative = compared(np.minimum(level, 0), 0.0, 0.0)
    whole, lost = (float((x[..., 0].mean(axis=1) * quadrature(len(x))).sum())
                   for x in (grid, level))  # fmt: skip
    errors = np.concatenate([
        negative.errors, np.abs(level / peak - dim).ravel(), [abs(lost / whole - 1)],
    ])  # fmt: skip
    # Linear in the light to rounding; energy to what the coarser grid resolves. The Gaussian's
    # series is negative around its peak, where radiance is cut off at 0: under a sun alone in the
    # dark that adds 1.6 % at alpha .09 and 4.2 % at .36.
    energy = {0.09: 0.02, 0.36: 0.05}.get(round(alpha, 2), 2e-3) if kind == "gaussian" else 2e-3
    bounds = np.concatenate([
        0 * negative.errors, np.full(dim.size, 1e-13 * max(dim.max(), 1.0)), [energy],
    ])  # fmt: skip
    return Found(errors, bounds, np.zeros(0))


# --- paint and cameras ----------------------------------------------------------------------


def _paint(folder: Path, quick: bool) -> Iterator[Case]:
    corners = list(itertools.product((0.0, 1.0), repeat=3))
    for color, metallic, roughness in corners[1::5] if quick else corners:
        paint = {"base_color": color, "metallic": metallic, "roughness": roughness}
        name = f"base colour {color}, metallic {metallic}, roughness {roughness}"
        yield from both(name, photographed(folder, paint=paint), quick)


def _views(folder: Path, quick: bool) -> Iterator[Case]:
    ring = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    plane = np.stack([np.sin(ring), 0 * ring, np.cos(ring)], axis=-1)
    arc = np.linspace(-0.5, 0.5, 12)
    track = np.stack([arc, 0.3 + 0 * arc, np.sqrt(0.91 - arc**2)], axis=-1)
    places = {
        "one view": around(12)[:1],
        "two views": around(12)[[2, 9]],
        "12 identical views": around(12)[[3] * 12],
        "in a plane": plane,
        "on a track": track,
        "100 views": around(100),
    }
    if quick:
        del places["100 views"], places["in a plane"], places["two views"]
    for name, directions in places.items():
        taken = photographed(folder, directions=directions, size=16 if len(directions) > 20 else 24)
        yield from both(name, taken, quick)
        if not quick:
            for method, named in WAYS[1:]:
                for switches in ({"noise": "marginal"}, {"channels": "joint"}):
                    chosen = preset(named, method=method, **switches)
                    name_of = f"{name}, {method}, {named}, {switches}"
                    yield name_of, partial(agrees, taken, method, chosen, 25)
            yield f"{name}, paper", partial(agrees, taken, "spectrum", "paper")
            grown = preset("fixed", method="angular", noise="heteroscedastic", sigma=0.02)
            yield f"{name}, noise that grows", partial(agrees, taken, "angular", grown)
    if not quick:
        rng = np.random.default_rng(30013)
        images = list(rng.exponential(size=(512, 12, 12, 3)).astype(np.float32))
        crowd = ball(directions=around(512), size=12)
        taken = cache(partial(crowd.capture, folder, images))
        yield from both("512 views of nothing but noise", taken, True)
    start = photographed(folder)

    def unused() -> Capture:
        return replace(start(), used=(False,) * start().count)

    none = cache(lambda: ball(directions=around(0)).capture(folder, []))
    for method in METHODS:
        yield f"no view, {method}", partial(refused_run, none, method)
        yield f"all left out, {method}", partial(refused_run, unused, method)


EXACT = "entropy with double precision from the same samples"
SAME = "entropy with that before"
AXES = (
    Axis("exposure", "light and photographs times 2^-33 to 2^33; 2^-100 and 2^100 are refused",
         SAME, _exposure),
    Axis("light", "a sun of 1e5, 4096 : 1, constant, none (refused), black photographs", EXACT,
         _light),
    Axis("filtered light", "suns of 4096 to 1e9, constants of 1e-6 and 1e6; roughness 0 to 1",
         "linearity to 1e-13, sign, energy to 2e-3", _filter),
    Axis("paint", "base colour, metallic and roughness 0 and 1", EXACT, _paint),
    Axis("cameras", "1 to 512 views, identical, in a plane, on a track; none (refused)", EXACT,
         _views),
)  # fmt: skip
