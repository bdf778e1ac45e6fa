"""Error of a texel's mean that its neighbours in the map show.

Where few photographs show a texel, its posterior can be narrow around a wrong explanation. Means of
its neighbours then differ. The distance d of a mean from the median of up to eight neighbours has
the variance of both; if theirs is s^2, then d^2 - s^2 estimates the squared error of the mean:

    s^2 <- max(s^2, d^2 - s^2).

Edges and slopes of a texture change the median little. Errors that neighbours share, as texels of
one pixel do, and neighbours across seams are not seen.
"""

import numpy as np


def distance_from_neighbors(
    values: np.ndarray, index: np.ndarray, resolution: tuple[int, int]
) -> np.ndarray:
    """Return the distances of values from the median of their neighbours, (S, g) float32.

    Args:
        values: (S, g) values of texels; NaN for texels without one.
        index: (S,) row-major places of the texels in the map.
        resolution: size (W, H) of the map.
    """
    width, height = resolution
    place = (index // width + 1) * (width + 2) + index % width + 1  # in a map with a border
    steps = [y * (width + 2) + x for y in (-1, 0, 1) for x in (-1, 0, 1) if x or y]
    around = place + np.array(steps)[:, None]
    image = np.full((width + 2) * (height + 2), np.nan, np.float32)
    distances = np.zeros(values.shape, np.float32)
    for own, result in zip(values.T, distances.T, strict=True):
        image[place] = own
        ordered = np.sort(image[around], axis=0)  # NaN last
        count = np.isfinite(ordered).sum(axis=0)
        middle = [np.take_along_axis(ordered, k[None] // 2, axis=0)[0] for k in (count - 1, count)]
        result[:] = np.nan_to_num(np.abs(own - (middle[0] + middle[1]) / 2))
    return distances
