"""``python -m svu_mi`` is ``svu``."""

from svu_mi.cli.process import run

run()
