"""Total variation between neighbouring texels, on the surface or in the texture."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import to_drjit
from svu_mi.core.validation import require
from svu_mi.geometry.neighbors import Neighbors, lanes_of, over_neighbors
from svu_mi.geometry.texels import Texels
from svu_mi.recovery.regularizers.known_gradient import Regularizer, sign

EPSILON = 1e-2  # in units of the parameters, all in [0, 1]


@dataclass(frozen=True, eq=False)
class TotalVariation(Regularizer):
    """Mean absolute difference of neighbouring texels.

        TV(psi) = 1/P sum over pairs (i, j), sum over channels of
                  sqrt((psi_i - psi_j)^2 + epsilon^2) - epsilon

    A plain function of a texture, to be added to any loss; the paper gives it a weight of
    1e-2. Texels that no photograph shows take part, so that values spread into them.

    With a mesh, differences are taken on the surface: over the seams of the UV charts, and not
    between charts that touch in the map. Without one they are the paper's, in texture space:
    between every texel and its right and its lower neighbour in the map, wherever they are on
    the object. Texels outside the charts have no influence and no gradient in either case.

    With ``epsilon`` 0, a term is ``|psi_i - psi_j|`` as printed, its derivative the sign of the
    difference, 0 for equal values.

    Attributes:
        texels: T texels.
        mesh: the mesh they lie on; or their ``Neighbors``, if these are at hand; or None, for
            texture space, blind to seams.
        epsilon: differences far below it count as squares, those far above as they are; 0 for
            absolute values.

    Raises:
        OptionError: an epsilon that is negative, infinite or NaN.
        ShapeError: the neighbours are not those of T texels.
    """

    texels: Texels
    mesh: Any | None = None
    epsilon: float = field(default=EPSILON, kw_only=True)
    _around: dict[int, tuple[Any, ...]] = field(init=False, repr=False, compare=False)
    _scale: Any = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        require(self, 0 <= self.epsilon < np.inf, "epsilon", "at least 0")
        around, pairs = _table(self.texels, self._neighbors(self.mesh))
        columns = tuple(to_drjit(mi.UInt32, column) for column in around)
        object.__setattr__(self, "_around", {1: columns})
        object.__setattr__(self, "_scale", dr.opaque(mi.Float, 1 / max(pairs, 1)))

    def _texels(self) -> Texels:
        return self.texels

    def _of(self, values: Any, channels: int) -> tuple[Any, Any]:
        """Value and gradient; every lane, a texel's channel, only reads from its neighbours."""
        epsilon = dr.opaque(mi.Float, self.epsilon) if self.epsilon else None

        def add(other: Any, state: tuple[Any, Any]) -> tuple[Any, Any]:
            size, slope = absolute(values - dr.gather(mi.Float, values, other), epsilon)
            return state[0] + size, state[1] + slope

        # A texel without a neighbour may hold anything, NaN included.
        if channels not in self._around:  # kept, as every step needs it; but only if one does
            self._around[channels] = lanes_of(self._around[1], channels)
        around = self._around[channels]
        total, gradient = over_neighbors(around, add, (mi.Float(0), mi.Float(0)))
        gradient *= self._scale
        dr.eval(total, gradient)
        return dr.sum(total) * (0.5 * self._scale), gradient  # every pair was seen from both ends


def absolute(difference: Any, epsilon: Any | None) -> tuple[Any, Any]:
    """Return the size of differences, and its derivative."""
    if epsilon is None:
        return dr.abs(difference), sign(difference)
    smooth = dr.sqrt(dr.fma(difference, difference, dr.square(epsilon)))
    # Without cancellation: sqrt(d^2 + e^2) - e = d^2 / (sqrt(d^2 + e^2) + e).
    return dr.square(difference) / (smooth + epsilon), difference / smooth


def _table(texels: Texels, around: Neighbors) -> tuple[np.ndarray, int]:
    """Return the flat index of the neighbours of all H W texels, (K, H W), and P.

    One that has none is its own neighbour: the difference is 0.
    """
    table = around.table()
    own = np.arange(texels.count)
    width, height = texels.resolution
    index = texels.index.numpy()
    flat = np.tile(np.arange(width * height, dtype=np.uint32), (len(table), 1))
    flat[:, index] = index[table]
    return flat, int((table != own).sum()) // 2
