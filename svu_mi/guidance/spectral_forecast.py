"""Expected entropy (Eq. 13) with the power spectra of the paper.

If psi_0 is true, the photographs have the spectrum S_L' Ks_0^2 e_l, and Eq. 11 becomes

    d(psi_0, psi) = sum_{l=1}^{l*} (Ks_0^2 e_l(alpha_0) - Ks^2 e_l(alpha))^2 S_L'(l)^2.

A candidate adds a rank-1 update to the fit of the mirrored light S_L'
(``frequency/solve_primal.py``).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import to_drjit
from svu_mi.frequency.harmonics import FitSystem
from svu_mi.frequency.solve_primal import fit_candidates
from svu_mi.geometry.pixel_footprint import as_channels
from svu_mi.geometry.sample_view import TexelLanes, ViewSample, mirror_direction
from svu_mi.guidance.forecast import Forecast, numbers
from svu_mi.guidance.objectives import FAR, color_marginal
from svu_mi.guidance.predicted_responses import ResponseFunction, Responses
from svu_mi.light.band_limited import Lighting
from svu_mi.light.light_visibility import trace_mirror
from svu_mi.posterior.grid import ParameterGrid
from svu_mi.posterior.spectrum import decay
from svu_mi.posterior.spectrum_kernel import SpectrumProducts, falloff, row_distances
from svu_mi.presets import Preset

NEGLIGIBLE = 1e-9  # probability below which a hypothesis is skipped

SpectrumReduction = Callable[[list[list[Any]]], list[Any]]
"""Spectrum by degree and channel -> values that ``SpectrumHypotheses`` needs."""


def columns(switches: Preset) -> int:
    """Return the number of columns: weight, direction to the camera (3), mirrored light."""
    return 4 + switches.colors


def respond(
    scene: Any, surface: TexelLanes, lighting: Lighting, switches: Preset
) -> ResponseFunction:
    """Return a function that evaluates the mirrored light of a view: a row of Eq. 12."""
    dr.eval(lighting.filtered)  # textures cannot be created inside a recorded loop

    def evaluate(seen: ViewSample, _: Any) -> list[Any]:
        free = seen.seen
        if switches.occluded:
            free = trace_mirror(scene, surface, seen, seen.seen)
        mirrored = lighting.radiance(mirror_direction(surface.normal, seen.direction))
        light = [dr.select(free, x, 0) for x in as_channels(mirrored, switches.colors)]
        return [*seen.direction, *light]

    return evaluate


@dataclass(frozen=True)
class SpectrumForecast(Forecast):
    """``Forecast`` on a grid of (roughness, Ks); ``prefilter`` is alpha' of the light L'."""

    grid: ParameterGrid
    switches: Preset
    sigma: float
    prefilter: float

    def _evaluate(
        self, views: np.ndarray, candidates: np.ndarray | None, texels: np.ndarray
    ) -> np.ndarray:
        powers = self._powers(views, candidates, numbers(texels))
        sees = np.ones((1, len(texels)), bool)
        if candidates is not None:
            sees = self.seen[np.ix_(candidates, texels)]
        pairs = np.flatnonzero(sees)
        result = np.zeros(sees.size, np.float32)
        result[pairs] = self._entropies(powers, numbers(texels), numbers(pairs))
        return result.reshape(sees.shape)

    def _powers(self, views: np.ndarray, candidates: np.ndarray | None, lane: Any) -> Any:
        """Return K values per texel (see ``_kept``): (A, K, L), or (1, K, L) without candidates."""
        asked = np.empty(0, np.int64) if candidates is None else candidates
        rows = self.responses.at(lane)
        size = dr.width(lane)
        stride, place = dr.opaque(mi.UInt32, size), dr.arange(mi.UInt32, size)
        kept, keep = self._kept(lane)
        result = dr.zeros(mi.Float64, max(len(asked), 1) * kept * size)
        dr.eval(result)

        def write(j: Any, power: list[list[Any]]) -> None:
            for k, value in enumerate(keep(power)):
                index = (j * kept + k) * stride + place
                dr.scatter(result, value, index, True, dr.ReduceMode.NoConflicts)

        switches = self.switches
        system = FitSystem.of(
            switches.degree, switches.colors, switches.regularizer, switches.penalize_constant
        )
        known = fit_candidates(
            (_samples(rows, views), dr.opaque(mi.UInt32, len(views))),
            (_samples(rows, asked), dr.opaque(mi.UInt32, len(asked))), system, write,
        )  # fmt: skip
        if len(asked):
            dr.eval(result)
            return result
        values = keep(known)
        dr.eval(values)
        return to_drjit(mi.Float64, np.concatenate([value.numpy() for value in values]))

    def _kept(self, lane: Any) -> tuple[int, SpectrumReduction]:
        """Return K, and a function that reduces a spectrum S_L' to K Float64 values.

        Value l is the sum of S_L'(l)^2 / (2 sigma^2) over channels, 0 < l <= K.
        """
        del lane
        scale = dr.opaque(mi.Float64, 0.5 / self.sigma**2)

        def keep(power: list[list[Any]]) -> list[Any]:
            return [scale * sum(S * S for S in row) for row in power[1:]]

        return self.switches.degree, keep

    def _hypotheses(self, texel: Any, kept: list[Any]) -> "SpectrumHypotheses":
        """Return the hypotheses of each lane's texel; ``kept`` are K Floats (see ``_kept``)."""
        return SpectrumHypotheses(self, texel, kept)

    def _entropies(self, powers: Any, lane: Any, pairs: Any) -> np.ndarray:
        """Return E[H] of pairs with the indices candidate * L + texel."""
        size = dr.opaque(mi.UInt32, dr.width(lane))
        candidate = pairs // size
        place = pairs - candidate * size
        texel = dr.gather(mi.UInt32, lane, place)
        count, _ = self._kept(lane)
        kept = [
            dr.gather(mi.Float64, powers, (candidate * count + k) * size + place)
            for k in range(count)
        ]
        H = _expected_entropy(
            self._hypotheses(texel, kept), dr.opaque(mi.UInt32, self.grid.shape[0])
        )
        dr.eval(H)
        return H.numpy()


