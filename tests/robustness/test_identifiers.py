"""Names from files add no line, element or path to the files that are written with them."""

from __future__ import annotations

import json
import shutil
import warnings
from collections import Counter
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from jinja2 import DictLoader, Environment
from support.helpers import ball, run

from svu_mi.capture.importers.nerf import read_transforms, write_transforms
from svu_mi.capture.importers.source import frame_of
from svu_mi.capture.sensors import make_sensor
from svu_mi.core.identifiers import materialx_name, obj_name, plain_name, xml_id
from svu_mi.core.io.exr import write_exr
from svu_mi.errors import CaptureError
from svu_mi.output import style
from svu_mi.output.export.asset import Asset
from svu_mi.output.export.write_asset import export_asset
from svu_mi.output.guidance_page import _short_name
from svu_mi.output.html import write_page
from svu_mi.output.maps import read_map
from svu_mi.output.texture_files import read_texture
from svu_mi.output.write_guidance import write_sensors
from svu_mi.recovery.svbrdf_textures import Textures

materialx = pytest.importorskip("MaterialX")
HARMLESS = "vase"
HOSTILE = {
    "lines": "a\nv 1 2 3\nf 1 2 3\r\nmtllib x",
    "markup": "<b id=\"x\">&amp;]]>--><script>alert('1')</script>",
    "parameter": "$spp",
    "formula": "$x^{",
    "comment": "# nothing",
    "path": "../../etc/passwd",
    "option": "-rf",
    "letters": "Väse 花 \u202e",
    "controls": "\0\x07\x1b[31m\x85\u2028",
    "surrogate": "\ud800",
    "number": "1",
    "none": "",
    "long": "a" * 5000,
    "root": "world",
}
NAMES = pytest.mark.parametrize("name", HOSTILE.values(), ids=HOSTILE)


def asset(name: str) -> Asset:
    planes = {"base_color": 3, "roughness": 1, "metallic": 1}
    images = {k: mi.TensorXf(np.full((4, 4, n), 0.5, np.float32)) for k, n in planes.items()}
    entropy = np.full((4, 4), 0.5, np.float32)
    return Asset(name=name, mesh=ball(8, 4), textures=Textures(**images), entropy=entropy)


def tags(path: Path) -> list[str]:
    return [node.tag for node in ElementTree.parse(path).iter() if isinstance(node.tag, str)]


def statements(path: Path) -> Counter[str]:
    return Counter(line.split(" ")[0] for line in path.read_text("utf-8").splitlines())


@pytest.fixture(scope="module")
def harmless(tmp_path_factory) -> Path:
    return export_asset(asset(HARMLESS), tmp_path_factory.mktemp("harmless")).parent


@NAMES
def test_export_structure_does_not_depend_on_the_name(name, harmless, tmp_path):
    out = export_asset(asset(name), tmp_path / "out").parent
    written = sorted(path.relative_to(out) for path in out.rglob("*"))
    assert written == sorted(path.relative_to(harmless) for path in harmless.rglob("*"))
    assert statements(out / "mesh.obj") == statements(harmless / "mesh.obj")
    for file in ("object.xml", "preview.xml", "material.mtlx"):
        assert tags(out / file) == tags(harmless / file), file
    shapes = [trimesh.load(folder / "mesh.obj", process=False) for folder in (out, harmless)]
    np.testing.assert_array_equal(*(shape.faces for shape in shapes))
    for file in ("asset.glb", "entropy.glb"):
        scene = trimesh.load(out / file)
        (geometry,) = scene.geometry.values()
        assert geometry.vertices.shape == ball(8, 4).positions.shape
    document = materialx.createDocument()
    materialx.readFromXmlFile(document, str(out / "material.mtlx"))
    assert document.validate() == (True, "") and len(document.getMaterialNodes()) == 1
    assert json.loads((out / "asset.json").read_text())["name"] == plain_name(name)
    assert len(mi.load_file(str(out / "preview.xml")).shapes()) == 2


