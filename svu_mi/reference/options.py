"""What a reference is asked for, checked before anything is traced."""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Integral
from typing import Any, Literal, get_args

import numpy as np

from svu_mi.errors import OptionError
from svu_mi.options import AngularPreset, Errors
from svu_mi.posterior import PrincipledGrid
from svu_mi.reference.deviations import CORNERS

Method = Literal["linear", "brute"]
Noise = Literal["relative", "heteroscedastic", "estimated"]


@dataclass(frozen=True)
class Options:
    """The numbers of ``reference_posterior``, checked.

    Raises:
        OptionError: one is out of range.
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
        estimated, linear = self.noise == "estimated", self.method == "linear"
        for name in ("method", "noise", "errors"):
            words = get_args({"method": Method, "noise": Noise, "errors": Errors}[name])
            given = getattr(self, name)
            _require(given in words, f"{name} must be {' or '.join(words)}, got {given!r}.")
        _require(
            _is_whole(self.spp, 2) and self.spp % 2 == 0,
            f"spp must be even and at least 2, got {self.spp!r}: its noise is measured from two "
            "halves.",
        )
        positive = bool(np.isfinite(self.sigma) and self.sigma > 0)
        _require(positive, f"sigma must be above 0, got {self.sigma!r}.")
        _require(
            _is_whole(self.max_depth, 2),
            f"max_depth must be at least 2 (direct light), got {self.max_depth!r}.",
        )
        _require(_is_whole(self.seed, 0), f"seed must be a whole number >= 0, got {self.seed!r}.")
        _require(
            not (estimated and self.errors == "sum"),
            "estimated noise counts every view already; use errors='mean', or noise='relative'.",
        )
        _require(
            linear or not estimated,
            "estimated noise needs method='linear', whose sums it is computed from; got "
            f"{self.method!r}.",
        )
        _require(
            not linear or self.max_depth == 2,
            "radiance is linear in the material only for direct light; use method='brute' for "
            f"max_depth {self.max_depth}, or max_depth=2.",
        )

    @property
    def levels(self) -> np.ndarray:
        """(R,) roughness that is traced: what the angular estimator gathers at."""
        nodes = self.grid.roughness_nodes
        if self.noise == "estimated" and len(nodes) > 1:
            return np.linspace(0, 1, AngularPreset().levels)
        return nodes

    @property
    def renders(self) -> int:
        """Number of psi that are traced."""
        _, *others = self.grid.shape
        rows = len(self.levels)
        return rows * (len(CORNERS) if self.method == "linear" else int(np.prod(others)))


def check_subset(subset: Any, count: int) -> int | np.ndarray:
    """Return a number of texels, or (n,) int64 indices of texels that exist."""
    label = "reference_posterior(): subset"
    if np.ndim(subset) == 0:
        if not _is_whole(subset, 1):
            raise OptionError(f"{label} must be a number of texels >= 1, got {subset!r}.")
        return int(subset)
    indices = np.asarray(subset)
    if indices.ndim != 1 or not indices.size or not np.issubdtype(indices.dtype, np.integer):
        raise OptionError(
            f"{label} must be a list of texel indices, got {indices.dtype} of shape "
            f"{indices.shape}."
        )
    wrong = (indices < 0) | (indices >= count)
    if wrong.any():
        raise OptionError(
            f"{label} must hold texel indices 0 to {count - 1}, got {indices[wrong][0]}."
        )
    return indices.astype(np.int64)


def _require(fine: bool, sentence: str) -> None:
    if not fine:
        raise OptionError(f"reference_posterior(): {sentence}")


def _is_whole(value: object, least: int) -> bool:
    return isinstance(value, Integral) and not isinstance(value, bool) and int(value) >= least
