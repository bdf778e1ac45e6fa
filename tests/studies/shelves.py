"""Many captures: what workers gain, what memory does, and that nothing that ends changes results.

    PYTHONPATH=tests python -m studies.shelves -o out/shelves

A shelf of captures of two own scenes under three lights. It is worked on by one worker on one core,
by two workers, by two workers of which some are killed at random moments, and by a command that is
itself interrupted and killed at random moments until it gets through; all must end with the same
maps. The memory of a batch of many captures is watched.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich.console import Console

from svu_mi import scenes
from svu_mi.bench.text import table
from svu_mi.cli import main as svu
from svu_mi.cli.terminal import say
from svu_mi.errors import SvuEnvironmentError
from svu_mi.exr import read_exr
from svu_mi.files import write_text

SCENES, LIGHTS = ("vase", "knot"), ("window", "studio", "overcast")
VIEWS, FILM, SPP = 24, 192, 16
STEPS = ("entropy", "recover")
PERIOD = 0.05  # seconds between looks


@dataclass(frozen=True, kw_only=True)
class Shelves:
    """Measure svu batch; writes shelves.md."""

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("out/shelves")
    """Folder for captures and results."""
    captures: int = 12
    many: int = 40
    """Captures over which memory is watched."""
    kills: int = 10
    """Times that a worker is killed."""
    interruptions: int = 20
    """Times that the command is interrupted or killed."""
    resolution: int = 256
    seed: int = 1
    """Of the random moments."""
    draws = False

    def run(self, console: Console) -> int:
        """Work on the shelf in all ways, one after the other."""
        shelf, chance, rows = self._shelf(self.captures), random.Random(self.seed), []

        def row(name: str, folder: str, work: Callable[[Path], str]) -> float:
            output = self.output / folder
            shutil.rmtree(output, ignore_errors=True)
            start = time.perf_counter()
            said = work(output)
            seconds = time.perf_counter() - start
            files, differ = _compared(self.output / "one", output)
            same = "" if folder == "one" else f"{files} files, {differ} differ"
            rows.append([name, f"{seconds:.0f} s", said, same])
            say(console, ", ".join(rows[-1]))
            return seconds

        one = row("one worker on one core", "one", lambda out: self._plain(shelf, out, 1, one=True))
        two = row("two workers", "two", lambda out: self._plain(shelf, out, 2))
        rows[-1][2] = f"{one / two:.2f} times as fast"
        row("workers killed", "killed", lambda out: self._killed(shelf, out, chance))
        row("interrupted", "interrupted", lambda out: self._interrupted(shelf, out, chance))
        # Those that were made before are links: only their number counts.
        many = self._shelf(self.many, "many")
        rows.append([f"{self.many} captures", "", self._memory(many, self.output / "flat"), ""])
        heading = [f"{self.captures} captures", "wall", "", "maps"]
        write_text(self.output / "shelves.md", table(heading, rows) + "\n")
        say(console, f"Wrote {self.output / 'shelves.md'}")
        return 0

    def _shelf(self, count: int, name: str = "shelf") -> Path:
        """Return a folder with so many captures, those of each cell the same."""
        folder = self.output / name
        for number in range(count):
            place = folder / f"capture_{number:02d}"
            if (place / "capture.json").is_file():
                continue
            scene = SCENES[number % len(SCENES)]
            light = LIGHTS[number // len(SCENES) % len(LIGHTS)]
            made = self.output / "made" / f"{scene}_{light}"
            if not (made / "capture.json").is_file():
                size = ("--views", VIEWS, "--resolution", FILM, "--spp", SPP)
                words = ("render", scenes.path(scene), "-D", f"light={light}", *size, "-o", made)
                _require(_started(words).wait(), "render")
            shutil.copytree(made, place)
            record = json.loads((place / "capture.json").read_text())
            record["scene"] = str(scenes.path(scene))
            (place / "capture.json").write_text(json.dumps(record))
        return folder

    def _words(self, shelf: Path, output: Path, workers: int) -> tuple[object, ...]:
        how = ("--workers", workers, "-t", 2, "--resolution", self.resolution)
        return "batch", shelf, *how, "--steps", *STEPS, "-o", output

    def _plain(self, shelf: Path, output: Path, workers: int, *, one: bool = False) -> str:
        _require(_started(self._words(shelf, output, workers), one=one).wait(), "batch")
        return ""

    def _killed(self, shelf: Path, output: Path, chance: random.Random) -> str:
        """Kill a worker every few seconds."""
        process, killed = _started(self._words(shelf, output, 2)), 0
        while process.poll() is None and killed < self.kills:
            time.sleep(chance.uniform(1, 6))
            workers = _children(process.pid)
            if workers:
                os.kill(chance.choice(workers), signal.SIGKILL)
                killed += 1
        status = process.wait()
        if status:  # three in a row were of the same command: the same command goes on
            _require(_started(self._words(shelf, output, 2)).wait(), "batch")
        return f"{killed} killed, then status {status}"

    def _interrupted(self, shelf: Path, output: Path, chance: random.Random) -> str:
        """End the command itself, in turns by Ctrl-C and at once, and type it again; from nothing
        where it got through before that."""
        ended, whole = 0, 0
        while ended < self.interruptions:
            process = _started(self._words(shelf, output, 2))
            try:
                _require(process.wait(chance.uniform(0.3, 12)), "batch")
            except subprocess.TimeoutExpired:
                process.send_signal(signal.SIGINT if ended % 2 else signal.SIGKILL)
                process.wait()
                ended += 1
            else:
                whole += 1
                files, differ = _compared(self.output / "one", output)
                if differ:
                    return f"batch {whole}: {differ} of {files} files differ"
                shutil.rmtree(output)
        _require(_started(self._words(shelf, output, 2)).wait(), "batch")
        return f"{ended} times, of {whole + 1} batches"

    def _memory(self, shelf: Path, output: Path) -> str:
        """Watch the batch itself, and its largest worker, over many captures."""
        shutil.rmtree(output, ignore_errors=True)
        words = ("batch", shelf, "--steps", "entropy", "--resolution", 64, "-t", 2, "-o", output)
        process = _started(words)
        looks: list[tuple[int, int]] = []

        def watch() -> None:
            while process.poll() is None:
                own = _resident(process.pid)
                looks.append((own, max(map(_resident, _children(process.pid)), default=0)))
                time.sleep(PERIOD)

        watcher = threading.Thread(target=watch)
        watcher.start()
        _require(process.wait(), "batch")
        watcher.join()
        own, others = np.array(looks).T / 1e6
        parts = [np.array_split(series, 4) for series in (own, others)]
        batch, workers = ([f"{part.max():.0f}" for part in series] for series in parts)
        return f"MB, by quarter: batch {' '.join(batch)}, workers {' '.join(workers)}"


def _started(words: tuple[object, ...], *, one: bool = False) -> subprocess.Popen[bytes]:
    before = ["taskset", "-c", "0"] if one else []
    line = [*before, sys.executable, "-m", "svu_mi", *map(str, words)]
    return subprocess.Popen(line, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def _require(status: int, command: str) -> None:
    if status:
        raise SvuEnvironmentError(f"svu {command}: ended with {status}.")


def _children(parent: int) -> list[int]:
    line = ["pgrep", "-P", str(parent)]
    found = subprocess.run(line, capture_output=True, text=True, check=False)
    return [int(word) for word in found.stdout.split()]


def _resident(process: int) -> int:
    try:
        for line in Path(f"/proc/{process}/status").read_text().splitlines():
            if line.startswith("VmRSS"):
                return int(line.split()[1]) * 1024
    except OSError:
        pass
    return 0


def _maps(folder: Path) -> dict[str, bytes]:
    """Return all channels of all maps and textures, by the name of their file."""
    found = {}
    for path in sorted(folder.rglob("*.exr")):
        planes = read_exr(path)
        found[str(path.relative_to(folder))] = b"".join(planes[x].tobytes() for x in sorted(planes))
    return found


def _compared(wanted: Path, found: Path) -> tuple[int, int]:
    """Return the number of maps, and of those that differ or are missing on one side."""
    ours, theirs = _maps(wanted), _maps(found)
    return len(ours), sum(ours.get(name) != theirs.get(name) for name in {*ours, *theirs})


if __name__ == "__main__":
    sys.exit(svu.main(None, Shelves, "python -m studies.shelves", Shelves.__doc__ or ""))
