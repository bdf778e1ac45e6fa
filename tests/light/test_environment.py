"""Light: harmonics against Dr.Jit, integrals against exact ones, orientation against a render."""

from __future__ import annotations

import sys

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.helpers import python, unit, unit_vectors

from svu_mi.core.arrays import fibonacci, to_drjit
from svu_mi.core.io.exr import write_exr
from svu_mi.errors import OptionError, SceneError
from svu_mi.light import latlong
from svu_mi.light.band_limited import band_limited_lighting, degrees, zonal_cosine
from svu_mi.light.environment import (
    Environment,
    analyze,
    basis_at,
    directions,
    lat_long,
    polar_from_local,
    quadrature,
    read_environment,
    synthesize,
)
from svu_mi.light.light_tree import LARGEST, build_light_tree


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


@pytest.mark.parametrize("rows", [5, 8, 33, 128])
def test_quadrature_is_exact_for_polynomials(rows):
    x = np.cos(np.pi * np.arange(rows) / (rows - 1))
    weights = quadrature(rows)
    assert (weights > 0).all()
    for power in range(rows - 1):
        exact = 2 / (power + 1) if power % 2 == 0 else 0
        assert weights @ x**power == pytest.approx(exact, abs=1e-12)


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


@pytest.mark.few(2)
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

    lighting = band_limited_lighting(read_environment(emitter), 400)
    ours = lighting.radiance(mi.Vector3f(np.ascontiguousarray(d.T, np.float32))).numpy().T
    direction = d[ours.sum(axis=1).argmax()]
    assert np.linalg.norm(direction - brightest) < np.radians(3.5)  # a texel is 2.8 degrees wide


def test_lookups_of_the_filtered_light_agree_with_its_expansion():
    pixels = np.random.default_rng(3391).uniform(size=(33, 64, 3)) ** 8
    lighting = band_limited_lighting(read_environment(envmap(pixels)), 60)
    d = unit_vectors(np.random.default_rng(3392), 500)
    c = lighting.coefficients * np.exp(-((60**-0.5 * degrees(lighting.degree)) ** 2))[:, None]
    exact = basis_at(polar_from_local(d), lighting.degree) @ c
    ours = lighting.radiance(mi.Vector3f(np.ascontiguousarray(d.T, np.float32))).numpy().T
    np.testing.assert_allclose(ours, exact, atol=5e-3 * exact.max())  # bilinear lookup


def test_light_at_the_poles_and_the_seam_has_no_jump():
    pixels = np.random.default_rng(7712).uniform(size=(33, 64, 3))
    lighting = band_limited_lighting(read_environment(envmap(pixels)), 60)
    eps = 1e-3
    for d in ([0, 1, 0], [0, -1, 0], [0, 0.3, -1]):
        side = np.cross(d, [0.3, 0.1, 0.7])
        around = unit(np.array([np.add(d, eps * s * side) for s in (-1, 0, 1)]))
        values = lighting.radiance(mi.Vector3f(np.ascontiguousarray(around.T, np.float32))).numpy()
        assert np.ptp(values, axis=1).max() < 5e-3 * values.max()


@pytest.mark.few(1)
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
    light = band_limited_lighting(read_environment(scene.emitters()[0]), 60)
    ours = light.irradiance(mi.Vector3f(n.astype(np.float32))).numpy().ravel()
    np.testing.assert_allclose(ours, rendered, rtol=0.015)  # Monte Carlo: below 0.5 %


@pytest.mark.parametrize("power", [0, 5])
def test_zonal_factors_integrate_a_hemisphere(power):
    x, w = np.polynomial.legendre.leggauss(400)
    for l, factor in enumerate(zonal_cosine(12, power)):
        legendre = np.polynomial.legendre.Legendre.basis(l)(x)
        exact = 2 * np.pi * (w * np.maximum(x, 0) * (1 - x) ** power * legendre).sum()
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


