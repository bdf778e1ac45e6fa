"""Light from other surfaces: closed forms, a furnace, and path-traced photographs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import repeat
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from numpy.polynomial.legendre import leggauss
from oracle.angular import albedo, fresnel, reflectance
from support.helpers import STUDIO, launched_kernels, memory_capture, render_views, run, write_ball
from support.walled import BLACK, angular

import svu_mi as svu
from svu_mi import scenes
from svu_mi.bench.spoiled_captures import photographed, with_table
from svu_mi.capture.mesh import arrays, make_mesh
from svu_mi.capture.replace_material import scene_around
from svu_mi.capture.scene import load_scene
from svu_mi.capture.sensors import sphere_sensors
from svu_mi.capture.surroundings import surroundings
from svu_mi.core.arrays import fibonacci, to_drjit
from svu_mi.errors import OptionError
from svu_mi.geometry.sample_view import TexelLanes
from svu_mi.geometry.texel_materials import parameters_at
from svu_mi.light.band_limited import band_limited_lighting, lat_long_texture
from svu_mi.light.environment import read_environment
from svu_mi.light.near_light import trace_near_light
from svu_mi.light.panorama import ROWS, Panorama, trace_panorama
from svu_mi.posterior.object_appearance import near_surfaces
from svu_mi.posterior.observations import observe
from svu_mi.presets import preset
from svu_mi.reflection import near_lobes
from svu_mi.reflection.albedo_table import AlbedoTable
from svu_mi.reflection.near_lobes import NearLobes
from svu_mi.reflection.near_surfaces import NearSurfaces, ShownObject
from svu_mi.reflection.render_model import prefiltered_model

ANGLE = 0.7  # between the axis and the rim of the disk
RADIANCE = np.array([1.0, 2.0, 0.5])
PATH = {"type": "path", "max_depth": 6}


def glowing(color):
    """A texture of one radiance."""
    bitmap = mi.Bitmap(np.full((2, 2, 3), color, np.float32))
    return mi.load_dict({"type": "bitmap", "bitmap": bitmap, "raw": True})


def emitting(shape, **changes):
    """A scene of one shape that emits ``RADIANCE``."""
    light = {"type": "area", "radiance": {"type": "rgb", "value": RADIANCE.tolist()}}
    return mi.load_dict({"type": "scene", "a": {"type": shape, "emitter": light, **changes}})


@dataclass
class Glowing:
    """A scene that has the same radiance everywhere."""

    scene: Any
    color: list[float]

    def radiance_along(self, origin, direction, active, _size):
        met = self.scene.ray_test(mi.Ray3f(origin, direction), active=active)
        return dr.select(met, mi.Color3f(self.color), 0)


def texel_facing(normals):
    """Texels at the origin with these normals."""
    normals = np.atleast_2d(normals).astype(np.float32).T
    normal = to_drjit(mi.Normal3f, normals)
    return TexelLanes(
        to_drjit(mi.Point3f, 0 * normals), normal, normal, dr.opaque(mi.Float, 1e-4)
    )  # fmt: skip


def traced(scene, normals, rays=4096):
    return trace_near_light(Glowing(scene, RADIANCE.tolist()), texel_facing(normals), rays)


def disk_above(normal):
    """A disk in the direction of the normal, seen under ``ANGLE``."""
    place = mi.ScalarTransform4f().look_at(
        (2 * np.array(normal)).tolist(), [0, 0, 0], [0.6, 0, -0.8]
    )
    return emitting("disk", to_world=place.scale(float(2 * np.tan(ANGLE))))


def test_moments_of_a_disk_are_its_integrals():
    """c0 = L pi sin^2 t, m0 = L 2 pi / 3 (1 - cos^3 t) n; the others by quadrature."""
    normal = np.array([0.48, 0.6, 0.64])
    near = traced(disk_above(normal), normal)
    nodes, weights = leggauss(16)
    z = 1 - (1 - np.cos(ANGLE)) * (nodes + 1) / 2
    weights = weights * (1 - np.cos(ANGLE)) * np.pi
    c0, m0 = np.pi * np.sin(ANGLE) ** 2, 2 * np.pi / 3 * (1 - np.cos(ANGLE) ** 3)
    c1, m1 = ((weights * z ** (1 + k) * (1 - z) ** 5).sum() for k in (0, 1))
    for moments, value in zip(near.moments, RADIANCE, strict=True):
        found = np.array([x.numpy()[0] for x in moments])
        expected = value * np.array([c0, *(m0 * normal), c1, *(m1 * normal)])
        np.testing.assert_allclose(found, expected, rtol=0.02, atol=0.01)


def test_lobes_in_a_furnace_see_its_radiance():
    """Inside a bright sphere, each lobe reflects its albedo, for narrow and wide ones."""
    near = traced(emitting("sphere", flip_normals=True, radius=10.0), [[0, 0, 1], [0.6, 0, 0.8]])
    alpha = np.array([1e-3, 0.05, 0.3, 1.0])
    lobes = NearLobes(near, 3, alpha, AlbedoTable.of(alpha, "split_sum"))
    surface = texel_facing([[0, 0, 1], [0.6, 0, 0.8]])
    direction = mi.Vector3f(0.36, 0.48, 0.8)
    cosine = dr.dot(surface.normal, direction)
    found = lobes.reflect(surface, direction, cosine)
    for level, width in enumerate(alpha.tolist()):
        albedo = lobes.albedo.at(level, width, cosine)
        for value, parts in zip(RADIANCE, found[level], strict=True):
            for part, whole in zip(parts, albedo, strict=True):
                np.testing.assert_allclose(part.numpy(), value * whole.numpy(), rtol=0.02)


def test_rays_of_each_lobe_meet_a_disk(monkeypatch):
    """Along the normal, a disk has the part of a lobe whose half vectors are within ANGLE / 2."""
    monkeypatch.setattr(near_lobes, "RAYS", 100)
    normals = np.tile([0.0, 0.0, 1.0], (2048, 1))
    near = traced(disk_above([0, 0, 1]), normals, 64)
    alpha = np.array([1e-3, 0.1, 0.3, 0.6, 1.0])
    lobes = NearLobes(near, 3, alpha, AlbedoTable.of(alpha, "split_sum"))
    surface, turns = texel_facing(normals), dr.arange(mi.Float, 2048)
    up = dr.normalize(mi.Vector3f(1e-3 * dr.cos(turns), 1e-3 * dr.sin(turns), 1))
    found = lobes.reflect(surface, up, dr.dot(surface.normal, up))
    half = (np.arange(20000) + 0.5) / 20000 * np.pi / 4
    for level, width in enumerate(alpha.tolist()):
        ggx = 1 / (np.cos(half) ** 2 + (np.sin(half) / width) ** 2) ** 2
        smith = 2 / (1 + np.sqrt(1 + (width * np.tan(2 * half)) ** 2))
        weights = ggx * smith * np.cos(half) * np.sin(half)
        share = weights[half < ANGLE / 2].sum() / weights.sum()
        albedo = lobes.albedo.at(level, width, dr.dot(surface.normal, up))[0].numpy()
        values = [of_color[0].numpy().mean() for of_color in found[level]]
        np.testing.assert_allclose(values, share * RADIANCE * albedo.mean(), rtol=0.03)


@pytest.mark.parametrize("width", [0.3, 0.6, 1.0])
def test_wide_lobes_share_the_rays_of_a_texel(width):
    """Their noise is less than that of as many independent rays, and they are right on average."""
    normals, rays = np.tile([0.0, 0.0, 1.0], (4096, 1)), 64
    near = traced(disk_above([0, 0, 1]), normals, rays)
    lobes = NearLobes(near, 3, np.array([width]), AlbedoTable.of(np.array([width]), "split_sum"))
    surface, turns = texel_facing(normals), dr.arange(mi.Float, 4096)
    up = dr.normalize(mi.Vector3f(1e-3 * dr.cos(turns), 1e-3 * dr.sin(turns), 1))
    half = (np.arange(20000) + 0.5) / 20000 * np.pi / 4
    ggx = 1 / (np.cos(half) ** 2 + (np.sin(half) / width) ** 2) ** 2
    smith = 2 / (1 + np.sqrt(1 + (width * np.tan(2 * half)) ** 2))
    weights = ggx * smith * np.cos(half) * np.sin(half)
    share = weights[half < ANGLE / 2].sum() / weights.sum()
    cosine = dr.dot(surface.normal, up)
    albedo = lobes.albedo.at(0, width, cosine)[0].numpy()
    seen = lobes.reflect(surface, up, cosine)[0][0][0].numpy() / albedo / RADIANCE[0]
    assert seen.mean() == pytest.approx(share, rel=0.01)
    assert seen.std() < (share * (1 - share) / rays) ** 0.5


def test_an_object_photographed_from_above_looks_from_below_as_it_does(tmp_path):
    """Its unseen half reflects the light, which comes from above only."""
    sky = np.zeros((32, 64, 3), np.float32)
    sky[:16] = 2
    paint = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.5, 0.3, 0.2]}}
    mesh = {"type": "ply", "filename": str(write_ball(tmp_path)), "bsdf": paint}
    light = {"type": "envmap", "bitmap": mi.Bitmap(sky)}
    scene = mi.load_dict({"type": "scene", "integrator": PATH, "light": light, "ball": mesh})
    (ball,) = scene.shapes()
    sensors = sphere_sensors(ball, 8, (32, 32), lowest=0.6)
    images = render_views(scene, sensors, 64)
    capture = memory_capture(scene, images, sensors, shape=ball, mesh=ball)
    observed = observe(capture, svu.texels(ball, 32))
    assert 0.2 < (observed.coverage == 0).mean() < 0.6
    surfaces = near_surfaces(observed, preset("default", bounces=True))
    props = mi.Properties()
    props["emitter"] = mi.load_dict({"type": "area", "radiance": surfaces.shown.glow})
    props["bsdf"] = mi.load_dict({"type": "diffuse", "reflectance": 0.0})
    likeness = scene_around(make_mesh("ball", arrays(ball), props), capture)
    below = sphere_sensors(ball, 3, (12, 12))[2]
    real, found = (
        np.array(mi.render(each, sensor=below, integrator=mi.load_dict(PATH), spp=256))
        for each in (scene, likeness)
    )
    shown = np.array(real[..., 0]) < 1.5
    assert real[shown].min() < 0.05 < 0.2 < real[shown].max()
    np.testing.assert_allclose(found[shown], real[shown], atol=0.05)


GOLD = [0.9, 0.6, 0.3]


def golden(roughness):
    """Value of a single texel of a metal that has no diffuse radiance."""
    return mi.Float([0, 0, 0, roughness, *GOLD, 1])


@pytest.mark.parametrize("roughness", [0.2, 0.5, 0.9])
def test_a_shown_object_looks_as_path_traced(tmp_path, roughness):
    """A convex metal in direct light, seen from outside."""
    metal = {"type": "principled", "base_color": {"type": "rgb", "value": GOLD},
             "metallic": 1.0, "roughness": roughness}  # fmt: skip
    mesh = {"type": "ply", "filename": str(write_ball(tmp_path)), "bsdf": metal}
    scene = mi.load_dict({"type": "scene", "light": STUDIO, "ball": mesh})
    (ball,) = scene.shapes()
    sensors = sphere_sensors(ball, 2, (24, 24))
    capture = memory_capture(
        scene, [np.ones((24, 24, 3), np.float32)] * 2, sensors, shape=ball, mesh=ball
    )
    light = observe(capture, svu.texels(ball, 8)).distant_light
    black, _ = surroundings(capture)
    shown = ShownObject(
        prefiltered_model(light, angular(), 16), golden(roughness), (1, 1), glowing(0)
    )
    surfaces = NearSurfaces(black, shown, None)
    toward, paths = to_drjit(mi.Vector3f, fibonacci(200).T.astype(np.float32)), 4096
    ray = mi.Ray3f(4 * toward, dr.normalize(mi.Vector3f(0.2, 0.1, -0.2) - 4 * toward))
    met = black.ray_intersect_preliminary(ray)
    found = surfaces.radiance_along(ray.o, ray.d, met.is_valid(), mi.Float(0)).numpy()
    random = mi.load_dict({"type": "independent"})
    random.seed(7, 200 * paths)
    many = dr.gather(mi.Ray3f, ray, dr.repeat(dr.arange(mi.UInt32, 200), paths))
    direct = mi.load_dict({"type": "path", "max_depth": 2})
    color = direct.sample(scene, random, mi.RayDifferential3f(many))[0]
    real = np.array([dr.block_sum(x, paths).numpy() / paths for x in color])
    assert met.is_valid().numpy().all()
    error = found / real.mean() - real / real.mean()
    assert abs(error.mean()) < 0.02
    assert np.sqrt((error**2).mean()) < 0.1  # the model's lobes are symmetric


def test_a_ray_mirrors_the_lamps_of_its_solid_angle():
    """A mirror shows a small lamp to more rays, if these are broad; the mean of all stays."""
    pixels = np.zeros((128, 256, 3), np.float32)
    pixels[41:43, 61:63] = 2000.0
    sky = read_environment(mi.load_dict({"type": "envmap", "bitmap": mi.Bitmap(pixels)}))
    light = prefiltered_model(band_limited_lighting(sky, 9), angular(), 16)
    scene = emitting("sphere")
    shown, count = ShownObject(light, golden(0.3), (1, 1), glowing(0)), 20000
    surfaces = NearSurfaces(scene, shown, None)
    toward = to_drjit(mi.Vector3f, fibonacci(count).T.astype(np.float32))
    # Rays to the centre meet the sphere at right angles, and return.
    narrow, broad = (
        surfaces.radiance_along(4 * toward, -toward, mi.Bool(True), mi.Float(size)).numpy()[0]
        for size in (0.0, 0.05)
    )
    assert broad.mean() == pytest.approx(narrow.mean(), rel=0.02)
    # Squared alpha rises by .05 / 2 pi, from .0081: the peak of GGX falls to about one half.
    assert broad.max() / narrow.max() == pytest.approx(
        0.0081 / (0.0081 + 0.05 / 2 / np.pi), rel=0.1
    )


def test_mirror_rays_of_a_shown_object_meet_it():
    """Inside a bright sphere of metal, its albedo is added, whose closed form is Mitsuba's."""
    scene = emitting("sphere", flip_normals=True, radius=1.0)
    sky = read_environment(mi.load_dict({"type": "constant", "radiance": 7.0}))
    light = prefiltered_model(band_limited_lighting(sky, 9), angular(), 16)
    shown, count = ShownObject(light, golden(0.5), (1, 1), glowing(RADIANCE)), 4096
    surfaces = NearSurfaces(scene, shown, None)
    toward = to_drjit(mi.Vector3f, fibonacci(count).T.astype(np.float32))
    ray = mi.Ray3f(mi.Point3f(0, 0, 0.3), toward)
    hit, every = scene.ray_intersect(ray), mi.Bool(True)
    found = surfaces.radiance_along(ray.o, ray.d, every, mi.Float(0)).numpy()
    metal = mi.load_dict({
        "type": "principled", "base_color": {"type": "rgb", "value": GOLD}, "metallic": 1.0,
        "roughness": 0.5,
    })  # fmt: skip
    random = mi.load_dict({"type": "independent"})
    random.seed(7, 256 * count)
    lane = dr.repeat(dr.arange(mi.UInt32, count), 256)
    own = dr.gather(mi.SurfaceInteraction3f, hit, lane)
    _, weight = metal.sample(mi.BSDFContext(), own, random.next_1d(), random.next_2d())
    albedo = np.array([dr.block_sum(x, 256).numpy() / 256 for x in weight])
    expected = RADIANCE[:, None] * albedo
    np.testing.assert_allclose(found.mean(axis=1), expected.mean(axis=1), rtol=0.02)
    assert np.abs(found / expected - 1).mean() < 0.05


