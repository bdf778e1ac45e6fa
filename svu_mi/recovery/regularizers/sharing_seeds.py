"""Seeds of global sharing: the most certain texels of each material."""

import numpy as np

from svu_mi.geometry.neighbors import Neighbors, connected_components
from svu_mi.posterior.estimate import Estimate
from svu_mi.posterior.posterior import Posterior

RINGS = 3  # radius of the local minima of entropy, in texels
RESOLUTION = 1e-3  # step to which entropies are rounded


def find_seeds(estimate: Estimate, around: Neighbors, count: int) -> np.ndarray:
    """Return texel indices of up to ``count`` seeds of all materials, (S,) int64.

    Candidates are local minima of the smoothed entropy on the surface, at most at its median. The
    first seed is the candidate of least entropy. Each further one maximises 1 - H times the
    distance of its posterior mean from the nearest seed. The texels of least entropy alone might
    all belong to one material.
    """
    observed = np.array(estimate.coverage) > 0
    if not observed.any():
        return np.empty(0, np.int64)
    entropy = np.where(observed, np.array(estimate.entropy, np.float64), 1)
    table = around.table()
    linked = table != np.arange(around.count)
    smooth = (entropy + np.where(linked, entropy[table], 0).sum(axis=0)) / (1 + linked.sum(axis=0))
    candidates = local_minima(smooth, observed, around, RINGS, RESOLUTION)
    certain = candidates[smooth[candidates] <= np.median(smooth[observed])]
    candidates = certain if len(certain) else candidates
    candidates = candidates[np.argsort(smooth[candidates], kind="stable")]
    means = mean_parameters(estimate.posterior, candidates)
    chosen, worth = [0], 1 - smooth[candidates]
    nearest = np.linalg.norm(means - means[0], axis=1)
    while len(chosen) < count and (nearest * worth).max() > 0:
        chosen.append(int((nearest * worth).argmax()))
        nearest = np.minimum(nearest, np.linalg.norm(means - means[chosen[-1]], axis=1))
    return candidates[chosen]


def least_minima(
    entropy: np.ndarray, observed: np.ndarray, around: Neighbors, count: int
) -> np.ndarray:
    """Return the seeds of the paper: least local minima of the entropy, (S,) int64.

    A local minimum has no neighbour of lower entropy. Connected texels of equal entropy form a
    plateau, which counts as one minimum and is represented by its texel of lowest index.
    """
    candidates = local_minima(entropy, observed, around, 1, 0.0)
    return candidates[np.argsort(entropy[candidates], kind="stable")][:count]


def local_minima(
    values: np.ndarray, allowed: np.ndarray, around: Neighbors, rings: int, resolution: float
) -> np.ndarray:
    """Return one texel per local minimum among ``allowed`` texels, in ascending order.

    A minimum is the lowest value within ``rings`` texels. Values are rounded to ``resolution`` (0:
    not rounded); a plateau of equal values is one minimum.
    """
    level = np.where(allowed, np.round(values / resolution) if resolution else values, np.inf)
    table = around.table()
    lowest = level
    for _ in range(rings):
        lowest = np.minimum(lowest, lowest[table].min(axis=0))
    own = np.arange(around.count)
    links = [np.where(level[column] == level, column, own) for column in table]
    plateau = connected_components(links)
    beaten = np.zeros(plateau.max(initial=-1) + 1, bool)
    beaten[plateau[(lowest < level) | ~allowed]] = True
    inside = np.flatnonzero(~beaten[plateau])
    inside = inside[np.argsort(values[inside], kind="stable")]
    return np.sort(inside[np.unique(plateau[inside], return_index=True)[1]])


def mean_parameters(posterior: Posterior, chosen: np.ndarray) -> np.ndarray:
    """Return the posterior means of all parameters and channels, (t, D)."""
    columns = []
    for name, nodes in posterior.axes.items():
        marginal = np.array(posterior.marginal(name, chosen), np.float64)
        columns.append(np.einsum("tn...,n->t...", marginal, nodes).reshape(len(chosen), -1))
    return np.concatenate(columns, axis=1)
