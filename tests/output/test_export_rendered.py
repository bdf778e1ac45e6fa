"""Exported assets as other programs show them: against the scene that ``svu recover`` wrote."""

from __future__ import annotations

import base64
import json
from types import SimpleNamespace
from xml.etree import ElementTree

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from support.browser import Browser
from support.helpers import lettered, recovered_folder, write_known

import svu_mi as svu
from svu_mi.capture.image_io import srgb
from svu_mi.capture.mesh import MeshArrays, make_mesh
from svu_mi.capture.sensors import describe, make_sensor
from svu_mi.evaluation.psnr import psnr
from svu_mi.output.texture_files import MESH

SPP = 16
BETTER_THAN = 35.0  # dB, of 8-bit textures against single precision
SOFTWARE_WEBGL = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")
# Ends the page of trimesh's viewer, which brings three.js and its GLTFLoader.
SHOW = """
const view = VIEW;
const renderer_ = new THREE.WebGLRenderer({preserveDrawingBuffer: true, antialias: true});
renderer_.outputEncoding = THREE.sRGBEncoding;
renderer_.setSize(view.width, view.height);
document.body.appendChild(renderer_.domElement);
const shown = new THREE.Scene();
shown.background = new THREE.Color(view.mode == "color" ? 0x000000 : 0xffffff);
if (view.mode == "lit") {
  const room = new THREE.Scene();
  room.background = new THREE.Color(0xffffff);
  shown.environment = new THREE.PMREMGenerator(renderer_).fromScene(room).texture;
}
const eye = new THREE.PerspectiveCamera(view.fov, view.width / view.height, view.near, view.far);
eye.matrixAutoUpdate = false;
eye.matrix.fromArray(view.matrix);
eye.updateMatrixWorld(true);
const data = Uint8Array.from(atob("DATA"), c => c.charCodeAt(0)).buffer;
const done = new Promise((resolve, reject) => new THREE.GLTFLoader().parse(data, "", gltf => {
  let material = null;
  gltf.scene.traverse(node => { if (node.isMesh) {
    const m = node.material;
    material = {type: m.type, roughness: m.roughness, metalness: m.metalness,
      same: !!m.roughnessMap && m.roughnessMap === m.metalnessMap, colors: m.vertexColors,
      srgb: !!m.map && m.map.encoding === THREE.sRGBEncoding};
    if (view.mode == "color") node.material = new THREE.MeshBasicMaterial({map: m.map});
  } });
  shown.add(gltf.scene);
  shown.updateMatrixWorld(true);
  renderer_.render(shown, eye);
  resolve(material);
}, reject));</script>"""


@pytest.fixture(scope="module")
def rendered(tmp_path_factory):
    """A result, its export, and the pictures of ``recovered.xml``."""
    folder = tmp_path_factory.mktemp("result")
    capture = recovered_folder(folder, lettered(96, 80))
    write_known(folder, 32, 32)
    asset = tmp_path_factory.mktemp("asset")
    svu.export_asset(folder, asset)
    pictures = render(mi.load_file(str(folder / "recovered.xml")))
    return SimpleNamespace(folder=folder, asset=asset, capture=capture, pictures=pictures)


def render(scene):
    """The three views; the same seeds, so only what is seen differs."""
    return np.array([np.array(mi.render(scene, sensor=k, spp=SPP, seed=k)) for k in range(3)])


def scene_with(rendered, tmp_path, objects):
    """``recovered.xml`` with other nodes in the place of its object."""
    tree = ElementTree.parse(rendered.folder / "recovered.xml")
    root = tree.getroot()
    for shape in root.findall("shape"):
        if shape.find(f"string[@value='{MESH}']") is not None:
            root.remove(shape)
    root.extend(ElementTree.fromstring(f"<all>{objects}</all>"))
    tree.write(tmp_path / "scene.xml")
    return mi.load_file(str(tmp_path / "scene.xml"))


