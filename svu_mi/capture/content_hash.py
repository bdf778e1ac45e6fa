"""Digests of captures and their parts, to find out which capture a result belongs to.

    capture_key(capture)            # "5d1f0c..."
    photographs_key(capture)        # independent of light and materials
    capture_parts(capture)          # {"shapes": "a81e...", "light": "07c3...", ...}

Digests depend on content only, not on folders, file names or the process.
"""

import re
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture import mesh as meshes
from svu_mi.capture.capture import Capture, LightUncertainty
from svu_mi.capture.float_textures import as_stored
from svu_mi.capture.mesh import crosses_of, unit_vectors
from svu_mi.capture.normal_map import normal_map, scale_of, texture_of
from svu_mi.capture.replace_material import is_same
from svu_mi.capture.sensors import describe
from svu_mi.core.io.hashes import Key

TOLERANCE = 1e-4  # tolerance between stored and computed vertex normals; above rounding errors
# Lines "name = word" or "name = number" of str(object). Arrays are read as parameters.
PRINTED = re.compile(r"^\s*([\w ]+) = ([A-Za-z]\w*\[?|[-+.\de]+),?$", re.MULTILINE)
# File names are not content; the radius of a light is set by the last scene that used it.
NOT_CONTENT = ("name", "filename", "radius")
UNWRAPPED = ("faces", "vertex_positions", "vertex_texcoords")
ADDRESS = re.compile(r"0x[0-9a-f]+|object_\d+")


def capture_key(capture: Capture) -> str:
    """Return the digest of a capture, 32 hexadecimal digits."""
    return Key(capture_parts(capture)).digest()


def photographs_key(capture: Capture) -> str:
    """Return the digest of geometry, sensors and photographs.

    Light, materials, the integrator and unused views are ignored.
    """
    used = np.flatnonzero(capture.used).tolist()
    key = _shapes(capture.scene, capture.shape, materials=False)
    if layer := normal_map(capture.shape.bsdf()):
        key.add(layer.class_name(), scale_of(layer))
        key.add(*(array for _, array in _arrays(texture_of(layer))))
    key.add([describe(capture.sensors[view]) for view in used])
    key.add(_digests(capture.images[view] for view in used))
    _add_clipped(key, capture, used)
    key.add(_digests(capture.masks[view] for view in used))
    key.add([float(capture.exposures[view]) for view in used])
    return key.digest()


def mesh_key(mesh: Any) -> str:
    """Return the digest of a mesh's faces and UVs, which define its texels."""
    source = meshes.arrays(mesh)
    assert source.uvs is not None
    return Key(source.faces, source.uvs.astype(np.float32)).digest()


def scene_key(scene: Any, target: Any) -> str:
    """Return a digest of a scene's shapes and light, without its sensors."""
    return Key(_shapes(scene, target).digest(), _light(scene).digest()).digest()


def integrator_key(scene: Any) -> str:
    """Return a digest of a scene's integrator: 32 hexadecimal digits."""
    integrator = scene.integrator()
    hidden = getattr(integrator, "hide_emitters", None)  # not part of str(integrator)
    return Key(ADDRESS.sub("", str(integrator)), hidden).digest()


def capture_parts(capture: Capture) -> dict[str, str]:
    """Return the digest of each part of a capture, by name."""
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
        **({} if capture.flash is None else {"flash": Key(capture.flash)}),
        "exposures": Key(list(map(float, capture.exposures))),
    }
    _add_clipped(keys["photographs"], capture, used)
    for view in used if capture.rounding else ():
        steps = capture.rounding[view]
        keys["photographs"].add(*(() if steps is None else (view, steps.first, steps.slope)))
    digests = {name: key.digest() for name, key in keys.items()}
    return digests | {"integrator": integrator_key(capture.scene)}


def _add_clipped(key: Key, capture: Capture, used: Sequence[int]) -> None:
    """Add the clipped channels of the used views to a key."""
    if capture.clipped:
        for view in used:
            saturated = capture.clipped[view]
            key.add(*(() if saturated is None else (view, saturated.channels, saturated.least)))


def _digests(arrays: Iterable[np.ndarray | None]) -> list[str]:
    """Return a digest of each array; one worker per Dr.Jit thread."""
    with ThreadPoolExecutor(max(1, dr.thread_count())) as threads:
        return list(threads.map(lambda array: Key(array).digest(), arrays))


def _shapes(scene: Any, target: Any, materials: bool = True) -> Key:
    """Return the key of all shapes; computed vertex normals are excluded.

    Mitsuba computes missing normals by parallel sums, whose rounding differs between runs.
    """
    key = Key()
    for shape in scene.shapes():
        key.add(shape.id(), is_same(shape, target))
        key.add(shape.class_name(), shape.has_flipped_normals())
        if materials:
            bsdf = shape.bsdf()
            key.add(_settings(shape), None if bsdf is None else bsdf.class_name())
        for name, array in _arrays(shape):
            if not materials and "." in name:  # a parameter of its BSDF or emitter
                continue
            normals = name.endswith("vertex_normals") and array.size
            computed = normals and _are_computed(shape, array)
            stored = as_stored(array) if name.endswith(".data") else array
            key.add(name, "of faces" if computed else stored)
    return key


def _arrays(node: Any) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the name (without memory addresses) and value of each parameter of an object."""
    for name, value in mi.traverse(node):
        yield ADDRESS.sub("", name), np.asarray(getattr(value, "matrix", value))


def _light(scene: Any, uncertainty: LightUncertainty | None = None) -> Key:
    key = Key()
    for emitter in scene.emitters():
        key.add("node", emitter.class_name(), _settings(emitter))
        for name, array in _arrays(emitter):
            key.add(name, array)
    if uncertainty is not None:  # changes the posterior
        key.add(uncertainty)
    return key


def _settings(node: Any) -> list[Any]:
    """Return settings that Mitsuba prints but does not traverse, such as a distribution."""
    return [entry for entry in PRINTED.findall(str(node)) if entry[0] not in NOT_CONTENT]


def _are_computed(mesh: Any, normals: np.ndarray) -> bool:
    """Return whether normals equal those that Mitsuba computes (weighted by angle)."""
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
    sound = np.linalg.norm(total, axis=1) > TOLERANCE  # otherwise the normal is undefined
    return bool(
        np.abs(unit_vectors(total) - normals.reshape(-1, 3))[sound].max(initial=0) < TOLERANCE
    )
