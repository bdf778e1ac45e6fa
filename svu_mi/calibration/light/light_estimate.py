"""Light and exposure gains estimated from photographs."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy

from svu_mi.calibration.light.light_prior import SD
from svu_mi.core.arrays import fibonacci
from svu_mi.light.latlong import directions

ROWS, COLUMNS = 129, 256  # size of maps
UNANCHORED = (
    "The brightness of the light is not determined, since little of the surface seems to be "
    "dielectric, and brighter light on darker metal looks the same; set it with --grey-card or "
    "--mean-albedo. If much is dielectric, exposures, poses or mesh do not fit: run svu check."
)
ALIKE = 0.05  # log gains up to this are equal
# Standard deviation of log gains from which they differ, if the light is estimated, too. Equal
# photographs of the included objects (24 views, 96 pixels) have 0.05, ratios up to 1.6 have 0.12.
UNCERTAIN = 0.08
NINETY = 1.6449  # half width of the 90 % interval in standard deviations


@dataclass(frozen=True)
class FoundGains:
    """Exposure gains of V photographs.

    Attributes:
        logarithm: (V, 3) log gains, with mean 0 over all photographs except outliers.
        noise: (V,) residuals, relative to the noise of the texels; 0 if nothing is seen.
        odd: (V,) bool flags of outliers.
        sd: (V,) standard deviations of the channel means of ``logarithm``; None if the light was
            estimated, too.

    Example:
        >>> gains.odd.shape, gains.factor.shape
        ((12,), (12, 3))
    """

    logarithm: np.ndarray
    noise: np.ndarray
    odd: np.ndarray
    sd: Any = None

    @property
    def factor(self) -> np.ndarray:
        """(V, 3) gains."""
        return np.asarray(np.exp(self.logarithm))

    @property
    def vary(self) -> bool:
        """True if their spread exceeds the error of an estimate without a known light."""
        kept = self.logarithm[~self.odd]
        return len(kept) > 0 and float(kept.std()) > UNCERTAIN

    @property
    def differ(self) -> bool:
        """True if they vary, or if there are outliers."""
        return bool(self.odd.any()) or self.vary

    @property
    def are_equal(self) -> bool:
        """True without outliers and differences of more than 5 %."""
        return not self.odd.any() and float(np.abs(self.logarithm).max(initial=0)) <= ALIKE


@dataclass(frozen=True, kw_only=True, repr=False, eq=False)
class LightEstimate:
    """Environment map estimated from photographs, with its uncertainty.

    The log radiance of N cells of equal size (``arrays.fibonacci``) is normally distributed.
    Directions are in world space, and maps in the frame of Mitsuba's ``envmap`` without
    ``to_world``. If the light moves with the camera, both are in camera space (+X left, +Y up,
    +Z forward).

    Attributes:
        logarithm: (N, 3) float64 posterior mean of log radiance.
        cell_sd: (N,) float64 standard deviation of the channel mean of ``logarithm``, at fixed
            scale.
        draws: (K, N, 3) float64 posterior samples of log radiance, at fixed scale.
        scale_sd: (3,) float64 standard deviation of the log scale per channel; 0 if given.
        tint_sd: (3,) float64 part of ``scale_sd`` that is not common to the channels.
        moves: True if the light moves with the cameras.
        misfit: Noise of the median texel relative to the mean radiance, for fixed and for moving
            light; NaN if not tested.
        widening: Factor applied to the overdispersion of textures, as the light is uncertain.
        texels: Number of texels used.
        remarks: Sentences about undetermined parts.
        gains: Gains estimated together with the light; None if given.

    Example:
        >>> light.scaled(np.full(3, 2.0)).scale_sd.tolist()
        [0.0, 0.0, 0.0]
    """

    logarithm: np.ndarray
    cell_sd: np.ndarray
    draws: np.ndarray
    scale_sd: np.ndarray
    tint_sd: np.ndarray
    moves: bool = False
    misfit: tuple[float, float] = (np.nan, np.nan)
    widening: float = 1.0
    texels: int = 0
    remarks: tuple[str, ...] = ()
    gains: FoundGains | None = None

    def __repr__(self) -> str:
        low, high = self.scale_interval
        return (
            f"<LightEstimate of {self.texels} texels: {self.known_part:.0%} determined, "
            f"scale {low.min():.2f} to {high.max():.2f}"
            f"{', moves with the camera' if self.moves else ''}>"
        )

    @property
    def cells(self) -> int:
        """Number of cells, N."""
        return len(self.logarithm)

    @cached_property
    def radiance(self) -> np.ndarray:
        """(129, 256, 3) float32 radiance, a map for Mitsuba's ``envmap``."""
        return self._map(self.logarithm)

    @cached_property
    def sd(self) -> np.ndarray:
        """(129, 256) float32 standard deviation of log radiance, including the scale."""
        return np.hypot(self._details, np.mean(self.scale_sd)).astype(np.float32)

    @cached_property
    def known(self) -> np.ndarray:
        """(129, 256) float32 reduction of the prior variance, in [0, 1], at fixed scale."""
        return np.clip(1 - np.square(self._details / SD), 0, 1).astype(np.float32)

    @property
    def known_part(self) -> float:
        """Mean of ``known`` over the sphere."""
        return float(np.average(self.known, weights=self._solid))

    @property
    def scale_interval(self) -> tuple[np.ndarray, np.ndarray]:
        """Ends of the 90 % interval of the scale per channel, two (3,) arrays."""
        wide = NINETY * self.scale_sd
        return np.exp(-wide), np.exp(wide)

    def drawn(self, count: int) -> np.ndarray:
        """Return at most ``count`` posterior samples as maps, (K, 129, 256, 3) float32."""
        return np.stack([self._map(x) for x in self.draws[:count]])

    def scaled(self, factor: np.ndarray | float) -> "LightEstimate":
        """Return the light times a known factor; a scalar leaves its tint uncertain."""
        added, sd = np.broadcast_to(np.log(factor), 3), self.tint_sd * (np.ndim(factor) == 0)
        return replace(
            self,
            logarithm=self.logarithm + added,
            draws=self.draws + added,
            scale_sd=sd,
            tint_sd=sd,
            remarks=tuple(remark for remark in self.remarks if remark != UNANCHORED),
        )

    def _map(self, logarithm: np.ndarray) -> np.ndarray:
        """Return a radiance map whose mean over each cell is the radiance of the cell."""
        radiance = np.exp(self._interpolated(logarithm))
        owner = self._around[1][..., 0]
        count = np.maximum(np.bincount(owner.ravel(), self._solid.ravel(), self.cells), 1e-300)
        for c in range(3):
            weighted = (radiance[..., c] * self._solid).ravel()
            mean = np.bincount(owner.ravel(), weighted, self.cells) / count
            factor = np.exp(logarithm[:, c]) / np.maximum(mean, 1e-300)
            radiance[..., c] *= factor[owner]
        return radiance.astype(np.float32)

    def _interpolated(self, values: np.ndarray) -> np.ndarray:
        """Return values of cells (N, C) as a smooth map (129, 256, C)."""
        distance, near = self._around
        weight = np.exp(-0.5 * np.square(distance * np.sqrt(self.cells) / 2))
        weight /= weight.sum(axis=-1, keepdims=True)
        return np.einsum("ijk,ijkc->ijc", weight, values[near])

    @cached_property
    def _details(self) -> np.ndarray:
        return self._interpolated(self.cell_sd[:, None])[..., 0]

    @cached_property
    def _around(self) -> tuple[np.ndarray, np.ndarray]:
        """Distances and indices of the 4 nearest cells of each pixel, (129, 256, 4)."""
        tree = scipy.spatial.cKDTree(fibonacci(self.cells))
        distance, near = tree.query(directions(COLUMNS, ROWS), k=4)
        return np.asarray(distance), np.asarray(near)

    @cached_property
    def _solid(self) -> np.ndarray:
        return np.repeat(np.sin(np.pi * np.arange(ROWS) / (ROWS - 1))[:, None], COLUMNS, axis=1)
