"""Writer of photographs in the layout of Stanford-ORB, which ``stanford_orb`` reads.

``ground_truth`` has no surface_normal and z_depth, because geometry is given and not estimated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from svu_mi.capture.importers.source import OPENGL
from svu_mi.capture.importers.source_files import safe_path
from svu_mi.capture.importers.stanford_orb import ALBEDO, ENVIRONMENTS, MESH, SUFFIXES, TRUTH
from svu_mi.capture.mesh import MeshArrays, flipped_v
from svu_mi.core.io.exr import write_exr
from svu_mi.core.io.files import prepare_folder, replacing, write_json, write_text
from svu_mi.errors import MeshError

# Rotation of the normals of the scans in the data set.
NORMALS_AS_PUBLISHED = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


@dataclass(frozen=True, kw_only=True)
class OrbPhotograph:
    """A photograph.

    Attributes:
        image: Linear radiance, (H, W, 3).
        mask: Coverage by the object in [0, 1], (H, W).
        to_world: Matrix from Mitsuba's camera space to the world of the capture, (4, 4).
        environment: Environment map of a test photograph in the frame of its camera, (h, w, 3).
            Layout of Mitsuba's envmap, but the first row is half a row away from the pole.
        albedo: Linear base colour of a test photograph, (H, W, 3).
    """

    image: np.ndarray
    mask: np.ndarray
    to_world: np.ndarray
    environment: np.ndarray | None = None
    albedo: np.ndarray | None = None


@dataclass(frozen=True, kw_only=True)
class OrbCapture:
    """An object in one place.

    Attributes:
        name: Name of the capture, such as ``teapot_scene001``.
        x_fov: Horizontal field of view of all photographs in degrees.
        world: Rotation and translation from the frame of the mesh to the world of this place,
            (4, 4).
        train: Photographs for the recovery of textures.
        test: Photographs for the comparison with results.
    """

    name: str
    x_fov: float
    world: np.ndarray
    train: Sequence[OrbPhotograph]
    test: Sequence[OrbPhotograph]


def write_orb(root: str | Path, mesh: MeshArrays, captures: Sequence[OrbCapture]) -> None:
    """Write all captures of one object.

    Photographs are written with high and low dynamic range. ``transforms_novel.json`` of each
    capture lists the test photographs of the other captures.

    Args:
        root: Folder of the data set.
        mesh: Object with normals and UVs, in the frame that ``OrbCapture.world`` transforms.
        captures: Captures of the object.

    Raises:
        MeshError: The mesh has no normals or no UVs.
        CaptureError: The name of a capture is not a valid folder name.
        OutputError: A file cannot be written.
    """
    if mesh.normals is None or mesh.uvs is None:
        raise MeshError("write_orb(): the mesh needs normals and UVs.")
    for capture in captures:
        safe_path(Path(root), capture.name, "write_orb()")
        others = [other for other in captures if other is not capture]
        for kind in SUFFIXES:
            _write_photographs(Path(root) / kind, capture, others)
        _write_truth(Path(root) / TRUTH / capture.name, capture, mesh)


def _names(capture: OrbCapture) -> dict[str, list[tuple[str, OrbPhotograph]]]:
    """Return (file name, photograph) by split; files of ``train`` are numbered first."""
    numbered = enumerate([*capture.train, *capture.test])
    shots = [(f"{number:04d}", photograph) for number, photograph in numbered]
    return {"train": shots[: len(capture.train)], "test": shots[len(capture.train) :]}


def _write_photographs(folder: Path, capture: OrbCapture, others: Sequence[OrbCapture]) -> None:
    place = folder / capture.name
    angle = {"camera_angle_x": float(np.radians(capture.x_fov))}
    for split, shots in _names(capture).items():
        images, masks = (prepare_folder(place / name) for name in (split, f"{split}_mask"))
        for name, shot in shots:
            path = images / f"{name}{SUFFIXES[folder.name]}"
            if path.suffix == ".exr":
                write_exr(path, {"RGB": shot.image})
            else:
                _write_png(path, shot.image)
            _write_png(masks / f"{name}.png", shot.mask, encoded=True)
        frames = [_frame(split, name, shot.to_world) for name, shot in shots]
        write_json(place / f"transforms_{split}.json", {**angle, "frames": frames})
    novel = [
        {
            **_frame("test", name, capture.world @ np.linalg.inv(other.world) @ shot.to_world),
            "camera_angle_x": float(np.radians(other.x_fov)),
            "scene_name": other.name,
        }
        for other in others
        for name, shot in _names(other)["test"]
    ]
    write_json(place / "transforms_novel.json", {"frames": novel})


def _frame(split: str, name: str, to_world: np.ndarray) -> dict[str, Any]:
    return {"file_path": f"{split}/{name}", "transform_matrix": (to_world @ OPENGL).tolist()}


def _write_truth(place: Path, capture: OrbCapture, mesh: MeshArrays) -> None:
    for name, shot in _names(capture)["test"]:
        if shot.environment is not None:
            path = prepare_folder(place / ENVIRONMENTS) / f"{name}.exr"
            write_exr(path, {"RGB": shot.environment})
        if shot.albedo is not None:
            _write_png(prepare_folder(place / ALBEDO) / f"{name}.png", shot.albedo)
    prepare_folder((place / MESH).parent)
    rotation, shift = capture.world[:3, :3], capture.world[:3, 3]
    assert mesh.normals is not None and mesh.uvs is not None  # checked by write_orb
    columns = {
        "v": mesh.positions @ rotation.T + shift,
        "vt": flipped_v(mesh.uvs),  # OBJ counts V upwards
        "vn": mesh.normals @ rotation.T @ NORMALS_AS_PUBLISHED.T,
    }
    lines = [
        f"{key} {' '.join(f'{value:.9g}' for value in row)}"
        for key, rows in columns.items()
        for row in rows
    ]
    lines += [f"f {' '.join(f'{i}/{i}/{i}' for i in face)}" for face in mesh.faces + 1]
    write_text(place / MESH, "\n".join(lines))


def _write_png(path: Path, values: np.ndarray, *, encoded: bool = False) -> None:
    """Write an 8-bit PNG; linear values are encoded as sRGB."""
    bitmap = mi.Bitmap(np.ascontiguousarray(np.clip(values, 0, 1), np.float32))
    bitmap = bitmap.convert(component_format=mi.Struct.Type.UInt8, srgb_gamma=not encoded)
    with replacing(path) as temporary:
        bitmap.write(str(temporary))
