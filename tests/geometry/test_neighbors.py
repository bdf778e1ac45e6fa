"""Neighbours on the surface against searches over all pairs, and against what a sphere is."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.helpers import ball

import svu_mi.errors
import svu_mi.scenes
from svu_mi.capture.mesh import MeshArrays, make_mesh
from svu_mi.geometry.neighbors import (
    MOST,
    OPPOSITE,
    REACH,
    Neighbors,
    lanes_of,
    neighbors,
    over_neighbors,
)
from svu_mi.geometry.texels import Texels, texels


def quad(origin, along_u, along_v, uv) -> MeshArrays:
    """Two triangles over a UV rectangle (u0, v0, u1, v1)."""
    origin, along_u, along_v = (np.array(vector, float) for vector in (origin, along_u, along_v))
    points = np.array([origin, origin + along_u, origin + along_u + along_v, origin + along_v])
    u0, v0, u1, v1 = uv
    uvs = np.array([[u0, v0], [u1, v0], [u1, v1], [u0, v1]], float)
    return MeshArrays(points, np.array([[0, 1, 2], [0, 2, 3]]), None, uvs)


def together(*parts: MeshArrays):
    """One mesh of several charts that share no vertex."""
    offsets = np.cumsum([0, *(len(part.positions) for part in parts)])
    return make_mesh("parts", MeshArrays(
        np.concatenate([part.positions for part in parts]),
        np.concatenate([part.faces + o for part, o in zip(parts, offsets, strict=False)]),
        None,
        np.concatenate([part.uvs for part in parts if part.uvs is not None]),
    ))  # fmt: skip


def links(graph: Neighbors) -> set[tuple[int, int]]:
    first, second = (column.numpy().tolist() for column in graph.pairs)
    return set(zip(first, second, strict=True))


def spread(where: Texels) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions (T, 3), face normals (T, 3), and column and row in the map (T, 2)."""
    index, width = where.index.numpy().astype(int), where.resolution[0]
    cell = np.stack([index % width, index // width], axis=-1)
    return where.position.numpy().T, where.geometric_normal.numpy().T, cell


def check_consistent(graph: Neighbors, count: int) -> None:
    """Pairs and table say the same, and the table is symmetric."""
    first, second = (column.numpy() for column in graph.pairs)
    assert (first < second).all() and len(links(graph)) == len(first)
    table = graph.table()
    assert table.shape == (len(graph.around), count) and len(table) <= MOST
    here = np.broadcast_to(np.arange(count), table.shape)
    listed = set(zip(here[table != here].tolist(), table[table != here].tolist(), strict=True))
    assert len(listed) == (table != here).sum()  # nobody is listed twice
    assert listed == links(graph) | {(b, a) for a, b in links(graph)}


@pytest.mark.parametrize("resolution", [(64, 32), 96, (33, 71)])
def test_the_borders_of_a_sphere_meet(resolution):
    """Left and right border of the map are one meridian, and the chart has no other end."""
    mesh = make_mesh("ball", ball())
    where = texels(mesh, resolution)
    graph = neighbors(where, mesh)
    check_consistent(graph, where.count)
    _, _, cell = spread(where)
    joined, met = links(graph), []
    for y in np.unique(cell[:, 1]):
        row = np.flatnonzero(cell[:, 1] == y)
        left, right = sorted(row[[cell[row, 0].argmin(), cell[row, 0].argmax()]].tolist())
        met.append((left, right) in joined)
    assert len(met) > 0.9 * where.resolution[1]
    assert np.mean(met) > 0.85  # at the poles a meridian is nearer than the next texel
    assert all(met[len(met) // 8 : -len(met) // 8])


def brute_force(where: Texels, reach: float) -> set[tuple[int, int]]:
    """All pairs closer than ``reach`` steps of a uniform chart."""
    position = where.position.numpy().T.astype(np.float64)
    apart = np.linalg.norm(position[:, None] - position[None], axis=-1)
    step = float(where.footprint.numpy().mean())
    first, second = np.nonzero(np.triu(apart < reach * step, 1))
    return set(zip(first.tolist(), second.tolist(), strict=True))


def test_plane_cut_into_charts_keeps_its_neighbours():
    """Two halves lie apart in the map and one of them on its side; in space they are a square."""
    left = quad((0, 0, 0), (4, 0, 0), (0, 8, 0), (0, 0, 0.25, 0.5))
    turned = quad((8, 0, 0), (0, 8, 0), (-4, 0, 0), (0.5, 0.5, 1.0, 0.75))
    mesh = together(left, turned)
    where = texels(mesh, 32)
    assert where.count == 128 * 2
    graph = neighbors(where, mesh)
    check_consistent(graph, where.count)
    assert links(graph) == brute_force(where, 1.2)  # one step away, but not the diagonal's 1.4
    assert graph.seams == 16
    assert len(links(neighbors(where))) == len(links(graph)) - 16


def test_charts_that_touch_in_the_map_only_are_apart():
    mesh = together(
        quad((0, 0, 0), (4, 0, 0), (0, 4, 0), (0, 0, 0.5, 0.5)),
        quad((9, 0, 0), (4, 0, 0), (0, 4, 0), (0.5, 0, 1, 0.5)),
    )
    where = texels(mesh, 16)
    graph = neighbors(where, mesh)
    assert graph.seams == 0
    assert links(graph) == brute_force(where, 1.2)
    assert len(links(neighbors(where))) == len(links(graph)) + 8  # which does not know the mesh


@pytest.mark.parametrize("uv", [(0.5, 0, 1, 0.5), (0.25, 0.5, 0.75, 1.0)])
def test_the_sides_of_a_thin_sheet_are_apart(uv):
    """A sheet a tenth of a texel thick, whose sides touch in the map, or do not."""
    front = quad((0, 0, 0), (4, 0, 0), (0, 4, 0), (0, 0, 0.5, 0.5))
    back = quad((4, 0, -0.05), (-4, 0, 0), (0, 4, 0), uv)
    mesh = together(front, back)
    where = texels(mesh, 16)
    graph = neighbors(where, mesh)
    _, normal, _ = spread(where)
    first, second = (column.numpy() for column in graph.pairs)
    assert ((normal[first] * normal[second]).sum(axis=1) > 0.9).all()
    assert graph.seams == 0


def test_the_faces_of_a_cube_meet_at_its_edges():
    """Normals at a right angle are those of neighbours."""
    top = quad((0, 0, 0), (4, 0, 0), (0, 4, 0), (0, 0, 0.5, 0.5))
    side = quad((4, 0, 0), (0, 0, -4), (0, 4, 0), (0.5, 0.5, 1, 1))
    mesh = together(top, side)
    where = texels(mesh, 16)
    graph = neighbors(where, mesh)
    assert graph.seams == 8
    position, _, _ = spread(where)
    first, second = (column.numpy() for column in graph.pairs)
    across = np.abs(position[first, 2] - position[second, 2]) > 1e-3
    across &= np.minimum(position[first, 2], position[second, 2]) > -0.3
    across &= np.maximum(position[first, 2], position[second, 2]) > -1e-3
    assert across.sum() == 8
    assert (np.abs(position[first, 1] - position[second, 1])[across] < 1e-5).all()


def test_a_single_texel_has_no_neighbour():
    mesh = together(quad((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1, 1)))
    for given in (mesh, None):
        graph = neighbors(texels(mesh, 1), given)
        assert links(graph) == set()
        np.testing.assert_array_equal(graph.table(), [[0]])


@pytest.mark.parametrize("size", [1, 2, 3])
def test_a_fold_finds_every_neighbour_of_every_lane_once(size):
    """Up to five of a ball's texels along its seam, fewer at the poles."""
    mesh = make_mesh("ball", ball(96, 48))
    graph = neighbors(texels(mesh, (48, 32)), mesh)
    table, own = graph.table(), np.arange(graph.count)
    assert ((table != own).sum(axis=0) > 4).any() and ((table != own).sum(axis=0) < 4).any()
    values = np.random.default_rng(4).integers(1, 1000, (graph.count, size))
    numbers = mi.UInt32(values.ravel().astype(np.uint32))
    around = lanes_of(graph.around, size)
    total = over_neighbors(
        around, lambda other, sum: sum + dr.gather(mi.UInt32, numbers, other),
        dr.zeros(mi.UInt32, dr.width(around[0])),
    )  # fmt: skip
    wanted = np.where((table != own)[..., None], values[table], 0).sum(axis=0)
    np.testing.assert_array_equal(total.numpy().reshape(-1, size), wanted)


def test_a_neighbour_behind_a_texels_own_number_is_refused():
    columns = np.array([[1, 0, 2], [0, 2, 1]])
    around = tuple(mi.UInt32(column.astype(np.uint32)) for column in columns)
    pairs = mi.UInt32([0, 1]), mi.UInt32([1, 2])
    with pytest.raises(svu_mi.errors.ShapeError, match="texel 2 has a neighbour after its own"):
        Neighbors(pairs=pairs, around=around, seams=0)


@pytest.mark.few(3)
@pytest.mark.parametrize("name", ["knot", "vase", "planes", "spheres"])
@pytest.mark.parametrize("resolution", [128, (96, 160)])
def test_neighbours_are_near_and_face_the_same_way(name, resolution):
    scene = mi.load_file(str(svu_mi.scenes.path(name)), optimize=False)
    mesh = next(shape for shape in scene.shapes() if shape.is_mesh())
    where = texels(mesh, resolution)
    graph = neighbors(where, mesh)
    check_consistent(graph, where.count)
    position, normal, cell = spread(where)
    first, second = (column.numpy() for column in graph.pairs)
    assert ((normal[first] * normal[second]).sum(axis=1) > OPPOSITE).all()
    # No longer than the longest step in the map allows; stretched charts have long ones.
    apart = np.linalg.norm(position[first] - position[second], axis=1)
    in_map = np.abs(cell[first] - cell[second]).sum(axis=1) == 1
    longest = np.zeros(where.count)
    for side in (first, second):
        np.maximum.at(longest, side[in_map], apart[in_map])
    assert (apart <= 2 * REACH * np.maximum(longest[first], longest[second])).all()
    if name in ("knot", "vase"):  # closed around the axis: hardly anyone has a loose end
        degree = (graph.table() != np.arange(where.count)).sum(axis=0)
        assert (degree >= 4).mean() > 0.97
