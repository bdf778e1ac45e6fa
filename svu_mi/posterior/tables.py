"""Marginals, samples and mean colours of bin probabilities, in NumPy."""

from collections.abc import Mapping

import numpy as np


def marginals(p: np.ndarray, names: list[str]) -> dict[str, np.ndarray]:
    """Return the marginal of each parameter, (nodes,) by name, from grid probabilities."""
    axes = range(p.ndim)
    return {name: p.sum(axis=tuple(k for k in axes if k != own)) for own, name in enumerate(names)}


def sample_index(weights: np.ndarray, random: np.ndarray) -> np.ndarray:
    """Sample indices in proportion to ``weights``, (..., t, N); ``random`` is (count, t)."""
    below = np.cumsum(weights, axis=-1)
    picked = (below <= random[..., None] * below[..., -1:]).sum(axis=-1)
    return np.minimum(picked, weights.shape[-1] - 1)


def row_colors(p: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return mean colours, (t, rows, C); the best bin's colour if the mean's bin is empty."""
    middle = (edges[1:] + edges[:-1]) / 2
    # einsum() is much faster than sum() for axes other than the last.
    mean = np.einsum("trkc,k->trc", p, middle) / np.maximum(np.einsum("trkc->trc", p), 1e-30)
    bin_index = np.clip(np.searchsorted(edges, mean, "right") - 1, 0, len(middle) - 1)
    at = texel, row, channel = np.nonzero(
        np.take_along_axis(p, bin_index[:, :, None], 2)[:, :, 0] <= 0
    )
    mean[at] = middle[p[texel, row, :, channel].argmax(axis=1)]
    return np.asarray(mean)


def draw_bins(
    p: np.ndarray, axes: Mapping[str, np.ndarray], random: np.ndarray
) -> dict[str, np.ndarray]:
    """Sample nodes: (count, t, 1) float32 by name, (count, t, G) for the last parameter.

    Channels are independent given the other parameters. ``random`` is (1 + G, count, t) in [0, 1).
    """
    *shape, bins, groups = p.shape[1:]
    table = p.reshape(len(p), -1, bins, groups).astype(np.float64)
    rows = sample_index(table[..., 0].sum(axis=2), random[0])
    *shared, (name, nodes) = axes.items()
    index = np.unravel_index(rows, shape)
    drawn = {
        name: nodes[k][..., None].astype(np.float32)
        for (name, nodes), k in zip(shared, index, strict=True)
    }
    given = table[np.arange(len(p)), rows]  # (count, t, bins, G)
    picked = [sample_index(given[..., g], random[1 + g]) for g in range(groups)]
    return drawn | {name: nodes[np.stack(picked, axis=-1)].astype(np.float32)}
