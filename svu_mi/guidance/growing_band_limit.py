"""Expected entropy as printed in the paper (Eq. 13): light sharpens with every view.

    E[H] = sum_psi p(psi | B, L') H(B'_psi, L')

L' is the light mirrored into v' views and the candidate, with alpha' = (v' + 1)^(-1/2). The
probability of a hypothesis depends on L', too. With the spectrum S_B of the photographs,

    p(psi | B, L') ~ exp(-sum_l (S_B(l) - Ks^2 e_l S_L'(l))^2 / (2 sigma^2)) p(psi).

E[H] therefore changes in every step, and every candidate has its own weights. S_B is fitted to
fewer samples than S_L' and regularised more strongly. This favours weaker reflections.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import fold
from svu_mi.guidance.predicted_responses import Responses
from svu_mi.guidance.spectral_forecast import (
    SpectrumForecast,
    SpectrumHypotheses,
    SpectrumReduction,
)
from svu_mi.posterior.spectrum_kernel import SpectrumProducts, row_distances

Relight = Callable[[int], tuple[Responses, float]]
"""Number of views -> responses of all views in light with that band limit, and its alpha'."""


@dataclass(frozen=True)
class GrowingForecast(SpectrumForecast):
    """``SpectrumForecast`` with light that sharpens with every view.

    ``responses`` and ``prefilter`` belong to the light of the estimate. ``hypotheses``
    are all cells, weighted by the prior.

    Attributes:
        photographs: (T (l* + 1) C,) Float, power spectra S_B by texel, degree and channel.
        observed: (T,) Bool; hypotheses of other texels are weighted by the prior alone.
    """

    photographs: Any
    observed: Any
    relight: Relight
    _lights: "dict[int, GrowingForecast]" = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    @property
    def is_separable(self) -> bool:
        """False: the band limit of the light depends on all chosen views."""
        return False

    def _evaluate(
        self, views: np.ndarray, candidates: np.ndarray | None, texels: np.ndarray
    ) -> np.ndarray:
        evaluate = super(GrowingForecast, self._lit_for(len(views) + 1))._evaluate
        return evaluate(views, candidates, texels)

    def _lit_for(self, views: int) -> "GrowingForecast":
        """Return the forecast with the light for ``views`` views; the last result is cached."""
        if views not in self._lights:
            self._lights.clear()  # responses are large
            responses, prefilter = self.relight(views)
            self._lights[views] = replace(self, responses=responses, prefilter=prefilter)
        return self._lights[views]

    def _kept(self, lane: Any) -> tuple[int, SpectrumReduction]:
        """Append products S_L'(l) S_B(l) and the sum of S_B(l)^2 to the K values.

        All are summed over channels and divided by 2 sigma^2.
        """
        count, of_light = super()._kept(lane)
        scale = dr.opaque(mi.Float64, 0.5 / self.sigma**2)
        channels = self.switches.colors
        first = lane * dr.opaque(mi.UInt32, (count + 1) * channels)
        shown = [
            [
                mi.Float64(dr.gather(mi.Float, self.photographs, first + l * channels + c))
                for c in range(channels)
            ]
            for l in range(1, count + 1)
        ]
        energy = scale * sum(B * B for row in shown for B in row)

        def keep(power: list[list[Any]]) -> list[Any]:
            both = [
                scale * sum(S * B for S, B in zip(light, row, strict=True))
                for light, row in zip(power[1:], shown, strict=True)
            ]
            return [*of_light(power), *both, energy]

        return 2 * count + 1, keep

    def _hypotheses(self, texel: Any, kept: list[Any]) -> SpectrumHypotheses:
        return _WeightedHypotheses(self, texel, kept)


class _WeightedHypotheses(SpectrumHypotheses):
    """``SpectrumHypotheses`` weighted by their likelihood in the light of each lane."""

    def __init__(self, forecast: GrowingForecast, texel: Any, kept: list[Any]) -> None:
        degree = forecast.switches.degree
        light, both = kept[:degree], kept[degree : 2 * degree]
        super().__init__(forecast, texel, light)
        seen = dr.gather(mi.Bool, forecast.observed, texel)
        self._known = SpectrumProducts(
            [dr.select(seen, x, 0) for x in light],
            [dr.select(seen, x, 0) for x in both],
            dr.select(seen, kept[-1], 0),
        )
        self._least, self._total = self._sums()

    def truth(self, number: Any) -> tuple[Any, list[Any], Any]:
        """Return probability (normalised likelihood), Ks_0^2 e_l and -log prior of a hypothesis."""
        _, fall, prior = super().truth(number)
        away = mi.Float(dr.minimum(self._energy(number) - self._least, 1e3))
        return dr.exp(-away) / self._total, fall, prior

    def _energy(self, number: Any) -> Any:
        """Return -log p(psi | B, L') of a hypothesis up to a constant: Float64."""
        cell, _ = self._truths.at(number, self._texel)
        square, fall = self._cell(cell)
        return row_distances([square], self._known, fall)[0] + self._prior_of(cell)

    def _sums(self) -> tuple[Any, Any]:
        """Return the least energy of all hypotheses, and the sum of exp(least - energy)."""

        def add(number: Any, least: Any, total: Any) -> tuple[Any, Any, Any]:
            x = self._energy(number)
            lower = dr.minimum(least, x)
            old, new = (mi.Float(dr.minimum(y - lower, 1e3)) for y in (least, x))
            return number + 1, lower, dr.fma(dr.exp(-old), total, dr.exp(-new))

        count = dr.width(self._texel)
        start = dr.full(mi.Float64, 1e300, count), dr.zeros(mi.Float, count)
        least, total = fold(0, self.hypotheses, add, *start)
        return least, total