def painted(mesh, textures):
    """XML of a shape in three bitmaps; base colour is sRGB where it is a PNG."""
    bitmaps = "".join(
        f'<texture type="bitmap" name="{name}"><string name="filename" value="{path}"/>'
        f'<boolean name="raw" value="{str(name != "base_color").lower()}"/></texture>'
        for name, path in textures.items()
    )
    return (
        f'<shape type="{mesh.suffix[1:]}"><string name="filename" value="{mesh}"/>'
        f'<bsdf type="principled">{bitmaps}</bsdf></shape>'
    )


def included(asset):
    """XML as the comment in ``object.xml`` says."""
    return f'<path value="{asset}"/><include filename="object.xml"/>'


def unpack(glb, folder):
    """Read a GLB with trimesh and write what is in it for Mitsuba; return paths by parameter."""
    (mesh,) = trimesh.load_scene(glb, process=False).geometry.values()  # to_mesh() drops normals
    uvs = mesh.visual.uv * [1, -1] + [0, 1]  # trimesh has v = 0 at the bottom, Mitsuba at the top
    arrays = MeshArrays(mesh.vertices, mesh.faces, mesh.vertex_normals, uvs)
    make_mesh("read", arrays).write_ply(str(folder / "read.ply"))
    material = mesh.visual.material
    material.baseColorTexture.save(folder / "base_color.png")
    _, rough, metal = material.metallicRoughnessTexture.split()
    rough.save(folder / "roughness.png")
    metal.save(folder / "metallic.png")
    return {name: folder / f"{name}.png" for name in ("base_color", "roughness", "metallic")}


@pytest.mark.slow
def test_the_glb_shows_what_was_recovered(rendered, tmp_path):
    textures = unpack(rendered.asset / "asset.glb", tmp_path)
    pictures = render(scene_with(rendered, tmp_path, painted(tmp_path / "read.ply", textures)))
    assert relative_psnr(pictures, rendered.pictures) > BETTER_THAN
    upside_down = render(scene_with(rendered, tmp_path, painted(tmp_path / "read.ply", {
        **textures, "base_color": flipped(textures["base_color"], tmp_path / "flipped.png"),
    })))  # fmt: skip
    assert relative_psnr(upside_down, rendered.pictures) < 25  # it can be seen


def relative_psnr(pictures, truth):
    """Peak signal-to-noise ratio; the peak is the largest value of the truth."""
    return psnr(pictures / truth.max(), truth / truth.max())


def flipped(path, target):
    mi.Bitmap(np.array(mi.Bitmap(str(path)))[::-1].copy()).write(str(target))
    return target


@pytest.mark.slow
@pytest.mark.parametrize("mesh", ["mesh.obj", "mesh.ply"])
def test_png_textures_show_what_was_recovered(rendered, tmp_path, mesh):
    """Mitsuba turns v of an OBJ over: there it runs up, in a PLY down."""
    textures = {n: rendered.asset / "textures" / f"{n}.png"
                for n in ("base_color", "roughness", "metallic")}  # fmt: skip
    pictures = render(scene_with(rendered, tmp_path, painted(rendered.asset / mesh, textures)))
    assert relative_psnr(pictures, rendered.pictures) > BETTER_THAN


def test_the_object_is_included_by_another_scene(rendered, tmp_path):
    pictures = render(scene_with(rendered, tmp_path, included(rendered.asset)))
    np.testing.assert_allclose(pictures, rendered.pictures, atol=1e-5)


def test_the_preview_shows_the_object(rendered):
    scene = mi.load_file(str(rendered.asset / "preview.xml"), spp=4)
    assert scene.sensors()[0].sampler().sample_count() == 4
    picture = srgb(np.clip(np.array(mi.render(scene, spp=4, seed=2)), 0, 1))
    empty, middle = picture[:6].reshape(-1, 3), picture[156:356, 156:356].reshape(-1, 3)
    assert np.ptp(empty) < 1e-3  # all of the object fits
    assert 0.2 < np.median(middle) < 0.9 and middle.std() > 0.05


