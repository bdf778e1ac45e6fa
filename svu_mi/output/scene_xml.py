"""``recovered.xml``: a scene of plain Mitsuba that shows the object as it was recovered."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Comment, Element

import mitsuba as mi
import numpy as np

from svu_mi.capture import Capture, nodes
from svu_mi.capture.mesh import MeshArrays, arrays, write_ply
from svu_mi.capture.repaint import is_same, is_two_sided
from svu_mi.errors import SvuWarning
from svu_mi.files import prepare_folder
from svu_mi.output import scene_nodes
from svu_mi.output.textures import FILES, write_textures
from svu_mi.recovery.textures import Textures

SCENE = "recovered.xml"
ASSETS = "assets"
MESH = f"{ASSETS}/mesh.ply"
ANALYTIC = {"Sphere": "sphere", "Disk": "disk", "Cylinder": "cylinder"}
SPECULAR = 0.5  # of the principled BSDF: F0 = 0.04, as recovery takes it to be
WRAP = "repeat"  # a chart that goes around closes without a seam


def write_scene(
    capture: Capture,
    textures: Textures,
    folder: str | Path,
    *,
    attributes: Mapping[str, str | int | float] | None = None,
) -> Path:
    """Write the capture's scene with the object in recovered textures.

    The file loads with ``mitsuba.load_file`` alone and has the object with the UVs of its
    texels, all other shapes, the light, and one sensor per photograph (``view_0000``, ...).
    Beside it lie the textures, and in ``assets`` the meshes and the map of the light; all
    file names are relative, so the folder can be moved. ``-D spp=N`` sets samples per pixel.

    Args:
        capture: the ``Capture``.
        textures: over the UVs of ``capture.mesh``.
        folder: made if missing.
        attributes: header entries of the textures, such as the settings of the run.

    Returns:
        The path of the scene file.

    Raises:
        OutputError: the folder or a file cannot be written.
    """
    folder = prepare_folder(folder)
    prepare_folder(folder / ASSETS)
    write_textures(textures, folder, attributes)
    root = nodes.scene()
    root.append(scene_nodes.integrator(capture.scene))
    light = next(e for e in capture.scene.emitters() if e.is_environment())
    root.append(scene_nodes.light(light, folder, ASSETS))
    two_sided = is_two_sided(capture.shape.bsdf())
    root.append(object_node(capture.shape.id(), arrays(capture.mesh), folder, two_sided=two_sided))
    others = [s for s in capture.scene.shapes() if not is_same(s, capture.shape)]
    root.extend(_other(shape, folder, f"{ASSETS}/other_{k}") for k, shape in enumerate(others))
    root.extend(nodes.sensor(s, f"view_{k:04d}") for k, s in enumerate(capture.sensors))
    nodes.write_document(root, folder / SCENE)
    return folder / SCENE


def object_node(
    name: str,
    mesh: MeshArrays,
    folder: Path,
    *,
    file: str = MESH,
    textures: Mapping[str, str] = FILES,
    two_sided: bool = False,
) -> Element:
    """Return an object in recovered textures, and write the mesh that they belong to.

    Args:
        name: id of the shape.
        mesh: with the UVs of the textures.
        folder: where the scene file lies.
        file: of the mesh, relative to it.
        textures: files of base_color, roughness and metallic, relative to it; they are not
            written here.
        two_sided: whether the object reflects on the back of its surface, too.

    Raises:
        OutputError: the mesh cannot be written.
    """
    node = _mesh(mesh, folder, file, name)
    material = nodes.plugin("bsdf", "principled", id=f"{name}_material")
    for texture, path in textures.items():
        material.append(nodes.bitmap(texture, path, wrap=WRAP, id=f"{name}_{texture}"))
    nodes.put(material, specular=SPECULAR)
    if two_sided:
        sides = nodes.plugin("bsdf", "twosided", id=f"{name}_sides")
        sides.append(material)
        material = sides
    node.append(material)
    return node


def _other(shape: Any, folder: Path, stem: str) -> Any:
    """Return any other shape, with its own material."""
    kind = ANALYTIC.get(shape.class_name())
    if shape.is_mesh():
        node = _mesh(arrays(shape), folder, f"{stem}.ply", shape.id())
    elif kind is not None:
        node = nodes.plugin("shape", kind, id=shape.id())
        nodes.put(node, to_world=_matrix(shape))
        # A disk has none: its matrix is mirrored instead.
        nodes.put(node, flip_normals=bool(shape.has_flipped_normals()))
    else:
        warnings.warn(
            f"{SCENE}: shape '{shape.id()}' ({shape.class_name()}) cannot be written and is left "
            "out; add it to the written scene, or make it a mesh.",
            SvuWarning,
            stacklevel=4,
        )
        return Comment(f" Left out: {shape.class_name()} ")
    node.append(scene_nodes.material(shape.bsdf(), folder, stem))
    return node


def _mesh(mesh: MeshArrays, folder: Path, file: str, name: str) -> Element:
    write_ply(folder / file, name, mesh)
    node = nodes.put(nodes.plugin("shape", "ply", id=name), filename=file)
    # Mitsuba would compute smooth normals where the file has none.
    return node if mesh.normals is not None else nodes.put(node, face_normals=True)


def _matrix(shape: Any) -> np.ndarray:
    return np.array(mi.traverse(shape)["to_world"].matrix, np.float64).reshape(4, 4)