@NAMES
def test_sensors_are_written_under_legal_names(name, tmp_path):
    camera = make_sensor(RECORD, "camera")
    write_sensors(tmp_path / "sensors.xml", [camera, camera], [name, name])
    write_sensors(tmp_path / "harmless.xml", [camera, camera], [HARMLESS, HARMLESS])
    assert tags(tmp_path / "sensors.xml") == tags(tmp_path / "harmless.xml")
    scene = mi.load_file(str(tmp_path / "sensors.xml"), optimize=False)  # else they are merged
    assert len({sensor.id() for sensor in scene.sensors()}) == 2


RECORD = {
    "to_world": np.eye(4).tolist(), "x_fov": 40.0, "principal_point_offset": [0.0, 0.0],
    "clip": [0.1, 10.0], "film": [8, 8], "crop_offset": [0, 0], "crop_size": [8, 8],
}  # fmt: skip


@NAMES
def test_photographs_of_any_name_are_listed_once(name, tmp_path):
    """What was written is JSON; what it names outside the folder is refused when it is read."""
    camera = make_sensor(RECORD, "camera")
    names = [HARMLESS + ".exr", name + ".exr"]
    write_transforms(tmp_path / "transforms.json", [frame_of(camera, Path(n)) for n in names])
    frames = json.loads((tmp_path / "transforms.json").read_text())["frames"]
    assert len(frames) == 2 and frames[0].keys() == frames[1].keys()
    try:
        source = read_transforms(tmp_path / "transforms.json")
    except CaptureError as error:
        assert "\n" not in str(error) and str(error).isprintable()
    else:
        assert all(frame.image.is_relative_to(tmp_path) for frame in source.frames)


@NAMES
def test_pictures_have_any_name_for_a_title(name, tmp_path):
    """matplotlib takes what stands between two $ for a formula, and raises where it is none."""
    figure = style.new_figure(4, 1)
    style.heading(figure, _short_name(name) + " $", [_short_name(name), "$\\frac$"])
    style.title(figure.add_subplot(), _short_name(name) + "$\\nonsense$")
    with warnings.catch_warnings(action="ignore", category=UserWarning):  # glyphs a font lacks
        style.save_figure(figure, tmp_path / "a.png")


class Tags(HTMLParser):
    """Names of all elements and their attributes, in order."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, ...]] = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, *(key for key, _ in attrs)))


@pytest.mark.slow
@pytest.mark.parametrize("command", ["check", "report"])
def test_pages_of_a_folder_with_markup_in_its_name(command, shot, tmp_path, capsys):
    pages = []
    for name in (HARMLESS, "<img src=x onerror=alert(1)>\"'&amp;"):
        folder = tmp_path / name
        shutil.copytree(shot, folder)
        record = json.loads((shot / "capture.json").read_text())
        record["scene"] = str((shot / record["scene"]).resolve())
        (folder / "capture.json").write_text(json.dumps(record))
        words = ("--resolution", 16) if command == "report" else ()
        page = tmp_path / "out" / f"{command}.html"
        out = page if command == "report" else page.parent
        assert run(command, folder, *words, "-o", out) == 0, capsys.readouterr().err
        pages.append(Tags(page.read_text("utf-8")).tags)
    assert pages[0] == pages[1]


@NAMES
def test_a_page_holds_any_name_as_text(name, tmp_path, monkeypatch):
    template = {"a.html": "<p title='{{ name }}'>{{ name }}</p>"}
    plain = Environment(loader=DictLoader(template), autoescape=True)
    monkeypatch.setattr("svu_mi.output.html._environment", lambda: plain)
    write_page(tmp_path / "a.html", "a.html", name=name)
    assert Tags((tmp_path / "a.html").read_text("utf-8")).tags == [("p", "title")]


@NAMES
def test_legal_names(name):
    assert plain_name(name).isprintable() and plain_name(name).strip()
    for legal in (obj_name(name), xml_id(name), materialx_name(name)):
        assert legal and not set(legal) & set("\n\r <>&\"'$#./\\")
    assert materialx_name(name).isidentifier() and materialx_name(name).isascii()


def test_names_of_channels_add_no_control_characters(tmp_path):
    write_exr(tmp_path / "entropy.exr", {"a\x19b": np.zeros((2, 2), np.float32)})
    for read in (read_map, lambda path: read_texture(path, "roughness")):
        with pytest.raises(CaptureError, match=r"Y, found a\?b\."):
            read(tmp_path / "entropy.exr")
