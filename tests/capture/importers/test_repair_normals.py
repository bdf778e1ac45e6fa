"""Meshes: sharp edges, orientation of surfaces, and ignored features."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from support.helpers import unit
from trimesh.visual.material import PBRMaterial

import svu_mi as svu
from svu_mi.capture import mesh as capture_mesh
from svu_mi.capture.importers.import_capture import ImportOptions, import_capture
from svu_mi.capture.importers.mesh_files import read_textured_mesh
from svu_mi.capture.importers.repair_normals import CREASE, _corners_at_edges, repair_normals
from svu_mi.capture.importers.source import Frame, Light, Source
from svu_mi.capture.load_warnings import back_face_share, faces_outward
from svu_mi.capture.mesh import MeshArrays, arrays
from svu_mi.capture.replace_material import make_scene
from svu_mi.capture.sensors import affine
from svu_mi.core.io.exr import write_exr


def buffers(mesh: trimesh.Trimesh) -> MeshArrays:
    return MeshArrays(np.array(mesh.vertices), np.array(mesh.faces), None, None)


def corner_cosines(mesh: MeshArrays) -> np.ndarray:
    """Cosines (F, 3) between triangles and the normals of their corners."""
    flat = np.array(trimesh.Trimesh(mesh.positions, mesh.faces, process=False).face_normals)
    return np.einsum("fki,fi->fk", mesh.normals[mesh.faces], flat)


def test_a_box_without_normals_keeps_its_edges(tmp_path):
    trimesh.creation.box().export(tmp_path / "box.obj", include_normals=False)
    geometry = read_textured_mesh(tmp_path / "box.obj")
    np.testing.assert_allclose(corner_cosines(geometry.mesh), 1, atol=1e-12)
    assert len(geometry.mesh.positions) == 24 and len(geometry.mesh.faces) == 12
    sentence = "box.obj: normals are computed; edges of more than 40 degrees are kept sharp."
    assert any(note.endswith(sentence) for note in geometry.notes)


@pytest.mark.parametrize("encoding", ["binary", "ascii"])
def test_a_ply_keeps_its_own_normals(tmp_path, encoding):
    ball = trimesh.creation.icosphere(subdivisions=1)
    own = unit(np.array(ball.vertices) + [0.2, 0, 0])  # unlike computed normals
    ball.vertex_normals = own
    ball.export(tmp_path / "ball.ply", vertex_normal=True, encoding=encoding)
    imported = read_textured_mesh(tmp_path / "ball.ply")
    np.testing.assert_allclose(imported.mesh.positions, ball.vertices, atol=1e-6)
    np.testing.assert_allclose(imported.mesh.normals, own, atol=1e-6)
    assert not imported.notes


@pytest.mark.parametrize("sides", [6, 8, 10, 32])
def test_a_cylinder_is_round_where_its_sides_meet_flatly(sides):
    mesh, _ = repair_normals(buffers(trimesh.creation.cylinder(1, 2, sections=sides)), "cylinder")
    side = np.abs(mesh.normals[:, 2]) < 0.5
    round_ = mesh.positions[side, :2] / np.linalg.norm(mesh.positions[side, :2], axis=1)[:, None]
    cosine = np.einsum("ni,ni->n", mesh.normals[side, :2], round_)
    if 360 / sides < CREASE:
        assert cosine.min() > 0.99  # as on a smooth cylinder
    else:
        np.testing.assert_allclose(cosine, np.cos(np.pi / sides), atol=1e-9)  # as its planes
    np.testing.assert_allclose(np.abs(mesh.normals[~side, 2]), 1)


def test_uvs_go_along_and_nothing_is_moved():
    box = trimesh.creation.box()
    given = replace(buffers(box), uvs=np.array(box.vertices)[:, :2] + 0.5)
    mesh, _ = repair_normals(given, "box")
    np.testing.assert_array_equal(mesh.positions[mesh.faces], given.positions[given.faces])
    np.testing.assert_array_equal(mesh.uvs[mesh.faces], given.uvs[given.faces])


def test_smooth_mesh_and_degenerate_triangles_add_no_vertices():
    ball = buffers(trimesh.creation.icosphere(subdivisions=3))
    sliver = np.concatenate([ball.faces, [[0, 0, 1], [5, 5, 5]]])
    for mesh, notes in (
        repair_normals(ball, "ball"),
        repair_normals(replace(ball, faces=sliver), "ball"),
    ):
        assert len(mesh.positions) == len(ball.positions) and not notes
        assert np.einsum("ni,ni->n", mesh.normals, mesh.positions).min() > 0.999
    twice = np.concatenate([ball.faces, ball.faces])  # every edge has four triangles
    mesh, _ = repair_normals(replace(ball, faces=twice), "ball")
    assert len(mesh.positions) == len(ball.positions)


def test_corners_of_two_triangles_at_their_edge():
    two, three = [[0, 1, 2], [1, 0, 3]], [[0, 1, 2], [1, 0, 3], [0, 1, 4]]
    pairs, are_two = _corners_at_edges(np.array(two))
    assert pairs.tolist() == [[[0, 1]], [[4, 3]]] and are_two.tolist() == [True]
    assert not _corners_at_edges(np.array(three))[1].any()


def test_the_two_sides_of_a_sheet_do_not_cancel():
    """The mesh contains each triangle twice, once flipped, on the same vertices."""
    grid = buffers(trimesh.creation.icosphere(subdivisions=2))
    front = grid.faces[grid.positions[grid.faces].mean(axis=1)[:, 2] > 0.2]
    mesh, notes = repair_normals(
        replace(grid, faces=np.concatenate([front, front[:, ::-1]])), "sheet"
    )
    assert corner_cosines(mesh).min() > 0.9 and "kept sharp" in notes[0]


def shaken(mesh: trimesh.Trimesh, part: float) -> MeshArrays:
    """Return the mesh with noise on its points, relative to the mean edge length."""
    points = np.array(mesh.vertices)
    off = np.random.default_rng(0).normal(0, part * mesh.edges_unique_length.mean(), points.shape)
    return MeshArrays(points + off, np.array(mesh.faces), None, None)


@pytest.mark.parametrize("part", [0.2, 0.3])
def test_a_noisy_scan_is_smoothed_all_over(part):
    """With creases, the mean error of the normals would be 31 degrees instead of 20."""
    mesh, notes = repair_normals(shaken(trimesh.creation.icosphere(subdivisions=5), part), "scan")
    assert notes == [
        "scan: normals are computed; the surface is too noisy to detect edges, so none are kept "
        "sharp."
    ]
    assert len(mesh.positions) == 10242
    wanted = mesh.positions / np.linalg.norm(mesh.positions, axis=1, keepdims=True)
    off = np.degrees(np.arccos(np.clip(np.einsum("ni,ni->n", wanted, mesh.normals), -1, 1)))
    mean, most = {0.2: (11, 23), 0.3: (21, 50)}[part]
    assert off.mean() < mean and np.percentile(off, 95) < most


@pytest.mark.parametrize("kind", ["boxes", "cylinders", "rings", "one box"])
def test_dense_parts_that_were_designed_stay_sharp(kind):
    """Many edges are creases, but the others are flat."""
    part, count = {
        "boxes": (trimesh.creation.box(), 500), "cylinders": (trimesh.creation.cylinder(1, 2), 50),
        "rings": (trimesh.creation.annulus(0.5, 1, 0.2), 50),
        "one box": (trimesh.creation.box().subdivide().subdivide().subdivide().subdivide()
                    .subdivide(), 1),
    }[kind]  # fmt: skip
    parts = [part.copy().apply_translation([3 * k, 0, 0]) for k in range(count)]
    given = shaken(trimesh.util.concatenate(parts), 1e-4)
    assert len(given.faces) > 5000
    mesh, notes = repair_normals(given, "part")
    assert notes == ["part: normals are computed; edges of more than 40 degrees are kept sharp."]
    assert corner_cosines(mesh).min() > 0.9


def test_creases_of_few_triangles_are_no_noise():
    mesh, notes = repair_normals(shaken(trimesh.creation.icosphere(subdivisions=4), 0.3), "stone")
    assert len(mesh.faces) == 5120 and "too noisy" in notes[0]
    _, notes = repair_normals(shaken(trimesh.creation.icosphere(subdivisions=3), 0.3), "stone")
    assert notes == ["stone: normals are computed; edges of more than 40 degrees are kept sharp."]


def test_right_normals_of_a_mesh_that_is_inside_out_are_kept():
    ball = buffers(trimesh.creation.icosphere(subdivisions=2))
    given = replace(ball, faces=ball.faces[:, ::-1], normals=ball.positions)
    mesh, notes = repair_normals(given, "ball")
    assert notes == ["ball: the surface was inside out; its triangles are flipped."]
    np.testing.assert_allclose(mesh.normals, ball.positions, atol=1e-12)


# --- orientation ------------------------------------------------------------------


def open_vase() -> trimesh.Trimesh:
    """Return a vase without bottom, lid or thickness, with +Y up."""
    height, angle = np.meshgrid(np.linspace(-1, 1, 12), np.linspace(0, 2 * np.pi, 24))
    radius = 0.5 + 0.2 * np.cos(2 * height)
    points = np.stack([radius * np.cos(angle), height, radius * np.sin(angle)], axis=-1)
    index = np.arange(height.size).reshape(height.shape)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)
    return trimesh.Trimesh(points.reshape(-1, 3), faces, process=False)


def around(count: int = 6, height: float = 1.0, far: float = 4.0) -> list[np.ndarray]:
    """Return poses of cameras towards the origin."""
    poses = []
    for angle in np.linspace(0, 2 * np.pi, count, endpoint=False):
        place = np.array([far * np.cos(angle), height, far * np.sin(angle)])
        forward = -place / np.linalg.norm(place)
        left = np.cross([0.0, 1, 0], forward)
        left /= np.linalg.norm(left)
        poses.append(affine(np.stack([left, np.cross(forward, left), forward], axis=-1), place))
    return poses


def source_of(folder: Path, mesh: trimesh.Trimesh, poses: list[np.ndarray]) -> Source:
    folder.mkdir()
    mesh.export(folder / "mesh.ply")
    write_exr(folder / "map.exr", {"RGB": np.ones((8, 16, 3))})
    frames = []
    for k, pose in enumerate(poses):
        write_exr(folder / f"{k}.exr", {"RGB": np.full((6, 8, 3), 0.5)})
        frames.append(Frame(
            label=f"frame {k}", image=folder / f"{k}.exr", to_world=pose, focal=(9.0, 9.0),
            center=(4.0, 3.0), size=(8, 6),
        ))  # fmt: skip
    light = Light(path=folder / "map.exr")
    return Source(format="test", root=folder, frames=frames, mesh=folder / "mesh.ply", light=light)


@pytest.mark.parametrize("inside_out", [False, True])
def test_an_open_vase_is_turned_to_the_cameras(tmp_path, inside_out):
    mesh = open_vase()
    if inside_out:
        mesh.faces = mesh.faces[:, ::-1]
    notes = import_capture(source_of(tmp_path / "given", mesh, around()), tmp_path / "capture")
    said = [note for note in notes if "its triangles are flipped" in note]
    assert bool(said) == inside_out
    if said:
        words = "% of its visible area are back faces, where nothing is estimated; "
        assert f"mesh.ply: {said[0].split(': ')[1]}" in said[0] and words in said[0]
    capture = svu.load_capture(tmp_path / "capture")  # a warning would be an error
    imported = arrays(capture.mesh)
    outward = imported.positions * [1, 0, 1]
    assert np.einsum("ni,ni->n", imported.normals, outward).mean() > 0.3
    assert corner_cosines(imported).min() > 0.5


@pytest.mark.parametrize(
    ("height", "poses", "turned"),
    [(2.0, around(height=2), False), (-2.0, around(height=-2), True),
     (2.0, [*around(height=2), *around(height=-2)], False)],
)  # fmt: skip
def test_a_plate_shows_the_side_that_was_photographed(tmp_path, height, poses, turned):
    plate = trimesh.Trimesh(
        [[-1, 0, -1], [-1, 0, 1], [1, 0, 1], [1, 0, -1]], [[0, 1, 2], [0, 2, 3]], process=False
    )
    notes = import_capture(source_of(tmp_path / "given", plate, poses), tmp_path / "capture")
    assert any("100% of its" in note for note in notes) == turned
    normal = arrays(svu.load_capture(tmp_path / "capture").mesh).normals
    np.testing.assert_allclose(normal, [[0, np.sign(height), 0]] * len(normal), atol=1e-6)


def outwardness(folder: Path) -> float:
    """Return the mean cosine of imported normals and the direction away from the axis."""
    mesh = capture_mesh.read_ply(folder / "mesh.ply")
    flat = np.array(trimesh.Trimesh(mesh.positions, mesh.faces, process=False).face_normals)
    outward = mesh.positions[mesh.faces].mean(axis=1) * [1, 0, 1]
    return np.einsum("fi,fi->f", flat, outward).mean()


@pytest.mark.parametrize("inside_out", [False, True])
def test_a_correction_that_is_asked_for_wins(tmp_path, inside_out):
    """``--fix mesh-inside-out`` is always applied; a note warns if back faces are visible."""
    mesh = open_vase()
    if inside_out:
        mesh.faces = mesh.faces[:, ::-1]
    options = ImportOptions(fixes=("mesh-inside-out",))
    given = source_of(tmp_path / "given", mesh, around())
    notes = import_capture(given, tmp_path / "capture", options)
    assert not any("its triangles are flipped" in note for note in notes)
    sentence = "is estimated; --fix mesh-inside-out is the cause: omit it if that was not intended"
    assert any(sentence in note for note in notes) == (not inside_out)
    assert (outwardness(tmp_path / "capture") > 0.2) == inside_out
    assert abs(outwardness(tmp_path / "capture")) > 0.2


def test_cameras_inside_a_closed_mesh_mean_other_units(tmp_path):
    """A closed mesh in cm with poses in m is not flipped."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=100.0)
    given = source_of(tmp_path / "given", ball, around())
    notes = import_capture(given, tmp_path / "capture")
    sentence = "mesh and poses have different units, or frames; import with --mesh-scale 0.01."
    assert any(note.endswith(sentence) for note in notes)
    assert not any("flipped" in note for note in notes)
    assert outwardness(tmp_path / "capture") > 0.2
    words = f"Shape 'object': .* cameras are inside the bounding box .*{sentence}"
    with pytest.warns(svu.SvuWarning, match=words):
        svu.load_capture(tmp_path / "capture")
    notes = import_capture(given, tmp_path / "capture", ImportOptions(mesh_scale=0.01))
    assert not any("back faces" in note for note in notes)
    turned = ImportOptions(fixes=("mesh-inside-out",))
    import_capture(given, tmp_path / "capture", turned)
    assert outwardness(tmp_path / "capture") < -0.2


