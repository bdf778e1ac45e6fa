"""Objects of our own for sharing: one whose few materials repeat, one where nothing does."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from svu_mi.capture.picture import quantized, srgb
from svu_mi.files import prepare_folder, replacing
from svu_mi.formats.textures import write_pictures
from svu_mi.parameters import NAMES
from svu_mi.scenes import make_assets, meshes, textures

REPEATED, CONTINUOUS = "mosaic", "drift"
# Base colour, roughness, metallic: far apart, none a perfect mirror.
TILES = (
    ((0.62, 0.58, 0.50), 0.85, 0.0),  # plaster
    ((0.05, 0.14, 0.45), 0.25, 0.0),  # glaze
    ((0.55, 0.06, 0.05), 0.45, 0.0),  # lacquer
    ((0.95, 0.72, 0.35), 0.30, 1.0),  # gold
    ((0.45, 0.46, 0.50), 0.55, 1.0),  # steel
)
COLUMNS, ROWS, SEED = 14, 10, 91640277


def own_object(name: str, folder: Path) -> Path:
    """Write one of our objects as ``scenes/object`` reads it, unless it is there.

    Args:
        name: ``mosaic`` or ``drift``.
        folder: gets a folder of that name.

    Returns:
        That folder, absolute.
    """
    place = prepare_folder(folder / name).resolve()
    paint = {REPEATED: mosaic, CONTINUOUS: drift}[name]
    if not (place / "mesh.ply").exists():
        color, rough, metal = paint()
        pictures = (quantized(values) for values in (srgb(color), rough, metal))
        write_pictures(dict(zip(NAMES, pictures, strict=True)), place)
        with replacing(place / "mesh.ply") as temporary:  # last: a folder that has it is whole
            make_assets.write_mesh(temporary, meshes.vase())
    return place


def mosaic() -> textures.Material:
    """Tiles of five materials, in random order: (H, W, 3), (H, W), (H, W), all linear."""
    u, v = textures.coordinates()
    column = np.floor(np.clip(textures.along(u), 0, 1 - 1e-9) * COLUMNS).astype(int)
    row = np.floor(v * ROWS).astype(int)
    order = np.random.default_rng(SEED).integers(0, len(TILES), (ROWS, COLUMNS))[row, column]
    color = np.array([tile[0] for tile in TILES])[order]
    rough, metal = (np.array([tile[k] for tile in TILES])[order] for k in (1, 2))
    return color, rough, metal


def drift() -> textures.Material:
    """Smooth noise in every parameter, so that no two places are alike."""
    u, v = textures.coordinates()
    around = textures.along(u)
    fields = [textures.noise(SEED + k, 3, around, v) for k in range(5)]
    color = np.stack(fields[:3], axis=-1) * 0.8 + 0.08
    return color, 0.2 + 0.65 * fields[3], fields[4]
