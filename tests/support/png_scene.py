"""A ball whose textures are PNG files, as most scenes of other programs have them."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np

from support.helpers import sensor_xml, write_ball
from svu_mi import scenes

XML = """<scene version="3.0.0"><integrator type="{integrator}"/>
<emitter type="envmap"><string name="filename" value="{light}"/></emitter>
<shape type="ply" id="ball"><string name="filename" value="ball.ply"/>
<bsdf type="principled" id="paint">{textures}</bsdf></shape>{sensors}</scene>"""
TEXTURE = """<texture type="bitmap" name="{name}"><string name="filename" value="{name}.png"/>
<boolean name="raw" value="{raw}"/><string name="filter_type" value="nearest"/></texture>"""


def srgb_to_linear(codes: np.ndarray) -> np.ndarray:
    """Decode 8-bit sRGB (IEC 61966-2-1), float64."""
    encoded = codes / 255
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def write_png(path: Path, codes: np.ndarray) -> None:
    """Write (H, W, C) codes of 8 or 16 bits as they are."""
    bitmap = mi.Bitmap(np.ascontiguousarray(codes))
    bitmap.set_srgb_gamma(True)  # as in any PNG file; ``raw`` decides how it is read
    bitmap.write(str(path))


def write_png_scene(
    folder: Path, textures: dict[str, np.ndarray], views: int = 1, size: int = 24,
    integrator: str = "direct",
) -> Path:  # fmt: skip
    """Write a scene with a PNG of codes for each texture; base colour is sRGB, others are raw."""
    folder.mkdir(exist_ok=True)
    write_ball(folder)
    for name, codes in textures.items():
        write_png(folder / f"{name}.png", codes)
    raw = {name: str(name != "base_color").lower() for name in textures}
    path = folder / "scene.xml"
    path.write_text(XML.format(
        integrator=integrator, light=scenes.FOLDER / "lights" / "window.exr",
        sensors=sensor_xml(views, size, size),
        textures="".join(TEXTURE.format(name=name, raw=raw[name]) for name in textures),
    ))  # fmt: skip
    return path