@pytest.mark.parametrize("scale", [10.0, 100.0, 1000.0])
def test_a_scan_without_bottom_in_another_unit_is_not_flipped(tmp_path, scale):
    """From inside, all of an open mesh shows its back; its triangles are right all the same."""
    mesh = open_vase()
    mesh.vertices *= scale
    given = source_of(tmp_path / "given", mesh, around())
    notes = import_capture(given, tmp_path / "capture")
    assert sum(f"import with --mesh-scale {1 / scale:g}." in note for note in notes) == 1
    assert not any("flipped" in note for note in notes)
    assert outwardness(tmp_path / "capture") > 0.2 * scale
    right = import_capture(given, tmp_path / "right", ImportOptions(mesh_scale=1 / scale))
    assert not any("mesh-scale" in note or "flipped" in note for note in right)
    assert svu.load_capture(tmp_path / "right").warnings == ()
    twice = import_capture(given, tmp_path / "twice", ImportOptions(mesh_scale=10.0))
    if scale < 1000:  # 1e4 is no usual factor
        assert any(f"import with --mesh-scale {1 / scale:g}." in note for note in twice)


@pytest.mark.parametrize(("change", "outside"), [
    ({}, True), ({"faces": -1}, False), ({"normals": -1}, False),
    ({"faces": -1, "normals": -1}, False),
])  # fmt: skip
def test_where_the_front_of_a_closed_mesh_is(change, outside):
    ball = trimesh.creation.icosphere(subdivisions=1)
    mesh = MeshArrays(
        np.array(ball.vertices) + 50, np.array(ball.faces)[:, :: change.get("faces", 1)],
        change["normals"] * np.array(ball.vertices) if "normals" in change else None, None,
    )  # fmt: skip
    assert faces_outward(mesh) == outside
    assert not faces_outward(replace(mesh, faces=mesh.faces[1:]))


