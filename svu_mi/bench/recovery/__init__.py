"""``svu bench recovery``: textures recovered from photographs, against the true ones.

``rows`` says what is compared, ``cells`` on what, ``measure`` runs and times one row, ``judge``
compares it with the truth, ``costs`` times single steps, ``run`` calls them in turn.
"""

from svu_mi.bench.recovery.plots import draw_recovery as draw_recovery
from svu_mi.bench.recovery.run import run_recovery as run_recovery
from svu_mi.bench.recovery.tables import recovery_tables as recovery_tables
