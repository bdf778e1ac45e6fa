"""Pictures of base colour, without any light."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mitsuba as mi
import numpy as np

SAMPLES = 16


def albedo_pictures(scene: Any, sensors: Sequence[Any]) -> list[np.ndarray]:
    """Render the base colour of a scene's objects: one (H, W, 3) per sensor, linear.

    Args:
        scene: of ``principled`` objects.
        sensors: where from.
    """
    integrator = mi.load_dict({"type": "aov", "aovs": "base_color:albedo"})
    return [
        np.array(mi.render(scene, sensor=sensor, integrator=integrator, spp=SAMPLES), np.float32)
        for sensor in sensors
    ]
