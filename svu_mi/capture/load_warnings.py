"""Warnings about photographs, materials and shapes of a capture.

The front of a surface is defined by its vertex normals, or by the winding of the triangles. It is
known to be correct only for closed surfaces, whose front must be outside.
"""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from svu_mi.capture.mesh import MeshArrays, arrays, faces_at
from svu_mi.capture.normal_map import MAPS, normal_map, texture_of
from svu_mi.capture.photographs import Photograph
from svu_mi.capture.scene import is_closed, to_world
from svu_mi.capture.surroundings import NESTED, reflecting_shapes
from svu_mi.core.arrays import evenly_spaced, to_drjit
from svu_mi.errors import CaptureError, are, counted, excerpt, first_of, listed

NAMED = 3  # photographs that a message lists by name
FEWEST_FOR_LIGHT = 4  # views of a texel needed to estimate light or gains: it has 5 unknowns
# Assumed values of the ``principled`` parameters that are not estimated.
ASSUMED = {
    "specular": 0.5, "eta": 1.5, "anisotropic": 0.0, "clearcoat": 0.0, "sheen": 0.0,
    "spec_tint": 0.0, "spec_trans": 0.0, "flatness": 0.0,
}  # fmt: skip
TOLERANCE = 1e-3  # tolerated difference from these values
WRAPPERS = {  # names of unsupported BSDFs in str(bsdf), and their description
    "Mask[": "an opacity",
    "BlendBSDF[": "a blend of two materials", "Thin Principled": "a thin, transparent surface",
}  # fmt: skip
RELATIVE_GAINS = (
    "Exposures of EXIF are relative to each other: photographs and environment map differ in "
    "brightness by an unknown factor, which svu's commands estimate from the object, and which "
    "base colours share. To avoid that, import with the factor of the map, --environment-scale, or "
    "with --exposures FILE, gains that fit the map."
)
UNMODELLED = "which svu does not account for"
SHAPES = 5  # shapes that a message lists by name
MOST = 0.6  # share of back faces that causes a warning; 0.5 for a plate seen from both sides
POINTS, EYES = 400, 32  # sample sizes: surface points, and cameras
OFFSET = 1e-4  # distance of ray origins from the surface, relative to the object's size


def check_photographs(
    photographs: Sequence[Photograph], paths: Sequence[Path | None], names: Sequence[str], *,
    some: bool,
) -> tuple[list[str], tuple[bool, ...]]:  # fmt: skip
    """Return warnings, and V flags: False for black or missing photographs.

    Raises:
        CaptureError: All photographs are black, unless only ``some`` views were read.
    """
    taken = [
        (photograph, path, name)
        for photograph, path, name in zip(photographs, paths, names, strict=True)
        if path is not None
    ]
    used = tuple(not photograph.black for photograph in photographs)
    if taken and not any(used) and not some:
        raise CaptureError(
            f"{taken[0][1].parent}: all {len(taken)} photographs are entirely black; "
            "check the exposure and the channel names of the files."
        )
    remarks = dict.fromkeys(remark for one, _, _ in taken for remark in one.remarks)
    groups = [([one for one in taken if text in one[0].remarks], text) for text in remarks]
    for bits in (8, 16):
        group = [one for one in taken if one[0].bits == bits]
        text = (
            f"{bits}-bit, not HDR; decoded as {_curves(group)}, "
            f"{sum(_saturated(photograph) for photograph, _, _ in group)} saturated pixels"
            f"{clipped_where(one[0].mask is not None for one in group)}"
        )
        groups.append((group, text))
    count = sum(one[0].invalid for one in taken)
    text = f"{counted(count, 'pixel')} {are(count)} NaN, infinite or negative; ignored."
    groups.append(([one for one in taken if one[0].invalid], text))
    black = [one for one in taken if one[0].black]
    text = "entirely black, not used; check the exposure and objects before the camera, or remove"
    groups.append((black, f"{text} the photograph and its sensor."))
    return [f"{_subject(group, len(taken))}: {text}" for group, text in groups if group], used


