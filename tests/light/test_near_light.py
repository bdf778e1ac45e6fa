"""Light from other surfaces: closed forms, a furnace, and path-traced photographs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from numpy.polynomial.legendre import leggauss
from support.helpers import STUDIO, memory_capture, render_views, run, write_ball
from support.walled import BLACK, angular

import svu_mi as svu
from svu_mi import scenes
from svu_mi.capture.scene import load_scene
from svu_mi.capture.sensors import sphere_sensors
from svu_mi.capture.surroundings import surroundings
from svu_mi.core.arrays import fibonacci, to_drjit
from svu_mi.errors import OptionError
from svu_mi.geometry.sample_view import TexelLanes
from svu_mi.light.band_limited import band_limited_lighting
from svu_mi.light.environment import read_environment
from svu_mi.light.near_light import DEGREE, trace_near_light
from svu_mi.posterior.object_appearance import shown_object
from svu_mi.posterior.observations import observe
from svu_mi.presets import preset
from svu_mi.reflection import near_lobes
from svu_mi.reflection.lobes import lobe_profile, zonal_factors
from svu_mi.reflection.near_lobes import NearLobes
from svu_mi.reflection.render_model import prefiltered_model
from svu_mi.reflection.shown_object import ShownObject

ANGLE = 0.7  # between the axis and the rim of the disk
RADIANCE = np.array([1.0, 2.0, 0.5])
PATH = {"type": "path", "max_depth": 6}


def emitting(shape, **changes):
    """A scene of one shape that emits ``RADIANCE``."""
    light = {"type": "area", "radiance": {"type": "rgb", "value": RADIANCE.tolist()}}
    return mi.load_dict({"type": "scene", "a": {"type": shape, "emitter": light, **changes}})


@dataclass
class Glowing:
    """A scene whose first shape has the same radiance everywhere."""

    scene: Any
    color: list[float]

    def radiance(self, _ray, _met, active):
        return dr.select(active, mi.Color3f(self.color), 0)


def texel_facing(normals):
    """Texels at the origin with these normals."""
    normals = np.atleast_2d(normals).astype(np.float32).T
    normal = to_drjit(mi.Normal3f, normals)
    return TexelLanes(
        to_drjit(mi.Point3f, 0 * normals), normal, normal, dr.opaque(mi.Float, 1e-4)
    )  # fmt: skip


def traced(scene, normals, rays=4096):
    integrator = mi.load_dict({"type": "path", "max_depth": 1})
    return trace_near_light(scene, integrator, texel_facing(normals), rays)


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


def test_expansion_of_a_cap_has_the_coefficients_of_both_caps():
    """The integral of P_l over a cap, doubled by its mirror image, for even l."""
    near = traced(disk_above([0, 0, 1]), [0, 0, 1])
    parts = near.at(mi.UInt32(0), mi.Vector3f(0, 0, 1))
    nodes, weights = leggauss(32)
    z = 1 - (1 - np.cos(ANGLE)) * (nodes + 1) / 2
    weights = weights * (1 - np.cos(ANGLE)) / 2
    for l in range(DEGREE + 1):
        legendre = np.polynomial.legendre.Legendre.basis(l)(z)
        expected = 0 if l % 2 else (2 * l + 1) * (weights * legendre).sum()
        found = [part[l].numpy()[0] for part in parts]
        np.testing.assert_allclose(found, expected * np.append(RADIANCE, 1), atol=0.02)


def test_lobes_in_a_furnace_see_its_radiance():
    """Inside a bright sphere, each lobe reflects its albedo, for narrow and wide ones."""
    near = traced(emitting("sphere", flip_normals=True, radius=10.0), [[0, 0, 1], [0.6, 0, 0.8]])
    alpha = np.array([1e-3, 0.05, 0.3, 1.0])
    lobes = NearLobes.of(near, 3, alpha, angular())
    surface = texel_facing([[0, 0, 1], [0.6, 0, 0.8]])
    direction = mi.Vector3f(0.36, 0.48, 0.8)
    cosine = dr.dot(surface.normal, direction)
    found = lobes.reflect(surface, direction, cosine, mi.Bool(False))
    for level, width in enumerate(alpha.tolist()):
        albedo = lobes.albedo.at(level, width, cosine)
        for value, parts in zip(RADIANCE, found[level], strict=True):
            for part, whole in zip(parts, albedo, strict=True):
                np.testing.assert_allclose(part.numpy(), value * whole.numpy(), rtol=0.02)
    free = lobes.reflect(surface, direction, cosine, mi.Bool(True))
    assert np.abs([x.numpy() for x in free[0][0]]).max() < 1e-3  # the mirror ray leaves


def test_rays_of_each_lobe_look_at_the_photographed_object(monkeypatch):
    """Along the normal, a disk has the part of a lobe whose half vectors are within ANGLE / 2."""
    monkeypatch.setattr(near_lobes, "RAYS", 100)
    normals = np.tile([0.0, 0.0, 1.0], (2048, 1))
    scene = disk_above([0, 0, 1])
    near = replace(traced(scene, normals, 64), shown=Glowing(scene, RADIANCE.tolist()))
    alpha = np.array([1e-3, 0.1, 0.3, 0.6, 1.0])
    lobes = NearLobes.of(near, 3, alpha, angular())
    surface, turns = texel_facing(normals), dr.arange(mi.Float, 2048)
    up = dr.normalize(mi.Vector3f(1e-3 * dr.cos(turns), 1e-3 * dr.sin(turns), 1))
    found = lobes.reflect(surface, up, dr.dot(surface.normal, up), mi.Bool(False))
    half = (np.arange(20000) + 0.5) / 20000 * np.pi / 4
    for level, width in enumerate(alpha.tolist()):
        ggx = 1 / (np.cos(half) ** 2 + (np.sin(half) / width) ** 2) ** 2
        smith = 2 / (1 + np.sqrt(1 + (width * np.tan(2 * half)) ** 2))
        weights = ggx * smith * np.cos(half) * np.sin(half)
        share = weights[half < ANGLE / 2].sum() / weights.sum()
        albedo = lobes.albedo.at(level, width, dr.dot(surface.normal, up))[0].numpy()
        values = [of_color[0].numpy().mean() for of_color in found[level]]
        np.testing.assert_allclose(values, share * RADIANCE * albedo.mean(), rtol=0.03)


def test_zonal_factors_of_gaussian_lobes():
    """Eq. 6: degree l is scaled by exp(-(alpha l)^2); narrow lobes change nothing."""
    for alpha in (0.05, 0.2, 0.5):
        found = zonal_factors(lobe_profile("gaussian"), alpha, DEGREE)
        expected = np.exp(-((alpha * np.arange(DEGREE + 1)) ** 2))
        np.testing.assert_allclose(found, expected, atol=0.02)
    np.testing.assert_allclose(zonal_factors(lobe_profile("ggx"), 1e-3, DEGREE), 1, atol=1e-2)


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
    _, likeness, _ = shown_object(observed, 1024)
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
    black, _ = surroundings(capture, np.zeros((8, 8, 3)))
    shown = ShownObject(black, prefiltered_model(light, angular(), 16), golden(roughness), (1, 1))
    toward, paths = to_drjit(mi.Vector3f, fibonacci(200).T.astype(np.float32)), 4096
    ray = mi.Ray3f(4 * toward, dr.normalize(mi.Vector3f(0.2, 0.1, -0.2) - 4 * toward))
    met = black.ray_intersect_preliminary(ray)
    found = shown.radiance(ray, met, met.is_valid()).numpy()
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


def test_mirror_rays_of_a_shown_object_meet_it():
    """Inside a bright sphere of metal, its albedo is added, whose closed form is Mitsuba's."""
    scene = emitting("sphere", flip_normals=True, radius=1.0)
    sky = read_environment(mi.load_dict({"type": "constant", "radiance": 7.0}))
    light = prefiltered_model(band_limited_lighting(sky, 9), angular(), 16)
    shown, count = ShownObject(scene, light, golden(0.5), (1, 1)), 4096
    toward = to_drjit(mi.Vector3f, fibonacci(count).T.astype(np.float32))
    ray = mi.Ray3f(mi.Point3f(0, 0, 0.3), toward)
    hit, every = scene.ray_intersect(ray), mi.Bool(True)
    found = shown.radiance(ray, scene.ray_intersect_preliminary(ray), every).numpy()
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


