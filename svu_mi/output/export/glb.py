"""Binary glTF 2.0 (GLB): object with textures, and object coloured by entropy."""

import base64
import io
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation
from trimesh.exchange.gltf import export_glb
from trimesh.visual import ColorVisuals, TextureVisuals
from trimesh.visual.material import PBRMaterial

import svu_mi
from svu_mi.capture.image_io import decoded, quantized, srgb
from svu_mi.capture.mesh import MeshArrays, flipped_v
from svu_mi.capture.up_direction import UP
from svu_mi.core.io.files import replacing
from svu_mi.output.export.asset import SD, Asset, AssetFile
from svu_mi.output.export.asset_images import orm_image
from svu_mi.output.object_views import Up, upward
from svu_mi.output.style import COLORMAP

ASSET, ENTROPY = "asset.glb", "entropy.glb"
UNLIT = "KHR_materials_unlit"


def write_asset_glb(
    asset: Asset, folder: Path, at_vertices: Mapping[str, np.ndarray], *, up: Up
) -> AssetFile:
    """Write ``asset.glb``: mesh and textures (8-bit PNG) in one file.

    Maps at the N vertices become the attributes ``_ENTROPY`` and so on, which viewers ignore.
    Standard deviations are also textures, named by ``extras`` of the material; white is 1.
    """
    base_color = np.array(asset.textures.base_color)
    material = PBRMaterial(
        name=asset.name,
        baseColorTexture=Image.fromarray(quantized(srgb(base_color))),
        metallicRoughnessTexture=Image.fromarray(quantized(orm_image(asset))),
        normalTexture=None if asset.normals is None else Image.fromarray(quantized(asset.normals)),
        baseColorFactor=[255, 255, 255, 255],
        metallicFactor=1.0,
        roughnessFactor=1.0,
        doubleSided=asset.two_sided,
    )
    visual = TextureVisuals(uv=upward_uvs(asset.mesh), material=material)
    attributes = {f"_{name.upper()}": values for name, values in at_vertices.items()}
    _write(folder / ASSET, asset, visual, up, attributes, partial(_add_deviations, asset))
    return AssetFile(
        file=ASSET, format="glb", holds=", ".join(["mesh", "textures", *attributes]),
        values="8 bits; base colour sRGB; roughness (G), metallic (B) and standard deviations "
        "(extras of the material) linear",
    )  # fmt: skip


def _add_deviations(asset: Asset, tree: dict[str, Any]) -> None:
    """Add textures of standard deviations, which ``extras`` of the material refer to."""
    extras = {}
    for name, image in asset.deviations.items():
        png = io.BytesIO()
        Image.fromarray(quantized(image)).save(png, "PNG")
        data = base64.b64encode(png.getvalue()).decode()
        tree["images"].append({"name": name + SD, "uri": f"data:image/png;base64,{data}"})
        tree["textures"].append({"name": name + SD, "source": len(tree["images"]) - 1})
        extras[name + SD] = {"index": len(tree["textures"]) - 1}
    if extras:
        tree["materials"][0]["extras"] = extras


def write_entropy_glb(asset: Asset, folder: Path, entropy: np.ndarray, *, up: Up) -> AssetFile:
    """Write ``entropy.glb``: the mesh with entropy as unlit vertex colours.

    A separate file, because glTF multiplies vertex colours with textures.
    """
    from matplotlib import colormaps

    shown = colormaps[COLORMAP](entropy)[:, :3].astype(np.float32)
    colors = quantized(decoded(shown))  # COLOR_0 is linear (Sec. 3.7.2.1)
    visual = ColorVisuals(vertex_colors=np.insert(colors, 3, 255, axis=1))

    def unlit(tree: dict[str, Any]) -> None:
        tree["materials"] = [{
            "name": f"{asset.name} entropy", "doubleSided": asset.two_sided,
            "pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 1},
            "extensions": {UNLIT: {}},
        }]  # fmt: skip
        tree["extensionsUsed"] = [UNLIT]
        tree["meshes"][0]["primitives"][0]["material"] = 0

    _write(folder / ENTROPY, asset, visual, up, {"_ENTROPY": entropy}, unlit)
    return AssetFile(
        file=ENTROPY, format="glb", holds="entropy",
        values=f"vertex colours, {COLORMAP} over [0, 1]; _ENTROPY has the numbers",
    )  # fmt: skip


def _write(
    path: Path, asset: Asset, visual: Any, up: Up, attributes: Mapping[str, np.ndarray],
    change: Any = None,
) -> None:  # fmt: skip

    def finish(tree: dict[str, Any]) -> None:
        tree["asset"]["generator"] = f"svu_mi {svu_mi.__version__}"
        if change is not None:
            change(tree)

    turn = np.eye(4)  # glTF 2.0, Sec. 3.4: right-handed, +Y up
    turn[:3, :3] = Rotation.align_vectors([UP], [upward(up)])[0].as_matrix()
    scene = trimesh.Scene()
    mesh = as_trimesh(asset.mesh, visual, attributes)
    scene.add_geometry(mesh, node_name=asset.name, geom_name=asset.name, transform=turn)
    # Without normals, glTF requires flat shading (Sec. 3.7.2.1), like Mitsuba.
    data = export_glb(
        scene, include_normals=asset.mesh.normals is not None, tree_postprocessor=finish
    )
    with replacing(path) as temporary:
        temporary.write_bytes(data)


def as_trimesh(
    mesh: MeshArrays, visual: Any, attributes: Mapping[str, np.ndarray] | None = None
) -> Any:
    """Return a ``trimesh.Trimesh`` with the same vertices and order, and normals if present."""
    return trimesh.Trimesh(
        mesh.positions, front_faces(mesh), vertex_normals=mesh.normals, visual=visual,
        vertex_attributes=dict(attributes or {}), process=False,
    )  # fmt: skip


def front_faces(mesh: MeshArrays) -> np.ndarray:
    """Return (F, 3) faces wound counter-clockwise around their normals.

    Mitsuba uses normals to find front faces; other programs use the winding.
    """
    if mesh.normals is None:
        return mesh.faces
    normal = mesh.normals[mesh.faces].sum(axis=1)
    away = np.einsum("fi,fi->f", mesh.crosses, normal) < 0
    return np.where(away[:, None], mesh.faces[:, ::-1], mesh.faces)


def upward_uvs(mesh: MeshArrays) -> np.ndarray:
    """Return (N, 2) UVs with v = 0 at the bottom of an image, as in trimesh and OBJ."""
    assert mesh.uvs is not None
    return flipped_v(mesh.uvs)
