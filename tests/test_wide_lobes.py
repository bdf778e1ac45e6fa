"""Wide lobes by quadrature over cells, against float64 and against Mitsuba itself."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import ball
from oracle import angular as oracle

from svu_mi.capture import mesh as capture_mesh
from svu_mi.interop import owned
from svu_mi.light.cells import LightCells, adaptive_cells, light_cells
from svu_mi.light.environment import read_environment
from svu_mi.reflection.lobes import dielectric_fresnel
from svu_mi.reflection.wide import WideLobes
from svu_mi.surface import texels
from svu_mi.visibility.observe import Surface

ALPHA = np.array([0.15, 0.5, 1.0])
SEED = 77123


def environment(image: np.ndarray, **more: object) -> object:
    emitter = mi.load_dict({"type": "envmap", "bitmap": mi.Bitmap(image), **more})
    return read_environment(emitter)


def spotted() -> np.ndarray:
    """(H, W, 3) a dim sky with one bright patch."""
    image = np.random.default_rng(SEED).uniform(0.1, 0.3, (24, 48, 3)).astype(np.float32)
    image[5:7, 30:32] = (60, 50, 40)
    return image


def test_adaptive_cells_hold_all_light() -> None:
    light = environment(spotted())
    even, adaptive = light_cells(light, 512), adaptive_cells(light, 64)
    flux = [np.array(cells.flux).reshape(-1, 3) for cells in (even, adaptive)]
    np.testing.assert_allclose(flux[1].sum(axis=0), flux[0].sum(axis=0), rtol=1e-5)
    directions = np.array(adaptive.directions).reshape(-1, 3)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-5)


def test_adaptive_cells_are_better_than_even_ones() -> None:
    """What a lobe sees of 64 cells, against 4096: where it looks, light is near its place."""
    light = environment(spotted())
    looks = np.random.default_rng(SEED).normal(size=(200, 3))
    looks /= np.linalg.norm(looks, axis=1, keepdims=True)

    def seen(cells: LightCells) -> np.ndarray:
        toward = np.array(cells.directions, np.float64).reshape(-1, 3)
        flux = np.array(cells.flux, np.float64).reshape(-1, 3)
        return np.exp((looks @ toward.T - 1) / 0.3**2) @ flux.sum(axis=1)

    truth = seen(light_cells(light, 4096))
    even, adaptive = (
        np.sqrt(((seen(cells) - truth) ** 2).mean())
        for cells in (light_cells(light, 64), adaptive_cells(light, 64))
    )
    assert adaptive < 0.6 * even


def test_adaptive_cells_of_even_light() -> None:
    image = np.full((8, 16, 3), 2.0, np.float32)
    cells = adaptive_cells(environment(image), 40)
    values = [np.array(x) for x in (cells.directions, cells.flux)]
    assert all(np.isfinite(value).all() for value in values)
    assert len(values[0]) == 3 * 40
    np.testing.assert_allclose(values[1].sum() / 3, image.mean() * 4 * np.pi, rtol=2e-2)


def few_cells(count: int) -> tuple[LightCells, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(SEED)
    toward = rng.normal(size=(count, 3))
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    flux = rng.uniform(0, 2, (count, 3))
    floats = [owned(mi.Float, values.ravel()) for values in (toward, flux)]
    return LightCells(floats[0], floats[1], floats[0], dr.opaque(mi.UInt32, count)), toward, flux


@pytest.mark.parametrize("count", [1, 32, 45])
def test_reflection_is_the_sum_over_visible_cells(count: int) -> None:
    mesh = capture_mesh.make("ball", ball())
    scene = mi.load_dict({"type": "scene", "ball": mesh})
    grid = texels(mesh, (8, 6))
    surface = Surface.of(grid)
    cells, toward, flux = few_cells(count)
    lobes = WideLobes.trace(scene, surface, cells, ALPHA)
    normal = np.array(grid.normal, np.float64).T
    view = normal + np.random.default_rng(3).normal(scale=0.4, size=normal.shape)
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    cosine = (view * normal).sum(axis=1)
    found = lobes.reflect(
        surface.lane, mi.Vector3f(surface.normal), owned(mi.Vector3f, view.T),
        owned(mi.Float, cosine),
    )  # fmt: skip
    geometric = np.array(grid.geometric_normal, np.float64).T
    for k, alpha in enumerate(ALPHA):
        for t in range(grid.count):
            p = q = d = np.zeros(3)
            for w, light in zip(toward, flux, strict=True):
                incident = w @ normal[t]
                if incident <= 1e-4 or w @ geometric[t] <= 1e-4:
                    continue  # a convex ball hides nothing else
                half = (w + view[t]) / np.linalg.norm(w + view[t])
                lobe = oracle.ggx(half @ normal[t], alpha) * oracle.g1(incident, alpha)
                lobe *= oracle.g1(cosine[t], alpha) / (4 * cosine[t])
                schlick = (1 - half @ w) ** 5
                p = p + light * lobe * (1 - schlick)
                q = q + light * lobe * schlick
                d = d + light * lobe * dielectric_fresnel(half @ w)
            got = np.array([[np.array(value)[t] for value in channel] for channel in found[k]])
            np.testing.assert_allclose(got, np.stack([p, q, d], axis=1), rtol=2e-3, atol=1e-5)


def test_a_rough_metal_under_a_sun_is_what_mitsuba_renders() -> None:
    """Pre-filtered light is off by tens of percent here; the sum is not."""
    light = {"type": "envmap", "bitmap": mi.Bitmap(spotted())}
    mesh = capture_mesh.make("ball", ball(96, 48))
    mesh.set_bsdf(mi.load_dict({"type": "principled", "base_color": {"type": "rgb", "value": 0.8},
                                "roughness": 0.6, "metallic": 1.0}))  # fmt: skip
    emitter = mi.load_dict(light)
    scene = mi.load_dict({"type": "scene", "ball": mesh, "light": emitter}, optimize=False)
    grid = texels(mesh, (24, 12))
    surface = Surface.of(grid)
    cells = adaptive_cells(read_environment(emitter), 256)
    lobes = WideLobes.trace(scene, surface, cells, np.array([0.36]))
    camera = np.array([1.5, 2.5, 3.0])
    to_camera = camera - np.array(grid.position, np.float64).T
    view = to_camera / np.linalg.norm(to_camera, axis=1, keepdims=True)
    cosine = (view * np.array(grid.normal, np.float64).T).sum(axis=1)
    seen = np.flatnonzero(cosine > 0.15)
    (metal,) = lobes.reflect(
        surface.lane, mi.Vector3f(surface.normal), owned(mi.Vector3f, view.T),
        owned(mi.Float, np.maximum(cosine, 1e-3)),
    )  # fmt: skip
    model = np.mean([0.8 * np.array(p) + np.array(q) for p, q, _ in metal], axis=0)[seen]
    origin = mi.Point3f(*(np.full(len(seen), x, np.float32) for x in camera))
    rays = mi.RayDifferential3f(mi.Ray3f(origin, owned(mi.Vector3f, -view[seen].T)))
    integrator, total = mi.load_dict({"type": "path", "max_depth": 2}), np.zeros(len(seen))
    sampler = mi.load_dict({"type": "independent"})
    for seed in range(256):
        sampler.seed(dr.opaque(mi.UInt32, seed), len(seen))
        color = integrator.sample(scene, sampler, rays)[0]
        total += np.mean([np.array(channel) for channel in color], axis=0)
    truth = total / 256
    error = np.abs(model - truth) / truth.mean()
    assert np.median(error) < 0.03
    assert np.sqrt((error**2).mean()) < 0.08
