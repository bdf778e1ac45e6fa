"""What a scene has that the method does not account for."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import mitsuba as mi
import numpy as np

from svu_mi.capture.repaint import is_same
from svu_mi.errors import excerpt

# Parameters of ``principled`` that are not estimated, with the value that is assumed of each.
ASSUMED = {
    "specular": 0.5, "eta": 1.5, "anisotropic": 0.0, "clearcoat": 0.0, "sheen": 0.0,
    "spec_tint": 0.0, "spec_trans": 0.0, "flatness": 0.0,
}  # fmt: skip
ALIKE = 1e-3  # difference to it that changes nothing
WRAPPERS = {  # what Mitsuba prints of other BSDFs, most around another one, and what it stands for
    "BumpMap[": "a bump map", "NormalMap[": "a normal map", "Mask[": "an opacity",
    "BlendBSDF[": "a blend of two materials", "Thin Principled": "a thin, transparent surface",
}  # fmt: skip
NESTED = re.compile(r"^((nested_bsdf|[a-z]+_\d)\.)+")  # before parameters of a BSDF in another
BLACK = 0.05  # part of the light that black cloth, paper or paint reflects at most
BESIDE = {"alpha", "specular_reflectance", "opacity", "weight"}  # leave something dark dark
SMALL = 0.01  # part of all directions that a shape may cover without a word
NAMED = 5  # shapes that a sentence names


def ignored(scene: Any, target: Any) -> list[str]:
    """Return a sentence about what the object's material has, and one about other shapes.

    Args:
        scene: the ``mi.Scene``.
        target: the object in it.
    """
    notes = []
    if found := list(dict.fromkeys(_of_material(target.bsdf()))):
        notes.append(
            f"Shape '{excerpt(target.id())}' has {_and(found)}, which svu does not account for: if "
            "the photographs show that, roughness and base colour will be off."
        )
    others = [shape for shape in scene.shapes() if not is_same(shape, target)]
    near = [shape for shape in others if _extent(shape, target) > SMALL]
    if bright := [_name(shape) for shape in near if not _is_black(shape.bsdf())]:
        several = len(bright) > 1
        names = _and(bright if len(bright) <= NAMED else [*bright[:NAMED], "others"])
        notes.append(
            f"Shape{'s' * several} {names} reflect{'' if several else 's'} light onto "
            f"'{excerpt(target.id())}', which svu does not account for: base colours near "
            f"{'them' if several else 'it'} will be too bright; put something black around the "
            "object when it is photographed."
        )
    return notes


def _of_material(bsdf: Any) -> Iterator[str]:
    """Yield what a BSDF, or one in it, has beside what is estimated."""
    if bsdf is None:
        return
    printed = str(bsdf)
    for kind, name in WRAPPERS.items():
        if kind in printed:
            yield name
    for key, value in mi.traverse(bsdf) if "Principled BSDF" in printed else ():
        name, _, kind = NESTED.sub("", key).partition(".")
        if name in ASSUMED and not kind.endswith("to_uv"):
            values = np.array(value, np.float64).ravel()
            if np.abs(values - ASSUMED[name]).max(initial=0) > ALIKE:
                constant = kind in ("", "value")  # of a texture, data or the parameters of another
                yield f"{name} {values[0]:.3g}" if constant else f"a {name} texture"


def _is_black(bsdf: Any) -> bool:
    """Return whether a BSDF certainly reflects next to nothing: none, an invisible or a dark one.

    A dark one is diffuse, or plastic, which is diffuse below a gloss.
    """
    if bsdf is None or bsdf.class_name() == "Null":
        return True
    found: dict[str, list[np.ndarray]] = {}  # values and data of textures, by parameter
    for key, value in mi.traverse(bsdf):
        if not key.endswith("to_uv"):
            found.setdefault(_parameter(key), []).append(np.array(value, np.float32))
    if bsdf.class_name() == "MaskBSDF" and not any(map(np.any, found.get("opacity", [1]))):
        return True
    colors = [*found.pop("reflectance", ()), *found.pop("diffuse_reflectance", ())]
    gloss = [((eta - 1) / (eta + 1)) ** 2 for eta in found.pop("eta", ())]  # 4 % of usual plastic
    is_diffuse = bool(colors) and set(found) <= BESIDE  # others have more parameters, or no colour
    return is_diffuse and all((values <= BLACK).all() for values in [*colors, *gloss])


def _parameter(key: str) -> str:
    """Return what a parameter of a BSDF, or of one in it, is called, without its texture's own."""
    return NESTED.sub("", key).partition(".")[0]


def _extent(shape: Any, target: Any) -> float:
    """Return the part of all directions around an object that a sphere around a shape covers."""
    low, high = (np.array(corner, np.float64) for corner in (shape.bbox().min, shape.bbox().max))
    distance = np.linalg.norm((low + high) / 2 - np.array(target.bbox().center(), np.float64))
    radius = np.linalg.norm(high - low) / 2
    return float((1 - np.sqrt(1 - (radius / distance) ** 2)) / 2) if radius < distance else 1.0


def _name(shape: Any) -> str:
    return f"'{excerpt(shape.id())}'" if shape.id() else f"without an id ({shape.class_name()})"


def _and(words: list[str]) -> str:
    return " and ".join(filter(None, [", ".join(words[:-1]), words[-1]]))
