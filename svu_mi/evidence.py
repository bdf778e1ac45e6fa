"""What photographs say of texels, wherever they are: in this process, or in others.

Posteriors are made of statistics, and statistics add. So whoever makes a posterior asks for sums,
and needs no photograph: ``Observed`` has them in this process, ``shards.Sharded`` has them summed
where they are.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import inf
from typing import Any, Self

import numpy as np

from svu_mi.capture import Capture
from svu_mi.capture.scene import require_light
from svu_mi.light import Lighting, light
from svu_mi.options import AngularPreset
from svu_mi.progress import Progress
from svu_mi.statistics import Factors, Statistics
from svu_mi.statistics.censored import PASSES, best_models
from svu_mi.statistics.gather import ALIKE, Weighting
from svu_mi.surface import Texels

DARK = 1e-2  # part of the light that counts as the unit of radiance when all is black


@dataclass(frozen=True, kw_only=True)
class Wanted:
    """Statistics that are asked for.

    Attributes:
        roughness: (R,) levels.
        switches: the reflection model.
        channels: of the photographs, 3, or 1 for their mean.
        light_channels: of the light; 1 if it is grey.
        weighting: how much samples count.
        texels: (t,) their numbers among all T; None for all that are worth work.
    """

    roughness: np.ndarray
    switches: AngularPreset
    channels: int
    light_channels: int
    weighting: Weighting
    texels: np.ndarray | None


@dataclass(frozen=True, kw_only=True)
class OfAllViews:
    """What all photographs together show of T texels.

    Attributes:
        coverage: (T,) uint32, number of photographs that show each texel with nothing clipped.
        clipped: (T,) uint32, number of those that show it with channels that are clipped; None
            where no photograph is.
        per_view: (V,) int64, number of texels that each photograph that is used shows.
        grey: whether all photographs are grey where they show the object.
        scale: mean radiance of all samples; 0 if they are black.
    """

    coverage: np.ndarray
    clipped: np.ndarray | None
    per_view: np.ndarray
    grey: bool
    scale: float


@dataclass(eq=False, kw_only=True)
class Evidence(ABC):
    """Which texels photographs show, and the sums of what they say.

    Attributes:
        capture: scene, photographs and light.
        texels: the T texels.
        seen: (S,) int64, the texels that are worth any work: those that a photograph shows, or
            all if nothing may be skipped.
        lit_for: number of photographs that the light is filtered for; None for those that are
            used.
    """

    capture: Capture
    texels: Texels
    seen: np.ndarray
    lit_for: int | None = None
    _of_light: dict[Any, Any] = field(default_factory=dict, repr=False)

    @property
    @abstractmethod
    def all_views(self) -> OfAllViews:
        """What all photographs together show."""

    @property
    def coverage(self) -> np.ndarray:
        """(T,) uint32, number of photographs that show each texel with nothing clipped."""
        return self.all_views.coverage

    @property
    def clipped_coverage(self) -> np.ndarray | None:
        """(T,) uint32, number of those that show it with channels that are clipped; None where no
        photograph is."""
        return self.all_views.clipped

    @property
    def scale(self) -> float:
        """Mean radiance of all samples; 0 if they are black."""
        return self.all_views.scale

    @abstractmethod
    def _gather(self, wanted: Wanted) -> Statistics:
        """Sum over all photographs."""

    def _factor(self, wanted: Wanted) -> Factors:
        """Sum over all photographs, and factorise that."""
        return self._gather(wanted).factor()

    @abstractmethod
    def _rounded(self, weighting: Weighting) -> np.ndarray | None:
        """Return (S,) the sum of ``statistics.rounding`` over all samples of the texels of
        ``seen``; None of floats."""

    @abstractmethod
    def prepare(self, switches: AngularPreset, progress: Progress) -> None:
        """Trace what statistics of all of ``seen`` need, if that can be done ahead of time."""

    def part(self, texels: np.ndarray) -> Self:
        """Return the same, of which only some texels are worth any work; the light is read once.

        Args:
            texels: (t,) their numbers among all T.
        """
        return replace(self, seen=texels)

    @property
    def lighting(self) -> Lighting:
        """The light; read when first asked for.

        Raises:
            SceneError: there is none, it cannot be read, or it is black.
        """
        if "lighting" not in self._of_light:
            require_light(self.capture)
            views = sum(self.capture.used) if self.lit_for is None else self.lit_for
            self._of_light["lighting"] = light(self.capture, views)
        found: Lighting = self._of_light["lighting"]
        return found

    @cached_property
    def unit(self) -> float:
        """Radiance that noise is a part of: the photographs' mean, or if that is 0, some of the
        light's, since black under a known light is an observation too."""
        return self.scale or DARK * float(self.lighting.environment.coefficients(0).mean())

    @property
    def shown(self) -> np.ndarray:
        """(T,) uint32, number of photographs that show each texel, clipped or not."""
        clipped = self.clipped_coverage
        return self.coverage if clipped is None else np.asarray(self.coverage + clipped, np.uint32)

    def statistics(
        self, roughness: np.ndarray, switches: AngularPreset, channels: int, *,
        light_channels: int | None = None, weighting: Weighting = ALIKE,
        texels: np.ndarray | None = None,
    ) -> Statistics:  # fmt: skip
        """Gather what the photographs say of texels.

        Args:
            roughness: (R,) levels.
            switches: the reflection model.
            channels: of the photographs, 3, or 1 for their mean.
            light_channels: of the light; 1 if it is grey.
            weighting: how much samples count; all alike by default. Where samples that are clipped
                count by what they say (``statistics.censored``), it has a finite kappa and no
                ``current``; otherwise they do not count.
            texels: (t,) numbers of texels; by default those of ``seen``.
        """
        wanted = Wanted(
            roughness=roughness, switches=switches, channels=channels,
            light_channels=light_channels or channels, weighting=weighting, texels=texels,
        )  # fmt: skip
        return self._statistics(wanted)

    def factors(self, wanted: Wanted) -> Factors:
        """Return the square-root form of ``statistics``, without these wherever they need not be in
        memory."""
        if self._counts_clipped(wanted):
            return self._statistics(wanted).factor()
        return self._factor(wanted)

    def _statistics(self, wanted: Wanted) -> Statistics:
        found, clipped = self._gather(wanted), self.clipped_coverage
        if clipped is None or not self._counts_clipped(wanted):
            return found
        number = found.texel.numpy()
        # A sample whose middle is not clipped may be so in part.
        partly = (clipped[number] > 0) | (self.coverage[number] != found.views.numpy())
        lanes = np.flatnonzero(partly)
        if not len(lanes):
            return found
        # What is not clipped stays; samples that are clipped come beside it.
        plain, texels = found.at(lanes), number[lanes].astype(np.int64)
        some = plain
        for _ in range(PASSES):
            around = replace(wanted.weighting, models=best_models(some))
            some = plain + self._gather(replace(wanted, weighting=around, texels=texels))
        return found.replaced(lanes, some)

    def _counts_clipped(self, wanted: Wanted) -> bool:
        weighting = wanted.weighting
        leave_out = weighting.current is not None or not weighting.kappa < inf
        return self.clipped_coverage is not None and not leave_out

    def rounding(self, weighting: Weighting) -> np.ndarray | None:
        """Return the variance of a sample of weight 1 by rounding alone, of the texels of ``seen``:
        (S,) float64, squared radiance, the mean over samples and channels; None of floats."""
        total = self._rounded(weighting)
        return None if total is None else total / np.maximum(self.coverage[self.seen], 1)
