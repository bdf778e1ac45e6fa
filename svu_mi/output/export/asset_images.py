"""Textures and maps of an asset as EXR and PNG."""

from pathlib import Path

import mitsuba as mi
import numpy as np

import svu_mi
from svu_mi.capture.image_io import quantized, srgb
from svu_mi.core.io.exr import write_exr
from svu_mi.core.io.files import replacing
from svu_mi.errors import OutputError
from svu_mi.output.export.asset import TEXTURES, Asset, AssetFile
from svu_mi.output.texture_files import FILES, write_textures
from svu_mi.parameters import CHANNELS

LINEAR = "linear"
VALUES = {"entropy": "in [0, 1], 1 = no information", "coverage": "number of views"}
SD_OF = "standard deviation"
NORMALS = "linear: normal map, as in glTF and OpenGL (+Y)"
SRGB = "sRGB (IEC 61966-2-1)"
PACKED = "linear: R occlusion (unknown, 1), G roughness, B metallic, as in glTF"


def write_exr_images(asset: Asset, folder: Path, *, half: bool) -> list[AssetFile]:
    """Write textures and maps as linear EXR; entropy, coverage and deviations have channel Y."""
    write_textures(asset.textures, folder / TEXTURES, half=half)
    written = [
        AssetFile(file=f"{TEXTURES}/{file}", format="exr", holds=name, values=LINEAR)
        for name, file in FILES.items()
    ]
    for name, image in asset.maps.items():
        file = f"{TEXTURES}/{name}.exr"
        write_exr(folder / file, {"Y": image}, {"svu:version": svu_mi.__version__}, half=half)
        written.append(
            AssetFile(file=file, format="exr", holds=name, values=VALUES.get(name, SD_OF))
        )
    return written


def write_png_images(asset: Asset, folder: Path, *, bits: int) -> list[AssetFile]:
    """Write textures, the packed texture ``orm`` and maps as PNG."""
    images: dict[str, tuple[np.ndarray, str]] = {}
    for name, tensor in asset.textures.items():
        pixels = np.array(tensor)
        images[name] = (pixels, LINEAR) if CHANNELS[name] == 1 else (srgb(pixels), SRGB)
    images["orm"] = (orm_image(asset), PACKED)
    if asset.normals is not None:
        images["normal"] = (asset.normals, NORMALS)
    for name, image in asset.maps.items():
        if name == "coverage":
            maximum = max(float(image.max()), 1.0)
            images[name] = (image / maximum, f"linear: white is {maximum:g} views")
        else:
            images[name] = (image, f"linear {VALUES.get(name, f'in [0, 1]: {SD_OF}')}")
    written = []
    for name, (image, values) in images.items():
        file = f"{TEXTURES}/{name}.png"
        write_png(folder / file, quantized(image, bits), color=values == SRGB)
        written.append(AssetFile(file=file, format="png", holds=name, values=values))
    return written


def orm_image(asset: Asset) -> np.ndarray:
    """Return occlusion, roughness and metallic (H, W, 3) as in glTF 2.0 (Sec. 3.9.2).

    Occlusion is unknown and set to 1.
    """
    rough, metal = np.array(asset.textures.roughness), np.array(asset.textures.metallic)
    return np.concatenate([np.ones_like(rough), rough, metal], axis=-1)


def write_png(path: Path, pixels: np.ndarray, *, color: bool) -> None:
    """Write (H, W) or (H, W, C) uint8 or uint16 as PNG.

    If ``color``, the file declares sRGB. Other data declare no gamma, so that viewers apply none.
    """
    shown = np.ascontiguousarray(pixels[..., 0] if pixels.shape[2:] == (1,) else pixels)
    with replacing(path) as temporary:
        bitmap = mi.Bitmap(shown)
        # Without this call, Mitsuba would declare a gamma of 1.
        bitmap.set_srgb_gamma(color)
        try:
            bitmap.write(str(temporary))
        except RuntimeError as error:
            raise OutputError(f"{path}: cannot be written ({error}).") from error
