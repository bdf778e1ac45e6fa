"""How fast and how exact the kernels are, and the whole way from files to a map."""

from svu_mi.bench.kernels.run import run_kernels as run_kernels
from svu_mi.bench.kernels.tables import kernel_tables as kernel_tables
