"""Mitsuba scenes: loading, and checks of object, sensors and light."""

import os
import re
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi import _llvm
from svu_mi.capture.float_textures import store_as_float
from svu_mi.capture.mesh import MeshArrays, check_buffers
from svu_mi.capture.opaque_masks import remove_opaque_masks
from svu_mi.capture.plugin_security import (
    pin_own_plugins,
    refuse_foreign,
    require_own_plugins,
    search_folder_first,
)
from svu_mi.capture.scene_files import check_files, check_xml, name_objects
from svu_mi.core.io.schema import LARGEST
from svu_mi.core.threads import ensure_threads
from svu_mi.errors import SceneError, SvuEnvironmentError, SvuError, excerpt

ENVIRONMENTS = ("EnvironmentMapEmitter", "ConstantBackgroundEmitter", "SunskyEmitter")
LAMPS = ("AreaLight", "PointLight", "SpotLight", "DirectionalEmitter")
LONGEST = 240  # characters of Mitsuba's messages
DEFAULT = r"""<default\s+name=["']([^"']+)"""  # parameter of a scene
PLACE = re.compile(r"\] (?:Error while loading|At) (.+) \(line (\d+), col \d+\): ")
CONTENT = re.compile(r'( - object "[^"]+"): \w+\[.*', re.DOTALL)  # of a misnamed object
TRACE = re.compile(r"Traceback \(most recent call last\):\n(?:  .*\n)*(?:\w+: )?")  # of a plugin
RESERVED = frozenset(("config", "filename"))  # other arguments of mi.parser.parse_file


def require_variant() -> str:
    """Return the active variant; raise if it is unset or unsupported.

    Also loads Mitsuba's own plugins, so that no library replaces them (``pin_own_plugins``), and
    disables approximate divisions on CUDA, whose double precision has an error of 1e-6.
    """
    variant = mi.variant()
    if variant is None:
        raise SvuEnvironmentError(
            "No Mitsuba variant is set; call mitsuba.set_variant('llvm_ad_rgb') first."
        )
    if _first_process() != os.getpid():
        raise SvuEnvironmentError(
            "Dr.Jit hangs in forks of a process; use multiprocessing.get_context('spawn')."
        )
    if not re.fullmatch(r"(llvm|cuda|metal)_ad_rgb", variant):
        raise SvuEnvironmentError(
            f"Variant '{variant}' is not supported: entropy needs a vectorised RGB variant; "
            "use llvm_ad_rgb (or cuda_ad_rgb, metal_ad_rgb)."
        )
    if variant.startswith("llvm"):
        _llvm.require()
    if variant.startswith("cuda"):
        dr.set_flag(dr.JitFlag.FastMath, False)
    pin_own_plugins()
    return variant


@cache
def _first_process() -> int:
    """Return the id of the first process that asks; its forks inherit the answer."""
    return os.getpid()


def load_scene(
    path: Path, defines: Mapping[str, str] | None = None, *, trust: bool = False,
    float_textures: bool = False,
) -> Any:  # fmt: skip
    """Load a Mitsuba XML file without merging its shapes or textures.

    Args:
        path: Path of the XML file.
        defines: Values of the scene's ``<default>`` parameters.
        trust: True lets the scene load plugin libraries (see ``load_capture``).
        float_textures: True stores 8-bit textures of principled materials as float32.

    Raises:
        SceneError: The scene, or a file that it refers to, is missing, damaged or not allowed.
    """
    if not path.is_file():
        raise SceneError(f"{path}: no such scene file; give the path of a Mitsuba XML scene.")
    defines = dict(defines or {})
    for name in RESERVED & defines.keys():
        raise SceneError(f"{path}: {name!r} is reserved; rename this scene parameter.")
    require_own_plugins(trust)
    config = mi.parser.ParserConfig(mi.variant())
    # Merging equal textures and meshes would drop their ids.
    config.merge_equivalent = config.merge_meshes = False
    ensure_threads()
    with search_folder_first(os.path.dirname(path)):
        try:
            check_xml(path, defines)
            state = mi.parser.parse_file(config, str(path), **defines)
            mi.parser.transform_all(config, state)
            if not trust:
                refuse_foreign(state, str(path))
            check_files(state, str(path))
            name_objects(state)
            remove_opaque_masks(state)
            if float_textures:
                store_as_float(state)
            return mi.parser.instantiate(config, state)
        except SvuError:
            raise
        except Exception as error:  # Mitsuba raises RuntimeError for everything
            names = re.findall(DEFAULT, path.read_text(errors="replace"))
            known = f" The file has {', '.join(f'${name}' for name in names) or 'no parameters'}."
            unused = known if "unused parameters" in str(error) else ""
            raise SceneError(f"{_refusal(path, str(error))}{unused}") from error


