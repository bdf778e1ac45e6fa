"""The object among the shapes of a scene."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from support.helpers import ball, fails, run, sensor_xml, write_scene
from support.mitsuba_scenes import BODY, GREY, REF, SHARED, shape

from svu_mi.capture.analytic_shapes import analytic_mesh
from svu_mi.capture.loading import load_capture
from svu_mi.capture.mesh import MeshArrays, arrays, make_mesh
from svu_mi.capture.rendering import render_capture
from svu_mi.capture.replace_material import constant_parameters
from svu_mi.capture.scene import load_scene
from svu_mi.capture.target import find_target, merged
from svu_mi.errors import SceneError

SEED = 70261
RAYS = 4000
EDGE = 0.002  # share of rays that pass between the silhouettes of a sphere and of its mesh
SHAPES = "".join(text for text, _ in (
    shape("sphere", REF, id="1"), shape("sphere", GREY), shape("disk", REF, scale=(1, 2, 1)),
    shape("cylinder", GREY.replace("/>", ' id="red"/>'), id="a,b"),
    shape("cube", GREY, id="my box"),
))  # fmt: skip


def scene_of(tmp_path: Path, shapes: str = SHARED + SHAPES, sensors: int = 1) -> Path:
    """A scene without meshes from files."""
    path = tmp_path / "scene.xml"
    path.write_text(
        f'<scene version="3.0.0"><integrator type="direct"/>{sensor_xml(sensors)}'
        f'<emitter type="constant"/>{shapes}</scene>'
    )
    return path


@pytest.mark.parametrize(("word", "name"), [
    ("1", "1"),  # an id goes before a number
    ("0", "1"), ("2", "disk-2"), ("sphere-1", "sphere-1"), ("red", "3"), ("3", "3"), ("a,b", "3"),
    ("largest principled", "disk-2"), ("my box", "my box"), ("disk-2, 4 ,red", "disk-2,my box,3"),
    ("1,0,1", "1"),
])  # fmt: skip
def test_words_for_shapes(tmp_path, word, name):
    """The sphere of radius 1/2 has an area of pi, the ellipse of half-axes 1 and 2 one of 2 pi."""
    found = find_target(load_scene(scene_of(tmp_path)), word, "scene.xml")
    assert found.name == name
    assert find_target(load_scene(scene_of(tmp_path)), found.name, "scene.xml").name == name


@pytest.mark.parametrize(("word", "problem"), [
    ("", "there is no shape ''"), (",", "there is no shape ''"), ("5", "there is no shape '5'"),
    ("-1", "there is no shape '-1'"), ("1,", "there is no shape ''"), ("٣", "no shape '٣'"),
    ("9" * 5000, "no shape '9999"), ("\x1b[2J\n", "no shape"), ("largest", "no shape 'largest'"),
    ("paint", r"2 shapes are 'paint'; .* --shape 1 \(Sphere\), --shape disk-2 \(Disk\)\.$"),
])  # fmt: skip
def test_words_that_choose_no_shape_are_refused(tmp_path, word, problem):
    with pytest.raises(SceneError, match=problem) as caught:
        find_target(load_scene(scene_of(tmp_path)), word, "scene.xml")
    assert str(caught.value).isprintable() and len(str(caught.value)) < 350
    assert "paint" in word or "'my box' (Cube)" in str(caught.value)


@pytest.mark.filterwarnings("ignore::svu_mi.SvuWarning")
def test_an_empty_name_is_refused_before_rendering(tmp_path, capsys):
    path = scene_of(tmp_path)
    assert "there is no shape ''" in fails(
        capsys, "render", path, "--shape", "", "-o", path.parent / "a"
    )
    assert not (tmp_path / "a").exists()
    assert run("render", path, "--shape", "1", "--spp", 1, "-o", tmp_path / "b") == 0
    record = json.loads((tmp_path / "b" / "capture.json").read_text())
    (tmp_path / "b" / "capture.json").write_text(json.dumps({**record, "shape": ""}))
    with pytest.raises(SceneError, match="there is no shape ''"):
        load_capture(tmp_path / "b")


def test_many_shapes_are_not_all_listed(tmp_path):
    path = scene_of(tmp_path, shape("sphere", GREY)[0] * 40)
    with pytest.raises(SceneError, match=r"sphere-11 \(Sphere\) and 28 more; commas"):
        find_target(load_scene(path), None, "scene.xml")


def test_names_that_are_taken_are_not_given(tmp_path):
    path = scene_of(tmp_path, shape("sphere", GREY)[0] + shape("disk", BODY, id="sphere-0")[0])
    assert [each.id() for each in load_scene(path).shapes()] == ["sphere-0-", "sphere-0"]


# --- spheres, disks and cylinders -----------------------------------------------------------


def crossing(scene_shape: object, center: np.ndarray) -> mi.SurfaceInteraction3f:
    """Where rays from everywhere cross a shape."""
    rng = np.random.default_rng(SEED)
    outward = rng.normal(size=(RAYS, 3))
    origin = center + 10 * outward / np.linalg.norm(outward, axis=1, keepdims=True)
    way = center + rng.normal(0, 0.8, (RAYS, 3)) - origin
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    scene = mi.load_dict({"type": "scene", "shape": scene_shape})
    return scene.ray_intersect(mi.Ray3f(mi.Point3f(origin.T), mi.Vector3f(way.T)))


@pytest.mark.parametrize("kind", ["sphere", "disk", "cylinder"])
@pytest.mark.parametrize(("flip", "scale"), itertools.product((False, True), (1, -1)))
def test_meshes_have_the_surface_and_uvs_of_mitsubas_shapes(kind, flip, scale):
    place = mi.ScalarTransform4f().translate([1, 2, 3]).rotate([0.6, 0, 0.8], 40)
    exact = mi.load_dict(
        {"type": kind, "to_world": place.scale([2 * scale, 2, 2]), "flip_normals": flip}
    )
    mesh = make_mesh("mesh", analytic_mesh(exact, "shape"))
    hits = [crossing(each, np.array([1, 2, 3])) for each in (exact, mesh)]
    seen = [np.array(hit.is_valid()) for hit in hits]
    both = seen[0] & seen[1]
    assert (seen[0] != seen[1]).mean() < EDGE and both.mean() > 0.5
    places, normals, uvs = (
        [np.array(value)[:, both] for value in pair] for pair in (
            [hit.p for hit in hits], [hit.sh_frame.n for hit in hits], [hit.uv for hit in hits],
        )
    )  # fmt: skip
    # The mesh lies up to 3e-4 radii (of 2) inside; grazing rays cross it farther along.
    assert np.quantile(np.abs(places[0] - places[1]), 0.99) < 0.005
    assert (normals[0] * normals[1]).sum(axis=0).min() > 0.999
    wrapped = np.abs(uvs[0] - uvs[1])
    assert np.quantile(np.minimum(wrapped, 1 - wrapped), 0.99) < 0.001
    area = float(np.array(exact.surface_area()).ravel()[0])
    assert np.linalg.norm(arrays(mesh).crosses, axis=1).sum() / 2 == pytest.approx(area, rel=2e-3)


@pytest.mark.parametrize(("kind", "scale"), [("sphere", (1, 1, 2)), ("cylinder", (1, 2, 1))])
def test_stretched_round_shapes_are_refused(tmp_path, kind, scale):
    path = scene_of(tmp_path, shape(kind, scale=scale)[0])
    with pytest.raises(SceneError, match=f"'{kind}-0'.*different scales.*convert it to a PLY"):
        find_target(load_scene(path), None, "scene.xml")


@pytest.mark.parametrize("scale", [(1, 1, 0), (0, 0, 0), (1, 1e9, 1), (1, 2e6, 1)])
def test_disks_without_an_extent_are_refused(tmp_path, scale):
    path = scene_of(tmp_path, shape("disk", scale=scale)[0])
    with pytest.raises(SceneError, match="'disk-0'.*flattens it; correct its scale"):
        find_target(load_scene(path), None, "scene.xml")


def test_instances_are_refused_by_name(tmp_path):
    """Their group is out of reach, so no scene that contains them can be changed."""
    group = f'<shape type="shapegroup" id="group">{shape("cube")[0]}</shape>'
    path = scene_of(tmp_path, f'{group}<shape type="instance"><ref id="group"/></shape>')
    with pytest.raises(SceneError, match=r"'instance-0' \(Instance\) is not a triangle mesh"):
        find_target(load_scene(path), None, "scene.xml")
    path.write_text(path.read_text().replace("</scene>", shape("sphere")[0] + "</scene>"))
    with pytest.raises(SceneError, match="'instance-0' is an instance, so the scene cannot"):
        find_target(load_scene(path), None, "scene.xml")


# --- several shapes as one object -----------------------------------------------------------


PARTS = (
    shape("sphere", GREY, id="floor", move=(0, -8, 0), scale=(7, 7, 7))[0]
    + shape("cube", id="body")[0]
    + shape("cube", BODY.replace("/>", '><float name="clearcoat" value="1"/></bsdf>'), id="lid",
            move=(0.6, 0.6, 0), scale=(0.1, 0.1, 0.5))[0]
)  # fmt: skip


@pytest.mark.filterwarnings("ignore::svu_mi.SvuWarning")
def test_several_shapes_share_a_mask_and_the_photographs_are_of_the_scene(tmp_path):
    path = scene_of(tmp_path, PARTS, sensors=2)
    one, other, both = (
        render_capture(path, spp=1, shape=name) for name in ("body", "lid", "lid,body")
    )
    for view in range(2):
        np.testing.assert_allclose(both.images[view], one.images[view], rtol=1e-6)
        single = one.masks[view] | other.masks[view]
        # On pixels between them, each may cover less than half.
        assert both.masks[view][single].all() and (both.masks[view] != single).mean() < 0.01
        assert one.masks[view].any() and other.masks[view].any()
    assert both.shape.id() == "lid,body" and [s.id() for s in both.scene.shapes()][1:] == ["floor"]
    for sentence in ("'lid,body' has clearcoat 1", "'lid,body' is made of several shapes: UVs are"):
        assert any(sentence in warning for warning in both.warnings)
    assert any("'body' has the same UVs on all faces: UVs are" in line for line in one.warnings)


def test_the_rest_of_the_scene_is_kept(tmp_path):
    scene = find_target(load_scene(scene_of(tmp_path, PARTS, sensors=12)), "floor", "").scene
    assert [sensor.id() for sensor in scene.sensors()] == [f"cam{k}" for k in range(12)]
    assert scene.integrator().class_name() == "DirectIntegrator"
    assert sorted(each.id() for each in scene.shapes()) == ["body", "floor", "lid"]


def test_a_common_material_is_kept(tmp_path):
    shapes = shape("cube", REF, id="a")[0] + shape("cube", REF, id="b", move=(2, 0, 0))[0]
    painted = SHARED.replace("</bsdf>", '<texture type="checkerboard" name="metallic"/></bsdf>')
    scene = load_scene(scene_of(tmp_path, painted + shapes + shape("cube", id="c")[0]))
    same, mixed = (find_target(scene, name, "").mesh for name in ("a,b", "a,c"))
    assert constant_parameters(same)["roughness"] == pytest.approx(0.3)
    assert constant_parameters(mixed) == {}


def test_flat_parts_stay_flat_beside_smooth_ones():
    round_part = ball(8, 4)
    flat_part = MeshArrays(np.eye(3), np.array([[0, 1, 2]]), None, None)
    whole = merged([flat_part, round_part])
    assert len(whole.positions) == 3 + len(round_part.positions) and whole.uvs is None
    np.testing.assert_allclose(whole.normals[:3], np.full((3, 3), 3**-0.5))
    np.testing.assert_array_equal(whole.faces[1:], round_part.faces + 3)
    assert merged([flat_part, flat_part]).normals is None


def test_a_mesh_without_faces_is_refused(tmp_path):
    path = write_scene(tmp_path, faces=np.zeros((0, 3), int))
    with pytest.raises(SceneError, match="shape 'ball' has no faces"):
        render_capture(path, spp=1)
