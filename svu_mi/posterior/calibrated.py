"""Calibrated posterior: noise estimated from the photographs, continuous parameters.

    log p(psi | B, L) = -sum_i w_i |r_i(psi) - b_i|^2 / (2 s^2 tau) + log p(psi)

Base colour is integrated in closed form (``truncated_normal``), others on nodes (``quadrature``).
Probabilities are integrals over the grid's bins, and the entropy (Eq. 5) is computed from them.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from statistics import NormalDist
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture.capture import LightUncertainty
from svu_mi.core.arrays import to_drjit
from svu_mi.posterior import calibrated_kernel as kernel
from svu_mi.posterior.calibrated_fit import CalibratedFit, fit, problem_of
from svu_mi.posterior.calibrated_prior import CalibratedPrior
from svu_mi.posterior.calibrated_problem import CalibratedProblem
from svu_mi.posterior.folds import blur_error
from svu_mi.posterior.grid import PrincipledGrid
from svu_mi.posterior.intervals import shortest_interval
from svu_mi.posterior.kernel import Kernel, Pair, observed_by
from svu_mi.posterior.missing_light import MISSING_MEAN, MISSING_RMS, MISSING_SD
from svu_mi.posterior.posterior import Posterior
from svu_mi.posterior.quadrature import COLOR_PARTS, uniform_axis
from svu_mi.presets import AngularPreset
from svu_mi.presets import preset as find_preset
from svu_mi.statistics.cholesky_factors import Factors
from svu_mi.statistics.statistics import Statistics

DRAWN_TOGETHER = 8  # draws of a pass over the nodes; more of them make a larger kernel
TEXELS_PER_CHUNK = 2**17  # texels whose node masses are in memory at the same time
LEAST_SD = 1e-4  # least standard deviation of the normal distribution of an interval


@dataclass(frozen=True, kw_only=True)
class CalibratedKernel(Kernel):
    """Calibrated posterior; base colour has a distribution per channel.

    Attributes:
        noise: (S,) float64, standard deviation s of a sample of weight 1, in radiance.
        summary: entropy, moments and best bins of the S texels.
        learned: True if the prior was learned (``empirical_bayes``).
        spread: factor f of the standard deviation s by parameter, at least 1 (``folds``). Widens
            ``sd``, ``interval``, draws and entropy to sqrt(f^2 s^2 + c^2), with c of roughness
            from ``blur_error``, up to the prior's standard deviation; means and bin probabilities
            stay. Default: not widened.
        apart: distance of means from those of neighbours by parameter, (S, g); widens the same
            results if it exceeds the standard deviation (``neighbor_error``).
        common: standard deviation, per channel, of the log of a scale that all base colours share
            (unknown scale of the light). Included in ``sd`` and ``interval``, not in entropy.
        support: the same for a scale of each of the S texels (``support_error``), (S, 3); or None.
        missing: share of base colour that may be due to missing light (``missing_light``), (S, g);
            or None. Included in ``sd`` and ``interval``, not in entropy.
    """

    grid: PrincipledGrid
    problem: CalibratedProblem
    noise: np.ndarray
    summary: kernel.PosteriorSummary = field(repr=False)
    learned: bool = False
    spread: Mapping[str, float] = field(default_factory=dict)
    apart: Mapping[str, np.ndarray] = field(default_factory=dict)
    common: tuple[float, ...] = (0.0, 0.0, 0.0)
    support: np.ndarray | None = None
    missing: np.ndarray | None = None
    continuous = True

    @property
    def channels(self) -> int:
        """Number of base colours per texel: 3, or 1 for grey."""
        return self.problem.factors.channels * self.problem.copies

    @cached_property
    def prior(self) -> CalibratedPrior:
        """Prior of all texels."""
        return CalibratedPrior.of(self.problem, self.grid)

    @cached_property
    def lane(self) -> np.ndarray:
        """(T,) int64, lane of each texel in the arrays of S texels; 0 if it has none."""
        texel = self.problem.factors.texel.numpy()
        return self.problem.factors.lane_of_texel(int(texel.max()) + 1 if len(texel) else 0)

    def noise_of(self, texels: np.ndarray) -> np.ndarray:
        """Return the noise of texels, (t,) radiance."""
        return self.noise[self.lane[texels]]

    def entropy(self, texels: np.ndarray) -> np.ndarray:
        """Return the normalised entropy (see ``Kernel``)."""
        most = self.prior.max_entropy
        if most <= 0:  # the prior allows only one bin
            return np.zeros(len(texels), np.float32)
        entropy = np.array(self.summary.entropy)[self.lane[texels]] + self._spread_entropy(texels)
        return np.clip(entropy / np.float32(most), 0, 1)

    def _spread_entropy(self, texels: np.ndarray) -> Any:
        """Return the increase of the entropy by ``spread`` [nats], (t,).

        A normal distribution in bins of width h has the entropy 1/2 log(1 + 2 pi e s^2 / h^2),
        exact for s << h and s >> h.
        """
        added: Any = np.float32(0)
        for name in filter(self.spread.__contains__, self.grid.axes):  # a fixed order
            mean, sd = self._own_moments(name, texels)
            scaled = 2 * math.pi * math.e * (sd * (len(self.grid.axes[name]) - 1)) ** 2
            factors = self._factors(name, mean, sd, texels)
            rise = np.log((1 + factors**2 * scaled) / (1 + scaled)) / 2
            added = added + rise.mean(axis=1, dtype=np.float32)
        return added

    def probabilities(self, texels: np.ndarray) -> np.ndarray:
        """Return bin probabilities (see ``Kernel``)."""
        p = kernel.bin_probabilities(self.problem, self.lane[texels])
        p = np.repeat(p, self.problem.copies, -1) if self.problem.copies > 1 else p
        return p.reshape(len(p), *self.grid.shape, -1)

    def rows(self, texels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return masses and mean colours of rows of bins (see ``row_masses_and_colors``)."""
        return kernel.row_masses_and_colors(self.problem, self.lane[texels])

    def best(self, texels: np.ndarray) -> np.ndarray:
        """Return the most probable nodes (see ``Kernel``)."""
        summary, lanes = self.summary, self.lane[texels]
        rows = np.array(summary.best)[lanes].astype(np.int64)
        of_channels = [np.array(color)[lanes] for color in summary.best_colors]
        colors = np.repeat(np.stack(of_channels, axis=1), self.problem.copies, axis=1)
        shared = [np.repeat(node[:, None], colors.shape[1], axis=1)
                  for node in np.unravel_index(rows, self.grid.shape[:-1])]  # fmt: skip
        return np.stack([*shared, colors], axis=1)

    def moments(self, name: str, texels: np.ndarray) -> Pair:
        """Return mean and standard deviation (see ``Kernel``)."""
        mean, sd = self._own_moments(name, texels)
        sd = sd * self._factors(name, mean, sd, texels)
        scale = self._scale(texels, MISSING_RMS) if name == "base_color" else 0
        return mean, np.hypot(sd, mean * scale)

    def _factors(
        self, name: str, mean: np.ndarray, sd: np.ndarray, texels: np.ndarray
    ) -> np.ndarray:
        """Return factors of standard deviations ``sd``, (t, g), up to the prior's (``spread``)."""
        if name not in self.spread:
            return np.ones_like(sd)
        most, sd = np.float32(self.prior.moments(name)[1]), np.maximum(sd, np.float32(1e-9))
        blurred = blur_error(mean) if name == "roughness" else np.float32(0)
        wide = np.hypot(self.spread[name] * sd, blurred)
        if name in self.apart:
            apart = self.apart[name][self.lane[texels]]
            wide = np.sqrt(np.maximum(wide**2, apart**2 - wide**2))
        return np.clip(np.minimum(wide, most) / sd, 1, None)

    def _own_moments(self, name: str, texels: np.ndarray) -> Pair:
        """Return mean and standard deviation without ``spread`` and ``common``, (t, g)."""
        summary, lanes = self.summary, self.lane[texels]
        at = [list(self.grid.axes).index(name)]
        if name == "base_color":
            at = list(range(at[0], at[0] + self.problem.factors.channels)) * self.problem.copies
        mean, sd = (np.stack([np.array(x[k])[lanes] for k in at], axis=-1)
                    for x in (summary.mean, summary.sd))  # fmt: skip
        return mean, sd

    def ends(self, name: str, level: float, texels: np.ndarray) -> Pair:
        """Return the ends of the shortest intervals (see ``Kernel``)."""
        return self.widened_ends(name, level, self.own_ends(name, level, texels), texels)

    def own_ends(self, name: str, level: float, texels: np.ndarray) -> Pair:
        """Return the ends of intervals without ``spread`` and ``common`` (see ``Kernel``)."""
        lanes = self.lane[texels]
        of = self._ends_of_color if name == "base_color" else partial(self._ends_of_nodes, name)
        chunks = [
            of(level, lanes[first : first + TEXELS_PER_CHUNK])
            for first in range(0, len(lanes), TEXELS_PER_CHUNK)
        ]
        low, high = (np.concatenate([ends[k] for ends in chunks]) for k in range(2))
        if name != "base_color":
            return low, high
        # Narrower than a part, a posterior is close to normal.
        mean, sd = self._own_moments(name, texels)
        half = NormalDist().inv_cdf((1 + level) / 2) * np.maximum(sd, np.float32(LEAST_SD))
        normal = sd < 0.5 / COLOR_PARTS
        low = np.where(normal, np.maximum(mean - half, 0), low)
        return low, np.where(normal, np.minimum(mean + half, 1), high)

    def widened_ends(self, name: str, level: float, ends: Pair, texels: np.ndarray) -> Pair:
        """Return the ends of intervals, given those of ``own_ends``."""
        low, high = (self._stretched(name, end, texels) for end in ends)
        if name != "base_color" or not (scale := self._scale(texels, MISSING_SD)).any():
            return low, high
        middle, wide = (low + high) / 2, NormalDist().inv_cdf((1 + level) / 2) * scale
        half = np.hypot((high - low) / 2, wide * middle)
        least = np.zeros_like(middle)
        if self.missing is not None:
            middle *= 1 - MISSING_MEAN * self.missing[self.lane[texels]]
            least = self._own_moments(name, texels)[0]  # intervals contain the mean
        return np.maximum(middle - half, 0), np.clip(middle + half, least, 1)

    def _stretched(self, name: str, values: np.ndarray, texels: np.ndarray) -> np.ndarray:
        """Return values (..., t, g) moved away from the mean by the factors of ``spread``."""
        if name not in self.spread:
            return values
        mean, sd = self._own_moments(name, texels)
        factor = self._factors(name, mean, sd, texels)
        return np.clip(mean + factor * (values - mean), 0, 1)

    def _ends_of_nodes(self, name: str, level: float, lanes: np.ndarray) -> Pair:
        masses = kernel.node_masses(self.problem, name, lanes)
        low, high = shortest_interval(masses, self.problem.axis(name), len(lanes), level)
        return np.array(low)[:, None], np.array(high)[:, None]

    def _ends_of_color(self, level: float, lanes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        problem = self.problem
        parts = uniform_axis(self.grid.axes["base_color"], COLOR_PARTS)
        tables = kernel.color_masses(problem, parts, lanes)
        ends = [shortest_interval(masses, parts, len(lanes), level, divided=True)
                for masses in tables]  # fmt: skip
        low, high = (np.stack([np.array(end[k]) for end in ends], axis=-1) for k in range(2))
        return np.repeat(low, problem.copies, axis=1), np.repeat(high, problem.copies, axis=1)

    def draws(self, count: int, seed: int, texels: np.ndarray) -> dict[str, np.ndarray]:
        """Sample parameters (see ``Kernel``); draws of a texel do not depend on other texels."""
        problem, lanes, names = self.problem, self.lane[texels], list(self.grid.axes)
        index = to_drjit(mi.UInt32, lanes.astype(np.uint32))
        total = dr.gather(mi.Float, self.summary.total, index)
        drawn = {name: np.empty((count, len(texels), self.channels_of(name)), np.float32)
                 for name in names}  # fmt: skip
        for first in range(0, count, DRAWN_TOGETHER):
            here = slice(first, min(first + DRAWN_TOGETHER, count))
            random = [self._random(seed, first + k, lanes) for k in range(DRAWN_TOGETHER)]
            shared, colors = kernel.draw(
                problem, lanes, total, np.stack(random, axis=1), here.stop - first
            )
            for name, values in zip(names, [*([x] for x in shared), colors], strict=True):
                own = np.stack([np.array(x) for x in values], axis=-1)
                own = own.reshape(-1, len(lanes), len(values))
                drawn[name][here] = self._stretched(name, own, texels)
        return drawn

    def _random(self, seed: int, number: int, lanes: np.ndarray) -> np.ndarray:
        """Return the random numbers of a draw at t lanes, (K, t) float32 (see ``kernel.draw``)."""
        shape = len(self.grid.axes) + 2 * self.channels, self.problem.factors.count
        random = np.random.default_rng((seed, number)).random(shape, np.float32)
        return random[:, lanes]

    def of_tiles(
        self, tiles: Sequence[tuple[kernel.PosteriorSummary, np.ndarray]], texels: np.ndarray
    ) -> "CalibratedKernel":
        """Return a kernel whose moments, noise and entropy are those of the tiles' ``texels``.

        ``tiles`` are summaries and noise.
        """
        summaries, noise = zip(*tiles, strict=True)
        mean, sd = ([dr.concat(list(x)) for x in zip(*rows, strict=True)] for rows in (
            [one.mean for one in summaries], [one.sd for one in summaries]))  # fmt: skip
        entropy = dr.concat([one.entropy for one in summaries])
        summary = replace(self.summary, entropy=entropy, mean=mean, sd=sd)
        factors = replace(self.problem.factors, texel=to_drjit(mi.UInt32, texels.astype(np.uint32)))
        problem = replace(self.problem, factors=factors)
        return replace(self, problem=problem, noise=np.concatenate(noise), summary=summary)

    def widened_like(self, other: "CalibratedKernel", texels: np.ndarray) -> "CalibratedKernel":
        """Return the kernel with the error bars of ``texels`` of another, in the same order."""
        lanes = other.lane[texels]
        return replace(
            self, spread=other.spread, apart={name: x[lanes] for name, x in other.apart.items()},
            support=None if other.support is None else other.support[lanes],
            missing=None if other.missing is None else other.missing[lanes],
        )  # fmt: skip

    def alone(self) -> "CalibratedKernel":
        """Return the kernel of texels by themselves: no common scale, neighbours, missing light."""
        return replace(self, common=(0.0, 0.0, 0.0), apart={}, missing=None)

    def _scale(self, texels: np.ndarray, missing: float) -> np.ndarray:
        """Return the sd of the log scale of base colours, (t, g) or (g,), given that of u."""
        common = np.asarray(self.common, np.float32)
        if self.support is not None:
            common = np.hypot(common, self.support[self.lane[texels]])
        if self.missing is not None:
            common = np.hypot(common, missing * self.missing[self.lane[texels]])
        return common if self.channels > 1 else common.mean(axis=-1, keepdims=True)


def calibrated_posterior(
    statistics: Statistics | Factors,
    grid: PrincipledGrid | None = None,
    scale: float = 1.0,
    preset: str | AngularPreset = "default",
    *,
    prior: Any | None = None,
    copies: int = 1,
    texels: int | None = None,
    light_uncertainty: LightUncertainty | None = None,
    rounding: np.ndarray | None = None,
) -> Posterior[CalibratedKernel]:
    """Compute the posterior with noise estimated from the residual of each texel.

    Args:
        statistics: statistics of S texels at ``roughness_levels``, or factors.
        grid: grid of the bins; default: 8 x 8 x 8.
        scale: radiance unit, such as the mean of the photographs.
        preset: name or options.
        prior: non-negative weights in the grid's shape, or one per roughness node. They replace
            the preset's prior of bins, but not its density within a bin. The default differs from
            equal weights, because the outermost bins are half as wide as the others.
        copies: number of equal colour channels per channel of the statistics.
        texels: number T of texels, seen or not; default: the largest texel number plus one.
        light_uncertainty: uncertainty of the light; an error of its scale affects all base colours.
        rounding: (S,) minimum of the noise variance (``Observed.rounding``), squared radiance.

    Raises:
        OptionError: a preset of another method, or an invalid scale or prior.
        ShapeError: the prior's shape differs from the grid's, or other levels than
            ``roughness_levels``.

    Example:
        >>> observed = estimate.observed
        >>> from svu_mi.reflection.roughness_levels import roughness_levels
        >>> levels = roughness_levels(estimate.preset.levels)
        >>> statistics = observed.statistics(levels, estimate.preset, 3)
        >>> posterior = svu.calibrated_posterior(statistics, scale=observed.unit)
        >>> posterior.mean("base_color").shape == (estimate.texels.count, 3)
        True
    """
    switches = find_preset(preset, method="angular")
    factors = statistics.factor() if isinstance(statistics, Statistics) else statistics
    grid = grid or PrincipledGrid()
    observed = observed_by("calibrated_posterior()", factors, copies, texels)
    problem = problem_of(factors, grid, scale, switches, prior, copies)
    return posterior_of(fit(problem, switches, scale, rounding), grid, observed, light_uncertainty)


def posterior_of(
    fitted: CalibratedFit,
    grid: PrincipledGrid,
    observed: np.ndarray,
    light: LightUncertainty | None,
) -> Posterior[CalibratedKernel]:
    """Return the posterior of texels of which (T,) bool are ``observed``."""
    common = (light or LightUncertainty()).scale
    kernel_of_texels = CalibratedKernel(grid=grid, common=common, **fitted._asdict())
    return Posterior(kernel=kernel_of_texels, observed=observed)
