"""``svu bench``: how accurate and how fast the estimators are, with resumable runs.

``cells`` says what to run, ``variants`` which estimators, ``accuracy`` and ``speed`` measure,
``store`` keeps what is finished, ``report`` writes bench.json, bench.md and the plots.
"""

from svu_mi.bench.run import run_bench as run_bench
