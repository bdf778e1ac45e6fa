"""Regularised spherical harmonic fit of scattered samples (Eq. 12).

    (Y^T W^2 Y + lambda R) c = Y^T W^2 f,    R = diag(e^l),    W = diag(w)

The paper penalises l = 0 (R_00 = 1), which leaks a constant into l > 0; R_00 = 0 does not. Two
equivalent solvers: (degree + 1)^2 normal equations (``solve_primal``), or one equation per visible
view (``solve_dual``; a quarter of the time for 24 of 60 views). Both use double precision.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.core.arrays import tensor, to_drjit
from svu_mi.core.local_memory import scatter_rows
from svu_mi.errors import OptionError
from svu_mi.frequency import harmonics
from svu_mi.frequency.harmonics import FitSystem, ReadSample
from svu_mi.frequency.solve_dual import fit_dual
from svu_mi.frequency.solve_primal import fit_primal
from svu_mi.presets import Preset
from svu_mi.presets import preset as named_preset

CAPACITIES = (32, 64, 128, 256)
"""Sizes of the dual's local memory, in views. A call uses one size for all texels: each size takes
a second to compile, but a lane only reads and writes the part that its own views need."""

AUTO_CAPACITY = 128
"""Maximum number of views in the dual with ``auto``: 64 kB per lane, 1 MB of stack for 16 lanes."""

VIEWS_PER_COEFFICIENT = 2.5
"""Maximum number of visible views per coefficient in the dual with ``auto`` (measured at degree 6:
0.44, 0.59 and 0.82 of the primal's time at 80, 98 and 128 visible views)."""


def fit_lanes(sample: ReadSample, views: Any, system: FitSystem, capacity: int) -> list[list[Any]]:
    """Fit Eq. 12 in each lane; return (degree + 1)^2 coefficients of C Floats.

    ``sample(view)`` returns unit direction, weight w (0: unseen) and values. Coefficient (l, m) is
    at l*l + l + m; it is 0 in lanes without views. ``capacity`` is the maximum number of visible
    views in the dual solver, which needs about 4 capacity^2 bytes per lane; 0: primal solver.
    """
    if capacity:
        return fit_dual(sample, views, system, capacity)
    return fit_primal(sample, views, system)


@dataclass(frozen=True)
class SolverGroup:
    """Texels of one call of ``fit_lanes``.

    Attributes:
        selection: UInt32, indices of the texels, ascending.
        capacity: maximum number of views in the dual solver; 0 for the primal solver.
    """

    selection: Any
    capacity: int


def solver_groups(visible: Any, degree: int, method: str = "auto") -> list[SolverGroup]:
    """Group texels by their fastest solver, or use only the ``primal`` or ``dual`` solver."""
    counts = np.asarray(visible).reshape(-1)
    limits = {
        "auto": min(int(VIEWS_PER_COEFFICIENT * (degree + 1) ** 2), AUTO_CAPACITY),
        "primal": 0,
        "dual": CAPACITIES[-1],
    }
    if method not in limits:
        raise OptionError(f"The method of a fit must be auto, primal or dual, got {method!r}.")
    if method == "dual" and counts.max(initial=0) > CAPACITIES[-1]:
        raise OptionError(
            f"Texel {int(counts.argmax())} has {counts.max()} views; the dual solver is limited to "
            f'{CAPACITIES[-1]}. Use method="auto" or "primal".'
        )
    few = (counts > 0) & (counts <= limits[method])
    held = int(counts[few].max(initial=0))
    parts = (few, next(size for size in CAPACITIES if size >= held)), (counts > limits[method], 0)
    return [
        SolverGroup(to_drjit(mi.UInt32, np.flatnonzero(chosen).astype(np.uint32)), capacity)
        for chosen, capacity in parts if chosen.any()
    ]  # fmt: skip


UNIT_TOLERANCE = 1e-3
"""Maximum deviation of the length of a direction from 1; the fit normalises directions."""


@dataclass(frozen=True)
class _Samples:
    """Flat input arrays on the device, ordered by texel, then view, then component."""

    directions: Any
    weights: Any
    values: Any
    views: Any  # opaque
    channels: int

    def at(self, texel: Any, view: Any) -> tuple[Any, Any, list[Any]]:
        """Read one sample per lane; direction and values only where the weight is positive."""
        index = texel * self.views + view
        weight = dr.gather(mi.Float, self.weights, index)
        seen = weight > 0
        xyz = [dr.gather(mi.Float, self.directions, index * 3 + k, seen) for k in range(3)]
        values = [
            dr.gather(mi.Float, self.values, index * self.channels + c, seen)
            for c in range(self.channels)
        ]
        return mi.Vector3f(*xyz), weight, values


def fit_sh(
    directions: Any,
    weights: Any,
    values: Any,
    lmax: int = 6,
    regularizer: float = 1e-3,
    preset: str | Preset = "default",
    method: Literal["auto", "primal", "dual"] = "auto",
) -> Any:
    """Fit spherical harmonics to the samples of every texel (Eq. 12).

        (Y^T W^2 Y + lambda R) c = Y^T W^2 f,    R = diag(e^l),    W = diag(w)

    Inputs and outputs are in single, computations in double precision. Errors of the power spectrum
    are below 1e-6 of the largest degree for 1 to 200 views and lmax 1 to 9, also if all views are
    grazing, equal or collinear.

    Args:
        directions: (T, V, 3) unit directions of V views from T texels, in any frame.
        weights: (T, V) diagonals of W, >= 0; 0: the view does not show the texel, and its
            direction and value are ignored (NaN is permitted).
        values: (T, V, C) samples f, radiance in any unit.
        lmax: highest degree, in [0, 9].
        regularizer: lambda, in [1e-12, 1e12].
        preset: preset that defines R_00: 1 in ``paper``, 0 (constant unpenalised) in ``default``.
        method: ``primal`` (normal equations), ``dual`` (one unknown per visible view, at most 256
            views) or ``auto``: the faster of both for each texel. Results agree to rounding.

    Returns:
        (T, (lmax + 1)^2, C) coefficients in the order l*l + l + m; 0 for texels without views.

    Raises:
        ShapeError: arrays with inconsistent shapes.
        OptionError: an option outside its range, a negative or infinite weight, a visible sample
            that is not finite, or a direction that is not of unit length.

    Example:
        >>> directions = np.random.default_rng(0).normal(size=(2, 20, 3))  # 2 texels, 20 views
        >>> directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        >>> svu.fit_sh(directions, np.ones((2, 20)), np.ones((2, 20, 3)), lmax=6).shape
        (2, 49, 3)
    """
    if not 0 <= lmax <= harmonics.MAX_DEGREE:
        raise OptionError(f"fit_sh(): lmax must be in [0, {harmonics.MAX_DEGREE}], got {lmax}.")
    if not 1e-12 <= regularizer <= 1e12:
        raise OptionError(
            f"fit_sh(): regularizer must be a number in [1e-12, 1e12], got {regularizer!r}."
        )
    penalize_constant = named_preset(preset, method="spectrum").penalize_constant
    weight_tensor = tensor(weights, "fit_sh()", "weights", ("T", "V"))
    texels, views = weight_tensor.shape
    direction_tensor = tensor(directions, "fit_sh()", "directions", (texels, views, 3))
    value_tensor = tensor(values, "fit_sh()", "values", (texels, views, "C"))
    channels = value_tensor.shape[2]
    shape = (texels, (lmax + 1) ** 2, channels)
    _check_size(texels * views * max(channels, 3), texels * shape[1] * channels)
    if texels * views * channels == 0:
        return dr.zeros(mi.TensorXf, shape)

    flat = (direction_tensor.array, weight_tensor.array, value_tensor.array)
    samples = _Samples(*flat, dr.opaque(mi.UInt32, views), channels)
    groups = solver_groups(_inspect(samples, texels, views), lmax, method)
    system = FitSystem.of(lmax, channels, float(regularizer), penalize_constant)
    return mi.TensorXf(_fitted(samples, system, groups, texels), shape)


def _fitted(samples: _Samples, system: FitSystem, groups: list[SolverGroup], texels: int) -> Any:
    """Return the coefficients of all texels as a flat array, ordered by texel."""
    coefficients = dr.zeros(mi.Float, texels * (system.degree + 1) ** 2 * samples.channels)
    dr.eval(coefficients)
    for group in groups:
        sample = partial(samples.at, group.selection)
        fitted = fit_lanes(sample, samples.views, system, group.capacity)
        dr.eval(scatter_rows(coefficients, fitted, group.selection))
    return coefficients


def _check_size(*counts: int) -> None:
    if max(counts) >= 2**32:
        raise OptionError(
            f"fit_sh(): an array of {max(counts)} numbers exceeds 32-bit indices; call it on "
            "blocks of texels."
        )


def _inspect(samples: _Samples, texels: int, views: int) -> np.ndarray:
    """Return each texel's number of visible views; raise an error if a sample is invalid."""
    visible, first_bad = _count_visible(samples.at, dr.arange(mi.UInt32, texels), samples.views)
    dr.eval(visible, first_bad)
    bad = first_bad.numpy()
    if (bad < views).any():
        texel = int(np.flatnonzero(bad < views)[0])
        view = int(bad[texel])
        direction, weight, values = samples.at(mi.UInt32(texel), mi.UInt32(view))
        raise OptionError(
            f"fit_sh(): texel {texel}, view {view} is invalid: weight {weight[0]:g}, direction "
            f"({', '.join(f'{x[0]:g}' for x in direction)}), values "
            f"({', '.join(f'{v[0]:g}' for v in values)}). Weights must be finite and >= 0 and, "
            "where they are > 0, directions of unit length and values finite."
        )
    return visible.numpy().astype(np.int64)


@dr.syntax
def _count_visible(at: Any, texel: Any, views: Any) -> tuple[Any, Any]:
    """Return the number of visible views, and the index of the first invalid one (or ``views``)."""
    visible, first_bad = mi.UInt32(0), mi.UInt32(views)
    view = mi.UInt32(0)
    while view < views:
        direction, weight, values = at(texel, view)
        # NaN fails every comparison.
        usable = (weight == 0) | (
            (weight > 0)
            & dr.isfinite(weight)
            & (dr.abs(dr.norm(direction) - 1) < UNIT_TOLERANCE)
            & dr.isfinite(sum(dr.abs(value) for value in values))
        )
        first_bad = dr.select(usable, first_bad, dr.minimum(first_bad, view))
        visible += dr.select(weight > 0, mi.UInt32(1), mi.UInt32(0))
        view += 1
    return visible, first_bad
