"""A GLB file as the folder that the scene ``object`` reads."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from svu_mi.capture import mesh as capture_mesh
from svu_mi.errors import MeshError
from svu_mi.files import prepare_folder, replacing

CONSTANT = 4  # pixels per side of the texture that stands for a factor without a texture


def convert_glb(path: Path, folder: Path) -> Path:
    """Write mesh.ply, base_color.png, roughness.png and metallic.png of a GLB file.

    The mesh is centred and scaled to a bounding radius of 1. Textures are multiplied by the
    material's factors (base colour in linear light); normal maps, occlusion and emission are
    left out.

    Args:
        path: the GLB file, with one material.
        folder: made if missing; returned.

    Raises:
        MeshError: unreadable, no mesh, no UVs, or several materials.
        OutputError: the folder cannot be written.
    """
    mesh = _load(path)
    prepare_folder(folder)
    uvs = np.array(mesh.visual.uv, np.float64)
    # glTF and Mitsuba's PLY have v = 0 in the image's top row; trimesh turns it over.
    uvs[:, 1] = 1 - uvs[:, 1]
    uvs -= _tile(uvs)
    center = mesh.bounds.mean(axis=0)
    points = np.array(mesh.vertices, np.float64) - center
    points /= np.linalg.norm(points, axis=1).max()
    arrays = capture_mesh.MeshArrays(
        points, np.array(mesh.faces), np.array(mesh.vertex_normals, np.float64), uvs
    )
    with replacing(folder / "mesh.ply") as temporary:
        capture_mesh.make(path.stem, arrays).write_ply(str(temporary))
    for name, pixels in _textures(mesh.visual.material).items():
        _write_png(folder / f"{name}.png", pixels)
    return folder


def _load(path: Path) -> Any:
    import trimesh

    try:
        scene = trimesh.load_scene(path)
    except Exception as error:  # trimesh raises whatever its parser meets
        raise MeshError(f"{path}: cannot be read as a GLB file ({error}).") from error
    parts = [part for part in scene.geometry.values() if hasattr(part, "faces")]
    if not parts:
        raise MeshError(f"{path}: holds no triangle mesh.")
    for part in parts:
        if getattr(part.visual, "uv", None) is None:
            raise MeshError(f"{path}: a mesh has no UVs, so its textures have no place.")
    materials = {hash(part.visual.material) for part in parts}
    if len(materials) > 1:
        raise MeshError(
            f"{path}: has {len(materials)} materials; bake them into one texture set, the "
            "benchmark takes one material per object."
        )
    return scene.to_mesh()


def _tile(uvs: np.ndarray) -> np.ndarray:
    """Return the whole tile all UVs lie in: an offset that repeats the same texture."""
    return np.floor((uvs.min(axis=0) + uvs.max(axis=0)) / 2)


def _textures(material: Any) -> dict[str, np.ndarray]:
    """Return 8-bit pictures by parameter, factors multiplied in."""
    base, factor = _rgb(material.baseColorTexture), material.baseColorFactor
    factor = np.ones(3) if factor is None else np.array(factor, np.float64)[:3]
    # trimesh keeps colours as bytes; the factor itself is linear.
    factor = factor / 255 if factor.max() > 1 else factor
    packed = _rgb(material.metallicRoughnessTexture)
    rough, metal = (
        1.0 if value is None else float(value)
        for value in (material.roughnessFactor, material.metallicFactor)
    )
    return {
        "base_color": base if (factor == 1).all() else _encode(_decode(base) * factor),
        "roughness": _scaled(packed[..., 1], rough),
        "metallic": _scaled(packed[..., 2], metal),
    }


def _rgb(picture: Any) -> np.ndarray:
    """Return (H, W, 3) bytes; white where there is no texture."""
    if picture is None:
        return np.full((CONSTANT, CONSTANT, 3), 255, np.uint8)
    return np.array(picture.convert("RGB"))


def _scaled(values: np.ndarray, factor: float) -> np.ndarray:
    return np.clip(values * factor + 0.5, 0, 255).astype(np.uint8)


def _decode(values: np.ndarray) -> np.ndarray:
    """Return linear light of sRGB bytes (IEC 61966-2-1)."""
    v = values / 255
    return np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4)


def _encode(values: np.ndarray) -> np.ndarray:
    """Return sRGB bytes of linear light."""
    curve = 1.055 * np.maximum(values, 0) ** (1 / 2.4) - 0.055
    v = np.where(values <= 0.0031308, 12.92 * values, curve)
    return np.clip(v * 255 + 0.5, 0, 255).astype(np.uint8)


def _write_png(path: Path, pixels: np.ndarray) -> None:
    from PIL import Image

    with replacing(path) as temporary:
        Image.fromarray(np.ascontiguousarray(pixels)).save(temporary)
