"""Whether a mistake shows: rendered with it, does the object look different?"""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from svu_mi.bench.captures import some_views
from svu_mi.capture import Capture
from svu_mi.capture.poses import scaled_sensor

VIEWS, SIDE, BLOCK, SPP = 6, 64, 8, 128
SEED = 2909
LEAST, CERTAIN = 0.03, 3  # of the mean radiance, and times what noise changes


def looks(capture: Capture, seed: int = SEED) -> np.ndarray:
    """Return a few coarse pictures of the object, without what is behind it."""
    integrator = mi.load_dict({"type": "direct", "hide_emitters": True})
    pictures = []
    for index, sensor in enumerate(some_views(capture, min(VIEWS, capture.count)).sensors):
        image = mi.render(
            capture.scene, sensor=scaled_sensor(sensor, SIDE), integrator=integrator, spp=SPP,
            seed=seed + index,
        )  # fmt: skip
        pixels = np.array(image)[..., :3]
        edges = [np.arange(0, length, BLOCK) for length in pixels.shape[:2]]
        pictures.append(np.add.reduceat(np.add.reduceat(pixels, edges[0], 0), edges[1], 1))
    return np.stack(pictures)


def shows(right: np.ndarray, again: np.ndarray, wrong: np.ndarray) -> bool:
    """Return whether pictures differ by more than noise.

    Args:
        right: ``looks`` of a capture.
        again: the same with another seed.
        wrong: with a mistake.
    """
    noise, change = (np.abs(one - right).mean() for one in (again, wrong))
    return bool(change > max(LEAST * right.mean(), CERTAIN * noise))
