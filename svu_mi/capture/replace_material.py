"""The object's material: constant parameters, and its replacement."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture.capture import Capture
from svu_mi.capture.mesh import arrays, make_mesh
from svu_mi.capture.normal_map import layers, normal_map, with_normal_map
from svu_mi.errors import SceneError, excerpt
from svu_mi.parameters import NAMES, PARAMETERS


def is_principled(bsdf: Any) -> bool:
    """Return whether a BSDF has the parameters of ``principled``."""
    return bsdf is not None and all(dr.all(bsdf.has_attribute(name)) for name in NAMES)


def constant_parameters(shape: Any) -> dict[str, float]:
    """Return the untextured ``principled`` parameters of a shape, by name.

    Constant colours that are not grey are omitted. The result is empty for other BSDFs, and for
    a BSDF without textures, which is assumed to be a placeholder.
    """
    bsdf = layers(shape.bsdf())[-1]
    constants: dict[str, float] = {}
    if not is_principled(bsdf):
        return constants
    for key, value in mi.traverse(bsdf):
        name, _, kind = key.partition(".")
        if name in NAMES and kind == "value":
            values = np.array(value, np.float64).ravel()
            if np.ptp(values) == 0 and PARAMETERS[name].holds(values[0]):
                constants[name] = float(values[0])
    return constants if len(constants) < len(NAMES) else {}


@dataclass(frozen=True)
class RepaintedScene:
    """Copy of a scene with another material of the object.

    Attributes:
        scene: The ``mi.Scene``.
        shape: The object in it, an ``mi.Mesh``.
    """

    scene: Any
    shape: Any


def replace_material(capture: Capture, material: Any, mesh: Any = None) -> RepaintedScene:
    """Return a copy of the scene with another material (and mesh)."""
    surface = capture.mesh if mesh is None else mesh
    if is_same(surface, capture.shape):  # otherwise the map does not fit its UVs
        material = with_normal_map(normal_map(capture.shape.bsdf()), material)
    if is_two_sided(capture.shape.bsdf()):
        material = mi.load_dict({"type": "twosided", "material": material})
    shape = make_mesh(capture.shape.id(), arrays(surface))
    shape.set_bsdf(material)
    return RepaintedScene(scene=scene_around(shape, capture), shape=shape)


def with_normals(capture: Capture, pixels: np.ndarray) -> Capture:
    """Return the capture with another normal map of the object, (H, W, 3) in [0, 1]."""
    old = capture.shape.bsdf()
    texture = {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(np.ascontiguousarray(pixels))}
    made = {"type": "normalmap", "normalmap": texture, "material": layers(old)[-1]}
    made = {"type": "twosided", "material": made} if is_two_sided(old) else made
    shape = make_mesh(capture.shape.id(), arrays(capture.mesh))
    shape.set_bsdf(mi.load_dict(made))
    return replace(capture, shape=shape, mesh=shape, scene=scene_around(shape, capture))


def scene_around(shape: Any, capture: Capture) -> Any:
    """Return the scene of a capture, without sensors and with ``shape`` as its object."""
    # Area lights are part of their shapes.
    lights = [e for e in capture.scene.emitters() if e.get_shape() is None]
    return make_scene([shape, *lights, *other_shapes(capture.scene, capture.shape)])


def other_shapes(scene: Any, target: Any) -> list[Any]:
    """Return the shapes of a scene except the object."""
    return [shape for shape in scene.shapes() if not is_same(shape, target)]


def make_scene(objects: Sequence[Any]) -> Any:
    """Make a scene of existing objects, such as shapes, emitters and sensors."""
    for thing in objects:  # the group of an instance is not accessible from Python
        if thing.class_name() == "Instance":
            raise SceneError(
                f"Shape '{excerpt(thing.id())}' is an instance, so the scene cannot be changed; "
                "put the shapes of its shapegroup into the scene instead."
            )
    names = [thing.id() for thing in objects]
    parts = {f"part_{index}": thing for index, thing in enumerate(objects)}
    scene = mi.load_dict({"type": "scene", **parts}, optimize=False)
    for thing, name in zip(objects, names, strict=True):
        thing.set_id(name)  # load_dict replaced it
    return scene


def is_same(a: Any, b: Any) -> bool:
    """Return whether two Python objects refer to the same Mitsuba shape."""
    return bool(np.array(mi.ShapePtr(a) == mi.ShapePtr(b)).all())


def is_two_sided(bsdf: Any) -> bool:
    """Return whether a BSDF reflects on both sides of its surface."""
    return bsdf is not None and "TwoSided" in bsdf.class_name()