# --- A browser ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def webgl(tmp_path_factory):
    """A browser that draws without a graphics card."""
    running = Browser(tmp_path_factory.mktemp("webgl"), *SOFTWARE_WEBGL)
    yield running
    running.close()


def show(webgl, folder, glb, sensor, mode):
    """Return what three.js has found in a GLB, and its picture from a sensor's place."""
    record = describe(sensor)
    pose = np.array(record["to_world"]) @ np.diag([-1, 1, -1, 1])  # three.js looks along -Z
    width, height = record["film"]
    near, far = record["clip"]
    view = {"width": width, "height": height, "fov": record["x_fov"], "near": near, "far": far,
            "matrix": pose.T.ravel().tolist(), "mode": mode}  # fmt: skip
    archive = trimesh.resources.get_bytes("templates/viewer.zip")
    template = trimesh.util.decompress(archive, file_type="zip")["viewer.html.template"]
    start = template.read().decode().rpartition("init();</script>")[0]
    data = base64.b64encode(glb.read_bytes()).decode()
    page = folder / "page.html"
    page.write_text(start + SHOW.replace("VIEW", json.dumps(view)).replace("DATA", data))
    opened = webgl.open(page, width, height)
    material = opened.evaluate("done")
    assert not opened.complaints and not opened.requests
    opened.screenshot(folder / "shown.png", full=False)
    opened.close()
    return material, np.array(mi.Bitmap(str(folder / "shown.png")))[..., :3] / 255


def large(sensor, side=96):
    return make_sensor({**describe(sensor), "film": [side, side], "crop_size": [side, side]}, "")


def seen_by_mitsuba(rendered, sensor, shape):
    """The picture of the PLY as a plain shape, in sRGB."""
    mesh = {"type": "ply", "filename": str(rendered.asset / "mesh.ply"), **shape}
    scene = mi.load_dict({"type": "scene", "i": {"type": "direct"}, "mesh": mesh}, optimize=False)
    return srgb(np.clip(np.array(mi.render(scene, sensor=sensor, spp=SPP)), 0, 1))


@pytest.mark.slow
def test_a_browser_shows_the_textures_the_right_way_round(rendered, webgl, tmp_path):
    sensor = large(rendered.capture.sensors[1])  # sees the letter
    material, shown = show(webgl, tmp_path, rendered.asset / "asset.glb", sensor, "color")
    assert material == {
        "type": "MeshStandardMaterial", "roughness": 1, "metalness": 1, "same": True,
        "srgb": True, "colors": False,
    }  # fmt: skip
    glowing = seen_by_mitsuba(rendered, sensor, {"light": {"type": "area", "radiance": {
        "type": "bitmap", "filename": str(rendered.asset / "textures" / "base_color.exr"),
    }}})  # fmt: skip
    assert psnr(shown, glowing) > 30  # edges are smoothed in two ways
    assert psnr(shown[::-1], glowing) < 20 and psnr(shown[:, ::-1], glowing) < 20


@pytest.mark.slow
def test_a_browser_shades_as_mitsuba_does(rendered, webgl, tmp_path):
    """In a white room, where the split-sum approximation of three.js is good."""
    sensor = large(rendered.capture.sensors[0])
    _, shown = show(webgl, tmp_path, rendered.asset / "asset.glb", sensor, "lit")
    scene = scene_with(rendered, tmp_path, included(rendered.asset))
    picture = srgb(np.clip(np.array(mi.render(scene, sensor=sensor, spp=64)), 0, 1))
    assert psnr(shown, picture) > 25


@pytest.mark.slow
def test_a_browser_shows_entropy_without_light(rendered, webgl, tmp_path):
    sensor = large(rendered.capture.sensors[0])
    material, shown = show(webgl, tmp_path, rendered.asset / "entropy.glb", sensor, "as it is")
    assert material["type"] == "MeshBasicMaterial" and material["colors"]
    # Half of it is unseen: the yellow end of viridis, whatever the light.
    yellow = np.abs(shown - np.array([253, 231, 37]) / 255).max(axis=-1) < 0.02
    assert yellow.any()
