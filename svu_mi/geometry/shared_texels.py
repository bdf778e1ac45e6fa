"""Texels that are so near to each other that they share rays to distant light."""

import numpy as np

from svu_mi.geometry.texels import Texels

TURN = 0.03  # largest angle between normals [rad], half the radius of a fine light cell
STEP = 0.004  # largest distance, relative to the mesh's extent


def shared_texels(texels: Texels, chosen: np.ndarray) -> np.ndarray:
    """Return the texel whose rays each of t ``chosen`` texels shares, (t,) int64.

    It is the first of a block of 2 x 2, except for texels with a shading or face normal that is
    turned by more than ``TURN`` from the first, or farther than ``STEP`` from it. These share the
    rays of the first of them, with the same exceptions, which keep their own. Seen from another
    texel, an occluder at distance D moves by STEP / D, less than a fine cell if D > 0.07 of the
    extent.
    """
    width, index = texels.resolution[0], texels.index.numpy().astype(np.int64)
    block = index // width // 2 * width + index % width // 2
    near = np.flatnonzero(np.isin(block, block[chosen]))  # whole blocks: chosen or not
    block, lane = block[near], np.searchsorted(near, chosen)
    # By component: to read a vector at once, Dr.Jit compiles a kernel for each number of texels.
    turned = [x.numpy()[near] / TURN for x in (*texels.normal, *texels.geometric_normal)]
    moved = [x.numpy()[near] / (STEP * texels.extent) for x in texels.position]
    owner = left = np.arange(len(block))
    for _ in range(2):
        starts = np.flatnonzero(np.diff(block[left], prepend=-1))
        first = left[np.repeat(starts, np.diff(starts, append=len(left)))]
        far = sum(np.square(x[left] - x[first]) for x in (*turned, *moved)) > 1
        owner = owner.copy()
        owner[left] = np.where(far, left, first)
        left = left[far]
    return near[owner[lane]]
