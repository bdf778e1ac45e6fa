"""Captures without files."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from svu_mi.capture import Capture


def in_memory(scene: Any, shape: Any, sensors: Sequence[Any], images: Any) -> Capture:
    """Return a capture without masks, whose every pixel is used.

    Args:
        scene: with the light.
        shape: its target, which has UVs.
        sensors: V of them.
        images: V photographs (H, W, 3).
    """
    count = len(sensors)
    return Capture(
        scene=scene, shape=shape, mesh=shape, sensors=tuple(sensors),
        images=tuple(np.ascontiguousarray(image, np.float32) for image in images),
        masks=(None,) * count, exposures=(1.0,) * count,
        names=tuple(f"view_{view:04d}.exr" for view in range(count)),
        unusable=(0,) * count, used=(True,) * count,
    )  # fmt: skip
