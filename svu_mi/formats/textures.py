"""The material of a mesh file as pictures of ``principled``'s parameters."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from trimesh.visual.material import empty_material

from svu_mi.capture.picture import decoded, quantized, srgb
from svu_mi.errors import MeshError, excerpt
from svu_mi.files import replacing

MAX_PIXELS = 2**26  # 8192 x 8192
CONSTANT = 4  # pixels per side of the texture that stands for a factor without a texture

# Statements of an OBJ's material that no parameter here stands for.
IGNORED = {
    "bump": "a bump map", "map_bump": "a bump map", "norm": "a normal map", "disp": "displacement",
}  # fmt: skip

# By parameter: base_color (H, W, 3) bytes, sRGB; roughness and metallic (H, W) bytes, linear.
Textures = Mapping[str, np.ndarray]


def textures_of(visual: Any, path: Path) -> Textures:
    """Return the textures of the ``visual`` of a ``trimesh.Trimesh``.

    Textures are multiplied by the material's factors (base colour in linear light); normal maps,
    occlusion and emission are ignored. Of an OBJ's material only the diffuse picture is read.

    Raises:
        MeshError: a texture is damaged.
    """
    material = getattr(visual, "material", None)
    try:
        if hasattr(material, "baseColorTexture"):
            return _of_gltf(material)
        picture = getattr(material, "image", None)
        return {"base_color": _rgb(picture)} if is_textured(visual) else {}
    except Exception as error:  # Pillow raises whatever its decoders meet
        raise MeshError(
            f"{path}: a texture cannot be read ({excerpt(error)}); export it again."
        ) from error


def is_textured(visual: Any) -> bool:
    """Return whether a mesh has at least one picture."""
    material = getattr(visual, "material", None)
    if getattr(material, "image", None) is not None:
        return hash(material) != hash(empty_material())  # what trimesh gives to UVs alone
    names = ("baseColorTexture", "metallicRoughnessTexture")
    return any(getattr(material, name, None) is not None for name in names)


def ignored_of(visual: Any) -> list[str]:
    """Return ignored parts of an OBJ's material, such as ``a bump map``."""
    said = getattr(getattr(visual, "material", None), "kwargs", None) or {}
    return [name for key, name in IGNORED.items() if key in said]


def load_pictures(visual: Any) -> None:
    """Decode all pictures of a material; a ValueError if one is too large, or Pillow's errors."""
    material = getattr(visual, "material", None)
    for name in ("image", "baseColorTexture", "metallicRoughnessTexture"):
        picture = getattr(material, name, None)
        if picture is None:
            continue
        if picture.width * picture.height > MAX_PIXELS:
            raise ValueError(f"a texture of {picture.width} x {picture.height} pixels is too large")
        picture.load()


def write_pictures(textures: Textures, folder: Path) -> None:
    """Write ``base_color.png``, ``roughness.png`` and ``metallic.png``, those that there are.

    Raises:
        OutputError: a file cannot be written.
    """
    from PIL import Image

    for name, pixels in textures.items():
        with replacing(folder / f"{name}.png") as temporary:
            Image.fromarray(np.ascontiguousarray(pixels)).save(temporary)


def _of_gltf(material: Any) -> Textures:
    base, factor = _rgb(material.baseColorTexture), material.baseColorFactor
    factor = np.ones(3) if factor is None else np.array(factor, np.float64)[:3]
    # trimesh keeps colours as bytes; the factor itself is linear.
    factor = factor / 255 if factor.max() > 1 else factor
    packed = _rgb(material.metallicRoughnessTexture)
    rough, metal = (
        1.0 if value is None else float(value)
        for value in (material.roughnessFactor, material.metallicFactor)
    )
    if (factor != 1).any():
        base = quantized(srgb(decoded(base / 255) * factor))
    return {
        "base_color": base,
        "roughness": quantized(packed[..., 1] / 255 * rough),
        "metallic": quantized(packed[..., 2] / 255 * metal),
    }


def _rgb(picture: Any) -> np.ndarray:
    """Return (H, W, 3) bytes; white where there is no texture."""
    if picture is None:
        return np.full((CONSTANT, CONSTANT, 3), 255, np.uint8)
    return np.array(picture.convert("RGB"))
