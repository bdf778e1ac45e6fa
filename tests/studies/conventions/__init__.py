"""``svu bench conventions``: how often ``svu check`` finds axes that were imported wrongly.

``written`` writes a right capture as other tools do, ``cases`` are the mistakes that it is then
imported with, ``photographs`` how it was taken, ``visible`` whether a mistake shows at all.
"""

from svu_mi.bench.conventions.run import conventions_tables as conventions_tables
from svu_mi.bench.conventions.run import run_conventions as run_conventions
