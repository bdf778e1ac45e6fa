"""Filtered light against quadrature around one direction at a time."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from oracle import angular as oracle
from support.helpers import unit, unit_vectors

from svu_mi.core.arrays import to_drjit
from svu_mi.light import prefiltered as module
from svu_mi.light.band_limited import band_limited_lighting, lat_long_texture, look_up
from svu_mi.light.environment import Environment, read_environment
from svu_mi.light.latlong import directions, quadrature
from svu_mi.light.prefiltered import convolve, filter_light, rasterized
from svu_mi.reflection.lobes import lobe_profile, zonal_profile

KINDS = ["ggx", "gaussian"]
ROWS = [256, 129]  # even, as most maps have; odd, with a row on the equator


LAMPS = unit_vectors(np.random.default_rng(5), 6)
POWERS = np.array([4.0, 2.0, 3.0, 1.0, 5.0, 2.0])


def scenery(d):
    """Six soft lamps and a gradient: smooth at the resolution of the maps here."""
    return 0.4 + 0.3 * d[..., 1] + np.exp(60 * (d @ LAMPS.T - 1)) @ POWERS


def sampled(function, rows):
    return function(directions(2 * (rows - 1), rows))[..., None]


def at(grid, d):
    """Bilinear look-up as kernels do it."""
    values = look_up(lat_long_texture(grid), to_drjit(mi.Vector3f, d.T.astype(np.float32)))
    return np.stack([v.numpy() for v in values], axis=-1)


def test_gpus_interpolate_in_single_precision():
    # Their texture units have 8 bits for the place between two texels.
    assert not lat_long_texture(np.ones((3, 4, 1))).use_accel()


def integral(grid):
    rows, columns = grid.shape[:2]
    return (grid * quadrature(rows)[:, None, None]).sum(axis=(0, 1)) * 2 * np.pi / columns


def spot(rows, row, column, flux=1.0):
    """Black but for one node, of a given irradiance."""
    grid = np.zeros((rows, 2 * (rows - 1), 1))
    grid[row, column] = flux / (quadrature(rows)[row] * np.pi / (rows - 1))
    return grid


@pytest.mark.parametrize("alpha", [0.03, 0.1, 0.3, 0.6, 1.0])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("rows", ROWS)
def test_a_level_is_the_average_under_the_lobe(rows, kind, alpha):
    level = convolve(sampled(scenery, rows), alpha, partial(zonal_profile, kind, alpha))
    # Poles, equator, the seam of the map, and anywhere.
    special = np.array([[0, 1, 0], [0, -1, 0], [1, 0, 0], [1e-3, 0.2, -1]])
    d = unit(np.concatenate([special, unit_vectors(np.random.default_rng(17), 16)]))
    truth = np.array([oracle.lobe_average(scenery, x, kind, alpha) for x in d])
    np.testing.assert_allclose(at(level, d)[:, 0], truth, rtol=1e-2, atol=5e-3)


@pytest.mark.parametrize("alpha", [0.02, 0.1, 0.3, 1.0])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("rows", ROWS)
def test_no_light_is_lost(rows, kind, alpha):
    grid = sampled(scenery, rows)
    level = convolve(grid, alpha, partial(zonal_profile, kind, alpha))
    assert (level >= 0).all()
    np.testing.assert_allclose(integral(level), integral(grid), rtol=2e-3)


@pytest.mark.parametrize("alpha", [0.1, 0.3, 1.0])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("row", [0, 1, 2, 20, 40, 128, 255])
def test_one_bright_node_comes_through(row, kind, alpha):
    """A sun, overhead too: its light is the lobe's shape, as if it were a direction."""
    grid = spot(256, row, 77)
    level = convolve(grid, alpha, partial(zonal_profile, kind, alpha))
    sun = directions(510, 256)[row, 77]
    ring = np.array([np.cos(1.0), 0, np.sin(1.0)])
    off = np.cross(sun, ring) / np.linalg.norm(np.cross(sun, ring))
    angle = np.array([0, 0.5, 1.0]) * alpha
    d = np.cos(angle)[:, None] * sun + np.sin(angle)[:, None] * off
    fine = np.linspace(0, np.pi, 20001)
    area = np.trapezoid(oracle.lobe(kind, alpha, fine) * np.sin(fine), fine) * 2 * np.pi
    truth = oracle.lobe(kind, alpha, angle) / area
    np.testing.assert_allclose(at(level, d)[:, 0], truth, rtol=0.03)


def lamp_environment(to_world=None):
    """A dim map with lamps, and a sun of its own on a disk."""
    sun = np.array([0.3, 0.8, -0.5])
    sun /= np.linalg.norm(sun)
    grid = np.repeat(sampled(scenery, 129), 3, axis=2) * [1.0, 0.5, 0.25]
    spread = unit(sun + 0.004 * np.random.default_rng(9).normal(size=(50, 3)))
    to_local = np.eye(3) if to_world is None else to_world.T
    return sun, Environment(
        grid, spread, np.full(50, 1e-6), np.full((50, 3), 2e5) * [1.0, 0.9, 0.7], to_local
    )


def test_a_narrow_lobe_is_a_mirror():
    grid = np.random.default_rng(2).random((65, 128, 3))
    np.testing.assert_array_equal(convolve(grid, 1e-3, partial(zonal_profile, "ggx", 1e-3)), grid)


