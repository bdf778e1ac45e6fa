"""Texels that are so near to each other that they share rays to distant light."""

from __future__ import annotations

import numpy as np

from svu_mi.geometry.texels import Texels

TURN = 0.03  # largest angle between normals [rad], half the radius of a fine light cell
STEP = 0.004  # largest distance, relative to the mesh's extent


def shared_texels(texels: Texels) -> np.ndarray:
    """Return the texel whose rays each texel shares, (T,) int64: the first of a block of 2 x 2.

    Texels keep their own rays if their shading or face normal is turned by more than ``TURN`` from
    the first, or if they are farther than ``STEP`` from it. Seen from the first, an occluder at
    distance D moves by STEP / D, which is less than a fine cell if D > 0.07 of the extent.
    """
    width, index = texels.resolution[0], texels.index.numpy().astype(np.int64)
    block = index // width // 2 * width + index % width // 2
    starts = np.flatnonzero(np.diff(block, prepend=-1))
    first = np.repeat(starts, np.diff(starts, append=len(block)))
    turned = np.concatenate([texels.normal.numpy(), texels.geometric_normal.numpy()]) / TURN
    moved = texels.position.numpy() / (STEP * texels.extent)
    far = sum(np.square(x - x[first]) for x in (*turned, *moved)) > 1
    return np.where(far, np.arange(len(block)), first)
