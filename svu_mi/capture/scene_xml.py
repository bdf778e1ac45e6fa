"""Writer of Mitsuba scene files from loaded scene objects.

``mi.parser.write_file`` needs the parser state, which a loaded scene does not have, and omits ids.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Comment, Element, SubElement

import mitsuba as mi
import numpy as np

import svu_mi
from svu_mi.capture.mesh import MeshArrays, arrays, write_ply
from svu_mi.capture.normal_map import MAPS, scale_of, texture_of
from svu_mi.capture.replace_material import is_two_sided
from svu_mi.capture.scene import to_world
from svu_mi.capture.sensors import describe
from svu_mi.core.identifiers import xml_id
from svu_mi.core.io.exr import write_exr
from svu_mi.core.io.files import mark_text, stamp, write_text
from svu_mi.errors import warn

FILTERS = {
    "BoxFilter": "box", "TentFilter": "tent", "GaussianFilter": "gaussian",
    "MitchellNetravaliFilter": "mitchell", "CatmullRomFilter": "catmullrom",
    "LanczosSincFilter": "lanczos",
}  # fmt: skip
ANALYTIC = {"Sphere": "sphere", "Disk": "disk", "Cylinder": "cylinder"}
MATERIALS = {"Principled": "principled", "SmoothDiffuse": "diffuse"}
LAMPS = {  # names of plugins, and of their spectra
    "AreaLight": ("area", "radiance"), "PointLight": ("point", "intensity"),
    "SpotLight": ("spot", "intensity"), "DirectionalEmitter": ("directional", "irradiance"),
}  # fmt: skip
GREY = 0.5  # reflectance that replaces an unsupported material
SAMPLES = 64  # default samples per pixel; -D spp=N overrides it
ROWS, POLES = "svu:rows", "poles"  # EXR attribute of maps whose first and last row are the poles


def scene() -> Element:
    """Return an empty scene with the parameter ``spp``, which sensors refer to."""
    root = Element("scene", version="3.0.0")
    root.append(Comment(f" Written by svu_mi {svu_mi.__version__}; needs nothing but Mitsuba. "))
    if stamp():
        root.append(Comment(f" {mark_text()} "))
    SubElement(root, "default", name="spp", value=str(SAMPLES))
    return root


def plugin(
    tag: str, kind: str, name: str | None = None, *, id: str | None = None, **properties: Any
) -> Element:
    """Return the XML element of a plugin with properties (see ``put``)."""
    attributes = {"type": kind, "name": name, "id": None if id is None else xml_id(id)}
    node = Element(tag, {key: value for key, value in attributes.items() if value is not None})
    return put(node, **properties)


def put(parent: Element, **properties: Any) -> Element:
    """Add properties: text, bool, int, float, rgb (3) or matrix (4 x 4).

    Returns:
        ``parent``.
    """
    for name, value in properties.items():
        if np.ndim(value) == 2:
            transform = SubElement(parent, "transform", name=name)
            SubElement(transform, "matrix", value=_text(np.ravel(value)))
        else:
            tag, text = _property(value)
            SubElement(parent, tag, name=name, value=text)
    return parent


def _property(value: Any) -> tuple[str, str]:
    if isinstance(value, bool):
        return "boolean", "true" if value else "false"
    if isinstance(value, int):
        return "integer", str(value)
    if isinstance(value, str):
        return "string", value
    if isinstance(value, Sequence):
        return "rgb", _text(value)
    return "float", repr(float(value))


def _text(values: Any) -> str:
    """Format numbers as text without loss of precision."""
    return " ".join(repr(float(value)) for value in values)


def write_document(root: Element, path: Path) -> None:
    """Write an indented scene file atomically; append numbers to repeated ids."""
    taken: set[str] = set()
    for node in sorted(root.iterfind(".//*[@id]"), key=lambda node: node.tag != "shape"):
        name, number = node.attrib["id"], 1  # the first shape keeps its id
        while node.attrib["id"] in taken:
            number += 1
            node.set("id", f"{name}_{number}")
        taken.add(node.attrib["id"])
    ElementTree.indent(root)
    write_text(path, ElementTree.tostring(root, "unicode"))


def sensor(camera: Any, name: str) -> Element:
    """Return a perspective sensor as XML, without loss of precision."""
    record = describe(camera)
    near, far = record["clip"]
    shift_x, shift_y = record["principal_point_offset"]
    (width, height), (left, top) = record["film"], record["crop_offset"]
    node = plugin(
        "sensor", "perspective", id=name, to_world=np.array(record["to_world"]),
        fov=record["x_fov"], fov_axis="x", near_clip=near, far_clip=far,
        principal_point_offset_x=shift_x, principal_point_offset_y=shift_y,
    )  # fmt: skip
    film = plugin(
        "film", "hdrfilm", width=width, height=height, crop_offset_x=left, crop_offset_y=top,
        crop_width=record["crop_size"][0], crop_height=record["crop_size"][1], pixel_format="rgb",
        component_format="float32",
    )  # fmt: skip
    film.append(plugin("rfilter", FILTERS.get(camera.film().rfilter().class_name(), "box")))
    sampler = plugin("sampler", "independent")
    SubElement(sampler, "integer", name="sample_count", value="$spp")
    node.extend([film, sampler])
    return node


def bitmap(name: str, file: str, *, id: str | None = None, raw: bool = True) -> Element:
    """Return a bitmap texture of linear (``raw``) or sRGB values."""
    # Repetition avoids a seam where a chart wraps around.
    return plugin(
        "texture", "bitmap", name, id=id, filename=file, raw=raw, filter_type="bilinear",
        wrap_mode="repeat",
    )  # fmt: skip


def mesh(source: MeshArrays, folder: Path, file: str, name: str) -> Element:
    """Write a mesh as PLY ``file`` in ``folder``; return the XML of its shape."""
    write_ply(folder / file, name, source)
    node = plugin("shape", "ply", id=name, filename=file)
    # Without this flag, Mitsuba computes smooth normals if the file has none.
    return node if source.normals is not None else put(node, face_normals=True)


def principled(name: str, textures: Mapping[str, str]) -> Element:
    """Return a textured ``principled`` BSDF; specular is 0.5, as in recovery.

    Args:
        name: Id of the object.
        textures: Files of base_color, roughness and metallic, relative to the scene file.
    """
    node = plugin("bsdf", "principled", id=f"{name}_material", specular=0.5)
    for texture, path in textures.items():
        node.append(bitmap(texture, path, id=f"{name}_{texture}"))
    return node


def on_both_sides(name: str, inner: Element) -> Element:
    """Return a BSDF within ``twosided``."""
    sides = plugin("bsdf", "twosided", id=f"{name}_sides")
    sides.append(inner)
    return sides


def mapped(layer: Any, inner: Element, folder: Path, file: str) -> Element:
    """Return a BSDF within a normal or bump map like ``layer``, whose bitmap is written as EXR."""
    kind, params = MAPS[layer.class_name()], mi.traverse(texture_of(layer))
    if "data" not in params or not np.allclose(params["to_uv"].matrix, np.eye(3)):
        warn(
            f"The {kind} of '{layer.id()}' is not a bitmap, or has a to_uv; it cannot be written "
            "and is missing in the new scene; add it there."
        )
        return inner
    pixels = np.array(params["data"])
    if pixels.dtype == np.uint8:
        pixels = pixels.astype(np.float32) / 255
    write_exr(folder / file, {"Y" if pixels.shape[2] == 1 else "RGB": pixels.astype(np.float32)})
    node = plugin("bsdf", kind)
    if kind == "bumpmap":
        put(node, scale=scale_of(layer))
    node.extend([bitmap("normalmap", file), inner])
    return node


def environment(emitter: Any, folder: Path, assets: str) -> Element:
    """Return an environment emitter as XML; write the map of an ``envmap``.

    A ``sunsky`` is not sampled on a map, because the sun would be smaller than a pixel. ``assets``
    is the folder of the map, relative to the scene file's ``folder``.
    """
    params, kind = mi.traverse(emitter), emitter.class_name()
    name = emitter.id() or "light"

    def number(key: str) -> Any:  # one number, or three channels
        return _plain(params[key] if key in params else params[f"{key}.value"])

    if kind == "ConstantBackgroundEmitter":
        return plugin("emitter", "constant", id=name, radiance=number("radiance"))
    if kind != "SunskyEmitter":
        file = f"{assets}/environment.exr"
        # Mitsuba 3.9 stores a halo column on each side.
        pixels = np.array(params["data"], np.float32)[:, 1:-1, :3]
        write_exr(folder / file, {"RGB": pixels}, {ROWS: POLES})
        scale = float(np.array(params["scale"]).ravel()[0])
        return plugin(
            "emitter", "envmap", id=name, filename=file, to_world=to_world(emitter), scale=scale
        )
    node = plugin("emitter", "sunsky", id=name, to_world=to_world(emitter))
    put(node, **{key: number(key) for key in ("turbidity", "albedo", "sun_scale", "sky_scale")})
    # The sun's direction is in world space, independent of to_world.
    sun = np.array(params["sun_direction"], np.float64).ravel()
    SubElement(node, "vector", name="sun_direction", value=_text(sun))
    for key, label in (("sun_aperture", "Sun aperture"), ("complex_sun", "Complex sun model")):
        match = re.search(rf"{label} = (\S+)", str(emitter))  # not a traversed parameter
        if match is not None:
            value = match[1] == "true" if match[1] in ("true", "false") else float(match[1])
            put(node, **{key: value})
    return node


def shape(source: Any, folder: Path, stem: str) -> Any:
    """Return the XML of a shape and its material; a comment if unsupported.

    Paths of the shape's files begin with ``stem``, relative to the scene file's ``folder``.
    """
    kind = ANALYTIC.get(source.class_name())
    if source.is_mesh():
        node = mesh(arrays(source), folder, f"{stem}.ply", source.id())
    elif kind is not None:
        matrix = np.array(mi.traverse(source)["to_world"].matrix, np.float64).reshape(4, 4)
        # For a disk the flag is False, and its matrix is mirrored instead.
        flipped = bool(source.has_flipped_normals())
        node = plugin("shape", kind, id=source.id(), to_world=matrix, flip_normals=flipped)
    else:
        warn(
            f"{stem}: shape '{source.id()}' ({source.class_name()}) cannot be written and is "
            "missing in the new scene; add it there, or convert it to a mesh."
        )
        return Comment(f" Missing: {source.class_name()} ")
    node.append(material(source.bsdf(), folder, stem))
    if source.is_emitter():
        node.append(lamp(source.emitter()))
    return node


def lamp(emitter: Any) -> Any:
    """Return an area, point, spot or directional emitter as XML; a comment if it has a texture."""
    params, kind = mi.traverse(emitter), emitter.class_name()
    tag, power = LAMPS[kind]
    if f"{power}.value" not in params or kind == "SpotLight" and "texture.value" not in params:
        warn(
            f"Emitter '{emitter.id()}' ({kind}) has a texture, cannot be written and is missing in "
            "the new scene; add it there."
        )
        return Comment(f" Missing: {kind} ")
    node = plugin("emitter", tag, **{power: _plain(params[f"{power}.value"])})
    if kind == "PointLight":
        place = np.array(params["position"], np.float64).ravel()
        SubElement(node, "point", name="position", value=_text(place))
    elif kind != "AreaLight":
        put(node, to_world=to_world(emitter))
    if kind == "SpotLight":
        put(node, **{key: _plain(params[key]) for key in ("cutoff_angle", "beam_width")})
    return node


def material(bsdf: Any, folder: Path, stem: str) -> Element:
    """Return the XML of a BSDF (not the object's), and write its textures as EXR.

    Supported are ``principled`` and ``diffuse``, also within ``twosided``. Others are replaced by
    a grey diffuse BSDF, with a warning. ``stem``: see ``shape``.
    """
    if not is_two_sided(bsdf):
        return _one_sided(bsdf, "", folder, stem)
    node = plugin("bsdf", "twosided")
    prefixes = {key.partition(".")[0] for key, _ in mi.traverse(bsdf) if "brdf_" in key}
    for prefix in sorted(prefixes):  # two if the back has another BSDF
        node.append(_one_sided(bsdf, f"{prefix}.", folder, f"{stem}_{prefix}"))
    return node


def _one_sided(bsdf: Any, prefix: str, folder: Path, stem: str) -> Element:
    params = mi.traverse(bsdf)
    inner = {key[len(prefix) :]: value for key, value in params if key.startswith(prefix)}
    names = {key.partition(".")[0] for key in inner}
    kind = MATERIALS.get(bsdf.class_name())
    if prefix:
        principled_too = {"base_color", "spec_tint"} <= names
        kind = "diffuse" if names == {"reflectance"} else "principled" if principled_too else None
    if kind is None:
        warn(
            f"{stem}: a material of type {bsdf.class_name()} cannot be written; it is replaced by "
            f"a diffuse one of reflectance {GREY}. Edit the written scene if that matters."
        )
        return plugin("bsdf", "diffuse", reflectance=[GREY] * 3)
    node, written = plugin("bsdf", kind), set()
    for key, value in inner.items():
        name, _, part = key.partition(".")
        if part == "data":
            file, pixels = f"{stem}_{name}.exr", np.array(value, np.float32)
            write_exr(folder / file, {"Y" if pixels.shape[2] == 1 else "RGB": pixels})
            node.append(bitmap(name, file))
            written.add(name)
        elif part in ("", "value") and not name.endswith("_sampling_rate"):
            put(node, **{name: _plain(value)})
            written.add(name)
    lost = {name for name in names if not name.endswith("_sampling_rate")} - written
    turned = {
        key.partition(".")[0] for key, value in inner.items()
        if key.endswith(".to_uv") and not np.allclose(np.array(value.matrix).squeeze(), np.eye(3))
    }  # fmt: skip
    for changed, result in ((lost, "has its default value"), (turned - lost, "loses its to_uv")):
        if changed:
            warn(
                f"{stem}: {', '.join(sorted(changed))} of this material {result}, because it "
                "cannot be written; edit the written scene if that matters."
            )
    return node


def _plain(value: Any) -> Any:
    flat = [float(v) for v in np.array(value, np.float64).ravel()]
    return flat[0] if len(flat) == 1 else flat
