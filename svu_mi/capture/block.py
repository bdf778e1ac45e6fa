"""Photographs in one block of memory, where kernels look them up without a copy."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np


def allocate(sizes: Sequence[tuple[int, int]]) -> list[np.ndarray]:
    """Make room for photographs, one after the other in one block.

    Args:
        sizes: V (width, height).

    Returns:
        V empty (H, W, 3) float32 arrays.
    """
    shapes = [(height, width, 3) for width, height in sizes]
    ends = np.cumsum([math.prod(shape) for shape in shapes], dtype=np.int64)
    block = np.empty(ends[-1] if shapes else 0, np.float32)
    parts = np.split(block, ends[:-1])
    return [part.reshape(shape) for part, shape in zip(parts, shapes, strict=False)]


def in_one_block(images: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Find the block that photographs lie in, or copy them into one.

    Args:
        images: V (H, W, 3) float32 arrays.

    Returns:
        (3 P,) float32, all pixels, and (V,) int64, index of each photograph's first pixel.
    """
    found = _shared(images)
    if found is not None:
        return found
    made = allocate([(image.shape[1], image.shape[0]) for image in images])
    for room, image in zip(made, images, strict=True):
        room[:] = image
    return _shared(made) or (np.empty(0, np.float32), np.empty(0, np.int64))


def _shared(images: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray] | None:
    """Return what ``in_one_block`` does if the photographs lie in one array, each by itself."""
    block = images[0].base if images else None
    if block is None or not all(_is_plain(image) and image.base is block for image in images):
        return None
    if not _is_plain(block):
        return None
    sizes = np.array([image.size for image in images])
    address = block.__array_interface__["data"][0]
    starts = np.array([image.__array_interface__["data"][0] - address for image in images]) // 4
    order = np.argsort(starts)
    first, end = starts[order[0]], starts[order[-1]] + sizes[order[-1]]
    apart = (starts[order][1:] >= (starts + sizes)[order][:-1]).all()
    if not apart or ((starts - first) % 3).any():
        return None
    return block.reshape(-1)[first:end], (starts - first) // 3


def _is_plain(array: object) -> bool:
    return isinstance(array, np.ndarray) and array.dtype == np.float32 and array.flags.c_contiguous
