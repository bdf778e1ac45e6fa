"""Which texels share rays, counted by hand on a strip that is folded by a right angle."""

import mitsuba as mi
import numpy as np
import pytest
from support.helpers import bits_of

from svu_mi.capture.mesh import MeshArrays, make_mesh
from svu_mi.core.arrays import to_drjit
from svu_mi.geometry.sample_view import TexelLanes
from svu_mi.geometry.shared_texels import shared_texels
from svu_mi.geometry.texels import texels
from svu_mi.light.environment import Environment
from svu_mi.light.latlong import directions
from svu_mi.light.light_tree import build_light_tree
from svu_mi.light.light_visibility import trace_light_visibility


def folded():
    """Two quads, 1 x 0.04 each: the ground, and a wall that hides light from it."""
    sides = np.array([[0, 0, 0], [0, 0.04, 0], [1, 0, 0], [1, 0.04, 0], [1, 0, 1], [1, 0.04, 1]])
    positions = sides[[0, 1, 2, 3, 2, 3, 4, 5]]
    uvs = np.array([[u, v] for u in (0, 0.5, 0.5, 1) for v in (0, 1)])
    faces = np.array([[0, 2, 1], [1, 2, 3], [4, 6, 5], [5, 6, 7]])
    return make_mesh("folded", MeshArrays(positions, faces, None, uvs))


@pytest.mark.parametrize("columns", [510, 102])
def test_near_texels_of_one_side_share_rays(columns):
    layout = texels(folded(), (columns, 10))
    every = np.arange(layout.count)
    index, owner = layout.index.numpy().astype(int), shared_texels(layout, every)
    (x, y), (own_x, own_y) = ((i % columns, i // columns) for i in (index, index[owner]))
    # The fold is in the middle of a block, and texels may be 0.02 wide: these share in columns.
    apart = (x == columns // 2) | ((columns < 500) & (x % 2 == 1))
    np.testing.assert_array_equal(own_x, np.where(apart, x, x - x % 2))
    np.testing.assert_array_equal(own_y, y - y % 2)
    some = every[7::13][::-1]
    np.testing.assert_array_equal(shared_texels(layout, some), owner[some])


def test_shared_rays_find_the_same_light():
    mesh = folded()
    scene, layout = mi.load_dict({"type": "scene", "mesh": mesh}), texels(mesh, (510, 10))
    disk = np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3))
    tree = build_light_tree(
        Environment(np.ones_like(directions(64, 33)), *disk, np.eye(3)), 128, 1024
    )
    traced, place = np.unique(shared_texels(layout, np.arange(layout.count)), return_inverse=True)
    chosen, places = (to_drjit(mi.UInt32, x.astype(np.uint32)) for x in (traced, place))
    own = trace_light_visibility(scene, TexelLanes.of(layout), tree)
    some = trace_light_visibility(scene, TexelLanes.of(layout, chosen), tree, places)
    assert len(traced) < 0.26 * layout.count
    lanes = layout.count, len(traced)
    every, shared = (bits_of(x.fine, 1024, n) for x, n in zip((own, some), lanes, strict=True))
    assert 0.2 < every.mean() < 0.5  # half of the sky, less what the wall hides
    # In a cell of 0.06 rad, the edge of the wall moves by at most 0.004 rad for most texels.
    assert (every != shared[:, place]).mean() < 0.002
    part = some.subset(np.array([7, 0, 7]))
    np.testing.assert_array_equal(part.place.numpy(), place[[7, 0, 7]])
