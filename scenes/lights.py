"""Environment maps of the scenes, as lat-long images.

Linear RGB radiance, with +Y at the top and +Z in the centre. The first and last rows are the poles,
columns are texel-centred. A fourth light, ``clear``, is Mitsuba's sunsky emitter without an image.
"""

from __future__ import annotations

import numpy as np

WIDTH, HEIGHT = 192, 97


def directions() -> np.ndarray:
    """Return the unit directions of the texels, (H, W, 3)."""
    theta = np.pi * np.arange(HEIGHT)[:, None] / (HEIGHT - 1)
    phi = 2 * np.pi * (np.arange(WIDTH)[None] + 0.5) / WIDTH
    y = np.broadcast_to(np.cos(theta), (HEIGHT, WIDTH))
    return np.stack([np.sin(theta) * np.sin(phi), y, -np.sin(theta) * np.cos(phi)], axis=-1)


def box(center: tuple[float, float, float], half: tuple[float, float], soft: float) -> np.ndarray:
    """Return the mask (H, W) of a rectangle with soft edges; ``center`` is its direction.

    ``half`` (half the width and height) and ``soft`` are lengths in the plane at distance 1.
    """
    d = directions()
    z = np.array(center) / np.linalg.norm(center)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    depth = d @ z
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = np.abs(d @ x) / depth - half[0], np.abs(d @ np.cross(z, x)) / depth - half[1]
    inside = np.clip(0.5 - np.maximum(a, b) / soft, 0, 1)
    return np.where(depth > 1e-3, inside, 0)


def studio() -> np.ndarray:
    """Return two soft boxes and a strip light in a grey room."""
    up = directions()[..., 1:2]
    room = (0.16 + 0.08 * up) * np.array([1.0, 1.0, 1.0])
    key = 9.0 * box((1.0, 0.9, 0.8), (0.35, 0.35), 0.06)
    fill = 3.5 * box((-1.0, 0.3, 0.5), (0.5, 0.6), 0.06)
    strip = 7.0 * box((0.2, 0.5, -1.0), (0.08, 0.6), 0.04)
    return room + np.stack([key + 0.9 * fill + strip, key + fill + strip, key + fill + strip], -1)


def overcast() -> np.ndarray:
    """Return an overcast sky over bright ground: a gradient of SH degree 1."""
    up = directions()[..., 1:2]
    return (0.9 + 0.3 * up) * np.array([1.0, 1.02, 1.06])


def window() -> np.ndarray:
    """Return a dark room with a bright window of four panes, and a lamp."""
    up = directions()[..., 1:2]
    room = (0.05 + 0.02 * up) * np.array([1.0, 0.9, 0.8])
    frame = box((0.9, 0.45, 1.0), (0.42, 0.5), 0.03)
    bars = np.maximum(
        box((0.9, 0.45, 1.0), (0.025, 0.6), 0.02), box((0.9, 0.45, 1.0), (0.6, 0.025), 0.02)
    )
    panes = 14.0 * (frame * (1 - bars))[..., None] * np.array([0.9, 1.0, 1.15])
    lamp = 30.0 * box((-1.0, 0.8, 0.3), (0.06, 0.06), 0.03)[..., None] * np.array([1.0, 0.8, 0.5])
    return room + panes + lamp
