"""Path-traced posterior of a few texels: what every estimator is measured against."""

from svu_mi.reference.posterior import reference_posterior as reference_posterior
from svu_mi.reference.record import Reference as Reference
from svu_mi.reference.record import SplitHalf as SplitHalf
