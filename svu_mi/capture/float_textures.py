"""Storage of 8-bit textures: Mitsuba keeps bytes, through which no gradient passes."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from svu_mi.capture.image_formats.png_images import SIGNATURE
from svu_mi.capture.tone_curve import quantized, srgb

BYTES = (".jpg", ".jpeg", ".bmp", ".tga")  # formats of 8 bits per channel
DEPTH = 24  # position of the bit depth in a PNG file
TOLERANCE = 1e-6  # of a byte / 255 in float32
SAMPLE = 4096  # values that decide for most textures


def store_as_float(state: Any) -> None:
    """Make a parsed scene store 8-bit bitmaps of principled materials as float32.

    The values are the same within 4e-7. A ``format`` in the scene is respected.
    """
    for node in state.nodes:
        if node.props.plugin_name() != "principled":
            continue
        for name in node.props.keys():  # noqa: SIM118 - not a dictionary
            if node.props.type(name) == mi.Properties.Type.ResolvedReference:
                texture = state.nodes[node.props[name].index()].props
                if _is_bytes(texture):
                    texture["format"] = "variant"


def as_stored(texture: np.ndarray) -> np.ndarray:
    """Return 8-bit codes for a float32 texture of decoded bytes (raw or sRGB), else ``texture``."""
    if texture.dtype == np.float32:
        sample = texture.ravel()[:: 1 + texture.size // SAMPLE]
        for encode in (np.asarray, srgb):
            if _holds_bytes(sample, encode) and _holds_bytes(texture, encode):
                return quantized(encode(texture))
    return texture


def _holds_bytes(values: np.ndarray, encode: Callable[[np.ndarray], np.ndarray]) -> bool:
    """Return whether ``encode`` maps all values to multiples of 1 / 255."""
    if not 0 <= values.min() <= values.max() <= 1:
        return False
    encoded = encode(values)
    return bool(np.abs(quantized(encoded) / np.float32(255) - encoded).max() < TOLERANCE)


def _is_bytes(texture: Any) -> bool:
    """Return whether Mitsuba will read a texture as bytes."""
    if texture.plugin_name() != "bitmap" or "format" in texture:
        return False
    path = Path(str(mi.file_resolver().resolve(str(texture.get("filename", "")))))
    if path.suffix.lower() in BYTES:
        return True
    if path.suffix.lower() != ".png" or not path.is_file():
        return False
    with path.open("rb") as file:
        start = file.read(DEPTH + 1)
    return start.startswith(SIGNATURE) and start[DEPTH:] <= b"\x08"
