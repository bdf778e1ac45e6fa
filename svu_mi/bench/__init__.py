"""``svu bench``: how accurate and how fast svu_mi is, with runs that can be interrupted.

A benchmark is a module of this package with a ``STUDY``: what is measured (an ``Experiment``: rows
on cells), which bars it has to reach, and how it is shown. ``run`` runs them, keeps what is
finished, and writes bench.json, bench.md and plots.
"""

# Every benchmark, and what it does: the module of that name has its ``STUDY``.
BENCHMARKS = {
    "accuracy": "entropy of every object under every light, against path tracing and the truth",
    "speed": "run times, of the first object and light",
    "recovery": "textures recovered in every way, against the true ones",
    "guidance": "textures recovered from views chosen in every way",
    "real": "photographs of a real CAPTURE that are left out, predicted from the others",
}
ALL = ("accuracy", "speed")  # what ``all`` stands for: each of the others takes as long again
