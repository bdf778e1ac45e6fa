"""Gaussian Markov random field around recovered textures.

Recovered textures x0 maximise the posterior under total variation. With total variation made
quadratic around x0 (``gmrf``), a parameter is a Gaussian Markov random field [Rue and Held 2005]
of precision D + K. D contains the precision of each texel's own posterior; K links neighbours.

This assumes independent errors of texels. Errors of light, poses and reflection model, however, are
correlated over a neighbourhood, and smoothing does not reduce them. Deviations thus have two parts,

    x = x0 + sqrt(rho) c g + sqrt(1 - rho) e,    e ~ N(0, (D + K)^-1),
    c^2 = (A b)^2 + a (S |x0 - m|)^2,    A = (D + K)^-1 D,    S = (d + K)^-1 d.

m and b are mean and standard deviation of a texel's own posterior, and g is a smooth random field
of variance 1. A b is the standard deviation after smoothing if all errors are correlated. The
second term of c^2 averages |x0 - m| over a small neighbourhood (d is constant).

Errors that neighbours share differ between places, and x0 varies with them. Let h be the rms
difference of x0 between a texel and its neighbours, and v what x0 varies over ``REACH``: this
distance times the mean slope, the sum of h over that of the sizes of seen texels. c^2 is reduced to
(f A b)^2 + c^2 v^2 / (c^2 + v^2) at most, where f is the share that the whole object may have in
common. Flat textures have small v.

Pixels and smoothing blur edges of textures: e h^2 is added to the variance, and draws are scaled.

Values x are clipped to [0, 1]; their standard deviations are enlarged to compensate for that.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy

from svu_mi.core.io.array_cache import ArrayCache
from svu_mi.core.io.schema import Field, checked
from svu_mi.core.memory import TILE
from svu_mi.core.progress import Progress
from svu_mi.core.validation import require_known
from svu_mi.errors import OptionError
from svu_mi.geometry.neighbors import Neighbors, neighbors, texel_squares
from svu_mi.geometry.texels import Texels
from svu_mi.parameters import CHANNELS, MIXED, NAMES
from svu_mi.posterior.calibrated import CalibratedKernel
from svu_mi.posterior.estimate import Estimate
from svu_mi.recovery.initialisation import supports_texture_field
from svu_mi.recovery.recover import PRIOR_WEIGHT
from svu_mi.recovery.recovery_options import ShOptions
from svu_mi.recovery.recovery_result import Recovery
from svu_mi.recovery.sh.likelihood import texel_moments
from svu_mi.recovery.svbrdf_textures import Textures, lay_out
from svu_mi.recovery.uncertainty import clipped_normal
from svu_mi.recovery.uncertainty.field_draws import (
    SMALLEST_SD,
    correlation_roots,
    prior_sds,
    smooth_fields,
)
from svu_mi.recovery.uncertainty.gmrf import Nested, Smoother

# Tuned on the example scenes:
# rho, correlated fraction of the variance of a seen texel. Metallic (MIXED) is fully correlated:
# an ambiguity between metal and paint affects a whole neighbourhood.
COMMON, COMMON_MIXED = 0.5, 1.0
DISAGREEMENT, DISAGREEMENT_MIXED = 1.1, 4.0  # a
NARROW = 0.1  # d, relative to the median of K's diagonal
REACH, SHARED = 0.1, 0.4  # distance of v, relative to the object's extent; f
EDGE = 0.2  # e
LENGTH = 0.1  # correlation length of g, relative to the object's extent
INTERVAL_MASS = 0.9
TINY = 1e-9


@dataclass(frozen=True, kw_only=True)
class TextureField:
    """Distribution of textures around the recovered ones.

    Attributes:
        texels: T texels.
        textures: Recovered textures x0.
        names: Recovered parameters; the others have standard deviation 0.
        own_mean: m, (N, T): posterior means of the N values of all parameters, base colour first.
        deviation: b, (N, T): posterior standard deviations.
        seen: (T,) bool, texels that photographs show.
        roots: Function that returns Cholesky factors of each texel's correlations, (T, N, N);
            needed for draws only.
        scale: Standard deviation of the logarithm of a base colour factor that is common to all
            texels, per channel.
        smoother: D + K.
        min_width: Lower limits (N, T) of standard deviations before clipping, used for filled
            texels; or None.
        cache: Results of earlier commands.

    Example:
        >>> field = svu.texture_field(recovery, mesh=capture.mesh)
        >>> low, high = field.interval("roughness")
        >>> low.shape == (texels.count,), bool((low <= high).all())
        (True, True)
        >>> [draw.resolution for draw in field.draw(2)]
        [(64, 64), (64, 64)]
    """

    texels: Texels
    textures: Textures
    names: tuple[str, ...]
    own_mean: np.ndarray
    deviation: np.ndarray
    seen: np.ndarray
    roots: Callable[[], np.ndarray]
    scale: np.ndarray
    smoother: Smoother
    min_width: np.ndarray | None = None
    cache: ArrayCache = ArrayCache()

    def mean(self, name: str) -> np.ndarray:
        """Return means, (T, C) or (T,); clipping shifts them near 0 and 1."""
        rows = self.rows(name)
        return self._laid_out(name, clipped_normal.moments(self.values[rows], self.width[rows])[0])

    def sd(self, name: str) -> np.ndarray:
        """Return standard deviations of a parameter, (T, C) or (T,)."""
        return self._laid_out(name, self.sds[self.rows(name)])

    def interval(self, name: str, level: float = INTERVAL_MASS) -> tuple[np.ndarray, np.ndarray]:
        """Return bounds of the central interval of probability ``level``, (T, C) or (T,).

        Raises:
            OptionError: The parameter is unknown, or ``level`` is not in (0, 1).
        """
        if not 0 < level < 1:
            raise OptionError(f"TextureField.interval(): level must be in (0, 1), got {level}.")
        rows = self.rows(name)
        low, high = clipped_normal.interval(self.values[rows], self.width[rows], level)
        return self._laid_out(name, low), self._laid_out(name, high)

    def to_textures(self, values: np.ndarray) -> Textures:
        """Convert (N, T) values of all parameters to textures."""
        return lay_out(self.texels, {name: values[self.rows(name)].T for name in NAMES})

    def draw(self, count: int, seed: int = 0) -> Iterator[Textures]:
        """Yield ``count`` random textures from the distribution, clipped to [0, 1].

        The first draws of a seed do not depend on ``count``.

        Raises:
            OptionError: ``count`` is negative.
        """
        if count < 0:
            raise OptionError(f"TextureField.draw(): count must be at least 0, got {count}.")
        for number in range(count):
            yield self._sample(np.random.default_rng((seed, number)))

    def _sample(self, random: np.random.Generator) -> Textures:
        length = dr.opaque(mi.Float, 1 / (LENGTH * self.texels.extent))
        smooth = np.array(smooth_fields(len(self.deviation), self.texels.position * length, random))
        forces = random.standard_normal(self.deviation.shape, np.float32)
        wave, force = (np.einsum("tij,jt->it", self.roots(), x) for x in (smooth, forces))
        together = np.sqrt(self.common) * self._coherent_sd * wave
        right = force / self.deviation + self.smoother.sample_links(random)
        away = together + np.sqrt(1 - self.common) * self._nested.solve(right)
        away *= self._unclipped_sd / np.maximum(self._own_sd, TINY)
        values = self.values + away
        values[:3] += values[:3] * self.scale[:, None] * random.standard_normal((3, 1))
        values = np.clip(values, 0, 1)
        drawn = self.to_textures(values)
        return self.textures.but(**{name: drawn[name] for name in self.names})

    @cached_property
    def values(self) -> np.ndarray:
        """Texture values of all parameters, (N, T) float64, base colour first."""
        rows = [self.textures.at(self.texels, name).reshape(self.texels.count, -1).T
                for name in NAMES]  # fmt: skip
        return np.concatenate(rows).astype(np.float64)

    @cached_property
    def _nested(self) -> Nested:
        """Multilevel solver of D + K."""
        return Nested.of(self.smoother, texel_squares(self.texels))

    @cached_property
    def _coherent_sd(self) -> np.ndarray:
        """Correlated standard deviation c, (N, T)."""
        schema = dict.fromkeys(("left", "apart"), Field("f8", self.deviation.shape, 0, np.inf))
        solved = self.cache.recall(
            "field", self._inputs() if self.cache.folder else [], self._solved,
            lambda arrays: arrays, lambda arrays: checked(arrays, schema, closed=True),
        )  # fmt: skip
        left, a = np.square(solved["left"]), _by_row(DISAGREEMENT, DISAGREEMENT_MIXED)
        square = left + a * np.square(solved["apart"])
        steps = np.sqrt(self.smoother.squared_steps[:, self.seen]).sum(axis=1, keepdims=True)
        size = np.maximum(self.texels.footprint.numpy()[self.seen].sum(), TINY)
        varies = np.maximum(REACH * self.texels.extent / size * steps, TINY)
        varies = np.where(self.seen, varies, np.inf)
        limit = SHARED**2 * left + square / (1 + square / np.square(varies))
        return np.sqrt(np.minimum(square, limit))

    def _inputs(self) -> list[Any]:
        """Return everything that the correlated standard deviation depends on."""
        texels, matrix = self.texels, self.smoother
        links = (matrix.strength, matrix.epsilon, matrix.own, matrix.start, matrix.diagonal)
        arrays = [np.array(each) for each in (texels.index, *links, *matrix.around)]
        return [*texels.resolution, *arrays, self.deviation, self.values, self.own_mean]

    def _solved(self) -> dict[str, np.ndarray]:
        """Return A b, and S |x0 - m|, (N, T) each."""
        left = self._nested.solve(1 / self.deviation)
        # Values spread over a few texels only (d is large), so coarser levels are not needed.
        links = np.median(self.smoother.links, axis=1, keepdims=True)
        d = np.broadcast_to(np.maximum(NARROW * links, TINY), self.deviation.shape)
        apart = self.smoother.with_precision(d).solve(d * np.abs(self.values - self.own_mean))
        if self.texels.count > TILE:
            dr.flush_malloc_cache()  # free the temporary memory of the solver
        return {"left": np.maximum(left, 0), "apart": np.maximum(apart, 0)}

    @cached_property
    def sds(self) -> np.ndarray:
        """Standard deviations of ``values``, (N, T), after clipping."""
        return clipped_normal.moments(self.values, self.width)[1]

    @cached_property
    def width(self) -> np.ndarray:
        """Standard deviations of ``values``, (N, T), before clipping."""
        variance = self._unclipped_sd**2 + self._common_sd**2
        for name in NAMES:
            if name not in self.names:
                variance[self.rows(name)] = 0
        return np.sqrt(variance)

    @cached_property
    def _unclipped_sd(self) -> np.ndarray:
        """``width`` without the common scale of base colour."""
        sd = np.sqrt(np.square(self._own_sd) + EDGE * self.smoother.squared_steps)
        width = clipped_normal.width_of(self.values, sd)
        if self.min_width is None:
            return width
        left = np.maximum(self.min_width**2 - self._common_sd**2, 0)
        return np.maximum(width, np.sqrt(left))

    @property
    def _common_sd(self) -> np.ndarray:
        """Standard deviations due to the common scale of base colour, (N, T)."""
        common = np.zeros_like(self.values)
        common[:3] = self.scale[:, None] * self.values[:3]
        return common

    @property
    def common(self) -> np.ndarray:
        """Correlated share rho of the variance, (N, T); 1 for unseen texels."""
        return np.where(self.seen, _by_row(COMMON, COMMON_MIXED), 1.0).astype(np.float32)

    @cached_property
    def _own_sd(self) -> np.ndarray:
        """Standard deviations after clipping, without edges and the common scale, (N, T)."""
        return np.sqrt(self.common * self._coherent_sd**2 + (1 - self.common) * self._variance)

    @property
    def _variance(self) -> np.ndarray:
        """Diagonal of (D + K)^-1, (N, T), as if D and links were constant [Economou 2006]."""
        links = self.smoother.links
        whole = links + self.smoother.precision
        return 2 / np.pi * scipy.special.ellipk(np.square(links / whole)) / whole

    @staticmethod
    def rows(name: str) -> slice:
        """Return the rows of a parameter among the N values.

        Raises:
            OptionError: The parameter is unknown.
        """
        require_known([name], NAMES, "parameter")
        first = sum(CHANNELS[other] for other in NAMES[: NAMES.index(name)])
        return slice(first, first + CHANNELS[name])

    def _laid_out(self, name: str, values: np.ndarray) -> np.ndarray:
        return values.T if CHANNELS[name] > 1 else values[0]


def texture_field(
    recovery: Recovery,
    estimate: Estimate | None = None,
    mesh: Any | None = None,
    *,
    progress: Progress | None = None,
) -> TextureField:
    """Return the distribution of textures around recovered ones.

    Args:
        recovery: Recovered textures.
        estimate: RGB estimate of the texels; default: the one used by the recovery.
        mesh: Mesh of the texels (``capture.mesh``), ignored if the recovery contains neighbours.
            Default: neighbours in the map.
        progress: Display of the stage.

    Raises:
        OptionError: An RGB estimate with noise levels is missing.
        ShapeError: The resolution of the estimate differs from the textures'.

    Example:
        >>> field = svu.texture_field(recovery, mesh=capture.mesh)
        >>> field.sd("base_color").shape == (texels.count, 3)
        True
    """
    estimated = recovery.estimate if estimate is None else estimate
    if estimated is None or not supports_texture_field(estimated):
        raise OptionError(
            "texture_field(): needs an RGB estimate with noise levels; pass "
            "estimate=svu.estimate(capture, texels)."
        )
    recovery.textures.require_resolution(estimated.texels)
    options = tv_weights(recovery.settings)
    with (progress or Progress()).stage("Computing the uncertainty of textures"):
        around = recovery.around or neighbors(recovery.texels, mesh)
        return field_around(
            recovery.textures, estimated, around, recovery.settings["parameters"], options
        )


def tv_weights(settings: Mapping[str, Any]) -> ShOptions:
    """Return the options of total variation in the recorded settings of a recovery.

    Losses other than ``statistics`` get the defaults, because their weights are not in nats.
    """
    used = settings.get("sh", {})
    if used.get("loss") != "statistics":
        return ShOptions()
    return ShOptions(tv=used["tv"], tv_epsilon=used["tv_epsilon"])


def field_of_textures(textures: Textures, estimate: Estimate, mesh: Any) -> TextureField | None:
    """Return the field around textures; None if the estimate's kind or size differs."""
    if not supports_texture_field(estimate) or textures.resolution != estimate.texels.resolution:
        return None
    return field_around(textures, estimate, neighbors(estimate.texels, mesh))


