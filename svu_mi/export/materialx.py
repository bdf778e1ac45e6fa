"""MaterialX: the material as ``standard_surface``, and the mesh as OBJ to put it on.

MaterialX takes the lower left corner of an image for (0, 0) (Specification 1.38, "Image Nodes").
In the OBJ, v runs upwards accordingly; a program that reads the GLB turns its v over to the same.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element, SubElement

from svu_mi.capture.scene_xml import write_document
from svu_mi.export.asset import TEXTURES, Asset, Written
from svu_mi.export.mesh import as_trimesh, upward_uvs
from svu_mi.files import write_text
from svu_mi.names import materialx_name, obj_name
from svu_mi.parameters import CHANNELS

MATERIAL, MESH = "material.mtlx", "mesh.obj"
DIGITS = 10  # after the point: objects of a millimetre in metres keep single precision
VERSION = "1.38"  # later ones read it, too
INDEX_OF_REFRACTION = 1.5  # F0 = 0.04, as specular = 0.5 of Mitsuba's principled
# Inputs of standard_surface, by parameter.
INPUTS = {
    "base_color": "base_color", "roughness": "specular_roughness", "metallic": "metalness",
}  # fmt: skip


def write_materialx(asset: Asset, folder: Path) -> list[Written]:
    """Write ``material.mtlx`` and ``mesh.obj``; the textures are those written as PNG.

    Raises:
        OutputError: a file cannot be written.
    """
    write_document(_document(materialx_name(asset.name)), folder / MATERIAL)
    _write_obj(asset, folder / MESH)
    return [
        Written(file=MATERIAL, format="materialx", holds="material",
                values="standard_surface; colour space of the document lin_rec709"),
        Written(file=MESH, format="materialx", holds="mesh", values="v = 0 at an image's bottom"),
    ]  # fmt: skip


def _document(name: str) -> Element:
    root = Element("materialx", version=VERSION, colorspace="lin_rec709")
    kinds = {parameter: "color3" if CHANNELS[parameter] == 3 else "float" for parameter in INPUTS}
    for parameter, kind in kinds.items():
        image = SubElement(root, "image", name=f"{name}_{parameter}", type=kind)
        file = _input(image, "file", "filename", value=f"{TEXTURES}/{parameter}.png")
        if kind == "color3":  # numbers have no colour space, and are taken as they are
            file.set("colorspace", "srgb_texture")
    surface = SubElement(root, "standard_surface", name=f"{name}_surface", type="surfaceshader")
    _input(surface, "base", "float", value="1")
    for parameter, kind in kinds.items():
        _input(surface, INPUTS[parameter], kind, nodename=f"{name}_{parameter}")
    _input(surface, "specular_IOR", "float", value=str(INDEX_OF_REFRACTION))
    material = SubElement(root, "surfacematerial", name=name, type="material")
    _input(material, "surfaceshader", "surfaceshader", nodename=f"{name}_surface")
    look = SubElement(root, "look", name=f"{name}_look")
    SubElement(look, "materialassign", name=f"{name}_assign", material=name, geom="/")
    return root


def _input(parent: Element, name: str, kind: str, **attributes: str) -> Element:
    return SubElement(parent, "input", {"name": name, "type": kind, **attributes})


def _write_obj(asset: Asset, path: Path) -> None:
    from trimesh.exchange.obj import export_obj
    from trimesh.visual import TextureVisuals

    mesh = as_trimesh(asset.mesh, TextureVisuals(uv=upward_uvs(asset.mesh)))
    text, _ = export_obj(
        mesh,
        include_normals=asset.mesh.normals is not None,
        return_texture=True,
        header=None,
        digits=DIGITS,
    )
    # trimesh names a material of its own, which is grey; ours is in the other file.
    left_out = ("mtllib", "usemtl")
    kept = [line for line in text.splitlines() if line and not line.startswith(left_out)]
    write_text(path, "\n".join([f"o {obj_name(asset.name)}", *kept]))
