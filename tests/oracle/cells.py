"""Light in even cells of the sphere, and what one texel reflects of each of them."""

from __future__ import annotations

import numpy as np

from oracle.angular import disney_diffuse, fresnel, g1, ggx, modelled


def gains(cells, n, o, roughness: float, metallic: float, color, widened: float) -> np.ndarray:
    """(N, 3) radiance that unit light in each cell adds, a colour channel each.

    A texel of roughness r, metallic m and base colour c reflects (1 - m) (c e + d) + m (c p + q).
    The lobe's width alpha = r^2 becomes that of alpha^2 + rho^2 (1 + 1 / (h.i)^2) / 2 for a cell
    of radius rho, by as much as the half vector turns. The camera's masking keeps the lobe's own.

    Args:
        cells: (N, 3) unit directions of cells of 4 pi / N each; those above the horizon are open.
        n: unit normal.
        o: unit direction to the camera.
        roughness: of the texel.
        metallic: of the texel.
        color: (3,) its base colour.
        widened: radii of a cell that widen the lobe.
    """
    solid, square = 4 * np.pi / len(cells), widened**2 * 4 / len(cells)
    up = cells @ n > 0
    i = cells[up]
    half = i + o
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    along, incident, alpha = (half * i).sum(axis=1), i @ n, max(roughness**2, 1e-3)
    wide = np.sqrt(alpha**2 + square * (1 + 1 / along**2) / 2)
    lobe = ggx(half @ n, wide) * g1(incident, wide) * g1(o @ n, alpha) / (4 * o @ n)
    schlick = (1 - along) ** 5
    e = incident * disney_diffuse(i, o, n, roughness, product=False)
    parts = [e, lobe * (1 - schlick), lobe * schlick, lobe * fresnel(along)]
    sums = np.zeros((len(cells), 3))
    for channel, c in enumerate(color):
        sums[up, channel] = solid * modelled(parts, c, metallic)
    return sums
