"""Error bars tested on the capture itself: posteriors without the photographs of one side.

If model and noise are right, omitting photographs changes a texel's mean by as much as its
variance grows (law of total variance),

    E (m_k - m)^2 = s_k^2 - s^2,

with mean m and standard deviation s from all photographs, m_k and s_k without fold k. Folds are
clusters of camera directions, because errors of neighbouring views are alike: interreflection,
other shapes, or poses that are off, which the model lacks, differ between sides. For each
parameter, r^2 is the ratio of both sides' sums over a sample of texels and all folds, and

    s <- s max(1, r).

Differences above 3 s_k count as 3 s_k: they are of a few texels that change from one explanation to
another, which their neighbours show (``neighbor_error``). Means stay. ``blur_error`` of low
roughness accounts for errors that all sides share (notebooks/design/calibration.md). If held-out
photographs are predicted badly, s is increased by a further factor of 1.5, because the error that
shows there is seldom the only one.
"""

from collections.abc import Mapping, Sequence

import numpy as np

ENOUGH = 12  # number of views from which s is increased as stated; fewer than 4 do not increase it
SAMPLE = 800  # number of texels
MIN_VIEWS = 6  # minimum number of views of a texel
UNRELIABLE = 1.5  # factor of standard deviations if held-out photographs are predicted badly
BLUR, SHARPEST = 1e-4, 0.1  # radians^2; roughness below which the error of blur is constant
ROUNDS = 20  # rounds of k-means
MOST = 3.0  # largest difference of means that counts, relative to s_k
TINY = 1e-9


def cluster_directions(directions: np.ndarray, seeds: Sequence[int]) -> np.ndarray:
    """Return the cluster of each of V unit vectors, (V,) int64; there is one for each seed.

    k-means on the sphere [Dhillon and Modha 2001], from the vectors numbered ``seeds``. Clusters
    can be empty if vectors are equal.

    Example:
        >>> from svu_mi.posterior.folds import cluster_directions
        >>> cluster_directions(np.array([[0, 0, 1.0], [1, 0, 0], [0, 0, 1]]), [0, 1]).tolist()
        [0, 1, 0]
    """
    centers = directions[seeds]
    for _ in range(ROUNDS):
        labels = np.argmax(directions @ centers.T, axis=1)
        sums = np.zeros_like(centers)
        np.add.at(sums, labels, directions)
        length = np.linalg.norm(sums, axis=1, keepdims=True)
        centers = np.where(length > TINY, sums / np.maximum(length, TINY), centers)
    return labels


def farthest_seeds(directions: np.ndarray, count: int) -> list[int]:
    """Return the number of the first of V unit vectors, and of those farthest from all before."""
    seeds = [0]
    while len(seeds) < count:
        seeds.append(int(np.argmin((directions @ directions[seeds].T).max(axis=1))))
    return seeds


def folds_of(cameras: np.ndarray, center: np.ndarray, most: int) -> list[np.ndarray]:
    """Return the views of at most ``most`` folds of (V, 3) camera positions around ``center``."""
    away = cameras - center
    length = np.linalg.norm(away, axis=1, keepdims=True)
    count = min(most, len(cameras) // 2)
    if count < 2:
        return []
    order = np.lexsort(away.T)  # folds do not depend on the order of photographs
    labels = np.empty(len(away), np.int64)
    directions = (away / np.maximum(length, TINY))[order]
    labels[order] = cluster_directions(directions, farthest_seeds(directions, count))
    folds = [np.flatnonzero(labels == k) for k in range(count)]
    return [fold for fold in folds if 0 < len(fold) < len(cameras)]


def compared(counts: np.ndarray) -> np.ndarray:
    """Return which texels are compared with and without each fold, (F, t) bool.

    ``counts`` are (1 + F, t) numbers of photographs of each texel: of all, and without each fold.
    """
    return (counts[0] >= MIN_VIEWS) & (counts[1:] > 0) & (counts[1:] < counts[0])


def blur_error(roughness: np.ndarray) -> np.ndarray:
    """Return the error of roughness by blur of pixels, texels and cells of light.

    A lobe of width alpha = r^2 that is blurred by an angle b looks like one of roughness r', with
    r'^4 = r^4 + b^2; the difference is b^2 / (4 r^3).

    Example:
        >>> from svu_mi.posterior.folds import blur_error
        >>> float(blur_error(np.array(0.2)).round(4))
        0.0063
    """
    return BLUR / (4 * np.maximum(roughness, SHARPEST) ** 3)


def spread_factors(
    views: int, there: np.ndarray, moments: Mapping[str, Sequence[np.ndarray]]
) -> dict[str, float]:
    """Return the factor of the standard deviation of each parameter, at least 1.

    Args:
        views: number of photographs.
        there: (F, t) bool, pairs of fold and texel to compare (``compared``).
        moments: mean and standard deviation by parameter, (1 + F, t, g) each: from all photographs,
            and without each fold.
    """
    trust = np.clip((views - 3) / (ENOUGH - 3), 0, 1)
    factors = {}
    for name, of_folds in moments.items():
        mean, sd = (x.astype(np.float64) for x in of_folds)
        moved = np.minimum(np.abs(mean[1:] - mean[0]), MOST * sd[1:])[there]
        grown = (np.square(sd[1:]) - np.square(sd[0]))[there].sum()
        ratio = np.square(moved).sum() / grown if grown > TINY else 0.0
        factors[name] = float(np.sqrt(1 + trust * max(ratio - 1, 0.0)))
    return factors
