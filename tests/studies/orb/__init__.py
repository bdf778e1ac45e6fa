"""``svu bench orb``: the evaluation of the Stanford-ORB data set, its protocol and its table.

``targets`` are the photographs that pictures are compared with, ``setting`` recovers and judges
one capture, ``run`` takes them all in turn; ``dataset`` renders a small set in the same layout.
"""

from svu_mi.bench.orb.run import run_orb as run_orb
from svu_mi.bench.orb.tables import orb_lines as orb_lines
from svu_mi.bench.orb.tables import orb_tables as orb_tables
from svu_mi.bench.orb.tables import write_csv as write_csv