def _refusal(path: Path, message: str) -> str:
    """Return Mitsuba's reason with the innermost file and line."""
    places = list(PLACE.finditer(message))
    if not places:
        return f"{path}: {last_sentence(message)}"
    file, line = places[-1].groups()
    included = "" if Path(file).resolve() == path.resolve() else f" {excerpt(Path(file).name)},"
    return f"{path}:{included} line {line}: {last_sentence(message[places[-1].end() :])}"


def last_sentence(message: str) -> str:
    """Return Mitsuba's message as a sentence, without positions in source code."""
    text = TRACE.sub("", re.sub(r"\[[\w.]+:\d+\]\s*", "", message))
    text = CONTENT.sub(r"\1", text)
    text = excerpt(text.strip(), LONGEST)
    return text if text.endswith((".", "!")) else text + "."


def find_sensors(
    scene: Any, path: str, remedy: str = "render some with svu render --views N"
) -> tuple[Any, ...]:
    """Return the scene's sensors, at least one; raise if one is unsupported."""
    sensors = tuple(scene.sensors())
    if not sensors:
        raise SceneError(
            f"{path}: the scene has no sensor; add one <sensor> per photograph, or {remedy}."
        )
    for index, sensor in enumerate(sensors):
        check_sensor(sensor, f"{path}: sensor {index} ('{sensor.id()}')")
    return sensors


def to_world(endpoint: Any) -> np.ndarray:
    """Return the local-to-world matrix of a sensor or emitter, (4, 4) float64."""
    return read_matrix(endpoint.world_transform())


def read_matrix(transform: Any) -> np.ndarray:
    """Return the matrix of a transform, (4, 4) float64; copies entries without a kernel launch."""
    matrix = transform.matrix
    return np.array([[matrix[i, j][0] for j in range(4)] for i in range(4)], np.float64)


def check_sensor(sensor: Any, label: str) -> None:
    """Raise unless a sensor is a pinhole camera with a rigid pose."""
    if sensor.class_name() != "PerspectiveCamera":
        raise SceneError(
            f"{label} is a {sensor.class_name()}; only 'perspective' sensors are supported: change "
            "its type, or take the sensors out of a batch."
        )
    rotation = to_world(sensor)[:3, :3]
    if np.linalg.det(rotation) < 0:
        raise SceneError(
            f"{label} has a mirrored to_world (determinant < 0); camera space is "
            "+X left, +Y up, +Z forward: negate one column."
        )
    if not np.allclose(rotation.T @ rotation, np.eye(3), atol=1e-3):
        raise SceneError(
            f"{label} has a to_world that is not a rotation and a translation; remove the scale "
            "or shear."
        )


def find_environment(scene: Any, path: str, flash: Any | None = None) -> Any:
    """Return the scene's only light, which must be an environment emitter."""
    lamps = ["a flash"] if flash is not None else [_emitter_name(lamp) for lamp in lamps_of(scene)]
    if lamps:
        raise SceneError(
            f"{path}: {lamps[0]} is not supported here; the light must be one distant envmap, "
            "constant or sunsky emitter. Estimates with the presets default and fixed support "
            "lamps."
        )
    return find_light(scene, path)


