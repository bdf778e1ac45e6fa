"""Gutters: carry values a little over the border of their charts.

A lookup between texels at the border of a chart mixes in a texel outside it. The gutter
gives that texel the value of the nearest one inside, so that no seam shows.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import scipy

from svu_mi.errors import OptionError, ShapeError

NARROW = 8  # texels: wider gutters may be most of the image, and are asked for once


def dilate(image: np.ndarray, valid: np.ndarray, texels: float) -> np.ndarray:
    """Fill invalid texels near valid ones with the nearest valid value.

    Args:
        image: (H, W) or (H, W, C), any type.
        valid: (H, W) bool, True where the image's value counts.
        texels: width of the gutter: the largest Euclidean distance between centres.

    Returns:
        A copy of the image; valid texels and those further away are as they were. Of several
        valid texels at the same distance, any one gives its value.

    Raises:
        ShapeError: ``valid`` is not the image's (H, W).
        OptionError: ``texels`` is negative.
    """
    image, valid = np.asarray(image), np.asarray(valid, bool)
    if image.ndim not in (2, 3) or valid.shape != image.shape[:2]:
        raise ShapeError(
            f"dilate(): expected an (H, W) or (H, W, C) image and an (H, W) mask, "
            f"got {image.shape} and {valid.shape}."
        )
    if texels < 0:
        raise OptionError(f"dilate(): the width must not be negative, got {texels}.")
    filled = image.copy()
    if texels <= NARROW:
        place, source = _of_mask(np.packbits(valid).tobytes(), valid.shape, texels)
    else:
        place, source = _gutter(valid, texels)
    flat = filled.reshape(valid.size, *image.shape[2:])  # a view: the copy is contiguous
    flat[place] = flat[source]
    return filled


@lru_cache(maxsize=2)  # of maps that are written, and of pictures
def _of_mask(
    packed: bytes, shape: tuple[int, int], texels: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return ``_gutter``, found once for all maps of a layout, which is known by its content."""
    bits = np.unpackbits(np.frombuffer(packed, np.uint8), count=shape[0] * shape[1])
    return _gutter(bits.view(bool).reshape(shape), texels)


def _gutter(valid: np.ndarray, texels: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the places (G,) of a gutter in the flat image, and where each takes its value from."""
    if not valid.any() or valid.all():  # without any, every distance would be to nowhere
        return np.empty(0, np.intp), np.empty(0, np.intp)
    distance, (row, column) = scipy.ndimage.distance_transform_edt(~valid, return_indices=True)
    place = np.flatnonzero(~valid & (distance <= texels))
    return place, (row.astype(np.intp) * valid.shape[1] + column).ravel()[place]