@pytest.fixture(scope="module")
def touching():
    """Photographs of touching spheres, their texels, and the surfaces around these."""
    scene = load_scene(scenes.path("spheres"), {"light": "studio"})
    (shape,) = scene.shapes()
    sensors = sphere_sensors(shape, 16, (64, 64))
    images = render_views(scene, sensors, 32)
    capture = memory_capture(scene, images, sensors, shape=shape, mesh=shape)
    layout = svu.texels(shape, 64)
    found = near_surfaces(observe(capture, layout), preset("default", bounces=True))
    return capture, layout, found


def test_materials_of_a_shown_object_are_estimated_in_its_own_light(touching):
    capture, layout, surfaces = touching
    alone = svu.estimate(capture, layout)
    shown = surfaces.shown.values.numpy().reshape(-1, 8)[layout.index.numpy()]
    truth, seen = parameters_at(capture, layout), alone.posterior.observed
    for name, values in (("metallic", shown[:, 7]), ("base_color", shown[:, 4:7])):
        direct = np.array(alone.posterior.mean(name)).reshape(values.shape)
        found, ignored = (np.square(x - truth[name])[seen].mean() for x in (values, direct))
        assert found < 0.75 * ignored


def test_matte_parts_beside_others_are_as_bright_as_path_traced(touching):
    """Light that reaches a violet ball of plastic by way of its neighbours is in its blue light."""
    capture, layout, surfaces = touching
    scene, shape = capture.scene, capture.shape
    random = np.random.default_rng(3)
    chosen = to_drjit(mi.UInt32, random.integers(layout.count, size=20000).astype(np.uint32))
    lanes = TexelLanes.of(layout, chosen)
    points = mi.Point2f(*random.random((2, 20000)).astype(np.float32))
    toward = mi.Frame3f(lanes.normal).to_world(mi.warp.square_to_cosine_hemisphere(points))
    origin = lanes.position + lanes.offset * lanes.geometric_normal
    hit = scene.ray_intersect(mi.Ray3f(origin, toward))
    rough = shape.bsdf().eval_attribute_1("roughness", hit, hit.is_valid()) > 0.8
    metal = shape.bsdf().eval_attribute_1("metallic", hit, hit.is_valid()) > 0.5
    matte = hit.is_valid() & rough & ~metal & (dr.dot(hit.n, toward) < 0)
    assert 100 < dr.count(matte)[0] < 2000
    path, sampler = mi.load_dict(PATH), mi.load_dict({"type": "independent"})
    real = 0.0
    for seed in range(8):
        sampler.seed(seed, 20000)
        ray = mi.RayDifferential3f(origin, toward)
        real += path.sample(scene, sampler, ray, None, matte)[0].z.numpy().sum() / 8
    found = surfaces.radiance_along(origin, toward, matte, mi.Float(0)).z.numpy().sum()
    assert 0.85 < found / real < 1.15


