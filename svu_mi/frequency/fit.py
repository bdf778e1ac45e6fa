"""Regularised spherical harmonic fit of scattered samples, one system per lane (Eq. 12).

    (Y^T W^2 Y + lambda R) c = Y^T W^2 f,    R = diag(e^l),    W = diag(w)

The paper penalises l = 0 as well (R_00 = 1), which leaks a constant signal into l > 0;
``penalize_constant=False`` leaves it free (R_00 = 0). Two equivalent ways to solve it:

* ``primal``: the (degree + 1)^2 normal equations. Any number of views, no memory for samples.
* ``dual``: one equation per *visible* view, M a = W f with M = W K W + I,
  K_ij = k(d_i . d_j), k the zonal kernel of (lambda R)^-1, and c = (lambda R)^-1 Y^T W a.
  With R_00 = 0 the constant is an extra unknown: with u = W Y_00,
  c_00 = u^T M^-1 W f / u^T M^-1 u and a = M^-1 (W f - u c_00).

Both are computed in double precision inside the kernel: lambda is a millionth of the trace of
Y^T W^2 Y for a few hundred views, and single precision then loses a degree altogether.
"""

from __future__ import annotations

from typing import Any, Literal

import drjit as dr
import mitsuba as mi

from svu_mi.frequency import harmonics
from svu_mi.frequency.dual import fit_dual
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
            Local memory is about 4 capacity^2 bytes per lane.

    Returns:
        (degree + 1)^2 coefficients in the order l*l + l + m, each a list of ``channels``
        Floats; 0 in a lane that sees no view.
    """
    system = System(
        degree=harmonics.check_degree(degree, "fit_lanes()"),
        channels=channels,
        ridge=harmonics.ridge(degree, penalize_constant),
        regularizer=dr.opaque(mi.Float64, regularizer),
    )
    if method == "dual":
        return fit_dual(sample, views, system, capacity)
    return fit_primal(sample, views, system)
