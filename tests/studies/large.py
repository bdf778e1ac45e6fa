"""Captures that do not fit into memory: time and memory of commands, in a group of limited memory.

    PYTHONPATH=tests python -m studies.large -o out/large

Twelve views of the vase of 24 megapixels are rendered and stored as JPEG, if they are not there
yet, and linked under as many names as there are photographs. Every command is a process of its own,
in a control group (version 1, which takes root) with that much memory; without one, only its
memory is measured.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from PIL import Image
from rich.console import Console

from svu_mi import scenes
from svu_mi.bench.text import table
from svu_mi.capture.picture import quantized, srgb
from svu_mi.cli import main as svu
from svu_mi.cli.terminal import say
from svu_mi.errors import SvuEnvironmentError
from svu_mi.exr import read_exr
from svu_mi.files import write_text
from svu_mi.formats.source import frame_of
from svu_mi.formats.transforms import write_transforms

DISTINCT, SIZE, SPP = 12, (6000, 4000), 2
GROUP = Path("/sys/fs/cgroup/memory/svu_large")
PERIOD = 0.05  # seconds between looks at a process
UNCLIPPED = 99.9  # per cent of the pixels that show something
COMMANDS = {
    "import": ("import", "{shot}", "--mesh", "{mesh}", "--environment", "{light}", "-o", "{cap}"),
    "check": ("check", "{cap}", "-o", "{out}/check"),
    "entropy, 2048 x 2048 texels": (
        "entropy", "{cap}", "--resolution", "2048", "-o", "{out}/entropy",
    ),
    "recover, 1024 x 1024 texels": (
        "recover", "{cap}", "--resolution", "1024", "-o", "{out}/recovered",
    ),
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Large:
    """Import, check, estimate and recover from many large photographs; writes large.md."""

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("out/large")
    """Folder for photographs and results."""
    photographs: int = 200
    """How many there are."""
    memory: float = 4.0
    """GB that a command may take, files that it reads included."""
    only: tuple[str, ...] = ()
    """Commands to run, by their first word; all by default."""
    draws = False

    def run(self, console: Console) -> int:
        """Run the commands one after the other."""
        words = {
            "shot": self._shot(), "cap": self.output / "capture", "out": self.output,
            "mesh": scenes.path("vase").parent / "mesh.ply",
            "light": scenes.path("vase").parent.parent / "lights" / "window.exr",
        }  # fmt: skip
        rows = []
        for name, line in COMMANDS.items():
            if self.only and line[0] not in self.only:
                continue
            log = self.output / f"{line[0]}.log"
            seconds, peak, whole = measured(
                [word.format(**words) for word in line], log, self.memory
            )
            row = [name, f"{seconds:.0f} s", f"{peak:.2f} GB", whole]
            say(console, ", ".join(row))
            rows.append(row)
        heading = [
            f"{self.photographs} photographs of {SIZE[0]} x {SIZE[1]}", "wall",
            "memory at its peak, without files", f"of the group of {self.memory:g} GB",
        ]  # fmt: skip
        write_text(self.output / "large.md", table(heading, rows) + "\n")
        return 0

    def _shot(self) -> Path:
        """Return the folder with the photographs and ``transforms.json``."""
        folder, rendered = self.output / "shot", self.output / "rendered"
        if not (folder / "transforms.json").is_file():
            size = ("--resolution", str(SIZE[0]), str(SIZE[1]))
            words = ("-D", "light=window", "--views", str(DISTINCT), *size, "--spp", str(SPP))
            if not (rendered / "capture.json").is_file():
                run("render", str(scenes.path("vase")), *words, "-o", str(rendered))
            _store(rendered, folder, self.photographs)
        return folder


def _store(rendered: Path, folder: Path, count: int) -> None:
    """Write photographs as JPEG with one exposure, and their poses."""
    import mitsuba as mi

    from svu_mi.capture.folder import read

    mi.set_variant("llvm_ad_rgb")
    description = read(rendered)
    assert description is not None
    folder.mkdir(parents=True, exist_ok=True)
    exposure = 0.0
    for view in range(DISTINCT):
        channels = read_exr(rendered / f"view_{view:04d}.exr")
        color = np.nan_to_num(np.stack([channels[name] for name in "RGB"], axis=-1))
        exposure = exposure or 1 / float(np.percentile(color[color > 0], UNCLIPPED))
        pixels = quantized(srgb(np.clip(color * exposure, 0, 1)))
        Image.fromarray(pixels).save(folder / f"distinct_{view:02d}.jpg", quality=92)
    frames = []
    for number, sensor in enumerate(description.make_sensors(rendered) * (count // DISTINCT + 1)):
        if number < count:
            path = folder / f"IMG_{number:04d}.jpg"
            path.unlink(missing_ok=True)
            os.link(folder / f"distinct_{number % DISTINCT:02d}.jpg", path)
            frames.append(frame_of(sensor, path, exposure=exposure))
    write_transforms(folder / "transforms.json", frames)


def run(*words: str) -> None:
    """Run a command of ``svu``, whose output is shown."""
    done = subprocess.run([sys.executable, "-m", "svu_mi", *words], check=False)
    if done.returncode:
        raise SvuEnvironmentError(f"svu {' '.join(words)}: ended with {done.returncode}.")


def measured(words: list[str], log: Path, memory: float) -> tuple[float, float, str]:
    """Run a command of ``svu``; return seconds, GB of memory that is not a file's, and what its
    group of so many GB took."""
    with _group(memory) as joined, log.open("w") as stream:
        start = time.perf_counter()
        process = subprocess.Popen(
            [sys.executable, "-m", "svu_mi", *words], stdout=stream, stderr=stream,
            preexec_fn=joined,
        )  # fmt: skip
        peaks = [0.0]
        watch = threading.Thread(target=_watch, args=(process, peaks))
        watch.start()
        status = process.wait()
        seconds = time.perf_counter() - start
        watch.join()
        whole = "not limited" if joined is None else f"{_most() / 1e9:.2f} GB"
    if status:
        raise SvuEnvironmentError(f"svu {words[0]}: ended with {status}, see {log}.")
    return seconds, max(peaks) / 1e9, whole


def _watch(process: subprocess.Popen[bytes], peaks: list[float]) -> None:
    while process.poll() is None:
        with contextlib.suppress(OSError, ValueError):
            for line in Path(f"/proc/{process.pid}/status").read_text().splitlines():
                if line.startswith("RssAnon"):
                    peaks.append(int(line.split()[1]) * 1024.0)
        time.sleep(PERIOD)


@contextlib.contextmanager
def _group(memory: float) -> Iterator[Callable[[], object] | None]:
    """Yield what puts a process into a control group with so many GB; None where none can be
    made."""
    try:
        GROUP.mkdir(exist_ok=True)
        (GROUP / "memory.limit_in_bytes").write_text(str(int(memory * 1e9)))
        (GROUP / "memory.max_usage_in_bytes").write_text("0")
    except OSError:
        yield None
        return
    try:
        yield lambda: (GROUP / "cgroup.procs").write_text(str(os.getpid()))
    finally:
        with contextlib.suppress(OSError):
            GROUP.rmdir()


def _most() -> int:
    return int((GROUP / "memory.max_usage_in_bytes").read_text())


if __name__ == "__main__":
    sys.exit(svu.main(None, Large, "python -m studies.large", Large.__doc__ or ""))
