"""Spherical harmonics, the fit of Eq. 12 and the power of Eq. 8, texel by texel."""

from svu_mi.bench.oracle import basis as basis
from svu_mi.bench.oracle import degrees as degrees
from svu_mi.bench.oracle import fit as fit
from svu_mi.bench.oracle import normal_equations as normal_equations
from svu_mi.bench.oracle import power as power
