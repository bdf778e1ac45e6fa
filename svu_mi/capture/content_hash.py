"""Digests of a capture and its parts, to recognise files of another one.

    capture_key(capture)            # "5d1f0c..."
    photographs_key(capture)        # the same whatever its light and materials are
    capture_parts(capture)          # {"shapes": "a81e...", "light": "07c3...", ...}

Digests go by content alone: the same files give the same ones in every process, wherever they
lie, and whatever the photographs are called.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture import mesh as meshes
from svu_mi.capture.capture import Capture, LightUncertainty
from svu_mi.capture.mesh import crosses_of, unit_vectors
from svu_mi.capture.replace_material import is_same
from svu_mi.capture.sensors import describe
from svu_mi.core.io.hashes import Key

ALIKE = 1e-4  # between normals of a file and of the faces around a vertex, beyond rounding
# Words and single numbers of what Mitsuba prints; arrays are parameters, which are added whole.
PRINTED = re.compile(r"^\s*([\w ]+) = ([A-Za-z]\w*\[?|[-+.\de]+),?$", re.MULTILINE)
# Files have any name; the radius of a light is that of the scene it was last used in.
NOT_ITS_OWN = ("name", "filename", "radius")
UNWRAPPED = ("faces", "vertex_positions", "vertex_texcoords")
ADDRESS = re.compile(r"0x[0-9a-f]+|object_\d+")


def capture_key(capture: Capture) -> str:
    """Return one digest of a whole capture: 32 hexadecimal letters (see ``capture_parts``)."""
    return Key(capture_parts(capture)).digest()


def photographs_key(capture: Capture) -> str:
    """Return a digest of what was photographed from where: 32 hexadecimal letters.

    Light, materials and the integrator count for nothing, nor do views that are not used.
    """
    used = np.flatnonzero(capture.used).tolist()
    key = _shapes(capture.scene, capture.shape, materials=False)
    key.add([describe(capture.sensors[view]) for view in used])
    key.add(_digests(capture.images[view] for view in used))
    _add_clipped(key, capture, used)
    key.add(_digests(capture.masks[view] for view in used))
    key.add([float(capture.exposures[view]) for view in used])
    return key.digest()


def mesh_key(mesh: Any) -> str:
    """Return a digest of what texels of a ``mi.Mesh`` are: its faces and their UVs."""
    source = meshes.arrays(mesh)
    assert source.uvs is not None
    return Key(source.faces, source.uvs.astype(np.float32)).digest()


def scene_key(scene: Any, target: Any) -> str:
    """Return a digest of a scene's shapes and light, whatever its sensors."""
    return Key(_shapes(scene, target).digest(), _light(scene).digest()).digest()


def integrator_key(scene: Any) -> str:
    """Return a digest of how a scene is rendered: 32 hexadecimal letters."""
    integrator = scene.integrator()
    hidden = getattr(integrator, "hide_emitters", None)  # which it does not print
    return Key(ADDRESS.sub("", str(integrator)), hidden).digest()


def capture_parts(capture: Capture) -> dict[str, str]:
    """Return digests of the parts of a capture."""
    used = np.flatnonzero(capture.used).tolist()
    pixels = _digests(capture.images[view] for view in used)
    masks = _digests(capture.masks[view] for view in used)
    shapes = _shapes(capture.scene, capture.shape)
    if not is_same(capture.mesh, capture.shape):  # the same surface, unwrapped
        params = mi.traverse(capture.mesh)
        shapes.add(*(np.asarray(params[name]) for name in UNWRAPPED))
    keys = {
        "shapes": shapes,
        "light": _light(capture.scene, capture.light_uncertainty),
        "sensors": Key([describe(sensor) for sensor in capture.sensors]),
        "photographs": Key(list(map(bool, capture.used)), pixels),
        "masks": Key(masks),
        "exposures": Key(list(map(float, capture.exposures))),
    }
    _add_clipped(keys["photographs"], capture, used)
    for view in used if capture.rounding else ():
        steps = capture.rounding[view]
        keys["photographs"].add(*(() if steps is None else (view, steps.first, steps.slope)))
    digests = {name: key.digest() for name, key in keys.items()}
    return digests | {"integrator": integrator_key(capture.scene)}


def _add_clipped(key: Key, capture: Capture, used: Sequence[int]) -> None:
    """Add which channels are clipped, if any is."""
    if capture.clipped:
        for view in used:
            saturated = capture.clipped[view]
            key.add(*(() if saturated is None else (view, saturated.channels, saturated.least)))


def _digests(arrays: Iterable[np.ndarray | None]) -> list[str]:
    """Return a digest of each array, on as many threads as Dr.Jit has."""
    with ThreadPoolExecutor(max(1, dr.thread_count())) as threads:
        return list(threads.map(lambda array: Key(array).digest(), arrays))


def _shapes(scene: Any, target: Any, materials: bool = True) -> Key:
    """Add shapes; vertex normals only where they are not those of the faces around.

    Mitsuba computes missing ones by a sum whose order, and so its last bits, are left to chance.
    """
    key = Key()
    for shape in scene.shapes():
        key.add(shape.id(), is_same(shape, target))
        key.add(shape.class_name(), shape.has_flipped_normals())
        if materials:
            bsdf = shape.bsdf()
            key.add(_settings(shape), None if bsdf is None else bsdf.class_name())
        for name, array in _arrays(shape):
            if not materials and "." in name:  # of its material, or of light that it emits
                continue
            normals = name.endswith("vertex_normals") and array.size
            computed = normals and _are_computed(shape, array)
            key.add(name, "of faces" if computed else array)
    return key


def _arrays(node: Any) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the parameters of a Mitsuba object; those without an id are named by an address."""
    for name, value in mi.traverse(node):
        yield ADDRESS.sub("", name), np.asarray(getattr(value, "matrix", value))


def _light(scene: Any, uncertainty: LightUncertainty | None = None) -> Key:
    key = Key()
    for emitter in scene.emitters():
        key.add("node", emitter.class_name(), _settings(emitter))
        for name, array in _arrays(emitter):
            key.add(name, array)
    if uncertainty is not None:  # posteriors are others
        key.add(uncertainty)
    return key


def _settings(node: Any) -> list[Any]:
    """Return what a Mitsuba object prints beside its parameters, such as a distribution."""
    return [entry for entry in PRINTED.findall(str(node)) if entry[0] not in NOT_ITS_OWN]


def _are_computed(mesh: Any, normals: np.ndarray) -> bool:
    """Return whether normals are means over the faces around, weighted by angle, as Mitsuba's."""
    params = mi.traverse(mesh)
    positions = np.array(params["vertex_positions"], np.float64).reshape(-1, 3)
    faces = np.asarray(params["faces"]).reshape(-1, 3)
    if not np.isfinite(positions).all() or (faces >= len(positions)).any():
        return False
    corners = positions[faces]
    across = unit_vectors(crosses_of(positions, faces))
    total = np.zeros_like(positions)
    for corner in range(3):
        here, after, before = (corners[:, (corner + k) % 3] for k in range(3))
        cosine = np.einsum("fi,fi->f", unit_vectors(after - here), unit_vectors(before - here))
        weighted = np.arccos(np.clip(cosine, -1, 1))[:, None] * across
        for axis in range(3):
            total[:, axis] += np.bincount(faces[:, corner], weighted[:, axis], len(total))
    sound = np.linalg.norm(total, axis=1) > ALIKE  # faces around cancel out: any direction will do
    return bool(np.abs(unit_vectors(total) - normals.reshape(-1, 3))[sound].max(initial=0) < ALIKE)
