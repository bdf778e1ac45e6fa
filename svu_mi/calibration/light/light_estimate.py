"""Light and exposure gains that were estimated from photographs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy

from svu_mi.calibration.light.light_prior import SD
from svu_mi.core.arrays import fibonacci
from svu_mi.light.latlong import directions

ROWS, COLUMNS = 129, 256  # of maps
UNANCHORED = (
    "The level of the light is not known: hardly any of the surface is dielectric, and brighter "
    "light on darker metal looks the same; --grey-card or --mean-albedo fix it."
)
NINETY = 1.6449  # standard deviations that 90 % of a normal distribution lie within


@dataclass(frozen=True)
class FoundGains:
    """Factors that V photographs were multiplied with.

    Attributes:
        logarithm: (V, 3), with a mean of 0 over the photographs that are no outliers.
        noise: (V,) residual, in units of the texels' noise; 0 where nothing is seen.
        odd: (V,) bool, outliers, which are not used.
    """

    logarithm: np.ndarray
    noise: np.ndarray
    odd: np.ndarray

    @property
    def factor(self) -> np.ndarray:
        """(V, 3) the gains."""
        return np.asarray(np.exp(self.logarithm))


@dataclass(frozen=True, kw_only=True, repr=False, eq=False)
class LightEstimate:
    """Light of a capture, estimated from its photographs.

    Even cells of the sphere (``arrays.fibonacci``) have a radiance whose logarithm is normally
    distributed. Directions are those of world space, maps those of Mitsuba's ``envmap`` without
    ``to_world``; if the light moves with the camera, both are camera space (+X left, +Y up,
    +Z forward).

    Attributes:
        logarithm: (N, 3) float64, of the radiance of the cells: mean of the posterior.
        cell_sd: (N,) float64, standard deviation of the channels' mean of that, at a given level.
        draws: (K, N, 3) float64, logarithms of light of that level that is as possible.
        scale_sd: (3,) float64, standard deviation of the logarithm of one factor per channel, that
            all of the light may have to be multiplied with: 0 where it was given.
        moves: whether it turns with the cameras.
        misfit: noise of the median texel as a part of the mean radiance, if the light stands still
            and if it moves; NaN where that was not tried.
        widening: how many times less certain textures are for not knowing the light: a factor of
            their overdispersion.
        texels: number of texels that it was estimated from.
        remarks: sentences about what is not known.
        gains: of the photographs, if they were estimated, too; None if they were given.
    """

    logarithm: np.ndarray
    cell_sd: np.ndarray
    draws: np.ndarray
    scale_sd: np.ndarray
    moves: bool = False
    misfit: tuple[float, float] = (np.nan, np.nan)
    widening: float = 1.0
    texels: int = 0
    remarks: tuple[str, ...] = ()
    gains: FoundGains | None = None

    def __repr__(self) -> str:
        low, high = self.scale_interval
        return (
            f"<LightEstimate of {self.texels} texels: {self.known_part:.0%} of it known, "
            f"scale {low.mean():.2f} to {high.mean():.2f}"
            f"{', moves with the camera' if self.moves else ''}>"
        )

    @property
    def cells(self) -> int:
        """N."""
        return len(self.logarithm)

    @cached_property
    def radiance(self) -> np.ndarray:
        """(129, 256, 3) float32, radiance: a map for Mitsuba's ``envmap``."""
        return self._map(self.logarithm)

    @cached_property
    def sd(self) -> np.ndarray:
        """(129, 256) float32, standard deviation of log radiance, with the scale's: .1 is 10 %."""
        return np.hypot(self._details, np.mean(self.scale_sd)).astype(np.float32)

    @cached_property
    def known(self) -> np.ndarray:
        """(129, 256) float32, part of the prior's variance that is removed at a given scale."""
        return np.clip(1 - np.square(self._details / SD), 0, 1).astype(np.float32)

    @property
    def known_part(self) -> float:
        """Mean of ``known`` over all directions."""
        return float(np.average(self.known, weights=self._solid))

    @property
    def scale_interval(self) -> tuple[np.ndarray, np.ndarray]:
        """Two (3,): factors of the light, one per channel, between which the truth is to 90 %."""
        wide = NINETY * self.scale_sd
        return np.exp(-wide), np.exp(wide)

    def drawn(self, count: int) -> np.ndarray:
        """Return possible maps, (count, 129, 256, 3) float32, at most as many as ``draws``."""
        return np.stack([self._map(x) for x in self.draws[:count]])

    def scaled(self, factor: np.ndarray | float) -> LightEstimate:
        """Return the same light, a factor (or one per channel) brighter and known to be so."""
        added = np.broadcast_to(np.log(factor), 3)
        return replace(
            self,
            logarithm=self.logarithm + added,
            draws=self.draws + added,
            scale_sd=np.zeros(3),
            remarks=tuple(remark for remark in self.remarks if remark != UNANCHORED),
        )

    def _map(self, logarithm: np.ndarray) -> np.ndarray:
        """Radiance as a map whose mean over every cell is that cell's."""
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
        """Values of cells (N, C) as a smooth map (129, 256, C)."""
        distance, near = self._around
        weight = np.exp(-0.5 * np.square(distance * np.sqrt(self.cells) / 2))
        weight /= weight.sum(axis=-1, keepdims=True)
        return np.einsum("ijk,ijkc->ijc", weight, values[near])

    @cached_property
    def _details(self) -> np.ndarray:
        return self._interpolated(self.cell_sd[:, None])[..., 0]

    @cached_property
    def _around(self) -> tuple[np.ndarray, np.ndarray]:
        """Distance to, and number of, the cells around every node: (129, 256, 4), nearest first."""
        tree = scipy.spatial.cKDTree(fibonacci(self.cells))
        distance, near = tree.query(directions(COLUMNS, ROWS), k=4)
        return np.asarray(distance), np.asarray(near)

    @cached_property
    def _solid(self) -> np.ndarray:
        return np.repeat(np.sin(np.pi * np.arange(ROWS) / (ROWS - 1))[:, None], COLUMNS, axis=1)
