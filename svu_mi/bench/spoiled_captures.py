"""Captures with one mistake each, to test whether it is noticed.

A mistake changes the photographs, or what is known about them: mesh, poses, light or gains.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from itertools import repeat
from typing import Any

import mitsuba as mi
import numpy as np
from scipy.ndimage import gaussian_filter

from svu_mi.calibration.checks.axis_hypotheses import with_changed_mesh
from svu_mi.capture.capture import Capture
from svu_mi.capture.importers.simplify_mesh import simplify
from svu_mi.capture.mesh import MeshArrays, arrays, make_mesh
from svu_mi.capture.replace_material import make_scene
from svu_mi.capture.scene import find_environment, to_world
from svu_mi.capture.sensors import affine, describe, film_size, make_sensor, sphere_sensors
from svu_mi.capture.surroundings import DEPTH
from svu_mi.capture.unwrap import unwrap
from svu_mi.light.environment import read_environment
from svu_mi.light.prefiltered import rasterized

UP = np.array([0.0, 1.0, 0.0])
LEAN = np.array([0.8, 0.3, 0.5]) / np.linalg.norm([0.8, 0.3, 0.5])  # not an axis of symmetry
TABLE = 4.0  # sides of the table, in diagonals of the object
RELIEF, ROUGH = 1024, 1.5  # pixels per side of a relief's normals, and their blur
ABOVE = 0.1  # sine of the lowest camera above a table


def rotation(axis: np.ndarray, degrees: float) -> np.ndarray:
    """Return the (3, 3) rotation about a unit axis."""
    return np.array(mi.ScalarTransform4f().rotate(axis.tolist(), degrees).matrix)[:3, :3]


def box_of(mesh: MeshArrays) -> tuple[np.ndarray, float]:
    """Return centre and diagonal of the bounding box."""
    low, high = mesh.positions.min(axis=0), mesh.positions.max(axis=0)
    return (low + high) / 2, float(np.linalg.norm(high - low))


def turned_mesh(capture: Capture, degrees: float) -> Capture:
    """Rotate the mesh about an oblique axis through its centre."""
    turn = rotation(LEAN, degrees)

    def change(mesh: MeshArrays) -> MeshArrays:
        center, _ = box_of(mesh)
        normals = None if mesh.normals is None else mesh.normals @ turn.T
        return replace(mesh, positions=(mesh.positions - center) @ turn.T + center, normals=normals)

    return with_changed_mesh(capture, change)


def moved_mesh(capture: Capture, part: float) -> Capture:
    """Move the mesh by a part of its diagonal."""
    step = np.array([0.6, 0.5, -0.6]) / np.linalg.norm([0.6, 0.5, -0.6])
    return with_changed_mesh(
        capture,
        lambda mesh: replace(mesh, positions=mesh.positions + part * box_of(mesh)[1] * step),
    )


def coarse_mesh(capture: Capture, part: float) -> Capture:
    """Simplify the mesh to a part of its faces, with new UVs."""

    def change(mesh: MeshArrays) -> MeshArrays:
        bare = MeshArrays(mesh.positions, mesh.faces, None, None)
        small, _ = simplify(bare, int(part * len(mesh.faces)), "mesh")
        return arrays(unwrap(make_mesh("mesh", small)))

    return with_changed_mesh(capture, change)


def with_relief(capture: Capture, degrees: float, spp: int) -> Capture:
    """Photograph the object with slopes of ``degrees`` rms that its mesh lacks."""
    random = np.random.default_rng(0).normal(size=(2, RELIEF, RELIEF))
    slopes = np.array([gaussian_filter(noise, ROUGH, mode="wrap") for noise in random])
    slopes *= np.tan(np.radians(degrees)) / np.sqrt(np.square(slopes).sum(axis=0).mean())
    normals = np.stack([*slopes, np.ones_like(slopes[0])], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    texture = mi.load_dict({
        "type": "bitmap", "raw": True,
        "bitmap": mi.Bitmap(np.ascontiguousarray((normals + 1) / 2, np.float32)),
    })  # fmt: skip
    shape = make_mesh(capture.shape.id(), arrays(capture.shape))
    shape.set_bsdf(mi.load_dict({
        "type": "normalmap", "normalmap": texture, "material": capture.shape.bsdf(),
    }))  # fmt: skip
    scene = make_scene([shape, find_environment(capture.scene, "scene")])
    taken = photographed(replace(capture, scene=scene), repeat(scene), spp, depth=2)
    return replace(taken, scene=capture.scene)


def foreign_mesh(capture: Capture, other: Capture) -> Capture:
    """Replace the mesh by that of another object, of the same place and size."""
    stranger = arrays(other.shape)

    def change(mesh: MeshArrays) -> MeshArrays:
        (center, size), (around, width) = box_of(mesh), box_of(stranger)
        return replace(stranger, positions=(stranger.positions - around) * (size / width) + center)

    return with_changed_mesh(capture, change)


def other_light(capture: Capture, light: Any, degrees: float) -> Capture:
    """Replace the light by another one, turned about the vertical axis."""
    return replace(capture, scene=lit_by(capture, turned_light(light, degrees)))


def lit_by(capture: Capture, light: Any, *others: Any) -> Any:
    """Return the scene of a capture with another light, and other shapes."""
    return make_scene([capture.shape, light, *others])


def turned_light(light: Any, degrees: float) -> Any:
    """Return an environment map, turned about the vertical axis."""
    bitmap = np.ascontiguousarray(rasterized(read_environment(light)), np.float32)
    return mi.load_dict({
        "type": "envmap", "id": light.id(), "bitmap": mi.Bitmap(bitmap),
        "to_world": mi.ScalarTransform4f(affine(rotation(UP, degrees)) @ to_world(light)),
    })  # fmt: skip


def wrong_poses(capture: Capture, degrees: float, seed: int = 0) -> Capture:
    """Rotate each camera about a random axis, by ``degrees`` rms."""
    random = np.random.default_rng(seed)
    sensors = []
    for sensor in capture.sensors:
        pose, vector = to_world(sensor), random.normal(size=3)
        angle = degrees * np.linalg.norm(vector) / np.sqrt(3)
        turn = affine(rotation(vector / np.linalg.norm(vector), angle))
        record = {**describe(sensor), "to_world": (pose @ turn).tolist()}
        sensors.append(make_sensor(record, sensor.id()))
    return replace(capture, sensors=tuple(sensors))


def with_gains(capture: Capture, most: float = 1.6, seed: int = 0) -> Capture:
    """Multiply each photograph by a factor, log-uniform from 1 / ``most`` to ``most``."""
    factors = most ** np.random.default_rng(seed).uniform(-1, 1, capture.count)
    images = [x * np.float32(g) for x, g in zip(capture.images, factors, strict=True)]
    return replace(capture, images=tuple(images), buffer=None)


def half_of_another(capture: Capture, other: Capture) -> Capture:
    """Replace every second photograph by that of another object."""
    images, masks = list(capture.images), list(capture.masks)
    images[1::2], masks[1::2] = other.images[1::2], other.masks[1::2]
    return replace(capture, images=tuple(images), masks=tuple(masks), buffer=None)


def with_table(capture: Capture, color: tuple[float, float, float]) -> Capture:
    """Put a table under the object, and the cameras above; photographs stay."""
    low, (center, size) = np.array(capture.shape.bbox().min), box_of(arrays(capture.shape))
    film = film_size(capture.sensors[0])
    above = sphere_sensors(capture.shape, capture.count, film, lowest=ABOVE)
    to = mi.ScalarTransform4f().translate([center[0], low[1], center[2]])
    to = to.scale(TABLE * size / 2).rotate([1, 0, 0], -90)
    table = mi.load_dict({
        "type": "rectangle", "id": "table", "to_world": to,
        "bsdf": {"type": "twosided", "bsdf": {
            "type": "diffuse", "reflectance": {"type": "rgb", "value": list(color)}}},
    })  # fmt: skip
    light = find_environment(capture.scene, "scene")
    return replace(without_masks(capture), sensors=above, scene=lit_by(capture, light, table))


def on_table(capture: Capture, color: tuple[float, float, float], spp: int) -> Capture:
    """Photograph the object on a table that the model lacks, from above."""
    tabled = with_table(capture, color)
    return replace(photographed(tabled, repeat(tabled.scene), spp), scene=capture.scene)


def on_turntable(capture: Capture, spp: int) -> Capture:
    """Turn the light with the camera about the vertical axis."""
    center, _ = box_of(arrays(capture.shape))
    away = np.array([to_world(sensor)[:3, 3] - center for sensor in capture.sensors])
    angles = np.degrees(np.arctan2(away[:, 0], away[:, 2]))
    light = find_environment(capture.scene, "scene")
    lights = (lit_by(capture, turned_light(light, float(angle))) for angle in angles)
    return photographed(capture, lights, spp)


def photographed(capture: Capture, scenes: Iterable[Any], spp: int, depth: int = DEPTH) -> Capture:
    """Return the capture with new photographs, of one scene each."""
    integrator = mi.load_dict({"type": "path", "max_depth": depth})
    images = []
    for number, (sensor, scene) in enumerate(zip(capture.sensors, scenes, strict=False)):
        image = mi.render(scene, sensor=sensor, integrator=integrator, spp=spp, seed=number)
        images.append(np.array(image, np.float32)[..., :3])
    return replace(capture, images=tuple(images), buffer=None)


def without_masks(capture: Capture) -> Capture:
    """Remove all masks."""
    return replace(capture, masks=(None,) * capture.count)