def field_around(
    textures: Textures, estimate: Estimate, around: Neighbors, names: Sequence[str] = NAMES,
    options: ShOptions | None = None,
) -> TextureField:  # fmt: skip
    """Return the field around textures with precomputed neighbours."""
    posterior, texels = estimate.posterior, estimate.texels
    assert isinstance(posterior.kernel, CalibratedKernel)
    options = options or ShOptions()
    values = {name: np.atleast_2d(textures.at(texels, name).T).astype(np.float64)
              for name in NAMES}  # fmt: skip
    x0 = np.concatenate(list(values.values()))
    means, sds = (np.concatenate(list(table.values())) for table in texel_moments(posterior))
    seen, others = posterior.observed, prior_sds(posterior)[:, None]
    deviation = np.maximum(np.where(seen, sds, others), SMALLEST_SD)
    # lambda per pair: total variation is a mean over pairs, in nats per seen texel.
    per_pair = seen.sum() / max(int(dr.width(around.pairs[0])), 1)
    strength = options.tv * np.sqrt(texels.count) * per_pair / (1 + PRIOR_WEIGHT)
    smoother = Smoother.of(
        1 / deviation**2, x0, around.around, strength, max(options.tv_epsilon, SMALLEST_SD)
    )
    return TextureField(
        texels=texels, textures=textures, names=tuple(names),
        own_mean=np.where(seen, means, x0), deviation=deviation, seen=seen, smoother=smoother,
        roots=cache(partial(correlation_roots, posterior, values)),
        scale=np.asarray(posterior.kernel.common),
        cache=ArrayCache() if estimate.observed is None else estimate.observed.cache,
    )  # fmt: skip


def _by_row(value: float, mixed: float) -> np.ndarray:
    """Return ``mixed`` for mixing parameters and ``value`` for others, (N, 1)."""
    return np.concatenate([
        np.full((CHANNELS[name], 1), mixed if name in MIXED else value) for name in NAMES
    ])  # fmt: skip