def test_a_shown_object_mirrors_sky_and_table():
    """Diffuse radiance, and the light in the mirror direction times the albedo of its lobe."""
    below = mi.ScalarTransform4f().translate([0, -2, 0]).rotate([1, 0, 0], -90).scale(1000)
    scene = mi.load_dict({"type": "scene", "a": {"type": "sphere"},
                          "b": {"type": "rectangle", "to_world": below}})  # fmt: skip
    sky, table = 7.0, np.array([0.5, 2.0, 3.0])
    light = band_limited_lighting(
        read_environment(mi.load_dict({"type": "constant", "radiance": sky})), 9
    )
    around = Panorama(mi.Point3f(0), lat_long_texture(np.full((9, 16, 4), [*table, 1.0])))
    diffuse, roughness, metallic = np.array([0.1, 0.2, 0.3]), 0.6, 0.3
    values = mi.Float([*diffuse, roughness, *GOLD, metallic])
    shown = ShownObject(prefiltered_model(light, angular(), 16), values, (1, 1), glowing(0))
    start = 3 * fibonacci(60)
    toward = np.array([0.4, -0.3, 0.5]) - start
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    ray = mi.Ray3f(*(to_drjit(mi.Vector3f, x.T.astype(np.float32)) for x in (start, toward)))
    surfaces = NearSurfaces(scene, shown, around)
    found = surfaces.radiance_along(ray.o, ray.d, mi.Bool(True), mi.Float(0)).numpy().T
    along = (start * toward).sum(axis=1)
    normal = start - (along + np.sqrt(along**2 - 8))[:, None] * toward  # on the unit sphere
    cosine = -(normal * toward).sum(axis=1)
    up = (2 * cosine[:, None] * normal + toward)[:, 1]
    kept = (np.abs(up) > 0.05) & (start[:, 1] > -1.9)  # meets sky or table, from above it
    assert 10 < (up[kept] > 0).sum() < kept.sum() - 10
    for own, value, mirrored in zip(found[kept], cosine[kept], up[kept], strict=True):
        A, B = albedo(roughness**2, value, 200)
        D = reflectance(roughness**2, value, fresnel, 200)
        shine = (1 - metallic) * D + metallic * (np.array(GOLD) * A + B)
        expected = diffuse + shine * (sky if mirrored > 0 else table)
        np.testing.assert_allclose(own, expected, rtol=0.01)