def test_a_plate_seen_from_both_sides_stays_as_it_is():
    plate = MeshArrays(
        np.array([[-1.0, 0, -1], [-1, 0, 1], [1, 0, 1], [1, 0, -1]]),
        np.array([[0, 1, 2], [0, 2, 3]]), None, None,
    )  # fmt: skip
    scene = make_scene([capture_mesh.make_mesh("plate", plate)])
    eyes = [pose[:3, 3] for h in (1.0, -1.0) for pose in around(height=h)]
    assert back_face_share(scene, plate, eyes) == pytest.approx(0.5, abs=1e-6)
    assert back_face_share(scene, plate, []) == 0


def test_what_hides_the_back_hides_it():
    """The near wall of a vase hides the far wall for both windings."""
    vase = buffers(open_vase())
    scene = make_scene([capture_mesh.make_mesh("vase", vase)])
    level = [pose[:3, 3] for pose in around(height=0.0)]
    assert back_face_share(scene, vase, level) < 0.02
    above = [np.array([0.0, 9.0, 0.1])]  # sees the inside, and the outside of the neck
    assert 0.15 < back_face_share(scene, vase, above) < 0.5


def test_loading_says_that_only_the_back_is_seen(tmp_path):
    """A Mitsuba scene with a mesh that was not imported, so not oriented."""
    import_capture(source_of(tmp_path / "given", open_vase(), around()), tmp_path / "capture")
    path = tmp_path / "capture" / "mesh.ply"
    mesh = capture_mesh.read_ply(path)
    turned = replace(mesh, faces=mesh.faces[:, ::-1], normals=None)
    capture_mesh.write_ply(path, "object", turned)
    sentence = (
        r"Shape 'object': \d+% of its visible area are back faces, which are not estimated; "
        "its normals point the wrong way: set flip_normals on the shape."
    )
    with pytest.warns(svu.SvuWarning, match=sentence):
        svu.load_capture(tmp_path / "capture")


