"""Live Mitsuba objects as nodes of a scene file.

``mi.parser.write_file`` writes what a scene was parsed from; a live scene has none of that, and
may never have been a file. So the few plugins that a capture consists of are written by hand,
from what ``mi.traverse`` says of them, with ids, which that function leaves out.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import mitsuba as mi
import numpy as np

from svu_mi.capture.poses import describe
from svu_mi.capture.repaint import is_two_sided
from svu_mi.capture.scene import to_world
from svu_mi.errors import SvuWarning
from svu_mi.exr import write_exr
from svu_mi.files import replacing
from svu_mi.recovery.relight import path_length

FILTERS = {
    "BoxFilter": "box", "TentFilter": "tent", "GaussianFilter": "gaussian",
    "MitchellNetravaliFilter": "mitchell", "CatmullRomFilter": "catmullrom",
    "LanczosSincFilter": "lanczos",
}  # fmt: skip
MATERIALS = {"Principled": "principled", "SmoothDiffuse": "diffuse"}
GREY = 0.5  # reflectance of a shape whose material cannot be written


def plugin(tag: str, kind: str, name: str | None = None, *, id: str | None = None) -> Element:
    """Return ``<tag type="kind" name="name" id="id"/>``."""
    attributes = {"type": kind, "name": name, "id": None if id is None else _legal(id)}
    return Element(tag, {key: value for key, value in attributes.items() if value is not None})


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


def write_xml(path: Path, root: Element) -> None:
    """Write a document, indented.

    Raises:
        OutputError: the file cannot be written.
    """
    indent(root)
    with replacing(path) as temporary:
        temporary.write_text(tostring(root, "unicode") + "\n", encoding="utf-8")


def integrator(scene: Any) -> Element:
    """Return ``path``, with paths as long as those of the scene's own integrator."""
    return put(plugin("integrator", "path"), max_depth=path_length(scene))


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


def light(emitter: Any, folder: Path, assets: str) -> Element:
    """Return an environment emitter; the map of an ``envmap`` is written as EXR.

    A ``constant`` and a ``sunsky`` are written as parameters: sampled on a map, the sun's disk
    would be smaller than a texel.

    Args:
        emitter: an ``envmap``, ``constant`` or ``sunsky``.
        folder: where the scene file lies.
        assets: the folder of the map, relative to it.
    """
    params = mi.traverse(emitter)
    name = emitter.id() or "light"
    if emitter.class_name() == "ConstantBackgroundEmitter":
        return put(plugin("emitter", "constant", id=name), radiance=_numbers(params, "radiance"))
    if emitter.class_name() == "SunskyEmitter":
        return _sunsky(emitter, params, name)
    # Mitsuba 3.9 keeps one halo column on each side.
    pixels = np.array(params["data"], np.float32)[:, 1:-1, :3]
    file = f"{assets}/environment.exr"
    write_exr(folder / file, {"RGB": pixels})
    node = put(plugin("emitter", "envmap", id=name), filename=file, to_world=to_world(emitter))
    return put(node, scale=float(np.array(params["scale"]).ravel()[0]))


def _sunsky(emitter: Any, params: Any, name: str) -> Element:
    node = put(plugin("emitter", "sunsky", id=name), to_world=to_world(emitter))
    for key in ("turbidity", "albedo", "sun_scale", "sky_scale"):
        put(node, **{key: _numbers(params, key)})
    # In world space, whatever to_world is, here and in the file.
    sun = np.array(params["sun_direction"], np.float64).ravel()
    SubElement(node, "vector", name="sun_direction", value=_text(sun))
    for key, label in (("sun_aperture", "Sun aperture"), ("complex_sun", "Complex sun model")):
        found = re.search(rf"{label} = (\S+)", str(emitter))  # not among its parameters
        if found is not None:
            value = found[1] == "true" if found[1] in ("true", "false") else float(found[1])
            put(node, **{key: value})
    return node