def environment_of(capture: Any) -> Any:
    """Return the environment emitter of a capture, which must be its only light."""
    return find_environment(capture.scene, str(capture.source or "The scene"), capture.flash)


def is_lit(capture: Any) -> bool:
    """Return whether a capture has a light."""
    return bool(capture.scene.emitters()) or capture.flash is not None


def find_light(scene: Any, path: str) -> Any | None:
    """Return the environment emitter, None if there are lamps only; raise if one is unsupported."""
    emitters = scene.emitters()
    if not emitters:
        raise SceneError(
            f"{path}: the scene has no emitter; the method needs the light the photographs were "
            "taken under: add an envmap, constant or sunsky emitter, or lamps."
        )
    for emitter in emitters:
        if emitter.class_name() not in (*ENVIRONMENTS, *LAMPS):
            raise SceneError(
                f"{path}: {_emitter_name(emitter)} is not supported; use envmap, constant, sunsky, "
                "area, point, spot or directional emitters."
            )
    return scene.environment()


def lamps_of(scene: Any) -> list[Any]:
    """Return the emitters of a scene that are not its environment."""
    return [emitter for emitter in scene.emitters() if emitter.class_name() in LAMPS]


def has_lamps(capture: Any) -> bool:
    """Return whether a capture has lamps, or a flash."""
    return bool(lamps_of(capture.scene)) or capture.flash is not None


def _emitter_name(emitter: Any) -> str:
    shape = emitter.get_shape()  # area lights have no id
    of = f"of shape '{shape.id()}'" if shape is not None else f"'{emitter.id()}'"
    which = "an area light" if shape is not None and not shape.id() else f"emitter {of}"
    return f"{which} ({emitter.class_name()})"


def require_light(capture: Any) -> None:
    """Raise if a capture has no light."""
    if not is_lit(capture):
        label = f"{capture.source or 'The scene'}: the capture has no light; estimate it with "
        raise SceneError(
            f"{label}svu.with_light(capture, svu.estimate_light(capture, texels)).",
            shell=f"{label}svu light.",
        )


def check_target(mesh: MeshArrays, label: str) -> None:
    """Raise if the object's mesh is empty, damaged or inside out."""
    if not len(mesh.faces):
        raise SceneError(f"{label} has no faces; export its mesh again.")
    check_buffers(mesh, label, SceneError, LARGEST)
    _check_orientation(mesh, label)


def is_closed(mesh: MeshArrays) -> bool:
    """Return whether each edge of the surface has two faces."""
    _, vertex = np.unique(np.round(mesh.positions, 8), axis=0, return_inverse=True)
    corners = vertex.reshape(-1)[mesh.faces]
    edges = np.sort(corners[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    edges = edges[edges[:, 0] != edges[:, 1]]
    return bool((np.unique(edges, axis=0, return_counts=True)[1] == 2).all())


def _check_orientation(mesh: MeshArrays, label: str) -> None:
    """Raise if a closed surface is inside out.

    A mirrored ``to_world`` reverses the winding, from which Mitsuba computes missing normals.
    """
    if len(mesh.faces) == 0 or mesh.normals is None:
        return
    centers = mesh.positions[mesh.faces].mean(axis=1)
    area = np.linalg.norm(mesh.crosses, axis=1) / 2
    outward = centers - np.average(centers, axis=0, weights=area + 1e-300)
    normal = mesh.normals[mesh.faces].mean(axis=1)
    flux = float((area * np.einsum("fi,fi->f", normal, outward)).sum())
    reach = float((area * np.linalg.norm(outward, axis=1)).sum())
    if flux < -0.3 * reach and is_closed(mesh):
        raise SceneError(
            f"{label}: its normals point inwards (a mirrored to_world does this); set flip_normals "
            "on the shape or remove the mirror."
        )