# --- ignored features of glTF ---------------------------------------------------------------


def painted(folder: Path, **material: object) -> Path:
    """Write a plane with a material, and glTF keys that trimesh does not write."""
    points = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    picture = Image.fromarray(np.full((4, 4, 3), 128, np.uint8))
    pbr = PBRMaterial(baseColorTexture=picture)
    visual = trimesh.visual.TextureVisuals(points[:, :2] / 2 + 0.5, pbr)
    mesh = trimesh.Trimesh(points, [[0, 1, 2], [0, 2, 3]], visual=visual, process=False)
    mesh.export(folder / "scan.gltf")
    record = json.loads((folder / "scan.gltf").read_text())
    record["materials"][0].update(material)
    (folder / "scan.gltf").write_text(json.dumps(record))
    return folder / "scan.gltf"


@pytest.mark.parametrize(("material", "named"), [
    ({"normalTexture": {"index": 0, "scale": 2}}, "a normal map"),
    ({"occlusionTexture": {"index": 0}}, "an occlusion map"),
    ({"emissiveFactor": [0, 0.5, 0]}, "emission"),
    ({"alphaMode": "MASK"}, "transparency"),
    ({"extensions": {"KHR_materials_clearcoat": {"clearcoatFactor": 1}}}, "clearcoat"),
    ({"normalTexture": {"index": 0}, "extensions": {"KHR_materials_sheen": {}}}, "sheen"),
])  # fmt: skip
def test_what_a_gltf_has_that_is_ignored_is_said(tmp_path, material, named):
    path = painted(tmp_path, **material)
    sentence = (
        f"{path}: has {named}, ignored: the material has only base colour, roughness and "
        "metallic, and normals come from the mesh."
    )
    assert sentence in read_textured_mesh(path).notes
    assert sentence not in read_textured_mesh(path, geometry_only=True).notes


def test_a_bump_map_of_an_obj_is_said_too(tmp_path):
    Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(tmp_path / "t.png")
    (tmp_path / "scan.mtl").write_text(
        "newmtl a\nKd 1 1 1\nmap_Kd t.png\nmap_Bump -bm 1 n.png\nbump n.png\nnorm n.png\n"
    )
    (tmp_path / "scan.obj").write_text(
        "mtllib scan.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl a\n"
        "f 1/1 2/2 3/3\n"
    )
    assert read_textured_mesh(tmp_path / "scan.obj").notes == [
        f"{tmp_path / 'scan.obj'}: has a bump map, a normal map, ignored: the material has only "
        "base colour, roughness and metallic, and normals come from the mesh."
    ]
    assert not read_textured_mesh(tmp_path / "scan.obj", geometry_only=True).notes[1:]


def test_a_plain_gltf_leaves_nothing_to_say(tmp_path):
    plain = painted(tmp_path, alphaMode="OPAQUE", doubleSided=True, emissiveFactor=[0, 0, 0])
    assert not read_textured_mesh(plain).notes
