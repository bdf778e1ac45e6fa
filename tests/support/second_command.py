"""Time of commands on a capture after ``svu entropy``, with its cache and without it, in pairs.

    python tests/support/second_command.py [--capture FOLDER] [--pairs 3] [--only report ...]

Without a capture, the vase is rendered with 60 photographs of 512 x 512 pixels. The two commands of
a pair take turns, so that load of the machine meets both, and their maps must be equal to the bit.
``svu view`` is timed until it prints its address.
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path
from typing import NamedTuple

import numpy as np

from svu_mi import scenes
from svu_mi.core.io.exr import read_exr

SVU = (sys.executable, "-m", "svu_mi")
NEEDS = ("--recovered", "textures")  # of commands that read the result of svu recover
KILO = 1024 if sys.platform == "linux" else 1  # unit of ru_maxrss
COMMANDS = {
    "recover": ("-o", "textures"), "guide": ("-o", "next"),
    "report": (*NEEDS, "-o", "report.html"), "view": (*NEEDS, "--port", "0"),
    "inpaint": (*NEEDS, "-o", "filled"),
}  # fmt: skip


class Used(NamedTuple):
    """Seconds of a command by the clock, and of all of its threads; peak memory in MB."""

    wall: float
    cpu: float
    peak: float


def timed(name: str, capture: Path, at: Path, *options: str) -> Used:
    """Run a command in a folder."""
    words = [*SVU, name, str(capture), *COMMANDS.get(name, ()), *options]
    start = time.monotonic()
    process = subprocess.Popen(words, cwd=at, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    for line in process.stdout:
        if line.startswith("Open "):
            break
    wall = time.monotonic() - start
    if name == "view":
        process.send_signal(signal.SIGINT)
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    assert name == "view" or process.returncode == 0, words
    return Used(wall, used.ru_utime + used.ru_stime, used.ru_maxrss * KILO / 1e6)


def require_equal(first: Path, second: Path) -> int:
    """Compare all maps in two folders; return their number."""
    names = sorted(path.relative_to(first) for path in first.rglob("*.exr"))
    assert names == sorted(path.relative_to(second) for path in second.rglob("*.exr"))
    for name in names:
        one, other = read_exr(first / name), read_exr(second / name)
        for channel in one:
            np.testing.assert_array_equal(one[channel], other[channel], err_msg=str(name))
    return len(names)


def main() -> None:
    """Time pairs of commands, compare their maps, and print medians and ratios."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--capture", type=Path)
    parser.add_argument("--pairs", type=int, default=3)
    parser.add_argument("--only", nargs="*", default=list(COMMANDS), choices=COMMANDS)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        at = Path(folder)
        capture = at / "capture"
        if options.capture is None:
            scene = (str(scenes.path("vase")), "-D", "light=window", "--spp", "4")
            size = ("--views", "60", "--resolution", "512", "-o", str(capture))
            subprocess.run([*SVU, "render", *scene, *size], check=True)
        else:
            capture = options.capture.resolve()
            shutil.rmtree(capture / "cache", ignore_errors=True)
        sides = {"without": at / "without", "with": at / "with"}
        for side in sides.values():
            side.mkdir()
            timed("recover", capture, side, "--no-cache")  # compiles kernels; read by others
        used: dict[str, dict[str, list[Used]]] = {name: defaultdict(list) for name in options.only}
        first = timed("entropy", capture, at, "-o", "maps")
        print(
            f"{'entropy, which keeps':20} {first.wall:6.1f} s, {first.cpu:6.1f} s CPU", flush=True
        )
        for name in options.only * options.pairs:
            for side, place in sides.items():
                also = ["--no-cache"] if side == "without" else []
                used[name][side].append(timed(name, capture, place, *also))
        print(require_equal(*sides.values()), "maps are equal to the bit")
    for name, of_sides in used.items():
        walls, cpus, peaks = (
            [statistics.median(each[k] for each in of_sides[side]) for side in sides]
            for k in range(3)
        )
        print(
            f"{name:20} {walls[0]:6.1f} -> {walls[1]:6.1f} s, ratio {walls[1] / walls[0]:.2f}; "
            f"CPU {cpus[0]:6.1f} -> {cpus[1]:6.1f} s, ratio {cpus[1] / cpus[0]:.2f}; "
            f"peak {peaks[0]:.0f} -> {peaks[1]:.0f} MB", flush=True
        )  # fmt: skip


if __name__ == "__main__":
    main()
