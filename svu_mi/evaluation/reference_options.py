"""Options of a reference, checked before tracing starts."""

from dataclasses import dataclass
from math import inf
from typing import Any, Literal

import numpy as np

from svu_mi.core.validation import indices_of, require, require_ranges, require_types
from svu_mi.errors import OptionError, excerpt
from svu_mi.evaluation.squared_errors import CORNERS
from svu_mi.posterior.grid import PrincipledGrid
from svu_mi.presets import AngularPreset, Errors
from svu_mi.reflection.roughness_levels import roughness_levels

Method = Literal["linear", "brute"]
Noise = Literal["relative", "heteroscedastic", "estimated"]


@dataclass(frozen=True)
class ReferenceOptions:
    """Checked options of ``reference_posterior``, where they are described.

    Raises:
        OptionError: an option is out of range.
    """

    spp: int
    grid: PrincipledGrid
    sigma: float
    max_depth: int
    method: Method
    seed: int
    noise: Noise = "relative"
    errors: Errors = "mean"

    def __post_init__(self) -> None:
        require_types(self)
        require_ranges(self, spp=(2, inf), max_depth=(2, inf), seed=(0, inf))
        require(self, self.spp % 2 == 0, "spp", "even, for two halves that measure the noise")
        require(self, 0 < self.sigma < inf, "sigma", "positive")
        estimated, linear = self.noise == "estimated", self.method == "linear"
        fits = not estimated or self.errors == "mean"
        require(self, fits, "errors", "mean with estimated noise, which sums over views already")
        fits = not estimated or linear
        require(self, fits, "method", "linear with estimated noise, which needs its sums")
        require(
            self, not linear or self.max_depth == 2, "max_depth",
            "2, for which radiance is linear in the material, unless method is brute",
        )  # fmt: skip

    @property
    def levels(self) -> np.ndarray:
        """Traced roughness levels, (R,); the angular estimator's levels if noise is estimated."""
        nodes = self.grid.roughness_nodes
        if self.noise == "estimated" and len(nodes) > 1:
            return roughness_levels(AngularPreset().levels)
        return nodes

    @property
    def renders(self) -> int:
        """Number of materials psi to trace."""
        _, *others = self.grid.shape
        rows = len(self.levels)
        return rows * (len(CORNERS) if self.method == "linear" else int(np.prod(others)))


def check_subset(subset: Any, count: int) -> int | np.ndarray:
    """Check ``subset``; return it as a number of texels, or as (n,) int64 texel indices."""
    given = np.asarray(subset)
    if given.ndim == 0 and given.dtype.kind in "iu" and given >= 1:
        return int(given)
    if given.ndim != 1 or not len(given):
        raise OptionError(
            "reference_posterior(): subset must be a number of texels (at least 1) or a list of "
            f"texel indices, got {excerpt(repr(subset))}."
        )
    return indices_of(given, count, "reference_posterior(): subset", "texel")
