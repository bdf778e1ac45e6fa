"""Tests of wide lobes by quadrature over cells, against float64 and Mitsuba."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from oracle import angular as oracle
from support.helpers import ball, bits_of, unit

from svu_mi.capture import mesh as capture_mesh
from svu_mi.core.arrays import to_drjit
from svu_mi.geometry.sample_view import TexelLanes
from svu_mi.geometry.texels import Texels, texels
from svu_mi.light.environment import Environment, read_environment
from svu_mi.light.light_tree import LightCells, build_light_tree
from svu_mi.light.light_visibility import LightVisibility, trace_light_visibility
from svu_mi.reflection import wide_lobes
from svu_mi.reflection.lobes import Normals
from svu_mi.reflection.wide_lobes import WideLobes

ALPHA = np.array([0.04, 0.15, 0.5, 1.0])
SEED = 77123


def environment(image: np.ndarray, **more: object) -> Environment:
    emitter = mi.load_dict({"type": "envmap", "bitmap": mi.Bitmap(image), **more})
    return read_environment(emitter)


def spotted() -> np.ndarray:
    """Return an environment map, (H, W, 3): a dim sky with one bright patch."""
    image = np.random.default_rng(SEED).uniform(0.1, 0.3, (24, 48, 3)).astype(np.float32)
    image[5:7, 30:32] = (60, 50, 40)
    return image


def surroundings(
    image: np.ndarray, coarse: int, fine: int = 512
) -> tuple[Texels, TexelLanes, LightVisibility]:
    """Return texels of a ball next to a wall, and the visibility of a light from them."""
    mesh = capture_mesh.make_mesh("ball", ball())
    turn = mi.ScalarTransform4f().translate([1.3, 0, 0]).rotate([0, 1, 0], -90).scale(1.5)
    wall = {"type": "rectangle", "to_world": turn, "bsdf": {"type": "diffuse"}}
    scene = mi.load_dict({"type": "scene", "ball": mesh, "wall": wall}, optimize=False)
    grid = texels(mesh, (8, 6))
    surface, tree = TexelLanes.of(grid), build_light_tree(environment(image), coarse, fine)
    return grid, surface, trace_light_visibility(scene, surface, tree)


def views_of(grid: Texels, spread: float = 0.8) -> tuple[np.ndarray, np.ndarray]:
    """Return normals and directions to cameras of all texels, some grazing, float64."""
    normal = unit(np.array(grid.normal).T)
    view = unit(normal + np.random.default_rng(3).normal(scale=spread, size=normal.shape))
    away = (view * normal).sum(axis=1) < 0.1
    view[away] = normal[away]
    return normal, view


def found_by(
    visibility: LightVisibility,
    surface: TexelLanes,
    view: np.ndarray,
    channels: int = 3,
    alpha: np.ndarray = ALPHA,
    bend: np.ndarray | None = None,
) -> np.ndarray:
    """Return p, q and d, (K, 3, C, T); ``bend`` (2, 3) are deviations of all normals."""
    normal = surface.normal.numpy().T
    cosine = (view * normal / np.linalg.norm(normal, axis=1, keepdims=True)).sum(axis=1)
    turned = None if bend is None else tuple(mi.Vector3f(*map(float, x)) for x in bend)
    lobes = WideLobes(visibility, alpha, channels).reflect(
        surface.lane, Normals.of(surface.normal, turned), to_drjit(mi.Vector3f, view.T),
        to_drjit(mi.Float, cosine),
    )  # fmt: skip
    values = np.array([[[x.numpy() for x in color] for color in lobe] for lobe in lobes])
    return np.moveaxis(values, 1, 2)


def table(cells: LightCells) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return directions, flux per channel, and radii of cells, float64."""
    toward = cells.toward.numpy().reshape(-1, 4).astype(np.float64)
    return toward[:, :3], cells.flux.numpy().reshape(-1, 4)[:, :3].astype(np.float64), toward[:, 3]