def test_a_suns_disk_keeps_its_energy_and_its_place():
    sun, environment = lamp_environment()
    grid = rasterized(environment)
    excess = grid - environment.radiance
    np.testing.assert_allclose(integral(excess), [10, 9, 7], rtol=1e-9)
    columns, rows = grid.shape[1], grid.shape[0]
    weight = excess[..., 0] * quadrature(rows)[:, None] * 2 * np.pi / columns
    middle = (weight[..., None] * directions(columns, rows)).sum(axis=(0, 1))
    assert np.arccos(middle @ sun / np.linalg.norm(middle)) < np.pi / rows


@pytest.mark.parametrize("row, column", [(0, 3), (5, 0), (32, 127), (40, 64)])
def test_a_small_disk_lands_on_the_node_nearest_to_it(row, column):
    """Also at a pole and at the seam of the map."""
    nodes = directions(128, 65)
    beside = nodes[row, column] + [4e-4, -3e-4, 5e-4]
    beside /= np.linalg.norm(beside)
    disk = beside[None], np.array([1e-4]), np.ones((1, 3))
    lit = np.argwhere(rasterized(Environment(np.zeros((65, 128, 3)), *disk, np.eye(3)))[..., 0] > 0)
    assert len(lit) == 1 and lit[0, 0] == row
    assert nodes[tuple(lit[0])] @ nodes[row, column] > 1 - 1e-9


def test_the_sun_of_a_sky_is_in_all_levels():
    sky = mi.load_dict({"type": "sunsky", "sun_direction": [0.4, 0.6, 0.7], "turbidity": 3.0})
    environment = read_environment(sky)
    assert len(environment.disk_weights) > 0
    grid = rasterized(environment)
    whole = environment.coefficients(0)[0] * np.sqrt(4 * np.pi)
    np.testing.assert_allclose(integral(grid), whole, rtol=1e-6)
    for alpha in (0.1, 0.4):
        level = convolve(grid, alpha, partial(zonal_profile, "ggx", alpha))
        np.testing.assert_allclose(integral(level), whole, rtol=1e-2)


@pytest.mark.parametrize("grey", [False, True])
def test_levels_turn_with_the_light(grey):
    """``to_world`` of the emitter applies to look-ups, and grey is the mean of the channels."""
    turn = np.linalg.qr(np.random.default_rng(31).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    _, environment = lamp_environment(turn)
    lighting = band_limited_lighting(environment, 20)
    widths = [1e-3, 0.1, 0.6]
    levels = filter_light(lighting, widths, partial(zonal_profile, "ggx"), grey=grey)
    assert levels.count == 3
    local = unit_vectors(np.random.default_rng(13), 60)
    world = to_drjit(mi.Vector3f, (local @ turn.T).T.astype(np.float32))
    for k, alpha in enumerate(widths):
        values = levels.radiance(k, world)
        dr.eval(values)
        ours = np.stack([v.numpy() for v in values], axis=-1)
        grid = convolve(rasterized(environment), alpha, partial(zonal_profile, "ggx", alpha))
        truth = at(grid, local)
        truth = truth.mean(axis=1, keepdims=True) if grey else truth
        np.testing.assert_allclose(ours, truth, rtol=5e-3, atol=1e-3)


def test_light_is_filtered_once_for_the_same_lobe(monkeypatch):
    widths = []
    monkeypatch.setattr(module, "convolve", lambda grid, width, _: widths.append(width) or grid)
    lighting = band_limited_lighting(lamp_environment(np.eye(3))[1], 20)
    first = filter_light(lighting, [0.1, 0.3], lobe_profile("ggx"))
    again = filter_light(lighting, [0.3, 0.1, 0.2], lobe_profile("ggx"))
    assert sorted(widths) == [0.1, 0.2, 0.3]
    assert again.textures[:2] == first.textures[::-1]
    filter_light(lighting, [0.1], lobe_profile("gaussian"))
    filter_light(lighting, [0.1], lobe_profile("ggx"), grey=True)
    assert widths[3:] == [0.1, 0.1]
    filter_light(replace(lighting, prefilter=0.5), [0.1], lobe_profile("ggx"))
    assert len(widths) == 6


@pytest.mark.few(1)
@pytest.mark.parametrize("alpha", [0.055, 0.068, 0.0816])
def test_a_column_is_as_bright_wherever_it_stands(alpha):
    """New columns do not stand for equal shares of the old: each brings its own solid angle."""
    energy = []
    for column in range(0, 64, 7):
        grid = np.zeros((257, 512, 1))
        grid[128, column] = 1
        level = convolve(grid, alpha, partial(zonal_profile, "ggx", alpha))
        energy.append((level[..., 0].mean(axis=1) * quadrature(len(level))).sum())
    exact = quadrature(257)[128] / 512
    np.testing.assert_allclose(energy, exact, rtol=1e-3)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("rows", [*ROWS, 33])
def test_a_constant_stays_what_it_is(rows, kind):
    grid = np.full((rows, 2 * (rows - 1), 2), 3.7)
    for alpha in (1e-3, 0.02, 0.1, 0.5, 1.0):
        level = convolve(grid, alpha, partial(zonal_profile, kind, alpha))
        np.testing.assert_allclose(level, 3.7, rtol=1e-12)