# --- cells ----------------------------------------------------------------------------------

LAMPS = unit_vectors(np.random.default_rng(611), 4)


def lamps(rows=65, to_world=None, disk=None):
    """A dim sky with soft lamps, and perhaps a sun on a disk."""
    nodes = directions(2 * (rows - 1), rows)
    radiance = 0.3 + np.exp(20 * (nodes @ LAMPS.T - 1)) @ np.array(
        [[3, 2, 1], [4, 4, 5], [0.5, 2, 3], [2, 2, 2.0]]
    )
    disk = disk or (np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3)))
    return Environment(radiance, *disk, np.eye(3) if to_world is None else to_world.T)


def sun(direction=(0.36, 0.48, 0.8)):
    return np.array([direction]), np.array([1e-3]), np.full((1, 3), 500.0)


def values(cells):
    """Directions (N, 3), radii (N,), flux (N, 3) and its mean (N,), float64."""
    toward = cells.toward.numpy().reshape(-1, 4).astype(np.float64)
    flux = cells.flux.numpy().reshape(-1, 4).astype(np.float64)
    return toward[:, :3], toward[:, 3], flux[:, :3], flux[:, 3]


SIZES = [(1, 1), (16, 16), (16, 128), (128, 1024), (512, 4096)]


@pytest.mark.parametrize(("coarse", "fine"), SIZES)
def test_cells_hold_all_the_light(coarse, fine):
    light = lamps(disk=sun())
    whole = light.coefficients(0)[0] * np.sqrt(4 * np.pi)
    tree = build_light_tree(light, coarse, fine)
    assert (tree.coarse.number, tree.fine.number) == (coarse, fine)
    for cells in (tree.coarse, tree.fine, tree.leaves):
        toward, radius, flux, grey = values(cells)
        assert len(toward) == cells.number == int(cells.count[0])
        np.testing.assert_allclose(flux.sum(axis=0), whole, rtol=1e-5)
        np.testing.assert_allclose(grey, flux.mean(axis=1), rtol=1e-5, atol=1e-12)
        np.testing.assert_allclose(np.linalg.norm(toward, axis=1), 1, atol=1e-5)
        assert (flux >= 0).all() and (radius >= 0).all()


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize(("coarse", "fine"), SIZES)
def test_a_cell_is_the_sum_of_those_below_it(coarse, fine, turned):
    """Flux, direction (the centroid of radiance) and radius: all follow from the leaves."""
    turn = np.linalg.qr(np.random.default_rng(31).normal(size=(3, 3)))[0] if turned else None
    tree = build_light_tree(lamps(to_world=turn, disk=sun()), coarse, fine)
    for above, below, first in (
        (tree.coarse, tree.fine, tree.first), (tree.fine, tree.leaves, tree.first_leaf)
    ):  # fmt: skip
        starts = first.numpy().astype(int)
        assert starts[0] == 0 and starts[-1] == below.number and (np.diff(starts) > 0).all()
        owner = np.repeat(np.arange(above.number), np.diff(starts))
        toward, radius, flux, _ = values(below)
        # Half a disk's squared radius is 1 - |mean|^2 of its directions.
        pull = flux.sum(axis=1, keepdims=True) * toward * np.sqrt(1 - radius[:, None] ** 2 / 2)
        sums = np.zeros((above.number, 6))
        np.add.at(sums, owner, np.hstack([flux, pull]))
        ours, size, light, _ = values(above)
        np.testing.assert_allclose(light, sums[:, :3], rtol=1e-5)
        length = np.linalg.norm(sums[:, 3:], axis=1)
        lit = length > 0  # leaves of a small map may hold none of its nodes
        assert lit.mean() > 0.4
        ours, size, sums, length = ours[lit], size[lit], sums[lit], length[lit]
        np.testing.assert_allclose(ours, sums[:, 3:] / length[:, None], atol=1e-4)
        spread = np.sqrt(np.maximum(2 * (1 - (length / sums[:, :3].sum(axis=1)) ** 2), 0))
        # 1 - |mean|^2 of small cells is a difference of single precision here.
        np.testing.assert_allclose(size, spread, atol=2e-3)


