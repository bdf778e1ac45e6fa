"""What remains of the photographs: sums of all views, and what the posterior reads of them."""

from svu_mi.statistics.factors import Factors as Factors
from svu_mi.statistics.gather import gather as gather
from svu_mi.statistics.sums import Statistics as Statistics