@pytest.fixture(scope="module")
def tables(tmp_path_factory):
    """A ball on a black and on a bright table, photographed from above."""
    folder = tmp_path_factory.mktemp("table")
    paint = {"type": "principled", "base_color": {"type": "rgb", "value": [0.5, 0.3, 0.2]},
             "roughness": 0.8}  # fmt: skip
    mesh = {"type": "ply", "filename": str(write_ball(folder)), "bsdf": paint}
    below = mi.ScalarTransform4f().translate([0, -1.02, 0]).rotate([1, 0, 0], -90).scale(6)
    captures = []
    for bsdf in (BLACK, {"type": "diffuse", "reflectance": 0.8}):
        table = {"type": "rectangle", "to_world": below, "bsdf": bsdf}
        parts = {"integrator": PATH, "light": STUDIO, "ball": mesh, "table": table}
        scene = mi.load_dict({"type": "scene", **parts}, optimize=False)
        ball = next(shape for shape in scene.shapes() if shape.id() == "ball")
        sensors = sphere_sensors(ball, 12, (32, 32), lowest=0.1)
        images = render_views(scene, sensors, 128)
        captures.append(memory_capture(scene, images, sensors, shape=ball, mesh=ball))
    return captures


def base_color_below(capture):
    """Mean base colour of seen texels that face the table."""
    chosen = preset("default", method="angular", folds=0)
    texels = svu.texels(capture.mesh, 12)
    estimate = svu.estimate(capture, texels, preset=chosen, known={"metallic": 0.0})
    below = (texels.normal.y.numpy() < 0) & estimate.posterior.observed
    return np.array(estimate.posterior.mean("base_color"))[below].mean(axis=0)