def test_coarse_cells_are_divided_until_their_fine_cells_fit_a_word():
    tree = build_light_tree(lamps(disk=sun()), 1, 256)
    assert 8 <= tree.coarse.number < 256
    assert np.diff(tree.first.numpy().astype(int)).max() <= 32


@pytest.mark.parametrize(("coarse", "fine"), SIZES)
def test_groups_are_runs_of_neighbours_that_fit_a_word(coarse, fine):
    tree = build_light_tree(lamps(), coarse, fine)
    edges = tree.groups.numpy().astype(int)
    assert edges[0] == 0 and edges[-1] == coarse and (np.diff(edges) > 0).all()
    assert np.diff(edges).max() <= LARGEST <= 32
    assert int(tree.group_count[0]) == len(edges) - 1
    grey = values(tree.fine)[3]
    np.testing.assert_array_equal(tree.bright.numpy() > 0, grey > 0.25 * grey.mean())
    if coarse >= 128:  # those of a group are nearer to each other than to others
        toward = values(tree.coarse)[0]
        same = np.repeat(np.arange(len(edges) - 1), np.diff(edges))
        near = np.arccos(np.clip(toward @ toward.T, -1, 1))
        together = (same[:, None] == same) & ~np.eye(coarse, dtype=bool)
        assert near[together].mean() < 0.5 * near[~together].mean()


def test_cells_are_small_where_the_light_is_bright():
    """What a lobe sees of them, against leaves: better than even cells of the same number."""
    rng = np.random.default_rng(77123)
    image = rng.uniform(0.1, 0.3, (24, 48, 3))
    image[5:7, 30:32] = (60, 50, 40)
    tree = build_light_tree(read_environment(envmap(image)), 64, 64)
    looks = unit_vectors(rng, 200)
    toward, _, flux, _ = values(tree.leaves)

    def seen(toward, flux):
        return np.exp((looks @ toward.T - 1) / 0.3**2) @ flux.sum(axis=1)

    nearest = (toward @ fibonacci(64).T).argmax(axis=1)
    sums, pull = np.zeros((64, 3)), np.zeros((64, 3))
    np.add.at(sums, nearest, flux)
    np.add.at(pull, nearest, flux.sum(axis=1, keepdims=True) * toward)
    even = seen(pull / np.linalg.norm(pull, axis=1, keepdims=True), sums)
    ours, truth = seen(*(values(tree.fine)[k] for k in (0, 2))), seen(toward, flux)
    errors = [np.sqrt(((x - truth) ** 2).mean()) for x in (ours, even)]
    assert errors[0] < 0.6 * errors[1]


@pytest.mark.parametrize("where", [(0.36, 0.48, 0.8), (0, 1, 0), (-0.6, 0, 0.8)])
def test_a_sun_has_a_cell_of_its_own_direction(where):
    """Its cell is looked at where the sun is, at every depth of the tree."""
    tree = build_light_tree(
        lamps(disk=(sun(where)[0], np.array([1e-4]), np.full((1, 3), 5e5))), 64, 512
    )
    for cells in (tree.coarse, tree.fine, tree.leaves):
        toward, radius, _, grey = values(cells)
        brightest = grey.argmax()
        assert toward[brightest] @ np.array(where) > np.cos(np.radians(1))
        assert radius[brightest] < 0.1


@pytest.mark.parametrize(("coarse", "fine"), [(0, 16), (32, 16), (64, 5000)])
def test_impossible_numbers_of_cells_are_refused(coarse, fine):
    with pytest.raises(OptionError, match="1 <= coarse <= fine <= 4096"):
        build_light_tree(lamps(), coarse, fine)


