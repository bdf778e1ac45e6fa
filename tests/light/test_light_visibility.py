"""What of the light reaches a surface: against single rays, form factors, every node of a map."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.helpers import bits_of, unit, unit_vectors, write_ball
from support.walled import noise_capture, walled_ball

import svu_mi as svu
from svu_mi.core.arrays import to_drjit
from svu_mi.geometry.sample_view import TexelLanes
from svu_mi.light.band_limited import band_limited_lighting
from svu_mi.light.environment import Environment
from svu_mi.light.latlong import directions, quadrature
from svu_mi.light.light_tree import build_light_tree
from svu_mi.light.light_visibility import trace_light_visibility
from svu_mi.posterior.observations import observe

UP = np.array([0.0, 0, 1])
LAMPS = unit(np.array([[0.3, 0.2, 0.9], [-0.8, 0.5, 0.3], [0.6, -0.7, 0.4], [0.1, 0.2, -1.0]]))
COLORS = np.array([[3, 2, 1], [4, 4, 5], [0.5, 2, 3], [2, 2, 2.0]])


def points(positions, normals):
    """A surface of a few free points."""
    positions, normals = (np.atleast_2d(x).astype(np.float32).T for x in (positions, normals))
    normal = to_drjit(mi.Normal3f, normals)
    position = to_drjit(mi.Point3f, positions)
    return TexelLanes(position, normal, normal, dr.opaque(mi.Float, 1e-4))


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


def tree(light, fine):
    """Cells as ``Observed.light_tree`` makes them."""
    return build_light_tree(light, max(fine // 8, 16), fine)


def arriving(scene, light, surface, cells=1024, channels=3, occluded=True):
    """(channels, 8) moments (T,)."""
    visibility = trace_light_visibility(scene, surface, tree(light, cells), occluded=occluded)
    return visibility.diffuse(surface, band_limited_lighting(light, 16), channels)


def irradiance(moments):
    """(T, C) c0."""
    return np.stack([of_channel[0].numpy() for of_channel in moments], axis=-1)


def every_node(light, sees=lambda d: np.ones(len(d), bool)):
    """World directions and irradiances (flux) of all nodes of a map that a point sees."""
    rows, columns = light.radiance.shape[:2]
    d = directions(columns, rows).reshape(-1, 3) @ light.to_local
    flux = light.radiance * quadrature(rows)[:, None, None] * 2 * np.pi / columns
    return d, flux.reshape(-1, 3) * sees(d)[:, None]


def rotation(seed):
    turn = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    return turn * np.sign(np.linalg.det(turn))


# --- nothing in the way ---------------------------------------------------------------------


def test_moments_are_those_of_every_node():
    """Where the light comes from, and what of it grazes: turned with the light, by channel."""
    light = environment(scenery, rotation(8))
    normals = unit_vectors(np.random.default_rng(23), 20)
    result = arriving(scene_of(), light, points(np.zeros((20, 3)), normals), cells=4096)
    d, flux = every_node(light)
    cosine = np.maximum(normals @ d.T, 0)
    for part, first in ((cosine, 0), (cosine * (1 - cosine) ** 5, 4)):
        for channel in range(3):
            weight = part * flux[:, channel]
            truth = np.concatenate([weight.sum(axis=1, keepdims=True), weight @ d], axis=1)
            ours = np.stack([m.numpy() for m in result[channel][first : first + 4]], axis=1)
            np.testing.assert_allclose(ours, truth, atol=0.012 * truth[:, 0].max())


def test_a_convex_object_hides_nothing_from_itself(tmp_path):
    """All of the light above both horizons, the shading normal's and the facet's."""
    ball = {"type": "ply", "filename": str(write_ball(tmp_path))}
    scene = mi.load_dict({"type": "scene", "ball": ball})
    surface = TexelLanes.of(svu.texels(scene.shapes()[0], 24))
    light = environment(white)
    visibility = trace_light_visibility(scene, surface, tree(light, 1024))
    above = directly(scene, surface, visibility.tree.fine, occluded=False)
    assert bits_of(visibility.fine, 1024, surface.count)[above].all()
    result = visibility.diffuse(surface, band_limited_lighting(light, 16), 3)
    np.testing.assert_allclose(irradiance(result), np.pi, rtol=0.02)


# --- something in the way -------------------------------------------------------------------


def wall(height=1e3):
    """A wall along y that rises at x = 1e-2 and faces the origin."""
    turn = mi.ScalarTransform4f().translate([1e-2, 0, 0]).rotate([0, 1, 0], -90).scale(height)
    return scene_of(wall=rectangle(turn))


@pytest.mark.parametrize("turned", [False, True])
def test_a_wall_takes_the_light_that_comes_from_behind_it(turned):
    light = environment(scenery, rotation(13) if turned else None)
    normals = unit(np.array([UP, [-0.6, 0, 0.8], [0, 0.6, 0.8], [0.3, 0.5, -0.8]]))
    result = arriving(wall(), light, points(np.zeros((4, 3)), normals), cells=4096)
    d, flux = every_node(light, lambda d: d[:, 0] < 0)
    truth = np.maximum(normals @ d.T, 0) @ flux
    # The wall cuts through cells: a hundredth of the light at most.
    np.testing.assert_allclose(irradiance(result), truth, atol=0.01 * truth.max())


def test_no_light_reaches_the_inside_of_a_box():
    box = {"type": "cube", "bsdf": {"type": "diffuse"}}
    scene, surface = scene_of(box=box), points([0.2, 0.1, -0.3], UP)
    light = environment(scenery)
    visibility = trace_light_visibility(scene, surface, tree(light, 1024))
    assert not bits_of(visibility.fine, 1024, 1).any()
    result = visibility.diffuse(surface, band_limited_lighting(light, 16), 3)
    assert all((moment.numpy() == 0).all() for of_channel in result for moment in of_channel)


def test_switches_leave_occlusion_out():
    light, surface = environment(scenery), points(np.zeros(3), UP)
    in_the_open = arriving(scene_of(), light, surface)
    left_out = arriving(wall(), light, surface, occluded=False)
    np.testing.assert_allclose(irradiance(left_out), irradiance(in_the_open), rtol=1e-6)
    hidden = arriving(wall(), light, surface)
    assert (irradiance(hidden) < 0.9 * irradiance(in_the_open)).all()


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


@pytest.mark.few(1)
@pytest.mark.parametrize("cells", [128, 1024])
@pytest.mark.parametrize("turned", [False, True])
def test_a_hidden_sun_gives_no_light(turned, cells):
    """Anywhere in its cell: the cell is traced towards the light, not towards its middle."""
    turn = rotation(34) if turned else None
    for sun in unit_vectors(np.random.default_rng(77), 8):
        sun = sun * np.sign(sun @ UP)
        if sun @ UP < 0.2:
            continue
        light, point = sunlight(sun, to_world=turn), points(np.zeros(3), UP)
        lit = irradiance(arriving(scene_of(), light, point, cells))
        hidden = irradiance(arriving(shade(sun), light, point, cells))
        assert (hidden == 0).all()
        # A point light in harmonics of degree 16, cosine-weighted.
        np.testing.assert_allclose(lit, np.pi * (sun @ UP), atol=0.02 * np.pi)


def test_a_hidden_sun_leaves_the_sky():
    sun = np.array([0.36, 0.48, 0.8])
    light, point = sunlight(sun, sky=0.2), points(np.zeros(3), UP)
    hidden = irradiance(arriving(shade(sun), light, point, 128))
    # The sun's cell goes with it, and it is as small as its light: 1 / 128 at most, pi / 32 sr.
    lost = 0.2 * (4 * np.pi / 128) * 0.8
    np.testing.assert_allclose(hidden, 0.2 * np.pi - lost, rtol=0.05)


def test_a_plate_beside_the_sun_takes_nothing_of_it():
    sun = np.array([0.36, 0.48, 0.8])
    beside = sun + np.array([0.08, -0.06, 0])  # 6 degrees, well inside the cell
    beside /= np.linalg.norm(beside)
    light, point = sunlight(sun), points(np.zeros(3), UP)
    lit, beside = (irradiance(arriving(s, light, point)) for s in (scene_of(), shade(beside)))
    np.testing.assert_array_equal(lit, beside)


# --- bits -----------------------------------------------------------------------------------


def directly(scene, surface, cells, occluded=True):
    """(N, T) bool: above both horizons, and seen along a ray of its own, cell by cell."""
    toward = cells.toward.numpy().reshape(-1, 4)[:, :3]
    count = surface.count
    lane = to_drjit(mi.UInt32, np.tile(np.arange(count, dtype=np.uint32), len(toward)))
    position, normal, geometric = (
        dr.gather(type(x), x, lane)
        for x in (surface.position, surface.normal, surface.geometric_normal)
    )
    d = to_drjit(mi.Vector3f, np.repeat(toward, count, axis=0).T)
    free = (dr.dot(normal, d) > 0) & (dr.dot(geometric, d) > 0)
    if occluded:
        free &= ~scene.ray_test(mi.Ray3f(position + surface.offset * geometric, d))
    return free.numpy().reshape(-1, count)


def inherited(cells, coarse, direct, high, several):
    """(N_f, T) the rule in words, from bits of coarse cells, and of fine ones if all were traced.

    A fine cell is seen as its coarse cell is, where that one is above the horizon (``high``,
    (N_c, T)), and all of its group are the same or the fine cell is dim; else by a ray of its own.
    If there are ``several`` shapes, it is for dim cells only.
    """
    first, groups = cells.first.numpy(), cells.groups.numpy()
    flux = cells.fine.flux.numpy().reshape(-1, 4)[:, 3]
    bright = flux > 0.25 * flux.mean()
    np.testing.assert_array_equal(cells.bright.numpy() > 0, bright)
    result = np.zeros_like(direct)
    for start, end in zip(groups[:-1], groups[1:], strict=True):
        mixed = several | coarse[start:end].any(axis=0) & ~coarse[start:end].all(axis=0)
        for cell in range(start, end):
            for below in range(first[cell], first[cell + 1]):
                own = (mixed & bright[below]) | ~high[cell]
                result[below] = np.where(own, direct[below], coarse[cell])
    return result


def surroundings(several=True):
    """Points of all sorts between a wall, a plate and a box, or near the wall."""
    rng = np.random.default_rng(66120)
    turn = mi.ScalarTransform4f().translate([0.4, 0, 0]).rotate([0, 1, 0], -90).scale(0.7)
    plate = mi.ScalarTransform4f().translate([-0.5, 0.3, 0.6]).scale(0.3)
    box = mi.ScalarTransform4f().translate([-0.3, -0.8, -0.2]).scale(0.25)
    others = {"plate": rectangle(plate),
              "box": {"type": "cube", "to_world": box, "bsdf": {"type": "diffuse"}}}  # fmt: skip
    wall = {"type": "scene", "wall": rectangle(turn)}
    scene = scene_of(**wall, **others) if several else mi.load_dict(wall)
    normals = unit_vectors(rng, 40)
    tilted = normals + 0.2 * unit_vectors(rng, 40)  # facets are not smooth
    tilted /= np.linalg.norm(tilted, axis=1, keepdims=True)
    surface = points(rng.uniform(-0.2, 0.2, (40, 3)), normals)
    geometric = to_drjit(mi.Normal3f, tilted.T.astype(np.float32))
    return scene, TexelLanes(surface.position, surface.normal, geometric, surface.offset)


@pytest.mark.parametrize("several", [True, False])
@pytest.mark.parametrize("occluded", [True, False])
@pytest.mark.parametrize(("coarse", "fine"), [(128, 1024), (64, 512), (64, 256), (100, 100)])
def test_bits_equal_those_of_single_rays(coarse, fine, occluded, several):
    """All bright cells are traced if there are several shapes."""
    scene, surface = surroundings(several)
    assert (len(scene.shapes()) > 1) == several
    cells = build_light_tree(environment(scenery, rotation(4)), coarse, fine)
    visibility = trace_light_visibility(scene, surface, cells, occluded=occluded)
    above = directly(scene, surface, cells.coarse, occluded)
    exact = directly(scene, surface, cells.fine, occluded)
    ours = bits_of(visibility.fine, fine, 40)
    high = directly(scene, surface, cells.coarse, False)
    np.testing.assert_array_equal(ours, inherited(cells, above, exact, high, several))
    # What is inherited is nearly always right, and nearly all of the light.
    flux = cells.fine.flux.numpy().reshape(-1, 4)[:, 3]
    assert 0.1 < exact.mean() < 0.6
    assert (ours == exact).mean() > 0.95
    assert (flux @ (ours != exact)).mean() < 0.03 * flux.sum()


@pytest.mark.parametrize("channels", [3, 1])
@pytest.mark.parametrize("turned", [False, True])
def test_diffuse_moments_are_sums_over_visible_cells(turned, channels):
    """In float64, of the irradiance that an open surface would have."""
    scene, surface = surroundings()
    light = environment(scenery, rotation(31) if turned else None)
    visibility, lighting = (
        trace_light_visibility(scene, surface, tree(light, 1024)),
        band_limited_lighting(light, 16),
    )
    ours = np.array(
        [[x.numpy() for x in c] for c in visibility.diffuse(surface, lighting, channels)]
    )
    cells = visibility.tree.fine
    toward = cells.toward.numpy().reshape(-1, 4)[:, :3].astype(np.float64)
    flux = cells.flux.numpy().reshape(-1, 4).astype(np.float64)
    flux = flux[:, :3] if channels == 3 else flux[:, 3:]
    normal = surface.normal.numpy().T.astype(np.float64)
    cosine = np.maximum(toward @ normal.T, 0)  # (N, T)
    seen = bits_of(visibility.fine, 1024, 40)
    known = lighting.irradiance(surface.normal).numpy().T
    known = known if channels == 3 else known.mean(axis=1, keepdims=True)
    for c in range(channels):
        scale = np.maximum(known[:, c], 0) / (flux[:, c] @ cosine)
        for part, first in ((cosine, 0), (cosine * (1 - cosine) ** 5, 4)):
            weight = flux[:, c, None] * part * seen * scale
            truth = np.concatenate([weight.sum(axis=0)[None], toward.T @ weight])
            size = np.abs(truth[0]).max()
            np.testing.assert_allclose(ours[c, first : first + 4], truth, atol=1e-5 * size)


# --- mirrors --------------------------------------------------------------------------------


def test_mirror_bits_equal_those_of_single_rays(tmp_path):
    """Of every sample; below the horizon nothing is free, nor where a view sees nothing."""
    capture = noise_capture(walled_ball(tmp_path))
    observed = observe(capture, svu.texels(capture.mesh, 16))
    surface, visibility = observed.surface, observed.visibility
    for slot in range(int(visibility.count[0])):
        place = dr.opaque(mi.UInt32, slot)
        seen = visibility.sample(observed.views, surface, place)
        n = mi.Vector3f(surface.normal)
        mirror = 2 * dr.dot(n, seen.direction) * n - seen.direction
        origin = surface.position + surface.offset * surface.geometric_normal
        free = seen.seen & (dr.dot(surface.geometric_normal, mirror) > 0)
        free &= ~capture.scene.ray_test(mi.Ray3f(origin, mirror))
        ours = observed.mirrors.test(place, surface.index).numpy()
        on = seen.seen.numpy()
        np.testing.assert_array_equal(ours[on], free.numpy()[on])
        assert not ours[~on].any()
    assert observed.mirrors is observed.mirrors  # traced once


def turns():
    """A white sky whose cells lie differently every time."""
    return [environment(white, rotation(seed)) for seed in range(16)]


def root_mean_square(errors):
    return np.sqrt(np.mean(np.square(errors)))


@pytest.mark.slow
def test_a_plate_overhead_takes_its_form_factor():
    heights, surface = (0.5, 1.0, 3.0), points(np.zeros(3), UP)
    plates = [rectangle(mi.ScalarTransform4f().translate([0, 0, h])) for h in heights]
    irradiances = []
    for sky in turns():
        cells, lighting = tree(sky, 2048), band_limited_lighting(sky, 16)
        reached = (
            trace_light_visibility(scene_of(plate=plate), surface, cells) for plate in plates
        )
        irradiances.append(
            [irradiance(visibility.diffuse(surface, lighting, 3)) for visibility in reached]
        )
    for height, ours in zip(heights, np.moveaxis(irradiances, 1, 0), strict=True):
        # A parallel square over one of its corners, four times [Howell, B-4].
        x = 1 / height
        root = np.sqrt(1 + x * x)
        lost = 4 / (2 * np.pi) * 2 * x / root * np.arctan(x / root)
        assert root_mean_square(ours / np.pi - (1 - lost)) < 0.01
