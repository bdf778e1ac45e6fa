"""``svu bench``: how accurate and how fast svu_mi is, with runs that can be interrupted.

A benchmark is a module of this package with a ``STUDY``: what is measured (an ``Experiment``: rows
on cases), which bars it has to reach, and how it is shown. ``study.run_bench`` runs them, keeps
what is finished, and writes bench.json, bench.md and plots.
"""

# Every benchmark, and what it does: the module of that name has its ``STUDY``.
BENCHMARKS = {
    "accuracy": "entropy of every object under every light, against path tracing and the truth",
    "calibration": "how often intervals and sets of the posterior hold the truth",
    "guidance": "textures recovered from views chosen in every way",
    "light": "light found in photographs, and textures under it, against the given light",
    "orb": "Stanford-ORB (--data), by its own rules",
    "paper": "Tables 2 and 3 and Figure 9 of the paper",
    "paths": "what indirect light and other noise change in accuracy",
    "real": "photographs of a real CAPTURE that are left out, predicted from the others",
    "recovery": "textures recovered in every way, against the true ones",
    "scaling": "time and memory by the number of texels and of views",
    "speed": "run times, of the first object and light, and of kernels",
    "sureness": "how often intervals of recovered textures and pictures hold the truth",
}
ALL = ("accuracy", "speed")  # what ``all`` stands for: each of the others takes as long again
