"""Memory that commands announce, and the peak that they take, each in a process of its own.

    PYTHONPATH=tests python -m support.announced [--only COMMAND ...]

Prints a row per command and size, and returns how many commands take more than announced.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import mitsuba as mi
import numpy as np

from support.helpers import ball, lettered, recovered_folder, write_ball
from svu_mi import scenes
from svu_mi.capture import mesh
from svu_mi.capture.importers.nerf import write_transforms
from svu_mi.capture.importers.source import frame_of
from svu_mi.capture.sensors import sphere_sensors
from svu_mi.core.io.exr import write_exr

SIZES = ((64, 96), (192, 256), (384, 600))  # pixels and texels per side
COMMANDS = ("render", "import", "export", "check", "entropy", "guide", "report", "compare",
            "recover", "relight", "inpaint", "view", "light")  # fmt: skip
RUN = """
import sys, resource
if sys.argv[1] != "0":
    resource.setrlimit(resource.RLIMIT_AS, (int(float(sys.argv[1])), -1))
from svu_mi.cli.main import main
if sys.argv[2] == "view":
    from svu_mi.output.viewer.viewer import Viewer
    Viewer.run = Viewer.stop  # else it serves until Ctrl-C
status = main(sys.argv[2:])
peak = next(line for line in open("/proc/self/status") if line.startswith("VmHWM"))
print("PEAK", int(peak.split()[1]) * 1024)
sys.exit(status)
"""


def words(command: str, shot: Path, folder: Path, resolution: int) -> tuple[object, ...]:
    """Return the words of a command on a capture; recovery and light are brief."""
    output = folder / ("out.html" if command == "report" else "out")
    size = () if command == "check" else ("--resolution", resolution)
    captures = (shot, shot) if command == "compare" else (shot,)
    brief = {"recover": ("--steps", 5), "light": ("--depths", 256, 1, "--light-fixed")}
    end = ("--port", 0) if command == "view" else ("-o", output)
    return command, *captures, *size, *brief.get(command, ()), *end


def prepared(command: str, folder: Path, side: int) -> tuple[object, ...]:
    """Return the words of a command that has no photographs of a scene yet, or no more."""
    if command == "render":
        place = scenes.path("vase"), "-D", "light=window", "--views", 3, "--resolution", side
        return command, *place, "--spp", 1, "-o", folder / "out"
    if command == "export":
        recovered_folder(folder / "recovered", lettered(side, side), uvs=ball().uvs)
        known = {"Y": np.full((side, side), 0.5, np.float32)}
        write_exr(folder / "recovered" / "entropy.exr", known)
        return command, folder / "recovered", "-o", folder / "out"
    sensors = sphere_sensors(mesh.make_mesh("ball", ball()), 3, (side, side))
    frames = [frame_of(each, folder / f"{k}.exr") for k, each in enumerate(sensors)]
    for frame in frames:
        write_exr(frame.image, {"RGB": np.full((side, side, 3), 0.5, np.float32)})
    write_transforms(folder / "transforms.json", frames)
    return command, folder, "--mesh", write_ball(folder), "-o", folder / "out"


def announced_and_taken(*words: object) -> tuple[float, float]:
    """Run a command in a process of its own; return gigabytes."""
    done = subprocess.run(
        [sys.executable, "-c", RUN, "0", *map(str, words)],
        capture_output=True, text=True, timeout=1800, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    announced = re.findall(r"Needs up to ([\d.]+) GB of memory", done.stdout)
    (peak,) = re.findall(r"PEAK (\d+)", done.stdout)
    return max(map(float, announced)), int(peak) / 1e9


def main() -> int:
    """Measure all commands; return how many take more memory than announced."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", nargs="*", default=COMMANDS, choices=COMMANDS)
    asked, above = parser.parse_args().only, 0
    mi.set_variant("llvm_ad_rgb")
    print("| command | pixels | texels | announced | taken |\n|---|--:|--:|--:|--:|", flush=True)
    for pixels, texels in SIZES:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            shot = folder / "shot"
            vase = ("render", scenes.path("vase"), "-D", "light=window", "--views", 24)
            announced_and_taken(*vase, "--resolution", pixels, "--spp", 1, "-o", shot)
            for command in asked:
                place = folder / command
                place.mkdir()
                if command in ("render", "import", "export"):
                    line = prepared(command, place, 4 * pixels)
                elif command in ("relight", "inpaint"):
                    announced_and_taken(*words("recover", shot, place, texels), "--draws", 4)
                    line = command, shot, "--recovered", place / "out", "-o", place / "again"
                else:
                    line = words(command, shot, place, texels)
                announced, peak = announced_and_taken(*line)
                above += peak > announced
                print(f"| {command} | {pixels} | {texels} | {announced:.2f} | {peak:.2f} |",
                      flush=True)  # fmt: skip
    return above


if __name__ == "__main__":
    raise SystemExit(main())
