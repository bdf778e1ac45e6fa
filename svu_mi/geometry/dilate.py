"""Dilation of textures beyond UV charts."""

from functools import lru_cache

import numpy as np
import scipy

from svu_mi.errors import OptionError, ShapeError

NARROW = 8  # texels; wider gutters are not cached, because they may fill most of the image


def dilate(image: np.ndarray, valid: np.ndarray, texels: float) -> np.ndarray:
    """Copy an image; invalid texels within ``texels`` of valid ones get the nearest value."""
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
    flat = filled.reshape(valid.size, *image.shape[2:])  # a view, because the copy is contiguous
    flat[place] = flat[source]
    return filled


@lru_cache(maxsize=2)  # one layout for maps, one for images
def _of_mask(packed: bytes, shape: tuple[int, int], texels: float) -> tuple[np.ndarray, np.ndarray]:
    """Return ``_gutter`` of a mask, given as packed bits; cached."""
    bits = np.unpackbits(np.frombuffer(packed, np.uint8), count=shape[0] * shape[1])
    return _gutter(bits.view(bool).reshape(shape), texels)


def _gutter(valid: np.ndarray, texels: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices (G,) of texels to fill, and of the nearest valid texels (G,)."""
    if not valid.any() or valid.all():  # distances are undefined without a valid texel
        return np.empty(0, np.intp), np.empty(0, np.intp)
    distance, (row, column) = scipy.ndimage.distance_transform_edt(~valid, return_indices=True)
    place = np.flatnonzero(~valid & (distance <= texels))
    return place, (row.astype(np.intp) * valid.shape[1] + column).ravel()[place]
