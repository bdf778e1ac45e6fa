"""Print the table of numerical stability: PYTHONPATH=tests python -m extremes [--quick]."""

import argparse
import tempfile
from pathlib import Path

import svu_mi  # noqa: F401 - first: it chooses LLVM

import mitsuba as mi  # isort: skip

from extremes.run import run_stability, stability_table  # isort: skip
from svu_mi.progress import Progress  # isort: skip

parser = argparse.ArgumentParser()
parser.add_argument("--quick", action="store_true", help="fewer cases of each axis")
asked = parser.parse_args()
mi.set_variant("llvm_ad_rgb")
with tempfile.TemporaryDirectory() as folder:
    record = run_stability(Path(folder), Progress(), asked.quick)
print(stability_table(record))
raise SystemExit(0 if record["stable"] else 1)
