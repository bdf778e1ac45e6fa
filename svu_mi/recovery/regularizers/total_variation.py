"""Total variation between neighbouring texels, on the surface or in the texture."""

from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import to_drjit
from svu_mi.core.validation import require, require_types
from svu_mi.geometry.neighbors import Neighbors, lanes_of, over_neighbors
from svu_mi.geometry.texels import Texels
from svu_mi.recovery.regularizers.known_gradient import Regularizer, sign

EPSILON = 1e-2  # in parameter units, [0, 1]


@dataclass(frozen=True, eq=False)
class TotalVariation(Regularizer):
    """Mean absolute difference of neighbouring texels.

        TV(psi) = 1/P sum over pairs (i, j), sum over channels of
                  sqrt((psi_i - psi_j)^2 + epsilon^2) - epsilon

    Call an instance with a texture, and add the result to any loss (weight 1e-2 in the paper).
    Unseen texels are included, so that values of neighbours spread into them.

    With a mesh, neighbours are adjacent on the surface: across seams of UV charts, but not between
    charts that only touch in the map. Without a mesh, as in the paper, they are the texels to the
    right and below in the map. Pixels outside the charts have no influence and no gradient.

    Attributes:
        texels: T texels.
        mesh: Mesh of the texels, or their ``Neighbors``; None for neighbours in the map.
        epsilon: Difference, >= 0, below which terms are quadratic; above, they are linear. With
            0, as in the paper, a term is ``|psi_i - psi_j|``, with derivative 0 for equal values.
        edge: Difference, >= 0, above which terms are logarithmic, e log(1 + term / e) [Candes et
            al. 2008], so that small regions keep their contrast. 0, as in the paper: linear.

    Raises:
        OptionError: ``epsilon`` or ``edge`` is negative, infinite or NaN.
        ShapeError: The neighbours belong to another number of texels.

    Example:
        >>> total_variation = svu.TotalVariation(texels, capture.mesh)
        >>> total_variation(mi.TensorXf(np.full((64, 64), 0.5)))
        [0]
    """

    texels: Texels
    mesh: Any | None = field(default=None, repr=False)
    epsilon: float = field(default=EPSILON, kw_only=True)
    edge: float = field(default=0.0, kw_only=True)
    _around: dict[int, tuple[Any, ...]] = field(init=False, repr=False, compare=False)
    _scale: Any = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        require_types(self)
        for name in ("epsilon", "edge"):
            require(self, 0 <= getattr(self, name) < np.inf, name, "at least 0")
        around, pairs = _table(self.texels, self._neighbors(self.mesh))
        columns = tuple(to_drjit(mi.UInt32, column) for column in around)
        object.__setattr__(self, "_around", {1: columns})
        object.__setattr__(self, "_scale", dr.opaque(mi.Float, 1 / max(pairs, 1)))

    def _of(self, values: Any, channels: int) -> tuple[Any, Any]:
        """Return value and gradient; each lane is a channel of a texel."""
        epsilon, edge = (
            dr.opaque(mi.Float, width) if width else None for width in (self.epsilon, self.edge)
        )

        def add(other: Any, state: tuple[Any, Any]) -> tuple[Any, Any]:
            size, slope = absolute(values - dr.gather(mi.Float, values, other), epsilon)
            if edge is not None:
                excess = 1 + size / edge
                size, slope = edge * dr.log(excess), slope / excess
            return state[0] + size, state[1] + slope

        # Pixels outside charts link to themselves only, so NaN there has no effect.
        if channels not in self._around:  # cached for the next steps
            self._around[channels] = lanes_of(self._around[1], channels)
        around = self._around[channels]
        total, gradient = over_neighbors(around, add, (mi.Float(0), mi.Float(0)))
        gradient *= self._scale
        dr.eval(total, gradient)
        return dr.sum(total) * (0.5 * self._scale), gradient  # each pair is visited twice


def absolute(difference: Any, epsilon: Any | None) -> tuple[Any, Any]:
    """Return the absolute value, smoothed by epsilon if given, and its derivative."""
    if epsilon is None:
        return dr.abs(difference), sign(difference)
    smooth = dr.sqrt(dr.fma(difference, difference, dr.square(epsilon)))
    # Without cancellation: sqrt(d^2 + e^2) - e = d^2 / (sqrt(d^2 + e^2) + e).
    return dr.square(difference) / (smooth + epsilon), difference / smooth


def _table(texels: Texels, around: Neighbors) -> tuple[np.ndarray, int]:
    """Return flat neighbour indices of all pixels, (K, H W), and the number of pairs P.

    Missing neighbours are replaced by the pixel itself: the difference is 0.
    """
    table = around.table()
    own = np.arange(texels.count)
    width, height = texels.resolution
    index = texels.index.numpy()
    flat = np.tile(np.arange(width * height, dtype=np.uint32), (len(table), 1))
    flat[:, index] = index[table]
    return flat, int((table != own).sum()) // 2
