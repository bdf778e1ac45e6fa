"""The reference of single texels: as Mitsuba renders them, in direct light and with bounces."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.helpers import memory_capture, render_views

import svu_mi as svu
from svu_mi import scenes
from svu_mi.bench.scene_light import SceneLight, scene_light_posteriors
from svu_mi.capture.replace_material import replace_material
from svu_mi.capture.scene import load_scene
from svu_mi.capture.sensors import sphere_sensors
from svu_mi.evaluation.path_trace import UniformScene, trace
from svu_mi.posterior.observations import observe

BRASS = {"roughness": 0.3, "metallic": 1.0, "base_color": 0.8}
CLAY = {"roughness": 0.8, "metallic": 0.0, "base_color": 0.9}
VARNISH = {"roughness": 0.1, "metallic": 0.0, "base_color": 0.3}
SAMPLES, PATHS = 256, 4096


@pytest.fixture(scope="module")
def knot():
    """A knot, whose parts light each other."""
    defines = {"light": "studio", "resolution": "24", "max_depth": "2"}
    scene = load_scene(scenes.path("knot"), defines)
    sensors = sphere_sensors(scene.shapes()[0], 6, (24, 24))
    return memory_capture(scene, render_views(scene, sensors, 16), sensors)


def rays_to(capture):
    """Rays of a camera that meet the object."""
    place = mi.Point2f(*np.random.default_rng(5261).random((2, 200)).astype(np.float32))
    ray, _ = capture.sensors[1].sample_ray(0, 0.5, place, 0.5)
    kept = dr.compress(capture.scene.ray_intersect(ray).is_valid())
    return dr.gather(mi.Ray3f, mi.Ray3f(ray), kept)


def require_equal(one, other):
    """Pairs of independent halves differ by no more than their noise."""
    (a, b), (c, d) = one, other
    difference, noise = (a + b - c - d) / 2, [(x - y) / 2 for x, y in (one, other)]
    mean = (c + d).mean() / 2
    assert np.sqrt(sum((x**2).mean() for x in noise)) < 0.1 * mean
    assert np.sqrt((difference**2).mean()) < 1.3 * np.sqrt(sum((x**2).mean() for x in noise))
    assert abs(difference.mean()) < 0.01 * mean


@pytest.mark.few(1)
@pytest.mark.parametrize("psi", [BRASS, CLAY, VARNISH])
def test_direct_light_is_that_of_a_uniform_object(knot, psi):
    """Without bounces, the other texels only hide the light."""
    rays, target = rays_to(knot), UniformScene.of(knot)
    found = SceneLight.trace(knot, target, rays, 2, SAMPLES)(psi)
    target.paint(psi)
    direct = mi.load_dict({"type": "path", "max_depth": 2})
    require_equal(found, trace(target.scene, direct, rays, PATHS, 7))


@pytest.mark.few(1)
@pytest.mark.parametrize("psi", [BRASS, CLAY])
def test_the_true_material_looks_as_path_traced(knot, psi):
    """The whole object has one material, which is asked for."""
    target = UniformScene.of(knot)
    target.paint(psi)
    capture = replace(knot, scene=replace_material(knot, target.shape.bsdf(), knot.shape).scene)
    rays, other = rays_to(knot), UniformScene.of(knot)
    found = SceneLight.trace(capture, other, rays, 5, SAMPLES)(psi)
    every = mi.load_dict({"type": "path", "max_depth": 5})
    expected = trace(capture.scene, every, rays, PATHS, 7)
    require_equal(found, expected)
    direct = mi.load_dict({"type": "path", "max_depth": 2})
    assert expected[0].mean() > 1.05 * trace(capture.scene, direct, rays, 256, 7)[0].mean()


@pytest.mark.slow
def test_posteriors_of_direct_light_agree(knot):
    observed = observe(knot, svu.texels(knot.mesh, 16))
    texels = np.flatnonzero(observed.coverage)[::4]
    models = "relative", "estimated"
    posteriors = scene_light_posteriors(observed, texels, models, 2, 32)
    for noise, found in zip(models, posteriors, strict=True):
        known = svu.reference_posterior(observed, subset=texels, spp=512, noise=noise)
        assert found.max_depth == 2 and found.count == len(texels)
        np.testing.assert_array_equal(found.coverage, known.coverage)
        assert np.corrcoef(found.entropy, known.entropy)[0, 1] > 0.95
