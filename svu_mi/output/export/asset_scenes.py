"""Scene files of an asset: Mitsuba XML, and MaterialX with an OBJ mesh.

In MaterialX, (0, 0) is the lower left corner of an image (Specification 1.38, "Image Nodes"), so v
points upwards in the OBJ. In the GLB, v points downwards.
"""

from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Comment, Element, SubElement

import mitsuba as mi
import numpy as np
from trimesh.exchange.obj import export_obj
from trimesh.visual import TextureVisuals

import svu_mi
from svu_mi.capture import scene_xml
from svu_mi.capture.mesh import make_mesh
from svu_mi.capture.sensors import bounding_sphere, sphere_sensors
from svu_mi.core.identifiers import materialx_name, obj_name
from svu_mi.core.io.files import write_text
from svu_mi.output.export.asset import TEXTURES, Asset, AssetFile
from svu_mi.output.export.glb import as_trimesh, upward_uvs
from svu_mi.output.object_views import Up, upward
from svu_mi.output.texture_files import FILES, object_node
from svu_mi.parameters import CHANNELS

OBJECT, PREVIEW, MESH = "object.xml", "preview.xml", "mesh.ply"
FILM = (512, 512)
ROOM, LAMP = 0.5, 16.0  # radiance of the preview's background and lamp
USE = """ Written by svu_mi {version}. To use the object in another scene:
       <path value="this folder"/>
       <include filename="object.xml"/>
     With two such objects in a scene, prepend its folder to each filename below. """
MATERIAL, OBJ = "material.mtlx", "mesh.obj"
DIGITS = 10  # decimals: objects of 1 mm in scenes in metres keep single precision
VERSION = "1.38"  # later versions read it, too
INDEX_OF_REFRACTION = 1.5  # F0 = 0.04, as specular = 0.5 of Mitsuba's principled
# Inputs of standard_surface, by parameter.
INPUTS = {"base_color": "base_color", "roughness": "specular_roughness", "metallic": "metalness"}


def write_mitsuba(asset: Asset, folder: Path, *, up: Up) -> list[AssetFile]:
    """Write ``object.xml``, ``mesh.ply`` and ``preview.xml``, which use the EXR textures.

    ``up`` is the upward axis of the preview's camera.
    """
    textures = {name: f"{TEXTURES}/{file}" for name, file in FILES.items()}
    layer = None
    if asset.normals is not None:
        picture = {"type": "bitmap", "bitmap": mi.Bitmap(asset.normals), "raw": True}
        layer = mi.load_dict(
            {"type": "normalmap", "normalmap": picture, "material": {"type": "diffuse"}}
        )
    node = object_node(
        asset.name, asset.mesh, folder, file=MESH, textures=textures, two_sided=asset.two_sided,
        layer=layer, normals=f"{TEXTURES}/normal.exr",
    )  # fmt: skip
    _write(folder / OBJECT, [Comment(USE.format(version=svu_mi.__version__)), node])
    _write(folder / PREVIEW, _preview(asset, up))
    return [
        AssetFile(file=OBJECT, format="xml", holds="object", values="to <include> in a scene"),
        AssetFile(file=PREVIEW, format="xml", holds="scene", values="object, light and camera"),
        AssetFile(file=MESH, format="xml", holds="mesh", values="v = 0 at the top of an image"),
    ]  # fmt: skip