@pytest.mark.slow
def test_a_table_in_the_scene_does_not_brighten_the_object(tables):
    """It does if the scene does not contain it."""
    black, bright = tables
    truth = np.array([0.5, 0.3, 0.2])
    known, ignored = map(base_color_below, (bright, replace(black, images=bright.images)))
    assert np.abs(known / truth - 1).max() < 0.1
    assert (ignored / truth).min() > 1.3


def test_a_table_is_as_bright_as_path_traced(tables):
    """Towards all sides, and in the shadow of a black ball."""
    scene, integrator = surroundings(tables[1])
    surfaces = NearSurfaces(scene, None, trace_panorama(tables[1], scene, integrator))
    count, paths = 400, 1024
    x, y, z = fibonacci(count, lowest=0.2).T  # y is up
    place = np.random.default_rng(3).uniform(-2, 2, (2, count))
    start = np.stack([place[0] + x / y, np.full(count, -0.02), place[1] + z / y])
    ray = mi.Ray3f(to_drjit(mi.Point3f, start.astype(np.float32)),
                   -to_drjit(mi.Vector3f, np.stack([x, y, z]).astype(np.float32)))  # fmt: skip
    met = scene.ray_intersect_preliminary(ray).shape
    lit = met == mi.ShapePtr(next(s for s in scene.shapes() if s.id() == "table"))
    found = surfaces.radiance_along(ray.o, ray.d, lit, mi.Float(0)).numpy()[:, lit.numpy()]
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(5, count * paths)
    many = dr.gather(mi.Ray3f, ray, dr.repeat(dr.arange(mi.UInt32, count), paths))
    color = integrator.sample(scene, sampler, mi.RayDifferential3f(many))[0]
    real = np.array([dr.block_sum(x, paths).numpy() / paths for x in color])[:, lit.numpy()]
    assert real.shape[1] > 200 and real.std() > 0.2 * real.mean()
    assert np.abs(found.mean() / real.mean() - 1) < 0.02
    assert np.sqrt(np.square(found - real).mean()) < 0.08 * real.mean()


