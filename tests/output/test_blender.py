"""An exported GLB in Blender itself, for those who have it: ``pip install bpy``."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys

import numpy as np
import pytest
from scipy.spatial import cKDTree
from support.helpers import lettered, recovered_folder

import svu_mi as svu
from svu_mi.capture.image_io import srgb
from svu_mi.core.io.exr import write_exr
from svu_mi.parameters import NAMES

# bpy brings NumPy and its own libraries: it runs in a process that imports nothing of ours.
BLENDER = """
import json, sys, bpy, numpy as np
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.import_scene.gltf(filepath=sys.argv[1])
shape, = (each for each in bpy.data.objects if each.type == "MESH")
mesh = shape.data
corner = np.array([shape.matrix_world @ mesh.vertices[l.vertex_index].co for l in mesh.loops])
uv = np.array([each.uv for each in mesh.uv_layers.active.data])
tree = mesh.materials[0].node_tree
shader = next(n for n in tree.nodes if n.type == "BSDF_PRINCIPLED")

def source(name):
    link, = shader.inputs[name].links
    node, channel = link.from_node, link.from_socket.name
    while node.type != "TEX_IMAGE":
        channel = link.from_socket.name
        link = next(l for i in node.inputs for l in i.links)
        node = link.from_node
    image = node.image
    pixels = np.array(image.pixels[:]).reshape(image.size[1], image.size[0], 4)
    return {"channel": channel, "space": image.colorspace_settings.name, "pixels": pixels.tolist()}

sockets = {"base_color": "Base Color", "roughness": "Roughness", "metallic": "Metallic"}
print(json.dumps({
    "corner": corner.tolist(), "uv": uv.tolist(),
    "textures": {name: source(socket) for name, socket in sockets.items()},
    "extras": {k: v.to_dict() for k, v in mesh.materials[0].items() if hasattr(v, "to_dict")},
}))
"""


@pytest.mark.skipif(importlib.util.find_spec("bpy") is None, reason="bpy is not installed")
def test_blender_reads_textures_uvs_and_the_up_axis(tmp_path):
    """Blender is +Z up, with v = 0 at the bottom; its first row of pixels is the lowest."""
    textures = lettered(48, 32)
    recovered_folder(tmp_path / "result", textures)
    rough = np.linspace(0, 0.4, 32 * 48, dtype=np.float32).reshape(32, 48)
    write_exr(tmp_path / "result" / "uncertainty.exr", {"roughness.sd": rough})
    svu.export_asset(tmp_path / "result", tmp_path / "out", svu.ExportOptions(formats=("glb",)))
    line = [sys.executable, "-c", BLENDER, str(tmp_path / "out" / "asset.glb")]
    said = subprocess.run(line, check=True, capture_output=True, text=True).stdout
    found = json.loads(said[said.index('{"corner"') :].splitlines()[0])

    mesh = svu.load_asset(tmp_path / "result").mesh
    x, y, z = mesh.positions[mesh.faces].reshape(-1, 3).T
    u, v = mesh.uvs[mesh.faces].reshape(-1, 2).T
    wanted = np.stack([x, -z, y, u, 1 - v], axis=1)
    got = np.concatenate([found["corner"], found["uv"]], axis=1)
    assert len(got) == len(wanted)
    for one, other in ((got, wanted), (wanted, got)):
        assert cKDTree(one).query(other)[0].max() < 1e-5

    base, roughness, metallic = (
        found["textures"][name] for name in ("base_color", "roughness", "metallic")
    )
    inside = np.s_[6:22, 10:40]  # of the chart, beside which colours are extended
    shown = {one["space"]: np.array(one["pixels"])[::-1][inside] for one in (base, roughness)}
    color, rough, metal = (np.array(textures[name])[inside] for name in NAMES)
    np.testing.assert_allclose(shown["sRGB"][..., :3], srgb(color), atol=0.003)
    np.testing.assert_allclose(shown["Non-Color"][..., 1:3], np.dstack([rough, metal]), atol=0.003)
    assert (base["channel"], roughness["channel"], metallic["channel"]) == (
        "Color",
        "Green",
        "Blue",
    )
    assert list(found["extras"]) == ["roughness_sd"]
