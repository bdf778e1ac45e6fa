"""The object among a scene's shapes: its choice by name, and its conversion to one mesh.

A name is an id, the id of a BSDF, a number (from 0, in the order of the scene), ``largest
principled``, or several of them with commas between. ``name_objects`` gives ids to shapes without.
"""

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture.analytic_shapes import analytic_mesh
from svu_mi.capture.mesh import MeshArrays, arrays, joined, make_mesh, unit_vectors
from svu_mi.capture.replace_material import is_same, is_two_sided, make_scene
from svu_mi.capture.scene import check_target
from svu_mi.errors import SceneError, excerpt, first_of

LARGEST = "largest principled"
LISTED = 12  # shapes in a message
LONGEST = 60  # characters of a name in a message
PLACEHOLDER = {"type": "principled"}


@dataclass(frozen=True, kw_only=True)
class SceneTarget:
    """The object as one mesh.

    Attributes:
        scene: The ``mi.Scene`` with this mesh in place of the object's shapes.
        mesh: The object, an ``mi.Mesh`` of the scene.
        name: Name that chooses it (``--shape``).
        materials: BSDFs of the object's shapes.
        lack: Reason for missing UVs, for messages.
    """

    scene: Any
    mesh: Any
    name: str
    materials: Sequence[Any]
    lack: str = "has no UVs"


def find_target(scene: Any, name: str | None, path: str) -> SceneTarget:
    """Return the object ``name``; by default the only shape, or the only principled one.

    Spheres, disks and cylinders become meshes with Mitsuba's UVs. Cubes and several shapes become
    one mesh without UVs, because theirs may overlap.

    Raises:
        SceneError: There is no such shape, there are several, or it cannot become a mesh.
    """
    shapes = list(scene.shapes())
    chosen = [_only_candidate(shapes, path)] if name is None else _named(shapes, name, path)
    words = ",".join(_word(shapes, shape) for shape in chosen)
    _refuse_invisible(shapes, path)
    for shape in chosen:
        _require_opaque(shape, f"{path}: shape '{excerpt(shape.id())}'")
    meshes = [_as_arrays(shape, f"{path}: shape '{excerpt(shape.id())}'") for shape in chosen]
    materials = [shape.bsdf() for shape in chosen]
    if len(chosen) == 1 and chosen[0].is_mesh() and not _is_cube(chosen[0]):
        return SceneTarget(scene=scene, mesh=chosen[0], name=words, materials=materials)
    whole = meshes[0] if len(meshes) == 1 else merged(meshes)
    made = make_mesh(words, whole)
    made.set_id(chosen[0].id() if len(chosen) == 1 else words)
    made.set_bsdf(_common_material(materials))
    others = [s for s in shapes if not any(is_same(s, one) for one in chosen)]
    parts = [scene.integrator(), *scene.sensors(), *scene.emitters(), made, *others]
    whole_scene = make_scene([part for part in parts if part is not None])
    lack = "is made of several shapes" if len(chosen) > 1 else "has the same UVs on all faces"
    return SceneTarget(scene=whole_scene, mesh=made, name=words, materials=materials, lack=lack)


def _only_candidate(shapes: Sequence[Any], path: str) -> Any:
    bodies = [shape for shape in shapes if not shape.is_emitter()]
    if not bodies:
        raise SceneError(f"{path}: the scene has no shape; add the object as a mesh with UVs.")
    candidates = [shape for shape in bodies if _has_principled(shape)] or bodies
    if len(candidates) > 1:
        raise SceneError(
            f"{path}: several shapes could be the object; choose one with "
            f"{_listed(shapes, candidates)}; commas join several to one object."
        )
    return candidates[0]


def _refuse_invisible(shapes: Sequence[Any], path: str) -> None:
    """Raise for boundaries of media: light passes them, but visibility rays do not."""
    for shape in shapes:
        if shape.bsdf() is not None and shape.bsdf().class_name() == "Null":
            raise SceneError(
                f"{path}: shape '{excerpt(shape.id())}' is invisible (Null), and would cast "
                "shadows here; remove it and its medium from the scene."
            )


