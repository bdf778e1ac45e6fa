"""Nodes of a Mitsuba scene file: plugins, their properties, and the sensors of a capture.

``mi.parser.write_file`` writes what a scene was parsed from; a live scene has none of that, and
may never have been a file. Its ids, which that function leaves out, are written here.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Comment, Element, SubElement

import numpy as np

import svu_mi
from svu_mi.capture.poses import describe
from svu_mi.files import mark_text, stamp, write_text
from svu_mi.names import xml_id

FILTERS = {
    "BoxFilter": "box", "TentFilter": "tent", "GaussianFilter": "gaussian",
    "MitchellNetravaliFilter": "mitchell", "CatmullRomFilter": "catmullrom",
    "LanczosSincFilter": "lanczos",
}  # fmt: skip
SAMPLES = 64  # per pixel, unless -D spp=N


def plugin(tag: str, kind: str, name: str | None = None, *, id: str | None = None) -> Element:
    """Return ``<tag type="kind" name="name" id="id"/>``."""
    attributes = {"type": kind, "name": name, "id": None if id is None else xml_id(id)}
    return Element(tag, {key: value for key, value in attributes.items() if value is not None})


def scene() -> Element:
    """Return an empty scene with the parameter ``spp``, which ``sensor`` refers to."""
    root = Element("scene", version="3.0.0")
    root.append(Comment(f" Written by svu_mi {svu_mi.__version__}; needs nothing but Mitsuba. "))
    if stamp():
        root.append(Comment(f" {mark_text()} "))
    SubElement(root, "default", name="spp", value=str(SAMPLES))
    return root


def put(parent: Element, **properties: Any) -> Element:
    """Add properties by name: text, bool, int, float, three floats (rgb), or a 4 x 4 matrix.

    Returns:
        ``parent``.
    """
    for name, value in properties.items():
        tag, text = _property(value)
        if tag == "transform":
            SubElement(SubElement(parent, tag, name=name), "matrix", value=text)
        else:
            SubElement(parent, tag, name=name, value=text)
    return parent


def sensor(camera: Any, name: str) -> Element:
    """Return a perspective sensor, in floats that read back as they are."""
    record = describe(camera)
    node = plugin("sensor", "perspective", id=name)
    put(node, to_world=np.array(record["to_world"]), fov=record["x_fov"], fov_axis="x")
    put(node, near_clip=record["clip"][0], far_clip=record["clip"][1])
    shift_x, shift_y = record["principal_point_offset"]
    put(node, principal_point_offset_x=shift_x, principal_point_offset_y=shift_y)
    film = plugin("film", "hdrfilm")
    put(film, width=record["film"][0], height=record["film"][1])
    put(film, crop_offset_x=record["crop_offset"][0], crop_offset_y=record["crop_offset"][1])
    put(film, crop_width=record["crop_size"][0], crop_height=record["crop_size"][1])
    put(film, pixel_format="rgb", component_format="float32")
    film.append(plugin("rfilter", FILTERS.get(camera.film().rfilter().class_name(), "box")))
    sampler = plugin("sampler", "independent")
    SubElement(sampler, "integer", name="sample_count", value="$spp")
    node.extend([film, sampler])
    return node


def bitmap(
    name: str, file: str, *, wrap: str = "repeat", id: str | None = None, raw: bool = True
) -> Element:
    """Return a texture of values that are taken as they are, or of sRGB colours."""
    node = plugin("texture", "bitmap", name, id=id)
    return put(node, filename=file, raw=raw, filter_type="bilinear", wrap_mode=wrap)


def write_document(root: Element, path: Path) -> None:
    """Write a scene file, indented, atomically; ids that occur twice are told apart.

    Raises:
        OutputError: it cannot be written.
    """
    _tell_apart(root)
    ElementTree.indent(root)
    write_text(path, ElementTree.tostring(root, "unicode"))


def _tell_apart(root: Element) -> None:
    """Number ids that are taken: Mitsuba wants each once. Shapes keep theirs, the first best."""
    taken: set[str] = set()
    for node in sorted(root.iterfind(".//*[@id]"), key=lambda node: node.tag != "shape"):
        name, number = node.attrib["id"], 1
        while node.attrib["id"] in taken:
            number += 1
            node.set("id", f"{name}_{number}")
        taken.add(node.attrib["id"])


def _property(value: Any) -> tuple[str, str]:
    if isinstance(value, bool):
        return "boolean", "true" if value else "false"
    if isinstance(value, int):
        return "integer", str(value)
    if isinstance(value, str):
        return "string", value
    if isinstance(value, Sequence):
        return "rgb", text_of(value)
    if np.ndim(value) == 2:
        return "transform", text_of(np.ravel(value))
    return "float", repr(float(value))


def text_of(values: Any) -> str:
    """Return numbers as text that reads back as they were."""
    return " ".join(repr(float(value)) for value in values)