def _preview(asset: Asset, up: Up) -> list[Element]:
    """Return the nodes of a scene: object, grey background, lamp at the upper left."""
    shape = make_mesh(asset.name, asset.mesh)
    camera = sphere_sensors(shape, 1, FILM, up=upward(up), lowest=-0.4)[0]
    pose = np.array(camera.world_transform().matrix, np.float64).reshape(4, 4)
    center, radius = bounding_sphere(shape)
    left, above, forward = pose[:3, :3].T
    place = center + 3 * radius * (0.8 * left + above - 0.8 * forward)
    turn = mi.ScalarTransform4f().look_at(
        list(map(float, place)), list(map(float, center)), list(map(float, above))
    ).scale(float(radius))  # fmt: skip
    # Prefix the ids: the object itself may be called lamp or camera.
    room, lamp, view = (f"{asset.name}_{what}" for what in ("room", "lamp", "camera"))
    matrix = np.array(turn.matrix, np.float64)
    square = scene_xml.plugin("shape", "rectangle", id=lamp, to_world=matrix)
    square.append(scene_xml.plugin("emitter", "area", radiance=[LAMP] * 3))
    return [
        Element("default", name="spp", value=str(scene_xml.SAMPLES)),
        scene_xml.plugin("integrator", "path", max_depth=8),
        scene_xml.sensor(camera, view),
        scene_xml.plugin("emitter", "constant", id=room, radiance=[ROOM] * 3),
        square,
        Element("include", filename=OBJECT),
    ]


def _write(path: Path, children: list[Any]) -> None:
    root = Element("scene", version="3.0.0")
    root.extend(children)
    scene_xml.write_document(root, path)


def write_materialx(asset: Asset, folder: Path) -> list[AssetFile]:
    """Write ``material.mtlx`` and ``mesh.obj``, which use the PNG textures."""
    root = _document(materialx_name(asset.name), with_normals=asset.normals is not None)
    scene_xml.write_document(root, folder / MATERIAL)
    mesh = as_trimesh(asset.mesh, TextureVisuals(uv=upward_uvs(asset.mesh)))
    text, _ = export_obj(
        mesh,
        include_normals=asset.mesh.normals is not None,
        return_texture=True,
        header=None,
        digits=DIGITS,
    )
    # Remove trimesh's default grey material.
    left_out = ("mtllib", "usemtl")
    kept = [line for line in text.splitlines() if line and not line.startswith(left_out)]
    write_text(folder / OBJ, "\n".join([f"o {obj_name(asset.name)}", *kept]))
    return [
        AssetFile(file=MATERIAL, format="materialx", holds="material",
                values="standard_surface; colour space of the document lin_rec709"),
        AssetFile(
            file=OBJ, format="materialx", holds="mesh", values="v = 0 at the bottom of an image"
        ),
    ]  # fmt: skip


def _document(name: str, *, with_normals: bool) -> Element:
    root = Element("materialx", version=VERSION, colorspace="lin_rec709")
    kinds = {parameter: "color3" if CHANNELS[parameter] == 3 else "float" for parameter in INPUTS}
    for parameter, kind in kinds.items():
        image = SubElement(root, "image", name=f"{name}_{parameter}", type=kind)
        file = _input(image, "file", "filename", value=f"{TEXTURES}/{parameter}.png")
        if kind == "color3":  # floats have no colour space
            file.set("colorspace", "srgb_texture")
    surface = SubElement(root, "standard_surface", name=f"{name}_surface", type="surfaceshader")
    _input(surface, "base", "float", value="1")
    for parameter, kind in kinds.items():
        _input(surface, INPUTS[parameter], kind, nodename=f"{name}_{parameter}")
    _input(surface, "specular_IOR", "float", value=str(INDEX_OF_REFRACTION))
    if with_normals:
        image = SubElement(root, "image", name=f"{name}_normal", type="vector3")
        _input(image, "file", "filename", value=f"{TEXTURES}/normal.png")
        mapped = SubElement(root, "normalmap", name=f"{name}_mapped", type="vector3")
        _input(mapped, "in", "vector3", nodename=f"{name}_normal")
        _input(surface, "normal", "vector3", nodename=f"{name}_mapped")
    material = SubElement(root, "surfacematerial", name=name, type="material")
    _input(material, "surfaceshader", "surfaceshader", nodename=f"{name}_surface")
    look = SubElement(root, "look", name=f"{name}_look")
    SubElement(look, "materialassign", name=f"{name}_assign", material=name, geom="/")
    return root


def _input(parent: Element, name: str, kind: str, **attributes: str) -> Element:
    return SubElement(parent, "input", {"name": name, "type": kind, **attributes})