def direct(
    cells: LightCells, seen: np.ndarray, normal: np.ndarray, view: np.ndarray, disks: bool = True,
    bend: np.ndarray | None = None,
) -> np.ndarray:  # fmt: skip
    """Return the sum over cells times their visible part, (N, T); (K, 3, C, T) float64."""
    toward, flux, radius = table(cells)
    toward = toward / np.linalg.norm(toward, axis=1, keepdims=True)
    radius = radius if disks else 0 * radius
    return np.array([
        np.moveaxis([
            oracle.reflected(
                toward[lit], seen[lit, t, None] * flux[lit], radius[lit], view[t], normal[t], a,
                bend,
            )
            for t, lit in enumerate(seen.T > 0)
        ], 0, -1)
        for a in ALPHA
    ])  # fmt: skip


def below(first: object, seen: np.ndarray) -> np.ndarray:
    """Return the visibility of children, (N_below, T), inherited from their cells."""
    return np.repeat(seen, np.diff(first.numpy().astype(int)), axis=0)


@pytest.mark.parametrize(("count", "bend"), [
    (64, None), pytest.param(100, None, marks=pytest.mark.slow),
    (64, np.array([[0.02, 0.05, 0.01], [0.0, -0.01, 0.03]])),
])  # fmt: skip
def test_unrefined_lobe_is_the_sum_over_visible_cells(
    count: int, bend: np.ndarray | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Compare with the exact BRDF of each cell, averaged over its disk and over normals.

    Coarse cells have the visible part of their fine cells.
    """
    monkeypatch.setattr(wide_lobes, "LARGE", 1e30)
    grid, surface, visibility = surroundings(spotted(), count)
    normal, view = views_of(grid)
    tree, free = visibility.tree, bits_of(visibility.fine, 512, grid.count)
    first = tree.first.numpy().astype(int)
    part = np.add.reduceat(free.astype(float), first[:-1]) / np.diff(first)[:, None]
    assert 0.05 < ((part > 0) & (part < 1)).mean() < 0.5 and part.max() == 1
    exact = direct(tree.coarse, part, normal, view, bend=bend)
    ours = found_by(visibility, surface, view, bend=bend)
    # Cosines of grazing directions have larger relative errors in single precision.
    size = exact.max(axis=3, keepdims=True)
    np.testing.assert_allclose(ours[1:], exact[1:], rtol=1e-4, atol=1e-5 * float(size[1:].max()))
    assert np.quantile(np.abs(ours - exact)[1:] / exact[1:].clip(1e-9), 0.95) < 5e-5
    np.testing.assert_allclose(ours[0], exact[0], rtol=5e-3, atol=1e-5 * float(size[0].max()))


def test_refined_to_the_last_it_is_the_sum_over_leaves(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compare with the sum over leaves of visible fine cells."""
    monkeypatch.setattr(wide_lobes, "LARGE", 0.0)
    grid, surface, visibility = surroundings(spotted(), 64)
    monkeypatch.setattr(wide_lobes, "ROOM", visibility.tree.leaves.number)
    normal, view = views_of(grid)
    leaves = below(visibility.tree.first_leaf, bits_of(visibility.fine, 512, grid.count))
    exact = direct(visibility.tree.leaves, leaves, normal, view)
    ours = found_by(visibility, surface, view)
    # Cells below the horizon are skipped with their leaves.
    np.testing.assert_allclose(ours[1:], exact[1:], rtol=2e-3, atol=1e-4 * float(exact[1:].max()))


def test_bright_cells_count_as_larger_and_dim_ones_as_smaller() -> None:
    tree = build_light_tree(environment(spotted()), 64, 512)
    mean = tree.fine.flux.numpy()[3::4].mean()
    for cells in (tree.coarse, tree.fine):
        _, flux, radius = table(cells)
        factor = np.clip(np.sqrt(flux.mean(axis=1) / mean), 0.5, 4)
        assert np.ptp(factor) > 1
        np.testing.assert_allclose(cells.size.numpy(), factor * radius**2, rtol=1e-3)


@pytest.mark.slow
def test_lists_of_cells_do_not_overflow(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without room for their leaves, fine cells stay whole; the widest lobe changes little."""
    monkeypatch.setattr(wide_lobes, "LARGE", 0.0)
    grid, surface, visibility = surroundings(spotted(), 64)
    of_rooms, (_, view) = [], views_of(grid)
    for room in (0, visibility.tree.leaves.number):
        monkeypatch.setattr(wide_lobes, "ROOM", room)
        of_rooms.append(found_by(visibility, surface, view)[-1])
    whole, leaves = of_rooms
    error = np.sqrt(((whole - leaves) ** 2).mean(axis=2)) / leaves.mean(axis=2)
    assert 0 < error.max() < 0.02


@pytest.mark.parametrize("name", ["spotted", "studio-like"])
def test_at_all_widths_it_is_the_quadrature_over_leaves(name: str) -> None:
    """Few cells instead of thousands have errors of a few percent."""
    image = spotted()
    if name == "studio-like":
        image[10:14, 5:20] = (3, 4, 5)
        image[15:20, 38:40] = (20, 18, 16)
    grid, surface, visibility = surroundings(image, 128, 1024)
    normal, view = views_of(grid)
    leaves = below(visibility.tree.first_leaf, bits_of(visibility.fine, 1024, grid.count))
    ours = found_by(visibility, surface, view)
    plain, blurred = (
        direct(visibility.tree.leaves, leaves, normal, view, disks=disks) for disks in (False, True)
    )
    for k, alpha in enumerate(ALPHA):
        # Leaves are 0.06 apart, too coarse for the narrowest lobe unless they have an extent.
        exact, most = (blurred[k], 0.1) if alpha < 0.06 else (plain[k], 0.05)
        error = np.sqrt(((ours[k] - exact) ** 2).mean(axis=(1, 2)))
        p, q, d = error / exact.mean(axis=(1, 2))
        assert p < most and d < most, (alpha, p, d)
        # The Fresnel term of a metal comes from few, grazing views, and is small.
        assert error[1] < 0.02 * exact[0].mean(), (alpha, q)
        for part in (0, 2):
            away = np.abs(ours[k, part] - exact[part]) / exact[part].clip(1e-6)
            assert np.median(away) < 0.03, (alpha, part)


def test_one_channel_is_the_mean_of_three() -> None:
    grid, surface, visibility = surroundings(spotted(), 64)
    _, view = views_of(grid)
    three, one = (found_by(visibility, surface, view, channels) for channels in (3, 1))
    np.testing.assert_allclose(one[:, :, 0], three.mean(axis=2), rtol=1e-5, atol=1e-7)


@pytest.mark.slow
def test_rough_metal_under_a_sun_matches_mitsuba() -> None:
    """Prefiltered light has errors of tens of percent here, sums do not."""
    light = {"type": "envmap", "bitmap": mi.Bitmap(spotted())}
    mesh = capture_mesh.make_mesh("ball", ball(96, 48))
    mesh.set_bsdf(mi.load_dict({"type": "principled", "base_color": {"type": "rgb", "value": 0.8},
                                "roughness": 0.6, "metallic": 1.0}))  # fmt: skip
    emitter = mi.load_dict(light)
    scene = mi.load_dict({"type": "scene", "ball": mesh, "light": emitter}, optimize=False)
    grid = texels(mesh, (24, 12))
    surface = TexelLanes.of(grid)
    visibility = trace_light_visibility(
        scene, surface, build_light_tree(read_environment(emitter), 64, 256)
    )
    camera = np.array([1.5, 2.5, 3.0])
    to_camera = camera - np.array(grid.position, np.float64).T
    view = to_camera / np.linalg.norm(to_camera, axis=1, keepdims=True)
    cosine = (view * np.array(grid.normal, np.float64).T).sum(axis=1)
    seen = np.flatnonzero(cosine > 0.15)
    (metal,) = WideLobes(visibility, np.array([0.36]), 3).reflect(
        surface.lane, Normals.of(surface.normal), to_drjit(mi.Vector3f, view.T),
        to_drjit(mi.Float, np.maximum(cosine, 1e-3)),
    )  # fmt: skip
    model = np.mean([0.8 * np.array(p) + np.array(q) for p, q, _ in metal], axis=0)[seen]
    origin = mi.Point3f(*(np.full(len(seen), x, np.float32) for x in camera))
    rays = mi.RayDifferential3f(mi.Ray3f(origin, to_drjit(mi.Vector3f, -view[seen].T)))
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
