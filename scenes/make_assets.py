"""Generator of the scenes' assets: PLY meshes and half-float EXR images.

Usage: ``python -m svu_mi.scenes.make_assets [FOLDER]``. The output is deterministic.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import trimesh

from svu_mi.core.io.exr import write_exr
from svu_mi.scenes import FOLDER, NAMES, lights, meshes, textures

VIEWS = 24
GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))
FOV = 36.0


def vertex_normals(mesh: meshes.Mesh) -> np.ndarray:
    """Return area-weighted normals, shared by vertices at the same position."""
    positions, faces, _ = mesh
    a, b, c = (positions[faces[:, k]] for k in range(3))
    face = np.cross(b - a, c - a)
    _, group = np.unique(np.round(positions, 6), axis=0, return_inverse=True)
    total = np.zeros((group.max() + 1, 3))
    for k in range(3):
        np.add.at(total, group.ravel()[faces[:, k]], face)
    normals = total[group.ravel()]
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


def write_mesh(path: Path, mesh: meshes.Mesh) -> None:
    """Write a binary PLY with normals, and UVs as the properties s and t of Mitsuba."""
    positions, faces, uvs = mesh
    made = trimesh.Trimesh(positions, faces, process=False)
    made.vertex_normals = vertex_normals(mesh)
    made.vertex_attributes = {"s": uvs[:, 0].astype("f4"), "t": uvs[:, 1].astype("f4")}
    path.write_bytes(trimesh.exchange.ply.export_ply(made, vertex_normal=True))


def sensor_directions(front_only: bool) -> np.ndarray:
    """Return evenly distributed directions from the object to the cameras, (VIEWS, 3)."""
    index = np.arange(VIEWS) + 0.5
    height = 1 - (0.8 if front_only else 2) * index / VIEWS
    ring, angle = np.sqrt(1 - height**2), GOLDEN_ANGLE * index
    # The pole of the spiral is +Z, in front of the planes; no camera is exactly above the object.
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), height], axis=-1)


def sensors_xml(positions: np.ndarray, front_only: bool) -> str:
    """Return an XML fragment with VIEWS perspective sensors around an object."""
    center = (positions.min(axis=0) + positions.max(axis=0)) / 2
    radius = np.linalg.norm(positions - center, axis=1).max()
    distance = 1.04 * radius / np.sin(np.radians(FOV) / 2)
    lines = ['<scene version="3.0.0">']
    for number, direction in enumerate(sensor_directions(front_only)):
        origin = ", ".join(f"{value:.6f}" for value in center + distance * direction)
        target = ", ".join(f"{value:.6f}" for value in center)
        up = "0, 1, 0" if abs(direction[1]) < 0.99 else "0, 0, 1"
        lines.append(
            f'  <sensor type="perspective" id="view_{number:04d}">\n'
            f'    <float name="fov" value="{FOV:g}"/>\n'
            f'    <float name="near_clip" value="{distance / 100:.4f}"/>\n'
            f'    <float name="far_clip" value="{distance * 10:.4f}"/>\n'
            f'    <transform name="to_world">\n'
            f'      <lookat origin="{origin}" target="{target}" up="{up}"/>\n'
            f"    </transform>\n"
            f'    <sampler type="independent">\n'
            f'      <integer name="sample_count" value="$spp"/>\n'
            f"    </sampler>\n"
            f'    <film type="hdrfilm">\n'
            f'      <integer name="width" value="$resolution"/>\n'
            f'      <integer name="height" value="$resolution"/>\n'
            f'      <string name="pixel_format" value="rgb"/>\n'
            f'      <string name="component_format" value="float32"/>\n'
            f'      <rfilter type="box"/>\n'
            f"    </film>\n"
            f"  </sensor>"
        )
    return "\n".join([*lines, "</scene>", ""])


def make(folder: Path) -> None:
    """Write all assets into a folder."""
    (folder / "lights").mkdir(parents=True, exist_ok=True)
    for name in ("studio", "overcast", "window"):
        image = getattr(lights, name)()
        write_exr(folder / "lights" / f"{name}.exr", _rgb(image), half=True)
    for name in NAMES:
        place = folder / name
        place.mkdir(exist_ok=True)
        mesh = getattr(meshes, name)()
        write_mesh(place / "mesh.ply", mesh)
        (place / "sensors.xml").write_text(sensors_xml(mesh[0], name == "planes"))
        color, rough, metal = getattr(textures, name)()
        write_exr(place / "base_color.exr", _rgb(color), half=True)
        write_exr(place / "roughness.exr", {"Y": rough}, half=True)
        write_exr(place / "metallic.exr", {"Y": metal}, half=True)
    unit = np.array([[-1.0, -1, -1], [1, 1, 1]]) / np.sqrt(3)
    (folder / "object").mkdir(exist_ok=True)
    (folder / "object" / "sensors.xml").write_text(sensors_xml(unit, False))


def _rgb(image: np.ndarray) -> dict[str, np.ndarray]:
    return {name: image[..., k] for k, name in enumerate("RGB")}


if __name__ == "__main__":
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else FOLDER
    make(target)
    print(f"Wrote {target}")
