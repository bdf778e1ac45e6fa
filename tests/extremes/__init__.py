"""Numerical stability under stress: kernels against double precision, axis by axis."""

from extremes.run import run_stability as run_stability
from extremes.run import stability_table as stability_table
