"""Numerical stability under stress: kernels against double precision, axis by axis."""

from svu_mi.bench.stability.run import run_stability as run_stability
from svu_mi.bench.stability.run import stability_table as stability_table
