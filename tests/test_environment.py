"""Light: harmonics against Dr.Jit, integrals against exact ones, orientation against a render."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from svu_mi.errors import SceneError
from svu_mi.light.environment import (
    analyze,
    basis_at,
    directions,
    polar_from_local,
    quadrature,
    read_environment,
    synthesize,
)
from svu_mi.light.lighting import band_limit, clamped_cosine, degrees


def unit_vectors(rng, count):
    d = rng.normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def envmap(pixels, to_world=None):
    emitter = {"type": "envmap", "bitmap": mi.Bitmap(np.ascontiguousarray(pixels, np.float32))}
    if to_world is not None:
        emitter["to_world"] = to_world
    return mi.load_dict(emitter)


def test_harmonics_are_those_of_drjit():
    d = unit_vectors(np.random.default_rng(71043), 60)
    ours = basis_at(d, 9)
    theirs = dr.sh_eval(mi.Vector3f(np.ascontiguousarray(d.T, np.float32)), 9)
    theirs = np.stack([np.broadcast_to(y.numpy(), 60) for y in theirs], axis=1)
    np.testing.assert_allclose(ours, theirs, atol=3e-6)  # float32 of degree 9


def test_projection_inverts_synthesis_at_degree_24():
    """Clenshaw-Curtis and equal azimuths are exact for products up to degree 48 on 65 rows."""
    c = np.random.default_rng(88132).normal(size=(25**2, 3))
    np.testing.assert_allclose(analyze(synthesize(c, 64, 65), 24), c, atol=1e-11)


def test_synthesis_agrees_with_point_evaluation():
    c = np.random.default_rng(5511).normal(size=(13**2, 2))
    grid = synthesize(c, 12, 9)
    points = basis_at(polar_from_local(directions(12, 9).reshape(-1, 3)), 12) @ c
    np.testing.assert_allclose(grid.reshape(-1, 2), points, atol=1e-11)


@pytest.mark.parametrize("rows", [5, 8, 33, 128])
def test_quadrature_is_exact_for_polynomials(rows):
    x = np.cos(np.pi * np.arange(rows) / (rows - 1))
    weights = quadrature(rows)
    assert (weights > 0).all()
    for power in range(rows - 1):
        exact = 2 / (power + 1) if power % 2 == 0 else 0
        assert weights @ x**power == pytest.approx(exact, abs=1e-12)


def test_a_constant_light_has_only_degree_zero():
    light = read_environment(mi.load_dict({"type": "constant", "radiance": 2.0}))
    c = light.coefficients(24)
    assert c[0] == pytest.approx(2 * np.sqrt(4 * np.pi), rel=1e-6)
    assert abs(c[1:]).max() < 1e-5


def test_the_sampled_map_is_the_bitmap():
    pixels = np.random.default_rng(4410).uniform(size=(8, 16, 3))
    light = read_environment(envmap(pixels))
    finer = light.radiance.shape[1] // 16  # so small a map is sampled between its nodes too
    nodes = light.radiance[::finer, finer // 2 :: finer]
    # On the poles every column is the same direction.
    np.testing.assert_allclose(nodes[1:-1], pixels[1:-1], atol=2e-5)


@pytest.mark.parametrize("size", [(2, 4), (8, 16), (33, 64), (200, 100)])
def test_a_constant_map_of_any_size_has_only_degree_zero(size):
    """On few nodes, high degrees alias: 16 columns cannot tell order 16 from a constant."""
    c = read_environment(envmap(np.full((*size, 3), 3.0))).coefficients(64)
    assert c[0] == pytest.approx(3 * np.sqrt(4 * np.pi), rel=1e-6)
    assert abs(c[1:]).max() < 1e-5


@pytest.mark.parametrize(
    "to_world",
    [
        lambda T: T(),
        lambda T: T().rotate([0, 1, 0], 70),
        lambda T: T().rotate([0.6, 0.8, 0], 125),
        lambda T: T().scale([-1, 1, 1]),
    ],
)
def test_a_single_bright_texel_is_found_where_a_mirror_shows_it(to_world):
    """Mitsuba itself says from where the light comes: brightest of many traced directions."""
    pixels = np.zeros((65, 128, 3)) + 1e-3
    pixels[20, 37] = [40, 50, 60]
    emitter = envmap(pixels, to_world(mi.ScalarTransform4f))
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "path"}, "light": emitter})
    d = unit_vectors(np.random.default_rng(90177), 200000)
    ray = mi.Ray3f(mi.Point3f(0), mi.Vector3f(np.ascontiguousarray(d.T, np.float32)))
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(1, len(d))
    seen = scene.integrator().sample(scene, sampler, mi.RayDifferential3f(ray))[0].numpy().T
    brightest = d[seen.sum(axis=1).argmax()]

    lighting = band_limit(read_environment(emitter), 400)
    ours = lighting.radiance(mi.Vector3f(np.ascontiguousarray(d.T, np.float32))).numpy().T
    found = d[ours.sum(axis=1).argmax()]
    assert np.linalg.norm(found - brightest) < np.radians(3.5)  # a texel is 2.8 degrees wide


def test_lookups_of_the_filtered_light_agree_with_its_expansion():
    pixels = np.random.default_rng(3391).uniform(size=(33, 64, 3)) ** 8
    lighting = band_limit(read_environment(envmap(pixels)), 60)
    d = unit_vectors(np.random.default_rng(3392), 500)
    c = lighting.coefficients * np.exp(-((60**-0.5 * degrees(lighting.degree)) ** 2))[:, None]
    exact = basis_at(polar_from_local(d), lighting.degree) @ c
    ours = lighting.radiance(mi.Vector3f(np.ascontiguousarray(d.T, np.float32))).numpy().T
    np.testing.assert_allclose(ours, exact, atol=5e-3 * exact.max())  # bilinear lookup


def test_light_at_the_poles_and_the_seam_has_no_jump():
    pixels = np.random.default_rng(7712).uniform(size=(33, 64, 3))
    lighting = band_limit(read_environment(envmap(pixels)), 60)
    eps = 1e-3
    for d in ([0, 1, 0], [0, -1, 0], [0, 0.3, -1]):
        side = np.cross(d, [0.3, 0.1, 0.7])
        around = np.array([np.add(d, eps * s * side) for s in (-1, 0, 1)])
        around /= np.linalg.norm(around, axis=1, keepdims=True)
        values = lighting.radiance(mi.Vector3f(np.ascontiguousarray(around.T, np.float32))).numpy()
        assert np.ptp(values, axis=1).max() < 5e-3 * values.max()


@pytest.mark.parametrize("kind", ["envmap", "sunsky", "constant"])
def test_irradiance_is_what_a_white_wall_reflects(kind):
    """Radiance of a white diffuse surface is E / pi; Mitsuba renders it."""
    if kind == "envmap":
        pixels = np.random.default_rng(6643).uniform(size=(33, 64, 3)) ** 6
        pixels[9, 20] = 200
        emitter = {"type": "envmap", "bitmap": mi.Bitmap(pixels.astype(np.float32))}
    else:
        emitter = {"type": kind}
        if kind == "sunsky":
            emitter["sun_direction"] = [0.5, 0.3, 0.7]
    n = np.array([0.4, 0.3, 0.866])
    n /= np.linalg.norm(n)
    T = mi.ScalarTransform4f
    wall = T().look_at(origin=[0, 0, 0], target=list(n), up=[0, 1, 0]).scale(1e-2)
    scene = mi.load_dict({
        "type": "scene",
        "integrator": {"type": "direct"},
        "light": emitter,
        "wall": {"type": "rectangle", "to_world": wall,
                 "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 1.0}}},
        "sensor": {"type": "perspective", "fov": 0.3,
                   "to_world": T().look_at(origin=list(n), target=[0, 0, 0], up=[0, 1, 0]),
                   "film": {"type": "hdrfilm", "width": 8, "height": 8}},
    })  # fmt: skip
    rendered = np.pi * np.array(mi.render(scene, spp=8192)).mean(axis=(0, 1))
    light = band_limit(read_environment(scene.emitters()[0]), 60)
    ours = light.irradiance(mi.Vector3f(n.astype(np.float32))).numpy().ravel()
    np.testing.assert_allclose(ours, rendered, rtol=0.015)  # Monte Carlo: below 0.5 %


def test_clamped_cosine_integrates_a_hemisphere():
    x, w = np.polynomial.legendre.leggauss(400)
    for l, factor in enumerate(clamped_cosine(12)):
        legendre = np.polynomial.legendre.Legendre.basis(l)(x)
        exact = 2 * np.pi * (w * np.maximum(x, 0) * legendre).sum()
        assert factor == pytest.approx(exact, abs=1e-4)  # Gauss sees the kink at 0


@pytest.mark.parametrize(
    ("pixels", "message"),
    [(np.zeros((8, 16, 3)), "black"), (np.full((8, 16, 3), np.nan), "NaN")],
)
def test_light_that_cannot_be_used_is_refused(pixels, message):
    with pytest.raises(SceneError, match=message):
        read_environment(envmap(pixels))


def test_a_scaled_environment_is_refused():
    emitter = envmap(np.ones((8, 16, 3)), mi.ScalarTransform4f().scale(2))
    with pytest.raises(SceneError, match="rotation"):
        read_environment(emitter)
