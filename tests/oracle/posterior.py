"""Eq. 3, 5 and 11 by brute force: every cell of the grid, one after the other."""

from svu_mi.bench.oracle import distances as distances
from svu_mi.bench.oracle import entropy as entropy
from svu_mi.bench.oracle import model as model
from svu_mi.bench.oracle import nodes as nodes
from svu_mi.bench.oracle import normalize as normalize