def test_paths_to_a_table_are_traced_once_for_all_channels(tables):
    scene, integrator = surroundings(tables[1])
    with launched_kernels() as kernels:
        trace_panorama(tables[1], scene, integrator)
    assert sum(kernel["size"] == 2 * (ROWS - 1) * ROWS for kernel in kernels) == 1


def test_a_mirroring_object_lights_a_table_as_path_traced():
    """Metal planes mirror a lamp onto the table, which no photograph from above shows."""
    scene = load_scene(scenes.path("planes"), {"light": "studio", "resolution": "32"})
    (planes,) = scene.shapes()
    sensors = sphere_sensors(planes, 16, (64, 64))
    images = [np.ones((64, 64, 3), np.float32)] * 16
    capture = memory_capture(scene, images, sensors, shape=planes, mesh=planes)
    capture = with_table(capture, (0.5, 0.5, 0.5))
    capture = photographed(capture, repeat(capture.scene), 64)
    observed = observe(capture, svu.texels(planes, 32))
    found = near_surfaces(observed, preset("default", bounces=True)).others
    black, path = surroundings(capture)
    real, dark = (trace_panorama(capture, each, path) for each in (capture.scene, black))
    found, real, dark = (np.array(x.texture.tensor())[..., :3] for x in (found, real, dark))
    assert (real - dark).sum() > 0.03 * dark.sum()
    assert (found - dark).sum() == pytest.approx((real - dark).sum(), rel=0.15)
    assert np.corrcoef((found - dark).ravel(), (real - dark).ravel())[0, 1] > 0.85


