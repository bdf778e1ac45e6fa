"""Compare the speed of two checkouts in pairs of runs.

    python tests/support/times.py OTHER [--pairs 3] [--side 512] [--views 60] [--commands | --cpu]

OTHER is the root of another checkout with a ``.venv``. A capture is rendered once; then processes
of the two checkouts take turns, so that load of the machine meets both. Each process computes
everything once (cold: kernels come from the cache on disk), then three times (warm), synchronised.
The ratio is that of medians over all pairs. ``--commands`` times whole commands instead, and
``--cpu`` takes CPU time of computations, where the machine does other work as well.
"""

from __future__ import annotations

import argparse
import json
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path

HERE = Path(__file__).resolve().parents[2]
OUTPUT = {"entropy": "maps", "recover": "textures", "guide": "views", "report": "report.html"}
WARM = 3


def computed(folder: Path, side: int, clock: Callable[[], float]) -> dict[str, list[float]]:
    """Return seconds of each computation in this process: the first run, then warm ones."""
    sys.path.insert(0, str(Path.cwd()))
    import svu_mi as svu  # first: it chooses the LLVM of Dr.Jit

    # isort: split
    import drjit as dr
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    capture = svu.load_capture(folder)
    texels, few = (svu.texels(capture.mesh, (n, n)) for n in (side, side // 2))

    def entropy(preset: str) -> None:
        dr.eval(svu.estimate(capture, texels, "angular", preset).entropy)

    known = svu.estimate(capture, few)
    work = {
        "entropy default": lambda: entropy("default"),
        "entropy fast": lambda: entropy("fast"),
        "recover sh": lambda: svu.recover(capture, few, "sh"),
        "recover sharing": lambda: svu.recover(capture, few, "sh", sharing=True),
        "guide": lambda: svu.next_best_view(known, count=2),
    }
    seconds: dict[str, list[float]] = {}
    for name, run in work.items():
        seconds[name] = []
        for _ in range(1 + WARM):
            dr.sync_thread()
            start = clock()
            run()
            dr.sync_thread()
            seconds[name].append(clock() - start)
    return seconds


def cpu_time() -> float:
    """Seconds that all threads of this process have computed."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def child(root: Path, folder: Path, side: int, cpu: bool) -> dict[str, list[float]]:
    """Run ``computed`` in a process of another checkout."""
    words = [root / ".venv/bin/python", __file__, "--measure", folder, "--side", side]
    words += ["--cpu"] if cpu else []
    done = subprocess.run(
        list(map(str, words)), cwd=root, capture_output=True, text=True, check=True
    )
    return json.loads(done.stdout.splitlines()[-1])


def commanded(root: Path, folder: Path) -> dict[str, list[float]]:
    """Return seconds of whole commands of a checkout."""
    seconds = {}
    for command in OUTPUT:
        with tempfile.TemporaryDirectory() as target:
            start = time.perf_counter()
            subprocess.run(
                [root / ".venv/bin/svu", command, folder, "-o", Path(target) / OUTPUT[command]],
                cwd=target, capture_output=True, check=True,
            )  # fmt: skip
            seconds[command] = [time.perf_counter() - start] * 2
    return seconds


def rendered(target: Path, views: int) -> Path:
    """Render the capture that both read."""
    code = (
        "import svu_mi as svu, mitsuba as mi; from svu_mi import scenes;"
        "mi.set_variant('llvm_ad_rgb');"
        f"svu.render_capture(scenes.path('vase'), spp=8, views={views}, resolution=(512, 512),"
        f"folder={str(target)!r}, defines={{'light': 'window', 'max_depth': '2'}})"
    )
    subprocess.run([sys.executable, "-c", code], cwd=HERE, check=True)
    return target


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("other", type=Path, nargs="?")
    parser.add_argument("--pairs", type=int, default=3)
    parser.add_argument("--side", type=int, default=512)
    parser.add_argument("--views", type=int, default=60)
    parser.add_argument("--commands", action="store_true")
    parser.add_argument("--cpu", action="store_true", help="CPU time, not wall time")
    parser.add_argument("--measure", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    clock = cpu_time if given.cpu else time.perf_counter
    if given.measure:
        print(json.dumps(computed(given.measure, given.side, clock)))
        return 0
    base = Path(tempfile.mkdtemp())
    folder = rendered(base / "capture", given.views)
    sides: dict[str, dict[str, list[list[float]]]] = {
        side: defaultdict(list) for side in ("before", "after")
    }
    for _ in range(given.pairs):
        for side, root in (("before", given.other.resolve()), ("after", HERE)):
            if given.commands:
                run = commanded(root, folder)
            else:
                run = child(root, folder, given.side, given.cpu)
            for name, seconds in run.items():
                sides[side][name].append(seconds)
    shutil.rmtree(base)
    for name, runs in sides["before"].items():
        before, after = runs, sides["after"][name]
        cold = [statistics.median(r[0] for r in side) for side in (before, after)]
        warm = [statistics.median(s for r in side for s in r[1:]) for side in (before, after)]
        print(
            f"{name:18} first {cold[0]:6.2f} -> {cold[1]:6.2f} s   "
            f"warm {warm[0]:6.2f} -> {warm[1]:6.2f} s, ratio {warm[1] / warm[0]:.3f}"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
