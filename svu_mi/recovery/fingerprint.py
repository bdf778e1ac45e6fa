"""What a recovery starts from, as a few numbers: a checkpoint knows its run by them."""

from __future__ import annotations

import zlib
from typing import Any

import numpy as np

from svu_mi.capture import Capture
from svu_mi.recovery.textures import Textures


def fingerprint(capture: Capture, start: Textures | None) -> dict[str, Any]:
    """Return checksums of the photographs and of the textures to start from.

    Args:
        capture: whose photographs are meant; the light and the shape are taken to be theirs.
        start: the caller's textures, None where the method finds its own.

    Returns:
        ``photographs`` and ``start``, CRC-32 each; ``start`` is None without textures.
    """
    photographs = 0
    for image, used in zip(capture.images, capture.used, strict=True):
        if used:
            photographs = zlib.crc32(image.tobytes(), photographs)
    textures = None
    if start is not None:
        textures = 0
        for _, tensor in start.items():
            textures = zlib.crc32(np.array(tensor).tobytes(), textures)
    return {"photographs": photographs, "start": textures}