def material(bsdf: Any, folder: Path, stem: str) -> Element:
    """Return the BSDF of a shape that is not the object; its textures are written as EXR.

    ``principled`` and ``diffuse`` become what they are, also within ``twosided``. Any other is
    replaced by a diffuse grey one, with a warning.

    Args:
        bsdf: the BSDF.
        folder: where the scene file lies.
        stem: beginning of the textures' file names, relative to it.
    """
    if is_two_sided(bsdf):
        node = plugin("bsdf", "twosided")
        prefixes = {key.partition(".")[0] for key, _ in mi.traverse(bsdf) if "brdf_" in key}
        for prefix in sorted(prefixes):  # two, if the back has a BSDF of its own
            node.append(_material(bsdf, f"{prefix}.", folder, f"{stem}_{prefix}"))
        return node
    return _material(bsdf, "", folder, stem)


def _material(bsdf: Any, prefix: str, folder: Path, stem: str) -> Element:
    params = mi.traverse(bsdf)
    inner = {key[len(prefix) :]: value for key, value in params if key.startswith(prefix)}
    kind = _kind(inner, bsdf, prefix)
    if kind is None:
        warnings.warn(
            f"{stem}: a material of type {bsdf.class_name()} cannot be written and becomes a "
            f"diffuse one of reflectance {GREY}; edit the written scene if it matters.",
            SvuWarning,
            stacklevel=2,
        )
        return put(plugin("bsdf", "diffuse"), reflectance=[GREY] * 3)
    node = plugin("bsdf", kind)
    written = set()
    for key, value in inner.items():
        name, _, part = key.partition(".")
        if part == "data":
            node.append(_bitmap(name, np.array(value, np.float32), folder, f"{stem}_{name}.exr"))
            written.add(name)
        elif part in ("", "value") and not name.endswith("_sampling_rate"):
            put(node, **{name: _plain(value)})
            written.add(name)
    _warn_of_changes(inner, written, stem)
    return node


def _warn_of_changes(inner: dict[str, Any], written: set[str], stem: str) -> None:
    """Say which parameters of a material a written scene does not have as they were."""
    lost = {key.partition(".")[0] for key in inner if not key.endswith("_sampling_rate")} - written
    turned = {
        key.partition(".")[0] for key, value in inner.items()
        if key.endswith(".to_uv") and not np.allclose(np.array(value.matrix).squeeze(), np.eye(3))
    }  # fmt: skip
    for names, what in ((lost, "is left at its default"), (turned - lost, "loses its to_uv")):
        if names:
            warnings.warn(
                f"{stem}: {', '.join(sorted(names))} of another shape's material {what}; edit the "
                "written scene if it matters.",
                SvuWarning,
                stacklevel=2,
            )


def _kind(inner: dict[str, Any], bsdf: Any, prefix: str) -> str | None:
    if not prefix:
        return MATERIALS.get(bsdf.class_name())
    names = {key.partition(".")[0] for key in inner}
    if names == {"reflectance"}:
        return "diffuse"
    return "principled" if {"base_color", "spec_tint"} <= names else None


def _bitmap(name: str, pixels: np.ndarray, folder: Path, file: str) -> Element:
    write_exr(folder / file, {"Y" if pixels.shape[2] == 1 else "RGB": pixels})
    return bitmap(name, file)


def bitmap(name: str, file: str, *, wrap: str = "repeat", id: str | None = None) -> Element:
    """Return a texture of values that are taken as they are."""
    node = plugin("texture", "bitmap", name, id=id)
    return put(node, filename=file, raw=True, filter_type="bilinear", wrap_mode=wrap)


def _numbers(params: Any, name: str) -> Any:
    """Return a parameter, whether it is a number or a spectrum of one or three."""
    return _plain(params[name] if name in params else params[f"{name}.value"])


def _plain(value: Any) -> Any:
    flat = [float(v) for v in np.array(value, np.float64).ravel()]
    return flat[0] if len(flat) == 1 else flat


def _property(value: Any) -> tuple[str, str]:
    if isinstance(value, bool):
        return "boolean", "true" if value else "false"
    if isinstance(value, int):
        return "integer", str(value)
    if isinstance(value, str):
        return "string", value
    if isinstance(value, Sequence):
        return "rgb", _text(value)
    if np.ndim(value) == 2:
        return "transform", _text(np.ravel(value))
    return "float", repr(float(value))


def _text(values: Any) -> str:
    # Seventeen digits: a double reads back as it was.
    return " ".join(repr(float(value)) for value in values)


def _legal(name: str) -> str:
    """Return an id that Mitsuba takes: it keeps leading underscores and dots for itself."""
    return re.sub(r"[^\w-]", "_", name).lstrip("_") or "node"