def too_few_for_light(count: int) -> str | None:
    """Return a sentence if ``count`` photographs are too few to estimate the light."""
    if count >= FEWEST_FOR_LIGHT:
        return None
    return (
        f"An unknown light needs at least {FEWEST_FOR_LIGHT} photographs of the same places, and "
        f"the capture has {count}: add photographs, or give the light."
    )


def clipped_where(masked: Iterable[bool]) -> str:
    """Return the end of a sentence about saturated pixels of photographs."""
    background = "" if all(masked) else ", with the background,"
    return f"{background} are lower bounds of radiance. Clipped highlights hide gloss: use HDR."


def _saturated(photograph: Photograph) -> int:
    """Return the number of saturated pixels, only on the object if there is a mask."""
    if photograph.clipped is None:
        return 0
    on_object = True if photograph.mask is None else photograph.mask
    return int(((photograph.clipped.channels > 0) & on_object).sum())


def _curves(group: Sequence[tuple[Photograph, Path, str]]) -> str:
    names = {one[0].curve for one in group}
    return " and ".join(sorted("sRGB" if name == "srgb" else name for name in names))


def _subject(group: Sequence[tuple[Photograph, Path, str]], count: int) -> str:
    """Return how messages name a ``group`` of the ``count`` photographs."""
    _, path, name = group[0]
    if len(group) == 1:
        return str(path) if name == path.name else f"{path} ({name})"
    if len(group) == count:
        return f"{path.parent}: all {count} photographs"
    some = first_of([name for _, _, name in group], NAMED)
    return f"{path.parent}: {len(group)} of {count} photographs ({some})"


def unsupported(
    scene: Any, target: Any, materials: Sequence[Any] = (), *, own_uvs: bool = True
) -> list[str]:
    """Return warnings about the target's materials, and about light from other shapes.

    ``materials`` belong to the shapes that were joined; default: the target's own. Without its
    ``own_uvs``, its normal and bump maps do not fit.
    """
    notes, bsdfs = [], materials or [target.bsdf()]
    found = [name for bsdf in bsdfs for name in _of_material(bsdf)]
    maps = [layer for bsdf in bsdfs if (layer := normal_map(bsdf))]
    found += [f"a {MAPS[each.class_name()][:-3]} map" for each in maps if not own_uvs]
    if any(map(_is_srgb, maps)):
        notes.append(
            f"The normal map of shape '{excerpt(target.id())}' is decoded as sRGB, which tilts all "
            'its normals: add <boolean name="raw" value="true"/> to its texture.'
        )
    if features := list(dict.fromkeys(found)):
        notes.append(
            f"Shape '{excerpt(target.id())}' has {listed(features)}, {UNMODELLED}: if the "
            "photographs show that, roughness and base colour will be off."
        )
    if cloudy := [_name(shape) for shape in scene.shapes() if shape.is_medium_transition()]:
        notes.append(
            f"Light is scattered in the medium of {listed(cloudy)}, {UNMODELLED}: if the "
            "photographs show that, roughness and base colour will be off."
        )
    if bright := [_name(shape) for shape in reflecting_shapes(scene, target)]:
        names = listed(bright if len(bright) <= SHAPES else [*bright[:SHAPES], "others"])
        notes.append(
            f"Light reflected by {names} falls on '{excerpt(target.id())}': the presets default "
            "and fixed account for it, but not other presets, svu light, and the comparisons of "
            "light by svu check."
        )
    return notes


def _is_opaque(mask: Any) -> bool:
    """Return whether the opacity of a ``mask``, such as an alpha channel, is 1 everywhere."""
    inputs = [v for k, v in mi.traverse(mask) if k in ("opacity.data", "opacity.value")]
    arrays_of = [np.array(value) for value in inputs]
    return bool(arrays_of) and all(
        (a >= (255 if a.dtype == np.uint8 else 1)).all() for a in arrays_of
    )


def _is_srgb(layer: Any) -> bool:
    """Return whether the bytes of a normal map are decoded as colours."""
    texture = texture_of(layer)
    return (
        layer.class_name() == "NormalMap"
        and "uint8" in texture.class_name() and "raw = 0" in str(texture)
    )  # fmt: skip