def _samples(rows: Responses, views: np.ndarray) -> Any:
    """Return a function that reads samples of Eq. 12 from responses, for ``fit_candidates``."""
    order = numbers(views if len(views) else [0])

    def sample(index: Any) -> tuple[Any, Any, list[Any]]:
        view = dr.gather(mi.UInt32, order, index)
        values = [value for k in range(rows.groups) for value in rows.read(view, k)]
        x, y, z, *light = values[: rows.columns - 1]
        return mi.Vector3f(x, y, z), rows.sees(view), light

    return sample


class SpectrumHypotheses:
    """Distances of Eq. 11 between grid cells, for the light of each lane."""

    def __init__(self, forecast: SpectrumForecast, texel: Any, light: list[Any]) -> None:
        grid, switches = forecast.grid, forecast.switches
        self._truths, self._texel = forecast.hypotheses, texel
        self.measure = forecast.measure
        self.hypotheses = dr.gather(mi.UInt32, forecast.hypotheses.counts, texel)
        self._light, self._prior = light, forecast.prior
        self._decay = to_drjit(mi.Float64, decay(switches, grid, forecast.prefilter))
        self._nodes = to_drjit(mi.Float64, grid.specular_nodes**2)
        self._squares = [mi.Float64(float(Ks) ** 2) for Ks in grid.specular_nodes]

    def truth(self, number: Any) -> tuple[Any, list[Any], Any]:
        """Return probability, Ks_0^2 e_l and -log prior of a hypothesis."""
        cell, weight = self._truths.at(number, self._texel)
        square, fall = self._cell(cell)
        return weight, [square * e for e in fall], self._prior_of(cell)

    def energies(self, level: Any, truth: list[Any], prior: Any) -> list[Any]:
        """Return d / (2 sigma^2) - log prior + log prior of the truth, for one roughness level."""
        both = [t * S for t, S in zip(truth, self._light, strict=True)]
        observed = sum(t * x for t, x in zip(truth, both, strict=True))
        products = SpectrumProducts(self._light, both, observed)
        energies = []
        for j, x in enumerate(row_distances(self._squares, products, self._falloff(level))):
            if self._prior is not None:
                place = level * len(self._squares) + j
                x += mi.Float64(dr.gather(mi.Float, self._prior, place)) - prior
            energies.append(mi.Float(dr.clip(x, -FAR, FAR)))
        return energies

    def _cell(self, cell: Any) -> tuple[Any, list[Any]]:
        """Return Ks^2 of a grid cell, and e_l of all degrees l."""
        count = len(self._squares)
        return dr.gather(mi.Float64, self._nodes, cell % count), self._falloff(cell // count)

    def _prior_of(self, cell: Any) -> Any:
        """Return -log prior of a cell, Float64."""
        if self._prior is None:
            return mi.Float64(0)
        return mi.Float64(dr.gather(mi.Float, self._prior, cell))

    def _falloff(self, level: Any) -> list[Any]:
        q = dr.gather(mi.Float64, self._decay, level)
        return falloff(q, mi.Float64(1), len(self._light))


@dr.syntax
def _expected_entropy(lanes: SpectrumHypotheses, levels: Any) -> Any:
    """Return the sum over psi_0 of p(psi_0) H."""
    total = mi.Float(0)
    h = mi.UInt32(0)
    while h < lanes.hypotheses:
        weight, truth, prior = lanes.truth(h)
        if weight > NEGLIGIBLE:
            sums = lanes.measure.start()
            level = mi.UInt32(0)
            while level < levels:
                sums = lanes.measure.add(
                    sums, color_marginal(lanes.energies(level, truth, prior)), ()
                )
                level += 1
            total += weight * lanes.measure.value(sums)
        h += 1
    return total
