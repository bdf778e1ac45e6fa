"""Surroundings of the object: other shapes that reflect light."""

import re
from typing import Any

import mitsuba as mi
import numpy as np

from svu_mi.capture.capture import Capture
from svu_mi.capture.replace_material import other_shapes, replace_material

BLACK = 0.05  # largest reflectance of black cloth, paper or paint
HARMLESS = {"alpha", "specular_reflectance", "opacity", "weight"}  # do not brighten a dark BSDF
NESTED = re.compile(r"^((nested_bsdf|[a-z]+_\d)\.)+")  # prefix of parameters of nested BSDFs
SMALL = 0.01  # fraction of all directions; shapes that cover less are ignored
DEPTH, DIRECT = 6, 2  # longest paths that are traced, and paths without reflected light


def reflecting_shapes(scene: Any, target: Any) -> list[Any]:
    """Return the shapes that may reflect visible light onto the object ``target``.

    There are none if the integrator of the scene traces direct light only.
    """
    if 0 <= path_length(scene) <= DIRECT:
        return []
    others = other_shapes(scene, target)
    return [s for s in others if _extent(s, target) > SMALL and not is_black(s.bsdf())]


def path_length(scene: Any) -> int:
    """Return the maximum path length of a scene's integrator (-1: unlimited)."""
    integrator = scene.integrator()
    if integrator is not None and integrator.class_name() == "DirectIntegrator":
        return DIRECT
    match = re.search(r"max_depth = (\d+)", str(integrator))  # mi.traverse does not expose it
    if match is None:
        return DEPTH
    return int(match[1]) if int(match[1]) < 2**31 else -1


def surroundings(capture: Capture, material: Any | None = None) -> tuple[Any, Any]:
    """Return the scene, with the object first, and an integrator for light of other shapes.

    The object has ``material``, a BSDF, or is black.
    """
    black = mi.load_dict({"type": "diffuse", "reflectance": 0.0})
    scene = replace_material(capture, black if material is None else material).scene
    length = path_length(capture.scene)
    depth = DEPTH if length < 0 else min(length, DEPTH)
    return scene, mi.load_dict({"type": "path", "max_depth": depth})


def is_black(bsdf: Any) -> bool:
    """Return whether a BSDF is certainly dark, invisible or missing.

    Only diffuse and plastic BSDFs with known reflectance are classified as dark.
    """
    if bsdf is None or bsdf.class_name() == "Null":
        return True
    inputs: dict[str, list[np.ndarray]] = {}  # values and data of textures, by parameter
    for key, value in mi.traverse(bsdf):
        if not key.endswith("to_uv"):
            name = NESTED.sub("", key).partition(".")[0]
            inputs.setdefault(name, []).append(np.array(value, np.float32))
    if bsdf.class_name() == "MaskBSDF" and not any(map(np.any, inputs.get("opacity", [1]))):
        return True
    colors = [*inputs.pop("reflectance", ()), *inputs.pop("diffuse_reflectance", ())]
    gloss = [((eta - 1) / (eta + 1)) ** 2 for eta in inputs.pop("eta", ())]  # typically 4 %
    is_diffuse = bool(colors) and set(inputs) <= HARMLESS  # other BSDFs have other parameters
    return is_diffuse and all((values <= BLACK).all() for values in [*colors, *gloss])


def _extent(shape: Any, target: Any) -> float:
    """Return the solid angle / 4 pi of a shape's bounding sphere from the target's centre."""
    low, high = (np.array(corner, np.float64) for corner in (shape.bbox().min, shape.bbox().max))
    distance = np.linalg.norm((low + high) / 2 - np.array(target.bbox().center(), np.float64))
    radius = np.linalg.norm(high - low) / 2
    return float((1 - np.sqrt(1 - (radius / distance) ** 2)) / 2) if radius < distance else 1.0
