"""Texels against Mitsuba's own parameterisation, and against counting by hand."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.helpers import ball

import svu_mi as svu
from svu_mi.capture.mesh import MeshArrays, make_mesh
from svu_mi.capture.unwrap import unwrap, unwrap_cached
from svu_mi.capture.uv_charts import rasterize
from svu_mi.errors import MeshError, OptionError, ShapeError
from svu_mi.geometry import texels as texels_module
from svu_mi.geometry.texels import texels


@pytest.mark.parametrize("resolution", [64, (96, 40), (33, 71)])
def test_texels_lie_where_mitsuba_puts_them(resolution):
    mesh = make_mesh("ball", ball())
    layout = texels(mesh, resolution)
    si = mesh.eval_parameterization(layout.uv)
    hit = si.is_valid().numpy()
    assert hit.mean() > 0.998  # Mitsuba's rays slip through some shared edges
    distance = dr.norm(si.p - layout.position).numpy()[hit]
    cosine = dr.dot(si.sh_frame.n, layout.normal).numpy()[hit]
    assert distance.max() < 1e-5
    assert cosine.min() > 1 - 1e-5
    assert float(dr.min(dr.dot(layout.normal, layout.geometric_normal))[0]) > 0.9


def test_every_texel_of_the_charts_is_found():
    mesh = make_mesh("ball", ball())
    layout = texels(mesh, (80, 50))
    u, v = np.meshgrid((np.arange(80) + 0.5) / 80, (np.arange(50) + 0.5) / 50)
    si = mesh.eval_parameterization(mi.Point2f(u.ravel().astype("f4"), v.ravel().astype("f4")))
    missed = si.is_valid().numpy() & ~layout.inside().ravel()
    assert not missed.any()
    assert layout.inside().sum() <= 1.005 * si.is_valid().numpy().sum()


def test_texels_on_the_diagonal_of_a_quad_are_covered_once():
    """The diagonal of the unit square runs through every centre of the grid's diagonal."""
    square = np.array([[0, 0], [1, 0], [0, 1], [1, 1]], float)
    faces = square[[[0, 1, 2], [2, 1, 3]]]
    owner, count = rasterize(faces, (16, 16))
    assert (count == 1).all()
    assert set(owner) == {0, 1}


def test_overlapping_charts_are_refused_with_the_fix():
    flat = ball()
    doubled = MeshArrays(
        np.concatenate([flat.positions, 2 * flat.positions]),
        np.concatenate([flat.faces, flat.faces + len(flat.positions)]),
        None,
        np.concatenate([flat.uvs, flat.uvs]),
    )
    with pytest.raises(MeshError, match="overlapping UV charts.*unwrap=True"):
        texels(make_mesh("twice", doubled), 64)


def test_a_small_overlap_is_left_out_and_counted():
    flat = ball()
    corner = flat.positions[flat.faces[400]] * 1.5
    patch = MeshArrays(
        np.concatenate([flat.positions, corner]),
        np.concatenate([flat.faces, [[len(flat.positions) + k for k in range(3)]]]),
        None,
        np.concatenate([flat.uvs, flat.uvs[flat.faces[400]]]),
    )
    whole, layout = texels(make_mesh("ball", flat), 128), texels(make_mesh("patched", patch), 128)
    assert 0 < layout.overlapping < 20
    assert layout.count == whole.count - layout.overlapping


@pytest.mark.parametrize(
    ("uvs", "message"),
    [
        (None, "has no UVs"),
        (ball().uvs + 1.5, "outside"),
        (ball().uvs * np.nan, "NaN"),
        (ball().uvs * 1e-6, "no texel centre"),
    ],
)
def test_unusable_uvs_are_refused(uvs, message):
    flat = ball()
    mesh = make_mesh("bad", MeshArrays(flat.positions, flat.faces, flat.normals, uvs))
    with pytest.raises(MeshError, match=message):
        texels(mesh, 32)


