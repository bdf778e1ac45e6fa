"""Squared deviation of every psi from what was observed, averaged over a texel's views.

With two independent renders A and B of one psi the reference takes their mean as r, and each of
them to state its own noise. The square (b - r)^2 has the variance of r on top of its exact value;
(b - A)(b - B) has not, but noise of mean zero takes it below zero, and whichever psi that pushes
down most is a false minimum. Products give a worse entropy at every number of samples from 8 to
128: at 32, its RMSE against 1024 samples is .065, and .042 from the squares.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from svu_mi.posterior import PrincipledGrid

Render = Callable[[float, float, float], tuple[np.ndarray, np.ndarray]]
"""(roughness, metallic, base colour) to the radiances (P,) of halves A and B, float64."""

KINDS = 3  # mean of both halves, A, B
CORNERS = ((0.0, 0.0), (0.0, 1.0), (1.0, 0.0), (1.0, 1.0))  # (metallic, base colour)


@dataclass(frozen=True)
class PerTexel:
    """Means over the P pairs of each of n texels; a texel without pairs has 0.

    Attributes:
        texel: (P,) int64, place of each pair's texel.
        count: n.
        weight: (P,) float64 that values are multiplied by, the mean still being over all
            pairs; or None.
    """

    texel: np.ndarray
    count: int
    weight: np.ndarray | None = None

    @property
    def pairs(self) -> np.ndarray:
        """(n,) int64, number of pairs."""
        return np.bincount(self.texel, minlength=self.count)

    def mean(self, values: np.ndarray) -> np.ndarray:
        """Average (P,) values to (n,) float64."""
        weighted = values if self.weight is None else self.weight * values
        total = np.bincount(self.texel, weights=weighted, minlength=self.count)
        return total / np.maximum(self.pairs, 1)


def brute(observed: np.ndarray, mean: PerTexel, grid: PrincipledGrid, render: Render) -> np.ndarray:
    """Render every psi.

    Args:
        observed: (P,) float64, grey radiance b.
        mean: the texels of the pairs.
        grid: R x M x C nodes of psi.
        render: traces both halves of one psi.

    Returns:
        (3, n, R, M, C) float64: means of (b - (A + B) / 2)^2, (b - A)^2 and (b - B)^2.
    """
    result = np.empty((KINDS, mean.count, *grid.shape))
    for cell in np.ndindex(*grid.shape):
        psi = (float(nodes[k]) for nodes, k in zip(grid.axes.values(), cell, strict=True))
        a, b = (observed - half for half in render(*psi))
        both = (a + b) / 2
        result[(slice(None), slice(None), *cell)] = [mean.mean(x * x) for x in (both, a, b)]
    return result


def linear(
    observed: np.ndarray, mean: PerTexel, grid: PrincipledGrid, render: Render
) -> np.ndarray:
    """Render four psi per roughness, and derive all others; exact for direct light alone.

    At fixed roughness, principled radiance is linear in (1-m) c, (1-m), m and m c: it is
    bilinear in metallic m and base colour c, hence r = sum_k w_k(m, c) r_k over the four
    corners. With q = (1, -w) and y = (b, r_1..r_4), (b - r)^2 = q' (y y') q: the mean over views
    of the 5 x 5 moments y y' is all that the cells need.

    Args and result are those of ``brute``.
    """
    _, metallic, base_color = np.meshgrid(
        [0.0], grid.metallic_nodes, grid.base_color_nodes, indexing="ij"
    )
    m, c = metallic.ravel(), base_color.ravel()
    q = np.stack([np.ones_like(m), -(1 - m) * (1 - c), -(1 - m) * c, -m * (1 - c), -m * c], axis=-1)
    forms = np.einsum("gi,gj->gij", q, q)
    result = np.empty((KINDS, mean.count, *grid.shape))
    for row, roughness in enumerate(grid.roughness_nodes):
        corners = [render(float(roughness), *corner) for corner in CORNERS]
        a, b = ([observed, *(corner[half] for corner in corners)] for half in range(2))
        both = [(x + y) / 2 for x, y in zip(a, b, strict=True)]
        for kind, values in enumerate((both, a, b)):
            cells = np.einsum("nij,gij->ng", _moments(mean, values), forms, optimize=True)
            result[kind, :, row] = cells.reshape(mean.count, *grid.shape[1:])
    return result


def _moments(mean: PerTexel, values: list[np.ndarray]) -> np.ndarray:
    """Return (n, k, k) moments of k values per pair."""
    size = len(values)
    result = np.empty((mean.count, size, size))
    for i in range(size):
        for j in range(i + 1):
            result[:, i, j] = result[:, j, i] = mean.mean(values[i] * values[j])
    return result