def _require_opaque(shape: Any, label: str) -> None:
    """Raise if a shape transmits or emits light; ``unsupported`` reports masks and spec_trans."""
    if shape.is_emitter():
        raise SceneError(
            f"{label} emits light, which the model of the object does not include; remove its "
            "emitter, or choose another shape with --shape."
        )
    bsdf, flags = shape.bsdf(), mi.BSDFFlags
    transmission = (
        flags.DiffuseTransmission, flags.GlossyTransmission, flags.DeltaTransmission, flags.Null
    )  # fmt: skip
    reported = _has_principled(shape) or bsdf is not None and bsdf.class_name() == "MaskBSDF"
    if bsdf is not None and not reported and any(bsdf.flags() & int(f) for f in transmission):
        raise SceneError(
            f"{label} transmits light ({bsdf.class_name()}), which the model of the object does "
            "not include; choose an opaque shape with --shape."
        )


def _named(shapes: Sequence[Any], name: str, path: str) -> list[Any]:
    """Return the shapes that a name chooses, without repetitions."""
    whole = _matches(shapes, name)
    words = [name] if whole else [word.strip() for word in name.split(",")]
    numbers: list[int] = []
    for word in words:
        found = _matches(shapes, word)
        if len(found) != 1:
            label = excerpt(repr(word), LONGEST)
            problem = f"{len(found)} shapes are {label}" if found else f"there is no shape {label}"
            known = [shapes[k] for k in found] or shapes
            raise SceneError(f"{path}: {problem}; choose one with {_listed(shapes, known)}.")
        numbers += found
    return [shapes[number] for number in dict.fromkeys(numbers)]


def _matches(shapes: Sequence[Any], word: str) -> list[int]:
    """Return the numbers of the shapes that a word names."""
    named = [k for k, shape in enumerate(shapes) if word and shape.id() == word]
    if named:
        return named
    if word == LARGEST:
        painted = [k for k, shape in enumerate(shapes) if _has_principled(shape)]
        areas = {k: float(np.array(shapes[k].surface_area()).ravel()[0]) for k in painted}
        return [max(areas, key=lambda k: areas[k])] if areas else []
    painted = [k for k, s in enumerate(shapes) if word and s.bsdf() and s.bsdf().id() == word]
    if painted:
        return painted
    number = int(word) if word.isascii() and word.isdigit() and len(word) < 10 else len(shapes)
    return [number] if number < len(shapes) else []


def _word(shapes: Sequence[Any], shape: Any) -> str:
    """Return a word that names only this shape, and can be typed."""
    name, number = shape.id(), next(k for k, s in enumerate(shapes) if is_same(s, shape))
    plain = name == excerpt(name, LONGEST) and "," not in name
    return name if plain and _matches(shapes, name) == [number] else str(number)


def _listed(shapes: Sequence[Any], some: Sequence[Any]) -> str:
    """Return the options that choose each of some shapes, to be typed as they are."""
    return first_of(
        [f"--shape {shlex.quote(_word(shapes, shape))} ({excerpt(shape.class_name())})"
         for shape in some],
        LISTED,
    )  # fmt: skip


def _has_principled(shape: Any) -> bool:
    return shape.bsdf() is not None and "Principled" in str(shape.bsdf())


def _as_arrays(shape: Any, label: str) -> MeshArrays:
    mesh = arrays(shape) if shape.is_mesh() else analytic_mesh(shape, label)
    check_target(mesh, label)
    return replace(mesh, uvs=None) if _is_cube(shape) else mesh


def _is_cube(shape: Any) -> bool:
    """Return whether a shape is Mitsuba's cube, whose faces have the same UVs."""
    return bool(shape.class_name() == "Cube")


def merged(meshes: Sequence[MeshArrays]) -> MeshArrays:
    """Join meshes to one without UVs; it has normals if one of them has."""
    smooth = any(mesh.normals is not None for mesh in meshes)
    meshes = [_with_normals(mesh) if smooth else mesh for mesh in meshes]
    return replace(joined(meshes), uvs=None)


def _with_normals(mesh: MeshArrays) -> MeshArrays:
    """Return a mesh with the normals of its faces if it has none."""
    if mesh.normals is not None:
        return mesh
    flat = np.repeat(unit_vectors(mesh.crosses), 3, axis=0)
    return MeshArrays(
        mesh.positions[mesh.faces.ravel()], np.arange(len(flat)).reshape(-1, 3), flat, None
    )


def _common_material(materials: Sequence[Any]) -> Any:
    """Return the BSDF of all shapes, or a placeholder for different ones."""
    first = materials[0]
    if all(dr.all(mi.BSDFPtr(first) == mi.BSDFPtr(other)) for other in materials):
        return first
    two_sided = any(map(is_two_sided, materials))
    return mi.load_dict({"type": "twosided", "a": PLACEHOLDER} if two_sided else PLACEHOLDER)
