"""Light that reaches a point: against form factors, and against every node of the map."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import write_ball
from oracle import angular as oracle

import svu_mi as svu
from svu_mi.interop import owned
from svu_mi.light import light_cells
from svu_mi.light.cells import fibonacci
from svu_mi.light.environment import Environment, directions, quadrature
from svu_mi.light.lighting import band_limit
from svu_mi.reflection.diffuse import diffuse_shading
from svu_mi.visibility import Surface, hemisphere

UP = np.array([0.0, 0, 1])
LAMPS = np.array([[0.3, 0.2, 0.9], [-0.8, 0.5, 0.3], [0.6, -0.7, 0.4], [0.1, 0.2, -1.0]])
LAMPS /= np.linalg.norm(LAMPS, axis=1, keepdims=True)
COLORS = np.array([[3, 2, 1], [4, 4, 5], [0.5, 2, 3], [2, 2, 2.0]])


def points(positions, normals):
    """A surface of a few free points."""
    positions, normals = (np.atleast_2d(x).astype(np.float32).T for x in (positions, normals))
    normal = owned(mi.Normal3f, normals)
    position = owned(mi.Point3f, positions)
    return Surface(position, normal, normal, dr.opaque(mi.Float, 1e-4))


def environment(radiance, to_world=None, disk=None, rows=65):
    """A map of radiance(directions) -> (..., 3), and nodes of a disk."""
    nodes = directions(2 * (rows - 1), rows)
    disk = disk or (np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3)))
    return Environment(radiance(nodes), *disk, np.eye(3) if to_world is None else to_world.T)


def white(d):
    return np.ones((*d.shape[:-1], 3))


def scenery(d):
    return 0.3 + np.exp(20 * (d @ LAMPS.T - 1)) @ COLORS


def rectangle(to_world):
    return {"type": "rectangle", "to_world": to_world, "bsdf": {"type": "diffuse"}}


def scene_of(**shapes):
    """A scene; a far, small plate stands in for nothing at all."""
    far = mi.ScalarTransform4f().translate([0, 0, -1e4]).scale(1e-3)
    return mi.load_dict({"type": "scene", "far": rectangle(far), **shapes}, optimize=False)


def arriving(scene, light, surface, rays=128, channels=3, occluded=True, lobes=True, degree=4):
    return hemisphere(
        scene, surface, band_limit(light, 16), light_cells(light, rays),
        channels=channels, occluded=occluded, lobes=degree if lobes else None,
    )  # fmt: skip


def irradiance(result):
    """(T, C) c0."""
    return np.stack([moments[0].numpy() for moments in result.diffuse], axis=-1)


def every_node(light, sees=lambda d: np.ones(len(d), bool)):
    """World directions and irradiances (flux) of all nodes of a map that a point sees."""
    rows, columns = light.radiance.shape[:2]
    d = directions(columns, rows).reshape(-1, 3) @ light.to_local
    flux = light.radiance * quadrature(rows)[:, None, None] * 2 * np.pi / columns
    return d, flux.reshape(-1, 3) * sees(d)[:, None]


def unit_vectors(rng, count):
    d = rng.normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def rotation(seed):
    turn = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    return turn * np.sign(np.linalg.det(turn))


# --- nothing in the way ---------------------------------------------------------------------


@pytest.mark.parametrize("turned", [False, True])
def test_in_the_open_all_irradiance_arrives(turned):
    light = environment(scenery, rotation(3) if turned else None)
    normals = unit_vectors(np.random.default_rng(19), 30)
    result = arriving(scene_of(), light, points(np.zeros((30, 3)), normals))
    d, flux = every_node(light)
    truth = np.maximum(normals @ d.T, 0) @ flux
    np.testing.assert_allclose(irradiance(result), truth, rtol=5e-3)
    known = band_limit(light, 16).irradiance(owned(mi.Vector3f, normals.T.astype(np.float32)))
    np.testing.assert_allclose(irradiance(result), known.numpy().T, rtol=1e-5)


def test_moments_are_those_of_every_node():
    """Where the light comes from, and what of it grazes: turned with the light, by channel."""
    light = environment(scenery, rotation(8))
    normals = unit_vectors(np.random.default_rng(23), 20)
    result = arriving(scene_of(), light, points(np.zeros((20, 3)), normals), rays=4096)
    d, flux = every_node(light)
    cosine = np.maximum(normals @ d.T, 0)
    for part, first in ((cosine, 0), (cosine * (1 - cosine) ** 5, 4)):
        for channel in range(3):
            weight = part * flux[:, channel]
            truth = np.concatenate([weight.sum(axis=1, keepdims=True), weight @ d], axis=1)
            ours = np.stack([m.numpy() for m in result.diffuse[channel][first : first + 4]], axis=1)
            np.testing.assert_allclose(ours, truth, atol=0.012 * truth[:, 0].max())


def test_grey_is_the_mean_of_the_channels():
    light = environment(scenery)
    surface = points(np.zeros((9, 3)), unit_vectors(np.random.default_rng(2), 9))
    color, grey = (arriving(scene_of(), light, surface, channels=c) for c in (3, 1))
    for k in range(8):
        mean = np.mean([moments[k].numpy() for moments in color.diffuse], axis=0)
        # Each channel is scaled to its own irradiance.
        np.testing.assert_allclose(grey.diffuse[0][k].numpy(), mean, rtol=0.05, atol=0.05)
    np.testing.assert_allclose(irradiance(grey)[:, 0], irradiance(color).mean(axis=1), rtol=1e-5)


@pytest.mark.parametrize("roughness", [0.1, 0.5, 1.0])
def test_disneys_diffuse_is_that_of_every_node(roughness):
    light = environment(scenery, rotation(5))
    rng = np.random.default_rng(41)
    normals = unit_vectors(rng, 12)
    views = unit_vectors(rng, 12) + 1.5 * normals
    views /= np.linalg.norm(views, axis=1, keepdims=True)
    cosine = (normals * views).sum(axis=1)
    result = arriving(scene_of(), light, points(np.zeros((12, 3)), normals), rays=512)
    d, flux = every_node(light)
    for channel in range(3):
        a, b = diffuse_shading(
            "disney", result.diffuse[channel], owned(mi.Vector3f, views.T.astype(np.float32)),
            owned(mi.Float, cosine.astype(np.float32)),
        )  # fmt: skip
        ours = (a + roughness * b).numpy()
        truth = [oracle.diffuse_radiance(d, flux[:, channel], o, n, roughness)
                 for o, n in zip(views, normals, strict=True)]  # fmt: skip
        np.testing.assert_allclose(ours, truth, rtol=0.02)


def test_a_convex_object_hides_nothing_from_itself(tmp_path):
    """All of the light above both horizons, the shading normal's and the facet's."""
    ball = {"type": "ply", "filename": str(write_ball(tmp_path))}
    scene = mi.load_dict({"type": "scene", "ball": ball})
    surface = Surface.of(svu.texels(scene.shapes()[0], 24))
    result = arriving(scene, environment(white), surface)
    visible, all_of_it = (np.stack([x.numpy() for x in field], axis=-1)
                          for field in (result.visible, result.unoccluded))  # fmt: skip
    # Facets and interpolated normals differ by a few degrees: one cell of 64 at the horizon.
    assert ((visible[:, 0] / all_of_it[:, 0]) > 0.9).all()
    assert (visible[:, 0] == all_of_it[:, 0]).mean() > 0.4
    np.testing.assert_allclose(irradiance(result), np.pi, rtol=0.02)


# --- something in the way -------------------------------------------------------------------


def wall(height=1e3):
    """A wall along y that rises at x = 1e-2 and faces the origin."""
    turn = mi.ScalarTransform4f().translate([1e-2, 0, 0]).rotate([0, 1, 0], -90).scale(height)
    return scene_of(wall=rectangle(turn))


def test_a_wall_beside_a_point_takes_half_of_a_white_sky():
    result = arriving(wall(), environment(white), points(np.zeros(3), UP))
    np.testing.assert_allclose(irradiance(result), np.pi / 2, rtol=0.03)
    assert result.visible[0].numpy() / result.unoccluded[0].numpy() == pytest.approx(0.5, abs=0.03)


@pytest.mark.parametrize("turned", [False, True])
def test_a_wall_takes_the_light_that_comes_from_behind_it(turned):
    light = environment(scenery, rotation(13) if turned else None)
    normals = np.array([UP, [-0.6, 0, 0.8], [0, 0.6, 0.8], [0.3, 0.5, -0.8]])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    result = arriving(wall(), light, points(np.zeros((4, 3)), normals), rays=4096)
    d, flux = every_node(light, lambda d: d[:, 0] < 0)
    truth = np.maximum(normals @ d.T, 0) @ flux
    # The wall cuts through cells: a hundredth of the light at most.
    np.testing.assert_allclose(irradiance(result), truth, atol=0.01 * truth.max())


@pytest.mark.parametrize("height", [0.5, 1.0, 3.0])
def test_a_plate_overhead_takes_its_form_factor(height):
    plate = mi.ScalarTransform4f().translate([0, 0, height])
    result = arriving(scene_of(plate=rectangle(plate)), environment(white),
                      points(np.zeros(3), UP), rays=2048)  # fmt: skip
    # A parallel square over one of its corners, four times [Howell, B-4].
    x = 1 / height
    root = np.sqrt(1 + x * x)
    lost = 4 / (2 * np.pi) * 2 * x / root * np.arctan(x / root)
    np.testing.assert_allclose(irradiance(result), np.pi * (1 - lost), atol=0.01 * np.pi)


def test_no_light_reaches_the_inside_of_a_box():
    box = {"type": "cube", "bsdf": {"type": "diffuse"}}
    result = arriving(scene_of(box=box), environment(scenery), points([0.2, 0.1, -0.3], UP))
    assert (irradiance(result) == 0).all()
    assert all((x.numpy() == 0).all() for x in result.visible)
    assert result.unoccluded[0].numpy() > 0


def test_switches_leave_occlusion_out():
    light, surface = environment(scenery), points(np.zeros(3), UP)
    in_the_open = arriving(scene_of(), light, surface)
    diffuse = arriving(wall(), light, surface, occluded=False)
    np.testing.assert_allclose(irradiance(diffuse), irradiance(in_the_open), rtol=1e-6)
    assert diffuse.visible[0].numpy() < 0.9 * diffuse.unoccluded[0].numpy()
    neither = arriving(wall(), light, surface, occluded=False, lobes=False)
    np.testing.assert_allclose(irradiance(neither), irradiance(in_the_open), rtol=1e-6)
    assert neither.visible == []
    assert neither.unoccluded == []


@pytest.mark.parametrize("turned", [False, True])
def test_harmonics_are_those_of_the_light_above_the_horizon(turned):
    light = environment(scenery, rotation(21) if turned else None)
    result = arriving(scene_of(), light, points(np.zeros(3), UP), rays=4096)
    d, flux = every_node(light, lambda d: d[:, 2] > 0)
    basis = np.stack([np.broadcast_to(y.numpy(), len(d)) for y in
                      dr.sh_eval(owned(mi.Vector3f, d.T.astype(np.float32)), 4)])  # fmt: skip
    truth = basis @ flux.sum(axis=1)
    for field in (result.visible, result.unoccluded):
        ours = np.array([x.numpy()[0] for x in field])
        np.testing.assert_allclose(ours, truth, atol=0.02 * truth[0])


# --- a sun ----------------------------------------------------------------------------------


def sunlight(direction, sky=0.0, to_world=None):
    """A sun of irradiance pi in a dim sky; direction is in world space."""
    local = direction if to_world is None else direction @ to_world
    disk = (local[None], np.array([1e-4]), np.full((1, 3), np.pi * 1e4))
    return environment(lambda d: sky * white(d), to_world, disk)


def shade(direction, size=0.03):
    """A small plate, a unit away, that faces the origin from some direction."""
    frame = mi.ScalarTransform4f().look_at(list(direction), [0, 0, 0], [0.1, 0.9, 0.3])
    return scene_of(shade=rectangle(frame @ mi.ScalarTransform4f().scale(size)))


@pytest.mark.parametrize("turned", [False, True])
def test_a_hidden_sun_gives_no_light(turned):
    """Anywhere in its cell: the cell is traced towards the light, not towards its middle."""
    turn = rotation(34) if turned else None
    for sun in unit_vectors(np.random.default_rng(77), 16):
        sun = sun * np.sign(sun @ UP)
        if sun @ UP < 0.2:
            continue
        light, point = sunlight(sun, to_world=turn), points(np.zeros(3), UP)
        lit = irradiance(arriving(scene_of(), light, point))
        hidden = irradiance(arriving(shade(sun), light, point))
        assert (hidden == 0).all()
        # A point light in harmonics of degree 16, cosine-weighted.
        np.testing.assert_allclose(lit, np.pi * (sun @ UP), atol=0.02 * np.pi)


def test_a_plate_beside_the_sun_takes_nothing_of_it():
    sun = np.array([0.36, 0.48, 0.8])
    beside = sun + np.array([0.08, -0.06, 0])  # 6 degrees, well inside the cell
    beside /= np.linalg.norm(beside)
    light, point = sunlight(sun), points(np.zeros(3), UP)
    lit, beside = (irradiance(arriving(s, light, point)) for s in (scene_of(), shade(beside)))
    np.testing.assert_array_equal(lit, beside)


def test_a_hidden_sun_leaves_the_sky():
    sun = np.array([0.36, 0.48, 0.8])
    light, point = sunlight(sun, sky=0.2), points(np.zeros(3), UP)
    hidden = irradiance(arriving(shade(sun), light, point))
    # The sun's cell goes with it: one of 128, pi / 32 sr.
    lost = 0.2 * (4 * np.pi / 128) * 0.8
    np.testing.assert_allclose(hidden, 0.2 * np.pi - lost, rtol=0.05)


# --- cells ----------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [16, 128, 1000])
def test_cells_hold_all_the_light(count):
    sun = np.array([0.36, 0.48, 0.8])
    disk = (sun[None], np.array([1e-3]), np.full((1, 3), 500.0))
    light = environment(scenery, None, disk)
    cells = light_cells(light, count)
    whole = light.coefficients(0)[0] * np.sqrt(4 * np.pi)
    flux = cells.flux.numpy().reshape(count, 3)
    np.testing.assert_allclose(flux.sum(axis=0), whole, rtol=1e-5)
    d = cells.directions.numpy().reshape(count, 3)
    np.testing.assert_allclose(np.linalg.norm(d, axis=1), 1, atol=1e-5)
    assert (flux >= 0).all()


def test_lattice_points_are_evenly_spread():
    d = fibonacci(128)
    np.testing.assert_allclose(np.linalg.norm(d, axis=1), 1, atol=1e-12)
    assert abs(d.mean(axis=0)).max() < 5e-3
    nearest = np.sort(d @ d.T, axis=1)[:, -2]
    assert np.degrees(np.arccos(nearest)).min() > 12
