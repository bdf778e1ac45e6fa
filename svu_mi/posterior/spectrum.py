"""The posterior from power spectra (Eq. 3, 5 and 11)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.brdf.principled import alpha_from_roughness, unbounded_alpha
from svu_mi.errors import OptionError, ShapeError
from svu_mi.frequency import arrays
from svu_mi.interop import owned
from svu_mi.options import Preset
from svu_mi.options import preset as find_preset
from svu_mi.posterior import spectrum_kernel as kernel
from svu_mi.posterior import streaming
from svu_mi.posterior.grid import ParameterGrid
from svu_mi.posterior.record import Posterior

DARK = 1e-4  # part of the incident power that counts when nothing at all is reflected
FITTED = 2  # parameters per texel and channel that the marginal noise rule pays for


@dataclass(frozen=True, kw_only=True)
class SpectrumPosterior(Posterior):
    """p over (roughness, specular), from power spectra.

    Attributes:
        problem: spectra, noise and grid tables (see ``spectrum_kernel``).
    """

    problem: kernel.Problem

    @property
    def groups(self) -> int:
        """Number of Ks per texel: 3 when each colour channel has its own, else 1."""
        return len(self.problem.groups)

    def _entropy_of_all(self) -> Any:
        return kernel.entropy(self.problem, self.count)

    def _tables(self, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        base, offsets = kernel.tables(self.problem, chosen)
        return streaming.probabilities(base, offsets, self.grid.shape)


def spectrum_posterior(
    incoming: Any,
    outgoing: Any,
    grid: ParameterGrid | None = None,
    sigma: float | None = None,
    preset: str | Preset = "default",
    *,
    prefilter: float = 0.0,
    prior: Any | None = None,
    observed: Any | None = None,
    samples: Any | None = None,
    scale: float | None = None,
) -> SpectrumPosterior:
    """Compare observed spectra with those of every (roughness, Ks) of a grid.

        d = sum_{l=1}^{l*} (S_B(l) - Ks^2 exp(-2 (alpha l)^2) S_L(l))^2        (Eq. 11)
        p ~ exp(-d / (2 sigma^2)) prior                                        (Eq. 3, 4)

    Args:
        incoming: (T, l* + 1, C) power spectra S_L of the light, in squared radiance.
        outgoing: (T, l* + 1, C) power spectra S_B of the observations.
        grid: parameter grid, 8 x 8 by default.
        sigma: standard deviation of a degree's power, in the unit of the preset's noise rule;
            the preset's own by default.
        preset: switches; ``paper`` is Eq. 3, 5, 11 as printed with alpha = roughness^2.
        prefilter: alpha' that the light was band-limited with; used if the preset undoes it:
            the exponent is then max(alpha^2 - alpha'^2, 0).
        prior: (R, S) or (R,) non-negative weights of the cells, any scale.
        observed: (T,) bool, False for texels nobody saw; all by default.
        samples: (T,) number of views that see each texel; needed by the marginal noise rule.
        scale: power that a relative sigma is a part of; by default the mean over the observed
            texels and channels of sum_l S_B(l). Give it when these texels are only some of a
            capture's.

    Raises:
        ShapeError: arrays that do not fit each other.
        OptionError: an invalid sigma or prior, or negative or non-finite spectra.
    """
    switches = find_preset(preset)
    if sigma is not None:
        switches = replace(switches, sigma=float(sigma))
    grid = (grid or ParameterGrid()).resolved(switches)
    S_L, S_B = _spectrum("incoming", incoming), _spectrum("outgoing", outgoing)
    if S_L.shape != S_B.shape:
        raise ShapeError(
            f"spectrum_posterior(): incoming is {S_L.shape} but outgoing is {S_B.shape}."
        )
    count, degrees, channels = S_L.shape
    seen = np.ones(count, bool) if observed is None else np.array(observed, bool).ravel()
    if len(seen) != count:
        raise ShapeError(f"spectrum_posterior(): {len(seen)} flags for {count} texels.")
    tables = streaming.log_prior(prior, grid.shape, "spectrum_posterior()")
    problem = kernel.Problem(
        incoming=S_L.array,
        outgoing=S_B.array,
        sigma=dr.opaque(mi.Float64, _sigma(switches, S_L, S_B, seen, scale)),
        power=_power(switches, samples, count),
        degree=degrees - 1,
        channels=channels,
        groups=_groups(switches, channels),
        decay=mi.Float64(_decay(switches, grid, degrees - 1, prefilter).ravel()),
        specular=grid.specular_nodes,
        prior=None if tables is None else (mi.Float64(tables[0]), mi.Float64(tables[1])),
    )
    posterior = SpectrumPosterior(grid=grid, observed=seen, problem=problem)
    return _most_certain_channel(posterior) if switches.channels == "minimum" else posterior


def _spectrum(name: str, values: Any) -> Any:
    """Check a spectrum and return it as an evaluated TensorXf."""
    axes = ("texels", "l* + 1", "channels")
    tensor = arrays.tensor(values, "spectrum_posterior()", name, axes, copy=True)
    if tensor.shape[1] < 2 or tensor.shape[2] < 1:
        raise ShapeError(
            f"spectrum_posterior(): {name} needs l* >= 1 and a channel, got shape "
            f"{tuple(tensor.shape)}."
        )
    if tensor.shape[0] and not dr.all((tensor.array >= 0) & dr.isfinite(tensor.array)):
        bad = np.array(tensor)
        texel = int(np.argwhere(~(np.isfinite(bad) & (bad >= 0)))[0][0])
        raise OptionError(
            f"spectrum_posterior(): the {name} spectrum of texel {texel} is negative or not finite."
        )
    return tensor


def _groups(switches: Preset, channels: int) -> tuple[tuple[int, ...], ...]:
    if switches.channels == "sum":
        return (tuple(range(channels)),)
    return tuple((channel,) for channel in range(channels))


def _decay(switches: Preset, grid: ParameterGrid, degree: int, prefilter: float) -> np.ndarray:
    """(R, l*) factors exp(-2 (alpha l)^2) of each roughness, l = 1 ... l* (Eq. 11)."""
    of_roughness = alpha_from_roughness if switches.bounded_alpha else unbounded_alpha
    alpha = of_roughness(grid.roughness_nodes)
    width = alpha**2
    if switches.undo_prefilter:
        width = np.maximum(width - prefilter**2, 0)
    l = np.arange(1, degree + 1)
    return np.exp(-2 * width[:, None] * l**2)


def _sigma(switches: Preset, S_L: Any, S_B: Any, seen: np.ndarray, scale: float | None) -> float:
    """Standard deviation of a degree's power, one number for the capture.

    Noise and the model's error come with the photographs, not with the texel: relative to
    each texel's own power, a dark texel would seem as well measured as a bright one.
    """
    if switches.noise == "fixed":
        return switches.sigma
    if scale is None:
        scale = _mean_power(S_B, seen) or DARK * _mean_power(S_L, seen)
    elif not (np.isfinite(scale) and scale > 0):
        raise OptionError(f"spectrum_posterior(): scale must be positive, got {scale!r}.")
    # Neither light nor reflection: any positive number leaves the posterior uniform.
    return switches.sigma * (scale or 1.0)


def _mean_power(spectrum: Any, seen: np.ndarray) -> float:
    """Mean over observed texels and channels of sum_l S(l)."""
    if not seen.any():
        return 0.0
    values = spectrum.numpy()[seen].astype(np.float64)
    return float(values.sum(axis=1).mean())


def _power(switches: Preset, samples: Any | None, count: int) -> Any | None:
    """nu / 2 of the marginal noise rule p ~ d^(-nu/2), or None."""
    if switches.noise != "marginal":
        return None
    if samples is None:
        raise OptionError(
            "spectrum_posterior(): the marginal noise rule needs samples, the number of views "
            "that see each texel."
        )
    seen = np.array(samples, np.float64).ravel()
    if len(seen) != count:
        raise ShapeError(f"spectrum_posterior(): {len(seen)} sample counts for {count} texels.")
    return owned(mi.Float64, np.maximum(seen - FITTED, 1) / 2)


def _most_certain_channel(posterior: SpectrumPosterior) -> SpectrumPosterior:
    """Keep, per texel, the channel with the smallest entropy (the published code's rule)."""
    problem, count = posterior.problem, posterior.count
    single = [replace(problem, groups=(group,)) for group in problem.groups]
    if count == 0:
        return replace(posterior, problem=single[0])
    best = mi.UInt32(0)
    lowest = dr.full(mi.Float, 2, count)
    for channel, alone in enumerate(single):
        value = kernel.entropy(alone, count)
        lower = value < lowest
        best = dr.select(lower, channel, best)
        lowest = dr.minimum(value, lowest)
    size = problem.degree + 1
    lane = dr.arange(mi.UInt32, count * size)
    index = lane * problem.channels + dr.gather(mi.UInt32, best, lane // size)
    chosen = replace(
        problem,
        incoming=dr.gather(mi.Float, problem.incoming, index),
        outgoing=dr.gather(mi.Float, problem.outgoing, index),
        channels=1,
        groups=((0,),),
    )
    dr.eval(chosen.incoming, chosen.outgoing)
    return replace(posterior, problem=chosen)
