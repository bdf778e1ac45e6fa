"""Angular statistics: what every roughness makes of all views, in six sums per texel."""

from svu_mi.angular.model import Reflection as Reflection
from svu_mi.angular.model import reflection as reflection
from svu_mi.angular.statistics import Statistics as Statistics
from svu_mi.angular.statistics import gather as gather
