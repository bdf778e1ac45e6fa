"""Prior of base colour given metallic: metals are bright.

For metallic m, the density of each channel c of base colour is

    p(c | m) = 1 - m + m (w Beta(c; a, b) + (1 - w) U(c; d, 1)),

with weight w (``AngularPreset.bare_metals``). Beta has the mean and the variance of the reflectance
of ten bare metals; the uniform density covers oxides, dirt and alloys, from d.
"""

import numpy as np
from scipy.special import betainc

from svu_mi.parameters import MIXED
from svu_mi.posterior.grid import PrincipledGrid

# Reflectance at normal incidence, linear sRGB [Lagarde 2011, Feeding a physically based shading
# model]: silver, aluminium, gold, copper, chromium, iron, nickel, titanium, cobalt, platinum.
BARE = np.array([
    [0.972, 0.960, 0.915], [0.913, 0.921, 0.925], [1.000, 0.766, 0.336], [0.955, 0.637, 0.538],
    [0.550, 0.556, 0.554], [0.560, 0.570, 0.580], [0.660, 0.609, 0.526], [0.542, 0.497, 0.449],
    [0.662, 0.655, 0.634], [0.672, 0.637, 0.585],
])  # fmt: skip
DARKEST = 0.06  # d: graphite and dark oxides reflect about 0.1
LEAST = 0.01  # minimum density


def metal_cdf(c: np.ndarray, bare: float) -> np.ndarray:
    """Return the probability that a channel of a metal's base colour is at most c."""
    mean, variance = BARE.mean(), BARE.var()
    total = mean * (1 - mean) / variance - 1
    of_bare = betainc(total * mean, total * (1 - mean), c)
    return np.asarray(bare * of_bare + (1 - bare) * np.clip((c - DARKEST) / (1 - DARKEST), 0, 1))


def color_density(edges: np.ndarray, metallic: np.ndarray, bare: float) -> np.ndarray:
    """Return the mean density of base colour in K bins, given (M,) metallic: (M, K) float64."""
    metal = np.maximum(np.diff(metal_cdf(edges, bare)) / np.diff(edges), LEAST)
    metal /= metal @ np.diff(edges)
    return 1 + metallic[:, None] * (metal - 1)


def color_densities(grid: PrincipledGrid, edges: np.ndarray, bare: float) -> np.ndarray | None:
    """Return ``color_density`` for each bin of the mixing parameters; None if it is uniform."""
    metallic = np.meshgrid(*grid.mixed_nodes, indexing="ij")[MIXED.index("metallic")].ravel()
    uniform = edges[0] == edges[-1] or bare * metallic.max() == 0
    return None if uniform else color_density(edges, metallic, bare)
