"""``svu bench``: accuracy and speed of svu_mi, in runs that can be interrupted.

A benchmark is a module of this package with a ``STUDY``. It contains the measurements (an
``Experiment`` with rows and cases), bars (limits that a release has to meet), tables and plots.
``study.run_bench`` runs benchmarks, caches finished results, and writes STUDY.json, bench.md and
plots.
"""

# Names and descriptions of the benchmarks; the module of that name contains ``STUDY``.
BENCHMARKS = {
    "accuracy": "entropy of all objects and lights, compared with path tracing and the truth",
    "calibration": "share of posterior intervals and sets that contain the truth",
    "guidance": "textures recovered from views that each strategy chose",
    "light": "estimated light, and textures under it, compared with the given light",
    "orb": "Stanford-ORB (--data), by the rules of the data set",
    "paper": "Tables 2 and 3 and Figure 9 of the paper",
    "paths": "accuracy with indirect light and with other noise",
    "poses": "textures with wrong and with refined camera poses",
    "real": "held-out photographs of a real CAPTURE, predicted from the others",
    "recovery": "textures of all recovery methods, compared with the true ones",
    "reflected": "textures under light of tables, of the object itself, and of lamps",
    "scaling": "time and memory by number of texels and of views",
    "speed": "run times of estimates and kernels, for the first object and light",
    "sureness": "share of intervals of textures and pictures that contain the truth",
    "verdict": "captures with a mistake: are they called unreliable, and is the cause named",
}
ALL = ("accuracy", "speed")  # run by ``all``; each of the others takes as long again