def test_a_table_in_the_scene_does_not_brighten_the_object(tables):
    """It does if the scene does not contain it."""
    black, bright = tables
    truth = np.array([0.5, 0.3, 0.2])
    known, ignored = map(base_color_below, (bright, replace(black, images=bright.images)))
    assert np.abs(known / truth - 1).max() < 0.1
    assert (ignored / truth).min() > 1.3


def test_an_object_of_radiance_1_lights_itself_where_it_hides_the_light():
    """Its light is its hidden part."""
    scene = load_scene(scenes.path("knot"), {"resolution": "24", "max_depth": "2"})
    (knot,) = scene.shapes()
    sensors = sphere_sensors(knot, 6, (24, 24))
    images = [np.ones((24, 24, 3), np.float32)] * 6
    capture = memory_capture(scene, images, sensors, shape=knot, mesh=knot)
    observed = observe(capture, svu.texels(knot, 16))
    scene, _ = surroundings(capture, np.ones((16, 16, 3), np.float32))
    direct, surface = mi.load_dict({"type": "path", "max_depth": 1}), observed.surface
    near = trace_near_light(scene, direct, surface, 256)
    shown = trace_near_light(scene, None, surface, 256, Glowing(scene, [1.0, 1.0, 1.0]))
    assert not dr.width(shown.values)  # lobes sample the knot
    for both in zip(near.moments[1], shown.moments[1], strict=True):
        np.testing.assert_allclose(*(x.numpy() for x in both), atol=0.05)
    *colors, hidden = near.values.numpy().reshape(4, -1, len(observed.seen))
    assert hidden[0].mean() > 0.1  # a knot hides much from itself
    for color in colors:  # a ray in a hundred meets a face from behind, which is dark
        np.testing.assert_allclose(color, hidden, atol=0.1)
        assert np.abs(color - hidden).mean() < 0.01
    assert observed.near_light(angular("default")) is None
    some = np.array([3, 0, 3])
    part, up = near.subset(some), mi.Vector3f(0.6, 0, 0.8)
    own, chosen = part.at(mi.UInt32([0, 1, 2]), up), near.at(mi.UInt32(some), up)
    np.testing.assert_array_equal(np.array(own), np.array(chosen))
    np.testing.assert_array_equal(part.moments[0][0].numpy(), near.moments[0][0].numpy()[some])


def test_bounces_need_a_preset_that_traces_light(tmp_path, capsys):
    with pytest.raises(OptionError, match="bounces"):
        preset("fast", method="angular", bounces=True)
    assert run("entropy", tmp_path, "--bounces", "--preset", "fast") == 2
    assert "--bounces needs" in capsys.readouterr().err