@pytest.mark.parametrize("size", [(256, 128), (200, 150), (200, 60)])
def test_averaging_a_large_map_keeps_its_light(size, monkeypatch):
    """On 2048 columns and 1025 rows at most, here on 130 and 65."""
    columns, rows = size
    rng = np.random.default_rng(5)
    coarse = rng.random((rows // 4 + 1, columns // 4 + 1, 3))
    pixels = np.kron(coarse, np.ones((4, 4, 1)))[:rows, :columns]
    emitter = envmap(pixels)
    whole = read_environment(emitter)
    monkeypatch.setattr(latlong, "MAX_SIZE", (130, 65))
    less = read_environment(emitter)
    assert less.radiance.shape == (min(whole.radiance.shape[0], 65), 130, 3)
    before, after = whole.coefficients(8), less.coefficients(8)
    np.testing.assert_allclose(after[0], before[0], rtol=2e-3)
    np.testing.assert_allclose(after, before, atol=0.02 * np.abs(before[1:]).max())


PEAK = """
import sys, numpy as np, svu_mi, mitsuba as mi
mi.set_variant("llvm_ad_rgb")
from svu_mi.light.environment import read_environment
from svu_mi.light.latlong import radiance_from
def held(name):
    return next(int(x.split()[1]) for x in open("/proc/self/status") if x.startswith(name)) / 1e3
emitter = mi.load_dict({"type": "envmap", "filename": sys.argv[1]})
radiance_from(emitter, np.array([[0.0, 1.0, 0.0]]))  # from now on Mitsuba has all that it takes
loaded, peak = held("VmRSS"), held("VmHWM")
read_environment(emitter).coefficients(24)
print(max(held("VmHWM") - max(loaded, peak), 0), held("VmRSS") - loaded)
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_a_map_of_4096_x_2048_costs_no_gigabyte(tmp_path):
    """It was 1.8 GB; this is what comes on top of what Mitsuba takes for it."""
    write_exr(tmp_path / "map.exr", {"RGB": np.ones((2048, 4096, 3), np.float32)}, half=True)
    done = python("-c", PEAK, tmp_path / "map.exr")
    assert done.returncode == 0, done.stderr
    above, kept = map(float, done.stdout.split())
    assert above < 200 and kept < 300, done.stdout


def test_synthesis_agrees_with_point_evaluation():
    c = np.random.default_rng(5511).normal(size=(13**2, 2))
    grid = synthesize(c, 12, 9)
    points = basis_at(polar_from_local(directions(12, 9).reshape(-1, 3)), 12) @ c
    np.testing.assert_allclose(grid.reshape(-1, 2), points, atol=1e-11)


def test_look_ups_have_finite_derivatives_at_and_near_the_poles():
    """Against differences of the closed form; acos has an infinite one where y rounds to 1."""
    angle = np.array([0, 1e-7, 1e-5, 1e-4, 3e-3, 0.5])
    x, y = np.sin(angle) * 0.6, np.cos(angle)
    z = np.sin(angle) * 0.8
    for sign in (1, -1):
        for mode in ("forward", "backward"):
            d = to_drjit(mi.Vector3f, np.stack([x, sign * y, z]).astype(np.float32))
            dr.enable_grad(d)
            _, theta = lat_long(d)
            value = dr.square(theta * dr.pi - (0 if sign > 0 else dr.pi))  # even around the pole
            if mode == "forward":
                dr.set_grad(d, mi.Vector3f(0.6, 0, 0.8))
                found = dr.forward_to(value).numpy()
            else:
                dr.backward(value)
                found = (dr.grad(d).x * 0.6 + dr.grad(d).z * 0.8).numpy()
            np.testing.assert_allclose(found, 2 * angle * np.cos(angle), rtol=1e-3, atol=1e-5)
        phi, _ = lat_long(d)
        dr.backward(phi)
        assert np.isfinite(dr.grad(d).numpy()).all()
