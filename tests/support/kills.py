"""Killed commands, and concurrent commands in one folder.

    PYTHONPATH=tests python -m support.kills [--kills 60] [--pairs 12] [--caches 60]

Whatever happens at whatever moment: a folder holds the old result or the new one, readers read it,
and the same command again succeeds and leaves nothing else. Every second kill is with the exchange
of folders made unavailable.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from support.helpers import ball, foreign_source, names, write_scene
from svu_mi import scenes
from svu_mi.calibration.light.light_folder import load_light
from svu_mi.capture.importers.nerf import write_transforms
from svu_mi.capture.loading import load_capture
from svu_mi.core.io.array_cache import ArrayCache
from svu_mi.core.io.exr import read_exr, write_exr
from svu_mi.core.io.folder_exchange import restore
from svu_mi.core.io.output_folder import CHECKPOINT
from svu_mi.core.io.provenance import RECORDS, entry_of
from svu_mi.output.texture_files import read_textures

SMALL = ("--resolution", "24")
LIMIT = 300.0  # seconds that a command may take
TWICE = "is writing there"
ENTROPY = Path("shot/entropy")  # of a batch
# Read by Python at its start, in the processes of a batch, too.
NO_EXCHANGE = "import svu_mi.core.io.folder_exchange as e\ne._exchange = lambda *_: False\n"

Words = Callable[[Path], tuple[object, ...]]  # of a command, for the folder of one of two captures
COMMANDS: dict[str, tuple[Words, Callable[[Path], object]]] = {
    "render": (lambda at: (at / "scene.xml", "--spp", 2), load_capture),
    "import": (lambda at: (at / "transforms.json", "--mesh", at / "ball.ply", "--environment",
                           at / "light.exr"), load_capture),
    "entropy": (lambda at: (at / "shelf/shot", *SMALL), lambda out: read_exr(out / "entropy.exr")),
    "recover": (lambda at: (at / "shelf/shot", *SMALL, "--steps", 40, "--checkpoint-seconds", 0),
                read_textures),
    "batch": (lambda at: (at / "shelf", *SMALL, "--steps", "entropy"),
              lambda out: read_exr(out / ENTROPY / "entropy.exr")),
    "light": (lambda at: (at / "around", *SMALL, "--texels", 100, "--depths", 64, 4),
              load_light),
}  # fmt: skip


def svu(*words: object, wait: bool = True, **environment: str) -> subprocess.Popen[str]:
    """Start ``svu`` in a process group of its own."""
    process = subprocess.Popen(
        [sys.executable, "-m", "svu_mi", *map(str, words)], text=True, start_new_session=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=os.environ | environment,
    )  # fmt: skip
    if wait:
        said = process.communicate(timeout=LIMIT)
        assert process.returncode == 0, (words, said)
    return process


def prepare(at: Path, commands: Collection[str] = COMMANDS) -> None:
    """Make two captures of different objects under different light, as the commands need them."""
    for which, light in (("a", 1.0), ("b", 0.5)):
        folder = at / which
        foreign = foreign_source(folder)
        write_transforms(folder / "transforms.json", foreign.frames[:2])
        write_exr(folder / "light.exr", {"RGB": np.full((8, 16, 3), light)})
        write_scene(folder, positions=ball().positions * (1.5 if which == "b" else 1.0))
        svu("render", folder / "scene.xml", "-o", folder / "shelf" / "shot", "--spp", 2)
        if "light" in commands:
            around = ("-D", f"light={'window' if which == 'a' else 'studio'}", "--views", 24)
            svu("render", scenes.path("vase"), *around, "--resolution", 48, "--spp", 4,
                "-o", folder / "around")  # fmt: skip
    (at / "without" / "exchange").mkdir(parents=True)
    (at / "without" / "exchange" / "sitecustomize.py").write_text(NO_EXCHANGE)


@dataclass
class Place:
    """Where results of one command go, with an older one there."""

    name: str
    at: Path
    older: str = ""
    seconds: float = 0.0

    def words(self, which: str, place: Path) -> list[object]:
        return [self.name, *COMMANDS[self.name][0](self.at / which), "-o", place / "out"]

    def begin(self) -> Place:
        """Write the older result, and measure how long that takes."""
        place = self.at / "older" / self.name
        start = time.monotonic()
        svu(*self.words("a", place))
        self.seconds = time.monotonic() - start
        self.older = self.run(place)
        return self

    def run(self, place: Path) -> str:
        """Return which run's result lies in a folder, after reading all of it.

        Raises:
            AssertionError: it is not complete.
        """
        out = place / "out" / (ENTROPY if self.name == "batch" else "")
        restore(out)
        COMMANDS[self.name][1](place / "out")
        entry = next(filter(None, (entry_of(out / record) for record in RECORDS)))
        lost = [name for name in entry.files if not entry.owns(out, name)]
        assert not lost, lost
        return entry.run

    def copy(self, place: Path) -> Path:
        """Put the older result where it may be lost, as deep as it was: it names its scene."""
        shutil.rmtree(place, ignore_errors=True)
        return Path(shutil.copytree(self.at / "older" / self.name, place))


def killed(place: Place, chance: random.Random, at: Path, atomic: bool) -> str:
    """Kill a command at a random moment, half of the times late; return what was left."""
    place.copy(at)
    path = {} if atomic else {"PYTHONPATH": str(place.at / "without" / "exchange")}
    process = svu(*place.words("b", at), wait=False, **path)
    time.sleep(chance.uniform(chance.choice((0, 0.7)), 1.05) * place.seconds)
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    kept = "old" if place.run(at) == place.older else "new"
    resumes = place.name == "recover" and list(at.glob(f".out*/{CHECKPOINT}"))
    svu(*place.words("b", at), *(["--resume"] if resumes else []))
    assert place.run(at) != place.older
    left = [path for path in at.rglob(".*") if path.name != ".svu-lock"]
    assert not left and names(at) == ["out"], left
    return kept


def kill_while_keeping(folder: Path, chance: random.Random, size: int = 2**22) -> str:
    """Kill a process at a random moment while it keeps an array; return whether it is kept.

    Either all of it is read afterwards, or it is computed and kept again.
    """
    folder = folder / str(chance.random())
    array = np.arange(size, dtype=np.float32)
    cache, computed = ArrayCache(folder), Counter[str]()

    def compute() -> np.ndarray:
        computed["array"] += 1
        return array

    def recall() -> np.ndarray:
        return cache.recall("array", [], compute, lambda x: {"x": x}, lambda a: a["x"])

    start = time.monotonic()
    recall()
    seconds = time.monotonic() - start
    shutil.rmtree(folder)
    if (pid := os.fork()) == 0:
        try:
            recall()
        finally:
            os._exit(0)
    time.sleep(chance.uniform(0, 1.05) * seconds)
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    whole = [name for name in names(folder) if name.startswith("array")] if folder.exists() else []
    computed.clear()
    for _ in range(2):  # what was lost is computed and kept
        np.testing.assert_array_equal(recall(), array)
    assert computed.total() == (0 if whole else 1) and len(names(folder)) == 1, names(folder)
    return "kept" if whole else "lost"


def met(place: Place, at: Path) -> str:
    """Start a command twice at once; return whether ``one`` or ``both`` have written."""
    place.copy(at)
    both = [svu(*place.words(which, at), wait=False) for which in "ab"]
    said = [process.communicate(timeout=LIMIT)[1] for process in both]
    codes = [process.returncode for process in both]
    place.run(at)
    assert names(at) == ["out"]
    if codes == [0, 0]:  # one was done before the other began
        return "both"
    assert sorted(codes) == [0, 2], (codes, said)
    sentence = said[codes.index(2)]
    assert TWICE in sentence and sentence.count("\n") == 1, sentence
    return "one"


def main() -> None:
    """Kill, and let meet, as often as asked; print what was left."""
    import mitsuba as mi

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=60)
    parser.add_argument("--pairs", type=int, default=12)
    parser.add_argument("--caches", type=int, default=60)
    parser.add_argument("--seed", type=int, default=19)
    options = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    chance, count = random.Random(options.seed), len(COMMANDS)
    with tempfile.TemporaryDirectory(prefix="svu-kills-") as folder:
        at = Path(folder)
        kept = Counter(kill_while_keeping(at / "cache", chance) for _ in range(options.caches))
        print("cache", *(f"{left}: {times}" for left, times in sorted(kept.items())), flush=True)
        if not options.kills + options.pairs:
            return
        prepare(at)
        places = [Place(name, at).begin() for name in COMMANDS]
        tally: dict[str, Counter[str]] = {name: Counter() for name in COMMANDS}
        for index in range(options.kills + options.pairs):
            place, again = places[index % count], at / "again" / places[index % count].name
            try:
                pair = index >= options.kills
                atomic = index // count % 2 == 0
                left = met(place, again) if pair else killed(place, chance, again, atomic)
            except Exception as error:  # whatever it is, it is counted
                print(f"{place.name}: {type(error).__name__}: {error}", file=sys.stderr)
                left = "wrong"
            tally[place.name][left] += 1
    for name, counts in tally.items():
        print(name, *(f"{left}: {times}" for left, times in sorted(counts.items())))


if __name__ == "__main__":
    main()
