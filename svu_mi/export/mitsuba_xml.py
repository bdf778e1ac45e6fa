"""Mitsuba XML: the object for other scenes to include, and a scene that shows it."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Comment, Element

import mitsuba as mi
import numpy as np

import svu_mi
from svu_mi.capture import scene_xml
from svu_mi.capture.mesh import make
from svu_mi.capture.poses import bounding_sphere, sphere_sensors
from svu_mi.export.asset import TEXTURES, Asset, Written
from svu_mi.output.textures import FILES, object_node
from svu_mi.output.upright import DIRECTION, Axis

OBJECT, PREVIEW, MESH = "object.xml", "preview.xml", "mesh.ply"
FILM = (512, 512)
ROOM, LAMP = 0.5, 16.0  # radiance
USE = """ Written by svu_mi {version}. To use the object in another scene:
       <path value="this folder"/>
       <include filename="object.xml"/>
     In a scene with two such objects, write its folder before each filename below. """


def write_mitsuba(asset: Asset, folder: Path, *, up: Axis) -> list[Written]:
    """Write ``object.xml``, ``mesh.ply`` and ``preview.xml``; textures are those written as EXR.

    Args:
        asset: the asset.
        folder: an existing folder.
        up: where the preview's camera has its top.

    Raises:
        OutputError: a file cannot be written.
    """
    textures = {name: f"{TEXTURES}/{file}" for name, file in FILES.items()}
    node = object_node(
        asset.name, asset.mesh, folder, file=MESH, textures=textures, two_sided=asset.two_sided
    )
    _write(folder / OBJECT, [Comment(USE.format(version=svu_mi.__version__)), node])
    _write(folder / PREVIEW, _preview(asset, up))
    return [
        Written(file=OBJECT, format="xml", holds="object", values="for <include> of a scene"),
        Written(file=PREVIEW, format="xml", holds="scene", values="object, light and camera"),
        Written(file=MESH, format="xml", holds="mesh", values="v = 0 at an image's top"),
    ]  # fmt: skip


def _preview(asset: Asset, up: Axis) -> list[Element]:
    """Return the nodes of a scene: the object in a grey room, lit from above the camera's left."""
    shape = make(asset.name, asset.mesh)
    camera = sphere_sensors(shape, 1, FILM, up=DIRECTION[up], lowest=-0.4)[0]
    pose = np.array(camera.world_transform().matrix, np.float64).reshape(4, 4)
    center, radius = bounding_sphere(shape)
    left, above, forward = pose[:3, :3].T
    place = center + 3 * radius * (0.8 * left + above - 0.8 * forward)
    turn = mi.ScalarTransform4f().look_at(
        list(map(float, place)), list(map(float, center)), list(map(float, above))
    ).scale(float(radius))  # fmt: skip
    # The object may itself be called lamp, or camera.
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