def test_faces_without_area_in_space_are_left_out():
    """The whole chart of a sphere that is flattened into a line has no surface."""
    flat = ball()
    line = flat.positions * [0, 1, 0]
    with pytest.raises(MeshError, match="no texel centre"):
        texels(make_mesh("line", MeshArrays(line, flat.faces, None, flat.uvs)), 32)


@pytest.mark.parametrize("resolution", [0, -3, (64, 0), 20000])
def test_impossible_resolutions_are_refused(resolution):
    with pytest.raises(OptionError, match="texels per side"):
        texels(make_mesh("ball", ball()), resolution)


@pytest.mark.parametrize("resolution", ["a", 64.0, (1, 2, 3), (32.5, 16), None])
def test_fractional_resolutions_are_refused(resolution):
    with pytest.raises(OptionError, match="whole number|resolution must have 2 values"):
        svu.texels(make_mesh("ball", ball()), resolution)


def test_numpy_resolution_is_accepted_and_sphere_is_refused():
    assert texels(make_mesh("ball", ball()), np.int64(16)).resolution == (16, 16)
    with pytest.raises(MeshError, match="not a triangle mesh"):
        texels(mi.load_dict({"type": "sphere"}), 16)


def test_to_image_puts_values_back(variant):
    layout = texels(make_mesh("ball", ball()), (20, 10))
    image = layout.to_image(layout.uv.numpy().T, -1)
    assert image.shape == (10, 20, 2)
    inside = layout.inside()
    u = np.broadcast_to((np.arange(20) + 0.5) / 20, (10, 20))
    np.testing.assert_allclose(image[inside][:, 0], u[inside], atol=1e-6)
    assert (image[~inside] == -1).all()
    with pytest.raises(ShapeError, match="one value for each"):
        layout.to_image(np.zeros(3))


def test_unwrapping_gives_texels_and_is_kept(tmp_path):
    flat = ball()
    mesh = make_mesh("ball", MeshArrays(flat.positions, flat.faces, flat.normals, None))
    first = unwrap_cached(mesh, tmp_path)
    assert (tmp_path / "unwrapped.ply").exists()
    again = unwrap_cached(mesh, tmp_path)
    a, b = texels(first, 64), texels(again, 64)
    assert a.count > 1500
    assert a.overlapping <= 0.01 * a.count
    np.testing.assert_allclose(a.position.numpy(), b.position.numpy(), atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(a.position.numpy(), axis=0), 1, atol=0.02)


def test_an_empty_mesh_cannot_be_unwrapped():
    nothing = MeshArrays(np.zeros((3, 3)), np.zeros((0, 3), int), None, None)
    with pytest.raises(MeshError, match="no faces"):
        unwrap(make_mesh("nothing", nothing))


def test_texels_interpolated_some_at_a_time_are_the_same(monkeypatch, vase):
    whole = texels(vase.capture.mesh, 64)
    monkeypatch.setattr(texels_module, "CHUNK", 333)
    parts = texels(vase.capture.mesh, 64)
    for name in ("position", "normal", "geometric_normal", "uv", "footprint"):
        one, other = (np.array(getattr(layout, name)) for layout in (parts, whole))
        np.testing.assert_array_equal(one, other)
    for one, other in zip(parts.sides, whole.sides, strict=True):
        np.testing.assert_array_equal(np.array(one), np.array(other))


def test_footprints_add_up_to_the_area_of_the_surface():
    layout = texels(make_mesh("ball", ball(192, 96)), 256)
    area = float(dr.sum(dr.square(layout.footprint))[0])
    assert area == pytest.approx(4 * np.pi, rel=5e-3)  # the polyhedron is a little smaller


def test_mirrored_triangles_are_rasterised_alike():
    corners = np.array([[[0.1, 0.1], [0.9, 0.2], [0.3, 0.8]]])
    owner, count = rasterize(corners, (40, 30))
    mirrored, mirrored_count = rasterize(corners[:, ::-1], (40, 30))
    np.testing.assert_array_equal(owner, mirrored)
    area = 0.5 * (0.8 * 0.7 - 0.1 * 0.2)
    assert abs(count.sum() / 1200 - area) < 0.02
    np.testing.assert_array_equal(count, mirrored_count)
