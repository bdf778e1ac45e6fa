"""Objects of other materials than those of the scenes, and what they need to be benchmarked.

    PYTHONPATH=tests python -m studies.repainted FOLDER
    PYTHONPATH=tests python -m studies.light --data FOLDER

The vase of brown wood with dull metal hoops, of slate, and of plaster with matte stripes: dark or
rough all over, they mirror little of the light, and tell least of how bright it is.
"""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import mitsuba as mi
import numpy as np

from svu_mi import scenes
from svu_mi.scenes.textures import SIZE, Material, along, coordinates, noise

LIGHTS = ("overcast", "studio", "window")  # those that are images


def wood() -> Material:
    """Brown, roughness .5 to .95; metal hoops of roughness .35 to .65."""
    grain, worn, scratched, dull = _noises()
    color = np.array([0.3, 0.16, 0.08]) * (0.5 + grain)[..., None]
    hoop = coordinates()[1] * 6 % 1 < 0.15
    iron = np.array([0.45, 0.42, 0.4]) * (0.7 + 0.5 * scratched)[..., None]
    rough = np.where(hoop, 0.35 + 0.3 * dull, 0.5 + 0.45 * worn)
    return np.where(hoop[..., None], iron, color), rough, hoop.astype(float)


def slate() -> Material:
    """Almost black, roughness .35 to .75."""
    grain, worn, *_ = _noises()
    color = np.array([0.1, 0.11, 0.13]) * (0.5 + 1.2 * grain)[..., None]
    return color, 0.35 + 0.4 * worn, np.zeros((SIZE, SIZE))


def plaster() -> Material:
    """White, roughness .8 to 1; blue stripes of roughness .55."""
    grain, worn, *_ = _noises()
    color = np.array([0.8, 0.77, 0.72]) * (0.75 + 0.3 * grain)[..., None]
    stripe = coordinates()[0] * 5 % 1 < 0.3
    rough = np.where(stripe, 0.55, 0.8 + 0.2 * worn)
    return np.where(stripe[..., None], [0.3, 0.35, 0.45], color), rough, np.zeros((SIZE, SIZE))


OBJECTS: dict[str, Callable[[], Material]] = {"wood": wood, "slate": slate, "plaster": plaster}


def _noises() -> list[np.ndarray]:
    u, v = coordinates()
    waves = (9, 5, 3, 12)
    return [noise(seed + 1, count, along(u), v) for seed, count in enumerate(waves)]


def write(folder: Path) -> None:
    """Write objects/NAME and envmaps/NAME.exr, as ``svu bench --data`` reads them."""
    vase = scenes.path("vase").parent
    for name, paint in OBJECTS.items():
        place = folder / "objects" / name
        place.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(vase / "mesh.ply", place / "mesh.ply")
        color, roughness, metallic = paint()
        _save(place / "base_color.png", color, srgb=True)
        _save(place / "roughness.png", roughness[..., None])
        _save(place / "metallic.png", metallic[..., None])
    skies = folder / "envmaps"
    skies.mkdir(parents=True, exist_ok=True)
    for light in LIGHTS:
        shutil.copyfile(vase.parent / "lights" / f"{light}.exr", skies / f"{light}.exr")


def _save(path: Path, values: np.ndarray, *, srgb: bool = False) -> None:
    bitmap = mi.Bitmap(np.ascontiguousarray(np.clip(values, 0, 1), np.float32))
    bitmap.convert(component_format=mi.Struct.Type.UInt8, srgb_gamma=srgb).write(str(path))


if __name__ == "__main__":
    mi.set_variant("scalar_rgb")
    write(Path(sys.argv[1]))
