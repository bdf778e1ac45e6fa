"""Live lights and materials as nodes of a scene file, from what ``mi.traverse`` says of them."""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, SubElement

import mitsuba as mi
import numpy as np

from svu_mi.capture.nodes import bitmap, plugin, put, text_of
from svu_mi.capture.repaint import is_two_sided
from svu_mi.capture.scene import to_world
from svu_mi.errors import SvuWarning
from svu_mi.exr import write_exr
from svu_mi.formats.light import POLES, ROWS
from svu_mi.recovery.relight import path_length

MATERIALS = {"Principled": "principled", "SmoothDiffuse": "diffuse"}
GREY = 0.5  # reflectance of a shape whose material cannot be written


def integrator(scene: Any) -> Element:
    """Return ``path``, with paths as long as those of the scene's own integrator."""
    return put(plugin("integrator", "path"), max_depth=path_length(scene))


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
    write_exr(folder / file, {"RGB": pixels}, {ROWS: POLES})
    node = put(plugin("emitter", "envmap", id=name), filename=file, to_world=to_world(emitter))
    return put(node, scale=float(np.array(params["scale"]).ravel()[0]))


def _sunsky(emitter: Any, params: Any, name: str) -> Element:
    node = put(plugin("emitter", "sunsky", id=name), to_world=to_world(emitter))
    for key in ("turbidity", "albedo", "sun_scale", "sky_scale"):
        put(node, **{key: _numbers(params, key)})
    # In world space, whatever to_world is, here and in the file.
    sun = np.array(params["sun_direction"], np.float64).ravel()
    SubElement(node, "vector", name="sun_direction", value=text_of(sun))
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
            f"diffuse one of reflectance {GREY}; edit the written scene if that matters.",
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


def _numbers(params: Any, name: str) -> Any:
    """Return a parameter, whether it is a number or a spectrum of one or three."""
    return _plain(params[name] if name in params else params[f"{name}.value"])


def _plain(value: Any) -> Any:
    flat = [float(v) for v in np.array(value, np.float64).ravel()]
    return flat[0] if len(flat) == 1 else flat
