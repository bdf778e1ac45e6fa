"""Normal maps of glTF: red tilts to the right of the picture, green to its top."""

from __future__ import annotations

import json

import numpy as np
import pytest
import trimesh
from PIL import Image
from trimesh.visual.material import PBRMaterial

from svu_mi.capture.importers.import_capture import ImportOptions, import_capture
from svu_mi.capture.importers.mesh_files import read_textured_mesh
from svu_mi.capture.importers.source import Frame, Source
from svu_mi.capture.load_warnings import unsupported
from svu_mi.capture.scene import load_scene
from svu_mi.capture.sensors import affine
from svu_mi.core.io.exr import write_exr
from svu_mi.geometry.texels import texels

TILT = np.array([0.3, 0.5, np.sqrt(0.66)])  # right, up, and out of the picture
POINTS = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])


def sheet(folder, mirrored=False, **entry):
    """A square that shows an upright (or mirrored) picture to +z, as glTF."""
    colors = 200, np.rint((TILT / 2 + 0.5) * 255)
    base, normal = (Image.fromarray(np.full((4, 4, 3), c, np.uint8)) for c in colors)
    material = PBRMaterial(baseColorTexture=base, normalTexture=normal)
    uvs = POINTS[:, :2] * ([-1, 1] if mirrored else [1, 1]) + [mirrored, 0]
    visual = trimesh.visual.TextureVisuals(uv=uvs, material=material)
    mesh = trimesh.Trimesh(POINTS, [[0, 1, 2], [0, 2, 3]], visual=visual, process=False)
    mesh.export(folder / "sheet.gltf")
    record = json.loads((folder / "sheet.gltf").read_text())
    record["materials"][0]["normalTexture"].update(entry)
    (folder / "sheet.gltf").write_text(json.dumps(record))
    return folder / "sheet.gltf"


def imported(folder, mesh, **options):
    """Import it with a photograph from the front; return the notes, and the object."""
    write_exr(folder / "0.exr", {"RGB": np.full((6, 8, 3), 0.5)})
    pose = affine(np.diag([-1.0, 1, -1]), np.array([0.5, 0.5, 3]))
    frame = Frame(
        label="frame 0", image=folder / "0.exr", to_world=pose, focal=(9.0, 9.0),
        center=(4.0, 3.0), size=(8, 6),
    )  # fmt: skip
    source = Source(format="test", root=folder, frames=[frame], mesh=mesh)
    notes = import_capture(source, folder / "capture", ImportOptions(**options))
    scene = load_scene(folder / "capture" / "scene.xml")
    assert unsupported(scene, scene.shapes()[0]) == []
    return notes, scene.shapes()[0]


def test_normals_tilt_as_in_the_picture(tmp_path):
    notes, shape = imported(tmp_path, sheet(tmp_path))
    assert not any("normal map" in note for note in notes)
    found = np.array(texels(shape, 4).normal)
    np.testing.assert_allclose(found, np.tile(TILT[:, None], 16), atol=5e-3)  # of 8 bits
    # A mesh with another axis up is rotated with its normals: its -y is up, its z is y.
    (tmp_path / "turned").mkdir()
    _, shape = imported(tmp_path / "turned", sheet(tmp_path / "turned"), fixes=("mesh-x270",))
    rotated = TILT[[0, 2, 1]] * [1, 1, -1]
    np.testing.assert_allclose(np.array(texels(shape, 4).normal)[:, 0], rotated, atol=5e-3)


def test_mirrored_uvs_are_reported(tmp_path):
    """glTF mirrors their tangents, Mitsuba does not."""
    notes, shape = imported(tmp_path, sheet(tmp_path, mirrored=True))
    said = "sheet.gltf: its normal map is ignored, because 100.0% of its UVs are mirrored."
    assert any(note.endswith(said) for note in notes)
    assert not (tmp_path / "capture" / "normals.png").exists()
    np.testing.assert_allclose(np.array(texels(shape, 4).normal)[:, 0], [0, 0, 1], atol=1e-6)


@pytest.mark.parametrize("entry", [{"scale": 0.5}, {"texCoord": 1}])
def test_unusual_normal_maps_are_reported(tmp_path, entry):
    geometry = read_textured_mesh(sheet(tmp_path, **entry))
    assert geometry.normals is None
    assert any("has a normal map, ignored" in note for note in geometry.notes)
    assert read_textured_mesh(sheet(tmp_path)).normals.shape == (4, 4, 3)
    assert read_textured_mesh(sheet(tmp_path), geometry_only=True).normals is None
