"""Posterior from power spectra (Eq. 3, 5 and 11)."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import tensor, to_drjit
from svu_mi.errors import OptionError, ShapeError
from svu_mi.posterior import row_entropy
from svu_mi.posterior import spectrum_kernel as kernel
from svu_mi.posterior.grid import ParameterGrid, PrincipledGrid
from svu_mi.posterior.kernel import GridKernel, Pair, Prior
from svu_mi.posterior.posterior import Posterior
from svu_mi.presets import Preset
from svu_mi.presets import preset as find_preset
from svu_mi.reflection.lobes import mean_albedo
from svu_mi.reflection.principled import alpha_from_roughness, paper_alpha

DARK = 1e-4  # unit of power if all observations are black, relative to the incident power


@dataclass(frozen=True)
class SpectrumKernel(GridKernel):
    """Posterior from power spectra on a ``ParameterGrid`` or ``PrincipledGrid``."""

    grid: ParameterGrid | PrincipledGrid
    count: int
    problem: kernel.SpectrumProblem

    @property
    def channels(self) -> int:
        """Number of base colours or Ks per texel: 3, or 1 for grey."""
        return len(self.problem.groups)

    @cached_property
    def prior(self) -> Prior:
        """Prior, equal for all channels."""
        return Prior(row_entropy.prior_table(self.problem.prior, self.grid.shape), self.grid.axes)

    def entropy(self, texels: np.ndarray) -> np.ndarray:
        """Return the normalised entropy (see ``Kernel``)."""
        return self._entropies[texels]

    def tables(self, texels: np.ndarray) -> Pair:
        """Return bin probabilities and the most probable nodes (see ``GridKernel``)."""
        base, offsets = kernel.energy_tables(self.problem, texels)
        return row_entropy.probabilities(base, offsets, self.grid.shape)

    @cached_property
    def _entropies(self) -> np.ndarray:
        return np.array(kernel.entropy(self.problem, self.count))


def spectrum_posterior(
    incoming: Any,
    outgoing: Any,
    grid: ParameterGrid | PrincipledGrid | None = None,
    sigma: float | None = None,
    preset: str | Preset = "default",
    *,
    prefilter: float = 0.0,
    prior: Any | None = None,
    observed: Any | None = None,
    scale: float | None = None,
    irradiance: Any | None = None,
    copies: int = 1,
) -> Posterior[SpectrumKernel]:
    """Compute the posterior on a grid from power spectra.

        d = sum_{l=1}^{l*} (S_B(l) - Ks^2 exp(-2 (alpha l)^2) S_L(l))^2        (Eq. 11)
        p ~ exp(-d / (2 sigma^2)) prior                                        (Eq. 3, 4)

    A grid over (roughness, metallic, base colour) requires the irradiance E. Ks and Kd follow from
    these parameters, and degree 0 adds the term

        (sqrt(S_B(0)) - 2 Kd E / sqrt(pi) - Ks sqrt(S_L(0)))^2 / (2 sigma_0^2).       (Eq. 7)

    Args:
        incoming: (T, l* + 1, C) power spectra S_L of the light, in squared radiance.
        outgoing: (T, l* + 1, C) power spectra S_B of the observations.
        grid: ``ParameterGrid`` or ``PrincipledGrid``; default: a ``PrincipledGrid`` if the preset's
            parameters are principled and the irradiance is given.
        sigma: standard deviation of the power of a degree, in the unit of the preset's ``noise``;
            default: the preset's.
        preset: name or options; ``paper`` is Eq. 3, 5, 11 as printed with alpha = roughness^2.
        prefilter: band limit alpha' of the light. Only used with the preset's ``undo_prefilter``:
            the exponent is then max(alpha^2 - alpha'^2, 0).
        prior: non-negative weights in the grid's shape, or one per roughness node.
        observed: (T,) bool, mask of seen texels; default: all.
        scale: unit of power of a relative sigma; default: the mean of sum_l S_B(l) over seen
            texels and channels. Required if the texels are only a part of the capture's.
        irradiance: (T, C) irradiance E; required for a ``PrincipledGrid``.
        copies: number of equal colour channels per given channel.

    Raises:
        ShapeError: arrays with inconsistent shapes.
        OptionError: an invalid sigma or prior, negative or non-finite spectra, or a grid that
            requires the irradiance without one.

    Example:
        >>> power = np.ones((5, 7, 3))  # texels, degrees 0 to 6, channels
        >>> posterior = svu.spectrum_posterior(power, 0.1 * power, svu.ParameterGrid(16, 16))
        >>> posterior.probabilities.shape
        (5, 16, 16, 3)
    """
    switches = find_preset(preset, method="spectrum")
    if sigma is not None:
        switches = replace(switches, sigma=float(sigma))
    grid = spectrum_grid(grid, switches, irradiance=irradiance is not None)
    S_L, S_B = _spectra(incoming, outgoing)
    seen = _seen(observed, S_L.shape[0])
    tables = row_entropy.log_prior(prior, grid.shape, "spectrum_posterior()")
    unit = _unit(switches, S_L, S_B, seen, scale)
    constant = _constant(switches, grid, irradiance, S_L.shape[::2], unit)
    falloff = decay(switches, grid, prefilter)
    problem = _problem(S_L, S_B, grid, switches, copies, falloff, unit, tables)
    problem = replace(problem, constant=constant)
    return Posterior(kernel=SpectrumKernel(grid, len(seen), problem), observed=seen)


def _problem(
    S_L: Any, S_B: Any, grid: ParameterGrid | PrincipledGrid, switches: Preset, copies: int,
    falloff: np.ndarray, unit: float, tables: tuple[np.ndarray, np.ndarray] | None,
) -> kernel.SpectrumProblem:  # fmt: skip
    """Return the inputs of the energy, without the term of degree 0."""
    _, degrees, channels = S_L.shape
    every = tuple(range(channels)) * copies
    *_, bins = grid.axes.values()
    return kernel.SpectrumProblem(
        incoming=S_L.array,
        outgoing=S_B.array,
        sigma=dr.opaque(mi.Float64, switches.sigma * unit),
        degree=degrees - 1,
        channels=channels,
        groups=(every,) if switches.channels == "sum" else tuple((c,) for c in every),
        rows=row_entropy.possible_rows(tables, int(np.prod(grid.shape[:-1]))),
        total=int(np.prod(grid.shape)),
        decay=to_drjit(mi.Float64, falloff),
        albedo=to_drjit(mi.Float64, np.square(_albedo(switches, grid))),
        bins=bins,
        prior=None if tables is None else tuple(to_drjit(mi.Float64, t) for t in tables),
    )


def _seen(observed: Any | None, count: int) -> np.ndarray:
    """Return the mask of seen texels, (count,) bool; default: all."""
    seen = np.ones(count, bool) if observed is None else np.array(observed, bool).ravel()
    if len(seen) != count:
        raise ShapeError(
            f"spectrum_posterior(): observed has {len(seen)} values for {count} texels."
        )
    return seen


def _spectra(incoming: Any, outgoing: Any) -> tuple[Any, Any]:
    S_L, S_B = _spectrum("incoming", incoming), _spectrum("outgoing", outgoing)
    if S_L.shape != S_B.shape:
        raise ShapeError(
            f"spectrum_posterior(): incoming is {S_L.shape} but outgoing is {S_B.shape}."
        )
    return S_L, S_B


def _spectrum(name: str, values: Any) -> Any:
    """Return a checked spectrum as an evaluated TensorXf."""
    axes = ("texels", "l* + 1", "channels")
    spectrum = tensor(values, "spectrum_posterior()", name, axes, copy=True)
    if spectrum.shape[1] < 2 or spectrum.shape[2] < 1:
        raise ShapeError(
            f"spectrum_posterior(): {name} needs a degree l* >= 1 and a channel, got shape "
            f"{tuple(spectrum.shape)}."
        )
    if spectrum.shape[0] and not dr.all((spectrum.array >= 0) & dr.isfinite(spectrum.array)):
        bad = np.array(spectrum)
        texel = int(np.argwhere(~(np.isfinite(bad) & (bad >= 0)))[0][0])
        raise OptionError(
            f"spectrum_posterior(): the {name} spectrum of texel {texel} is negative or not finite."
        )
    return spectrum


def spectrum_grid(
    grid: Any | None, switches: Preset, *, irradiance: bool = True
) -> ParameterGrid | PrincipledGrid:
    """Return ``grid`` or the preset's; a ``PrincipledGrid`` requires irradiance."""
    if grid is None:
        grid = PrincipledGrid() if irradiance and switches.principled else ParameterGrid()
    if isinstance(grid, ParameterGrid):
        return grid.resolved(switches)
    if not irradiance:
        raise OptionError(
            "spectrum_posterior(): a PrincipledGrid needs the irradiance; pass it, or use a "
            "ParameterGrid."
        )
    if switches.channels == "sum":
        raise OptionError(
            "channels='sum' does not work with a PrincipledGrid; use a ParameterGrid, or "
            "channels='grey'."
        )
    return grid


def _albedo(switches: Preset, grid: ParameterGrid | PrincipledGrid) -> np.ndarray:
    """Return the mean albedo of lobes with R0 = 1, (R,); 1 if Ks is a parameter."""
    if not switches.albedo or isinstance(grid, ParameterGrid):
        return np.ones(grid.shape[0])
    return mean_albedo(alpha_from_roughness(grid.roughness_nodes))


def decay(switches: Preset, grid: ParameterGrid | PrincipledGrid, prefilter: float) -> np.ndarray:
    """Return q = exp(-2 alpha^2), (R,); degree l is scaled by q^(l^2) (Eq. 11)."""
    of_roughness = alpha_from_roughness if switches.bounded_alpha else paper_alpha
    width = of_roughness(grid.roughness_nodes) ** 2
    if switches.undo_prefilter:
        width = np.maximum(width - prefilter**2, 0)
    return np.exp(-2 * width)


def _constant(
    switches: Preset,
    grid: ParameterGrid | PrincipledGrid,
    irradiance: Any | None,
    shape: tuple[int, int],
    unit: float,
) -> kernel.ConstantTerm | None:
    if not isinstance(grid, PrincipledGrid):
        return None
    known = tensor(irradiance, "spectrum_posterior()", "irradiance", shape, copy=True)
    if not dr.all((known.array >= 0) & dr.isfinite(known.array)):
        raise OptionError("spectrum_posterior(): the irradiance is negative or not finite.")
    sigma = switches.constant_sigma * (1.0 if switches.noise == "fixed" else unit**0.5)
    return kernel.ConstantTerm(
        mixed=grid.mixed_nodes,
        irradiance=known.array,
        albedo=to_drjit(mi.Float64, _albedo(switches, grid)),
        sigma=dr.opaque(mi.Float64, sigma),
    )


def _unit(switches: Preset, S_L: Any, S_B: Any, seen: np.ndarray, scale: float | None) -> float:
    """Return the unit of sigma, a power that is equal for all texels."""
    if switches.noise == "fixed":
        return 1.0
    if scale is None:
        scale = _mean_power(S_B, seen) or DARK * _mean_power(S_L, seen)
    elif not (np.isfinite(scale) and scale > 0):
        raise OptionError(f"spectrum_posterior(): scale must be positive, got {scale!r}.")
    # Without light or reflection the posterior is uniform with any unit.
    return scale or 1.0


def _mean_power(spectrum: Any, seen: np.ndarray) -> float:
    """Return the mean over seen texels and channels of sum_l S(l)."""
    if not seen.any():
        return 0.0
    values = spectrum.numpy()[seen].astype(np.float64)
    return float(values.sum(axis=1).mean())
