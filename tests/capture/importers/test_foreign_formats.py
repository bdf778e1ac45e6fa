"""Files of other tools are recognised and answered with the way to convert them."""

from __future__ import annotations

import io
import json
import sqlite3
import zipfile

import pytest
from PIL import Image

from svu_mi.capture.importers.registry import read_source
from svu_mi.errors import CaptureError

XML = '<?xml version="1.0" encoding="UTF-8"?>\n'
FILES = {
    "cameras.xml": (f'{XML}<document version="2.0.0">\n  <chunk label="a"><sensors/>', "Colmap"),
    "project.psx": (f'{XML}<document version="1.2.0" path="{{projectname}}.files/">', "Colmap"),
    "scene.csv": ("#name,x,y,alt,heading,pitch,roll,f,px,py,k1\n", "RealityScan"),
    "first.csv": ("#cameras 3\n#name,x,y,alt,heading,pitch,roll\n", "realitycapture"),
    "a.xmp": ('<x:xmpmeta xmlns:x="adobe:ns:meta/">\n<rdf:Description xcr:Version="3"', "COLMAP"),
    "scan.rcproj": ('<RealityCapture version="1.4.0">', "COLMAP"),
    "scan.rsproj": ('<RealityScan version="2.0">', "COLMAP"),
    "sfm_data.json": ('{\n "sfm_data_version": "0.3", "views": []}', "openMVG2Colmap"),
    "a.mg": ('{"header": {"pipelineVersion": "2.2"}}', "cameras.sfm"),
    "sfm.abc": ("Ogawa\xff\x00\x01", "ConvertSfMFormat"),
    "bundle.out": ("# Bundle file v0.3\n2 0\n", "COLMAP"),
    "a.nvm": ("NVM_V3\n\n2\n", "colmap automatic_reconstructor"),
    "reconstruction.json": ('[{"cameras": {"v2": {}}}]', "opensfm export_colmap"),
    "cameras.json": ('[{"id": 0, "img_name": "a", "width": 8}]', "cfg_args"),
    "keyframe.json": (
        '{"blur_score": 1, "cx": 9, "t_00": 1, "t_01": 0}',
        "ns-process-data polycam",
    ),
    "metadata": ('{"fps":60,"K":[1,0,0],"w":8,"poses":[[0,0]]}', "ns-process-data record3d"),
    "metadata.json": ('{"poses":[[0,0,0,1,0,0,0]', "ns-process-data record3d"),
    "a.blend": ("BLENDER-v405", "transforms.json"),
}


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("folder", [False, True])
def test_file_of_other_tool_is_named_with_its_export(tmp_path, name, folder):
    text, remedy = FILES[name]
    (tmp_path / name).write_text(text, encoding="latin-1")
    with pytest.raises(CaptureError) as error:
        read_source(tmp_path if folder else tmp_path / name)
    assert str(error.value).startswith(f"{tmp_path / name}: contains ") and remedy in str(
        error.value
    )


def test_binary_files_of_other_tools(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.usdz", "w") as file:
        file.writestr("baked_mesh.usdc", b"PXR-USDC")
    with pytest.raises(CaptureError, match=r"a\.usdz: contains a model of Apple.*colmap auto"):
        read_source(tmp_path / "a.usdz")
    with zipfile.ZipFile(tmp_path / "my.zip", "w") as file:
        file.writestr("my/transforms.json", "{}")
    with pytest.raises(CaptureError, match=r"my\.zip: contains a ZIP archive.*unpack"):
        read_source(tmp_path / "my.zip")
    with sqlite3.connect(tmp_path / "database.db") as database:
        database.execute("CREATE TABLE cameras (camera_id INTEGER)")
    with pytest.raises(CaptureError, match=r"database\.db: contains a database.*colmap mapper"):
        read_source(tmp_path / "database.db")


@pytest.mark.parametrize(
    "place", ["keyframes/corrected_cameras/1.json", "keyframes/cameras/1.json", "images/a.xmp"]
)
def test_files_in_folders_of_other_tools(tmp_path, place):
    (tmp_path / place).parent.mkdir(parents=True)
    (tmp_path / place).write_text('{"t_00": 1}' if "json" in place else '<a xcr:Version="3">')
    with pytest.raises(CaptureError, match=r"Polycam|RealityCapture"):
        read_source(tmp_path)


@pytest.mark.parametrize("place", [".", "images"])
def test_photographs_without_poses(tmp_path, place):
    data = io.BytesIO()
    Image.new("RGB", (2, 2)).save(data, "PNG")
    (tmp_path / place).mkdir(exist_ok=True)
    (tmp_path / place / "a.PNG").write_bytes(data.getvalue())
    with pytest.raises(CaptureError, match="has photographs but no poses; .* colmap automatic"):
        read_source(tmp_path)


def test_imported_capture_is_named(tmp_path):
    (tmp_path / "capture.json").write_text("{}")
    with pytest.raises(CaptureError, match="was imported already; give it to other commands"):
        read_source(tmp_path)


@pytest.mark.parametrize(
    "first", [{}, {"w": 8, "K": 3, "t": [1]}, {"train_filenames": ["a"] * 999}]
)
def test_transforms_are_not_taken_for_other_files(tmp_path, first):
    frame = {
        "w": 8,
        "h": 6,
        "fl_x": 9,
        "transform_matrix": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]],
    }
    record = {**first, "frames": [{**frame, "timestamp": 1, "file_path": "a"}]}
    (tmp_path / "transforms.json").write_text(json.dumps(record))
    assert len(read_source(tmp_path / "transforms.json").frames) == 1


def test_capture_beside_file_of_other_tool_is_read(tmp_path):
    (tmp_path / "cameras.xml").write_text(FILES["cameras.xml"][0])
    test_transforms_are_not_taken_for_other_files(tmp_path, {})
    assert len(read_source(tmp_path).frames) == 1


def test_mitsuba_scenes_and_captures_in_subfolders_are_named(tmp_path):
    scene = tmp_path / "scene.xml"
    scene.write_text('<?xml version="1.0"?>\n<!-- a ball -->\n<scene version="3.0.0"/>')
    with pytest.raises(CaptureError, match="a Mitsuba scene, .* needs no import: svu entropy"):
        read_source(scene)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "transforms.json").write_text('{"frames": []}')
    with pytest.raises(CaptureError, match="contains a capture in .*mine; import that folder"):
        read_source(tmp_path)