def _of_material(bsdf: Any) -> Iterator[str]:
    """Yield descriptions of the features of a BSDF that are not estimated."""
    if bsdf is None:
        return
    printed = str(bsdf)
    for kind, name in WRAPPERS.items():
        if kind in printed and not (kind == "Mask[" and _is_opaque(bsdf)):
            yield name
    for key, value in mi.traverse(bsdf) if "Principled BSDF" in printed else ():
        name, _, kind = NESTED.sub("", key).partition(".")
        if name in ASSUMED and not kind.endswith("to_uv"):
            values = np.array(value, np.float64).ravel()
            if np.abs(values - ASSUMED[name]).max(initial=0) > TOLERANCE:
                constant = kind in ("", "value")  # otherwise a texture
                yield f"{name} {values[0]:.3g}" if constant else f"a {name} texture"


def _name(shape: Any) -> str:
    return f"'{excerpt(shape.id())}'" if shape.id() else f"without an id ({shape.class_name()})"


def warn_of_back_faces(scene: Any, shape: Any, sensors: Sequence[Any]) -> list[str]:
    """Return a warning if the cameras see mostly back faces."""
    mesh = arrays(shape)
    behind = back_face_share(scene, mesh, [to_world(each)[:3, 3] for each in sensors])
    if behind < MOST:
        return []
    remedy = "its normals point the wrong way: set flip_normals on the shape"
    if faces_outward(mesh):
        remedy = "it is closed, so the cameras are inside: check that mesh and poses use one unit"
    share = f"{behind:.0%} of its visible area are back faces, which are not estimated"
    return [f"Shape '{shape.id()}': {share}; {remedy}."]


def faces_outward(mesh: MeshArrays) -> bool:
    """Return whether a surface is closed and its front faces are outside."""
    if not is_closed(mesh):
        return False
    cross, first = mesh.crosses, mesh.positions[mesh.faces[:, 0]] - mesh.positions.mean(axis=0)
    volume = np.einsum("fi,fi->", first, cross)
    if mesh.normals is not None:
        volume *= np.sign(np.einsum("fi,fki->", cross, mesh.normals[mesh.faces]))
    return bool(volume > 0)


def back_face_share(scene: Any, mesh: MeshArrays, eyes: Sequence[np.ndarray]) -> float:
    """Return the share of back faces in the visible projected area, in [0, 1].

    ``scene`` contains the occluders; ``eyes`` are world positions (3,) of the cameras.
    """
    cross = mesh.crosses
    if not cross.any() or not len(eyes):
        return 0.0
    face = faces_at(cross, (np.arange(POINTS) + 0.5) / POINTS)
    point = mesh.positions[mesh.faces[face]].mean(axis=1)
    normal = cross[face] / np.linalg.norm(cross[face], axis=1, keepdims=True)
    if mesh.normals is not None:
        pointing = mesh.normals[mesh.faces[face]].sum(axis=1)
        normal *= np.where(np.einsum("ni,ni->n", normal, pointing) < 0, -1, 1)[:, None]
    chosen = evenly_spaced(len(eyes), EYES)
    toward = np.array(eyes, np.float64)[chosen][:, None] - point
    distance = np.linalg.norm(toward, axis=2)
    direction = toward / np.maximum(distance, 1e-300)[..., None]
    cosine = np.einsum("vni,ni->vn", direction, normal)
    above = OFFSET * np.linalg.norm(np.ptp(mesh.positions, axis=0)) * np.sign(cosine)
    start = point + above[..., None] * normal
    origin, way = (values.reshape(-1, 3).T for values in (start, direction))
    ray = mi.Ray3f(to_drjit(mi.Point3f, origin), to_drjit(mi.Vector3f, way))
    ray.maxt = to_drjit(mi.Float, distance.ravel())
    free = ~np.array(scene.ray_test(ray), bool)
    seen = np.abs(cosine) * free.reshape(cosine.shape) / np.maximum(distance, 1e-300) ** 2
    return float(seen[cosine < 0].sum() / max(seen.sum(), 1e-300))