def test_an_object_of_radiance_1_lights_itself_where_it_hides_the_light():
    """Its irradiance is pi times its hidden part."""
    scene = load_scene(scenes.path("knot"), {"resolution": "24", "max_depth": "2"})
    (knot,) = scene.shapes()
    sensors = sphere_sensors(knot, 6, (24, 24))
    images = [np.ones((24, 24, 3), np.float32)] * 6
    capture = memory_capture(scene, images, sensors, shape=knot, mesh=knot)
    observed = observe(capture, svu.texels(knot, 16))
    near = trace_near_light(Glowing(scene, [1.0, 1.0, 1.0]), observed.surface, 256)
    hidden = observed.light_visibility(1024).hidden_share(observed.surface)
    assert hidden.mean() > 0.1  # a knot hides much from itself
    found = near.moments[1][0].numpy() / np.pi
    np.testing.assert_allclose(found, hidden, atol=0.1)
    assert np.abs(found - hidden).mean() < 0.02
    assert observed.near_light(angular("default")) is None
    some = np.array([3, 0, 3])
    part = near.subset(some)
    np.testing.assert_array_equal(part.moments[0][0].numpy(), near.moments[0][0].numpy()[some])


def test_bounces_need_a_preset_that_traces_light(tmp_path, capsys):
    with pytest.raises(OptionError, match="bounces"):
        preset("fast", method="angular", bounces=True)
    assert run("entropy", tmp_path, "--bounces", "--preset", "fast") == 2
    assert "--bounces needs" in capsys.readouterr().err
