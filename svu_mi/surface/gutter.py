"""Gutters: carry values a little over the border of their charts.

A lookup between texels at the border of a chart mixes in a texel outside it. The gutter
gives that texel the value of the nearest one inside, so that no seam shows.
"""

from __future__ import annotations

import numpy as np
import scipy

from svu_mi.errors import OptionError, ShapeError


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
    if valid.any() and not valid.all():  # without any, every distance would be to nowhere
        distance, (row, column) = scipy.ndimage.distance_transform_edt(~valid, return_indices=True)
        target = ~valid & (distance <= texels)
        filled[target] = image[row[target], column[target]]
    return filled
