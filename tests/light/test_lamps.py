"""Lamps: closed forms, integrals over their surface, and photographs under them."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from light.test_near_light import texel_facing
from support.helpers import memory_capture, render_views, require_equal_columns, unit, write_ball

import svu_mi as svu
from svu_mi.capture import scene_xml
from svu_mi.capture.scene import find_environment, find_light, lamps_of, load_scene
from svu_mi.capture.sensors import sphere_sensors
from svu_mi.core.arrays import to_drjit
from svu_mi.errors import SceneError
from svu_mi.light.lamps import trace_lamps
from svu_mi.presets import preset
from svu_mi.reflection.lobes import Normals
from svu_mi.reflection.wide_lobes import LobeSums

POINT = {"type": "point", "position": [0, 0.6, 0.8],
         "intensity": {"type": "rgb", "value": [1, 2, 4]}}  # fmt: skip
KINDS = ("point", "spot", "directional")


def place():
    return mi.ScalarTransform4f()


def lamp(kind):
    """A lamp that gives the origin 1, 2, 4 from (0, .6, .8)."""
    if kind == "point":
        return POINT
    if kind == "directional":
        power = {"type": "rgb", "value": [1, 2, 4]}
        return {"type": kind, "direction": [0, -0.6, -0.8], "irradiance": power}
    to = place().look_at([0, 3, 4], [0, 0, 0], [0, 0, 1])
    power = {"type": "rgb", "value": [25, 50, 100]}
    return {"type": kind, "to_world": to, "intensity": power, "cutoff_angle": 30.0}


def scene_of(**parts):
    return mi.load_dict({"type": "scene", **parts}, optimize=False)


def disk(radius, distance=2.0):
    """A disk above the origin that emits radiance 3."""
    there = place().translate([0, 0, distance]).rotate([1, 0, 0], 180).scale(radius)
    return {"type": "disk", "to_world": there, "emitter": {"type": "area", "radiance": 3.0}}


def traced(scene, normals, *, occluded=True):
    return trace_lamps(scene, lamps_of(scene), texel_facing(normals), occluded=occluded)


def index_of(lamps, cell, texel):
    """Index of a cell as seen from a texel."""
    return mi.UInt32(cell * int(lamps.lanes[0]) + int(lamps.place[texel]))


def number_of(lamps):
    """Number of cells."""
    return lamps.cells.number // int(lamps.lanes[0])


@pytest.mark.parametrize("kind", KINDS)
def test_single_lamps_give_their_irradiance(kind):
    """1, 2, 4 from (0, .6, .8): I / r^2, or the irradiance itself. Nothing from below."""
    normals = np.array([[0, 0.6, 0.8], [0, 0, 1], [0, 0, -1]])
    lamps = traced(scene_of(lamp=lamp(kind)), normals)
    toward, radius = lamps.cells.at(index_of(lamps, 0, 0))
    np.testing.assert_allclose(toward.numpy()[:, 0], [0, 0.6, 0.8], atol=1e-6)
    assert radius.numpy() == 0
    cosine = np.array([1, 0.8, 0])
    for value, moments in zip((1, 2, 4), lamps.moments, strict=True):
        c0, x0, y0, z0, c1, x1, y1, z1 = (m.numpy() for m in moments)
        np.testing.assert_allclose(c0, value * cosine, atol=1e-5)
        np.testing.assert_allclose([x0, y0, z0], np.outer([0, 0.6, 0.8], c0), atol=1e-5)
        np.testing.assert_allclose(c1, value * cosine * (1 - cosine) ** 5, atol=1e-5)
        np.testing.assert_allclose([x1, y1, z1], np.outer([0, 0.6, 0.8], c1), atol=1e-5)


def test_a_disk_gives_its_form_factor():
    """E = L pi sin^2 t of a disk overhead; hidden by a plate, only if occlusion is traced."""
    angle = np.arctan2(1.0, 2.0)
    lamps = traced(scene_of(lamp=disk(1.0)), [[0, 0, 1]])
    expected = 3 * np.pi * np.sin(angle) ** 2
    np.testing.assert_allclose([m[0].numpy()[0] for m in lamps.moments], expected, rtol=0.02)
    plate = {"type": "rectangle", "to_world": place().translate([0, 0, 1])}
    hidden = traced(scene_of(lamp=disk(1.0), plate=plate), [[0, 0, 1]])
    assert hidden.moments[0][0].numpy() == 0
    ignored = traced(scene_of(lamp=disk(1.0), plate=plate), [[0, 0, 1]], occluded=False)
    np.testing.assert_allclose(ignored.moments[0][0].numpy(), expected, rtol=0.02)


def reflected(alpha, radius, view, normal):
    """Integrate D G1 G1 / (4 cos_o) over a disk of radiance 3, in NumPy."""
    random = np.random.default_rng(0)
    r, turn = radius * np.sqrt(random.random(400_000)), 2 * np.pi * random.random(400_000)
    point = np.stack([r * np.cos(turn), r * np.sin(turn), np.full(len(r), 2.0)], axis=1)
    square = (point**2).sum(axis=1)
    w = point / np.sqrt(square)[:, None]
    flux = 3 * np.pi * radius**2 / len(r) * w[:, 2] / square
    h = unit(w + view)
    up, incident, outgoing = h @ normal, w @ normal, view @ normal
    d = (alpha / (up**2 * (alpha**2 - 1) + 1)) ** 2 / np.pi

    def g1(c):
        return 2 * c / (c + np.sqrt(c * c * (1 - alpha**2) + alpha**2))

    return (flux * d * g1(incident) * g1(outgoing) / (4 * outgoing)).sum()


def lobe_of(alpha, radius, view, normal):
    """The light of the disk that the model reflects."""
    lamps = traced(scene_of(lamp=disk(radius)), normal)
    surface, direction = texel_facing(normal), mi.Vector3f(*map(float, view))
    normals, cosine = Normals.of(surface.normal), dr.dot(surface.normal, direction)
    sums, count = LobeSums(np.array([alpha, 0.9]), 3, normals, direction), lamps.cells.count
    lobes = sums.of_cells(lamps.cells, count, mi.Bool(True), cosine, lamps.place, lamps.lanes)
    p, q, _ = lobes[0][0]
    return (p + q).numpy()[0]


@pytest.mark.parametrize(("alpha", "radius", "bar"), [
    (0.05, 0.05, 0.02), (0.3, 0.4, 0.02), (0.6, 1.0, 0.02), (0.02, 0.4, 0.1),
])  # fmt: skip
def test_lobes_are_integrals_over_the_lamp(alpha, radius, bar):
    """Also where the lobe is narrower than a cell: near the mirror direction of the centre."""
    normal = unit(np.array([0.1, 0.0, 1.0]))
    view = 2 * normal[2] * normal - [0, 0, 1]
    expected = reflected(alpha, radius, view, normal)
    assert lobe_of(alpha, radius, view, normal) == pytest.approx(expected, rel=bar)


@pytest.mark.parametrize("alpha", [0.05, 0.1])
def test_grazing_lobes_end_at_edges_of_lamps(alpha):
    """The mirror ray meets an edge; in half vectors, cells are six times as wide as long.

    Disks that are as large err by .15 of the light of the centre at alpha .05.
    """
    normal = unit(np.array([6.0, 0.0, 1.0]))
    mirror = 2 * normal[2] * normal - [0, 0, 1]
    bar = 0.06 * reflected(alpha, 0.4, mirror, normal)
    for offset in (0.15, 0.2, 0.25):
        view = unit(mirror + [0, offset, 0])
        expected = reflected(alpha, 0.4, view, normal)
        assert lobe_of(alpha, 0.4, view, normal) == pytest.approx(expected, abs=bar)


@pytest.mark.parametrize(("size", "cells"), [
    ((1.0, 1.0), (8, 8)), ((0.8, 0.1), (13, 2)), ((0.1, 0.8), (2, 13)), ((0.01, 0.01), (2, 2)),
])  # fmt: skip
def test_cells_are_as_wide_as_long(size, cells):
    """A rectangle from 2 away: 2 atan(.4) = .761 rad in 13 cells of .06, .1 in two."""
    to = place().translate([0, 0, 2]).rotate([1, 0, 0], 180).scale([*size, 1])
    shape = {"type": "rectangle", "to_world": to, "emitter": {"type": "area", "radiance": 1.0}}
    lamps = traced(scene_of(lamp=shape), [[0, 0, 1]])
    assert number_of(lamps) == cells[0] * cells[1]
    directions = lamps.cells.toward.numpy().reshape(-1, 4).astype(np.float64)
    deviation = np.std(2 * directions[:, :2] / directions[:, 2:3], axis=0)
    # Of n points at (2 k + 1) / n - 1.
    expected = np.array(size) * np.sqrt((1 - np.array(cells) ** -2.0) / 3)
    np.testing.assert_allclose(deviation, expected, rtol=1e-4)


@pytest.mark.parametrize(("kind", "corner"), [("rectangle", 40.0), ("disk", 0.1)])
def test_textures_of_lamps_give_their_moments(kind, corner):
    """Of a bright corner, a slope, and dark parts, as rays find them; cells are compact."""
    pixels = np.full((8, 8, 3), 0.1, np.float32)
    pixels[..., 1], pixels[5:, :3] = np.linspace(0, 3, 8), corner
    image = {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(pixels), "filter_type": "nearest"}
    scene = scene_of(lamp={
        "type": kind, "to_world": place().translate([0.3, 0, 2]).rotate([1, 0, 0], 180),
        "emitter": {"type": "area", "radiance": image},
    })  # fmt: skip
    lamps = traced(scene, [[0, 0, 1]])
    x, y = (np.arange(2000)[:, None] + 0.5) / 1000 - 1, np.arange(-1000, 1000)[None] / 1000
    toward = np.stack([*np.broadcast_arrays(x + 0.3, y), np.ones((2000, 2000))], -1).reshape(-1, 3)
    solid = 1e-6 / np.linalg.norm(toward, axis=1) ** 3
    toward = unit(toward)
    ray = mi.Ray3f(mi.Point3f(0), to_drjit(mi.Vector3f, toward.T.astype(np.float32)))
    hit = scene.ray_intersect(ray)
    light = lamps_of(scene)[0].eval(hit, hit.is_valid()).numpy().astype(np.float64)
    flux = np.where(hit.is_valid().numpy(), light, 0) * toward[:, 2] * solid
    for channel, moments in zip(flux, lamps.moments, strict=True):
        real = np.append(channel.sum(), channel @ toward)
        found = [m.numpy()[0] for m in moments[:4]]
        np.testing.assert_allclose(found, real, atol=0.03 * real[0])
    cells = range(number_of(lamps))
    radii = np.array([lamps.cells.at(index_of(lamps, k, 0))[1].numpy() for k in cells])
    assert radii.max() < 2 * radii.min()


def test_subsets_see_the_same_lamps():
    normals = unit(np.random.default_rng(1).normal(size=(5, 3)))
    lamps = traced(scene_of(lamp=disk(0.5), other=POINT), normals)
    some = lamps.subset(np.array([3, 1, 3]))
    for cell in (0, 3, number_of(lamps) - 1):
        for texel, whole in enumerate((3, 1, 3)):
            a, b = index_of(some, cell, texel), index_of(lamps, cell, whole)
            for x, y in zip(some.cells.at(a), lamps.cells.at(b), strict=True):
                np.testing.assert_array_equal(x.numpy(), y.numpy())
            x, y = (seen.cells.light(place, 1)[0].numpy() for seen, place in
                    ((some, a), (lamps, b)))  # fmt: skip
            np.testing.assert_array_equal(x, y)


@pytest.fixture(scope="module")
def lit_ball(tmp_path_factory):
    """A ball under two lamps, without an environment."""
    paint = {"type": "principled", "base_color": {"type": "rgb", "value": [0.5, 0.3, 0.2]},
             "roughness": 0.4}  # fmt: skip
    mesh = str(write_ball(tmp_path_factory.mktemp("lamps")))
    far = {**POINT, "position": [0, 4, 3], "intensity": {"type": "rgb", "value": [80, 80, 90]}}
    scene = scene_of(
        integrator={"type": "path", "max_depth": 2},
        ball={"type": "ply", "filename": mesh, "bsdf": paint},
        lamp=disk(1.0, 4.0),
        far=far,
    )
    ball = next(shape for shape in scene.shapes() if shape.id() == "ball")
    sensors = sphere_sensors(ball, 14, (32, 32))
    images = render_views(scene, sensors, 128)
    return memory_capture(scene, images, sensors, shape=ball, mesh=ball)


def test_an_object_is_measured_under_lamps(lit_ball):
    chosen = preset("default", method="angular", folds=0)
    texels = svu.texels(lit_ball.mesh, 16)
    estimate = svu.estimate(lit_ball, texels, preset=chosen, known={"metallic": 0.0})
    lit = (texels.normal.z.numpy() > 0.4) & estimate.posterior.observed
    mean = np.array(estimate.posterior.mean("base_color"))[lit].mean(axis=0)
    np.testing.assert_allclose(mean, [0.5, 0.3, 0.2], rtol=0.1)
    roughness = np.array(estimate.posterior.mean("roughness"))[lit].mean()
    assert roughness == pytest.approx(0.4, abs=0.08)


def test_forecasts_contain_lamps(lit_ball):
    require_equal_columns(lit_ball)


def test_what_supports_no_lamps_says_so(lit_ball):
    texels = svu.texels(lit_ball.mesh, 8)
    for call in (
        lambda: svu.estimate(lit_ball, texels, preset="fast"),
        lambda: svu.estimate(lit_ball, texels, method="spectrum"),
        lambda: svu.estimate_light(lit_ball, texels),
        lambda: find_environment(lit_ball.scene, "here"),
    ):
        with pytest.raises(
            SceneError, match=r"\(AreaLight\) is not supported here; the light must"
        ):
            call()
    assert find_light(lit_ball.scene, "here") is None


def test_lamps_are_written_to_scenes(tmp_path):
    """And read back, with their power and place."""
    parts = {**{kind: lamp(kind) for kind in KINDS}, "lamp": disk(0.5)}
    root, scene = scene_xml.scene(), scene_of(**parts)
    for emitter in scene.emitters():
        if emitter.get_shape() is None:
            root.append(scene_xml.lamp(emitter))
    root.append(scene_xml.shape(scene.shapes()[0], tmp_path, "disk"))
    scene_xml.write_document(root, tmp_path / "scene.xml")
    again = load_scene(tmp_path / "scene.xml")
    normals = [[0, 0.6, 0.8], [0, 0, 1]]
    assert len(again.emitters()) == 4
    total = [np.sum([m[0].numpy() for m in traced(s, normals).moments]) for s in (scene, again)]
    assert total[0] == pytest.approx(total[1], rel=1e-5) and total[0] > 10
