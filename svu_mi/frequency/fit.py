"""Regularised spherical harmonic fit of scattered samples, one system per lane (Eq. 12).

    (Y^T W^2 Y + lambda R) c = Y^T W^2 f,    R = diag(e^l),    W = diag(w)

The paper penalises l = 0 as well (R_00 = 1), which leaks a constant signal into l > 0;
``penalize_constant=False`` leaves it free (R_00 = 0). Two equivalent ways to solve it:

* ``primal``: the (degree + 1)^2 normal equations. Any number of views, no memory for samples.
* ``dual``: one equation per *visible* view, M a = W f with M = W K W + I,
  K_ij = k(d_i . d_j), k the zonal kernel of (lambda R)^-1, and c = (lambda R)^-1 Y^T W a.
  With R_00 = 0 the constant is an extra unknown: with u = W Y_00,
  c_00 = u^T M^-1 W f / u^T M^-1 u and a = M^-1 (W f - u c_00).

Lambda is a millionth of the trace of Y^T W^2 Y for a few hundred views, where single precision
loses a degree altogether: see ``precision`` for when it will do.
"""

from __future__ import annotations

from typing import Any, Literal

import drjit as dr
import mitsuba as mi

from svu_mi.frequency import harmonics
from svu_mi.frequency.dual import fit_dual
from svu_mi.frequency.precision import Precision, choose
from svu_mi.frequency.primal import fit_primal
from svu_mi.frequency.system import Sample, System

Method = Literal["primal", "dual"]


def fit_lanes(
    sample: Sample,
    views: Any,
    *,
    degree: int,
    channels: int,
    regularizer: float,
    penalize_constant: bool,
    method: Method,
    capacity: int,
    weights: tuple[float, float] = (1e-6, 1.0),
    precision: Precision | None = None,
) -> list[list[Any]]:
    """Fit Eq. 12 in every lane, inside the kernel that produces the samples.

    Args:
        sample: called once, while the loop over views is traced, with a UInt32 view index;
            returns the unit direction (Vector3f), the weight w of ``W = diag(w)`` (Float, 0
            where the lane does not see the view) and the values (``channels`` Floats). What
            it returns for a weight of 0 is not used.
        views: number of views, an opaque UInt32.
        degree: l*, in [0, 9].
        channels: number of right-hand sides; they share one factorisation.
        regularizer: lambda > 0.
        penalize_constant: R_00 = 1 as printed (True) or 0 (False).
        method: ``primal`` or ``dual``, the same to rounding. Dual is cheaper when a lane sees
            fewer views than there are coefficients.
        capacity: ``dual`` only: the most visible views a lane can hold; more are dropped.
            Local memory is about 2 capacity^2 bytes per lane, 4 in double precision.
        weights: the smallest and the largest w > 0 there may be; decides on the precision only.
        precision: ``dual`` only: what to compute in. None: the fastest that keeps the power
            spectrum within 1e-4 of the largest degree, by ``precision.choose``.

    Returns:
        (degree + 1)^2 coefficients in the order l*l + l + m, each a list of ``channels``
        Floats; 0 in a lane that sees no view.
    """
    degree = harmonics.check_degree(degree, "fit_lanes()")
    if method == "primal":
        precision = "double"
    elif precision is None:
        precision = choose(capacity, degree, regularizer, penalize_constant, weights)
    system = System(
        degree=degree,
        channels=channels,
        ridge=harmonics.ridge(degree, penalize_constant),
        regularizer=dr.opaque(mi.Float if precision == "single" else mi.Float64, regularizer),
        precision=precision,
    )
    if method == "dual":
        return fit_dual(sample, views, system, capacity)
    return fit_primal(sample, views, system)
