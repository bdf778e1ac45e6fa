"""From samples to spectra: spherical harmonic fit (Eq. 12) and power spectrum (Eq. 8)."""

from __future__ import annotations

from svu_mi.frequency.fit import SolverGroup, fit_lanes, fit_sh, solver_groups
from svu_mi.frequency.harmonics import power_lanes, power_spectrum

__all__ = [
    "SolverGroup",
    "fit_lanes",
    "fit_sh",
    "power_lanes",
    "power_spectrum",
    "solver_groups",
]
