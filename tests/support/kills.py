"""Commands that are killed, and commands that meet in one folder.

    PYTHONPATH=tests python -m support.kills [--kills 200] [--pairs 50]

Whatever happens at whatever moment: a folder holds the old result or the new one, readers read it,
and the same command again succeeds and leaves nothing else.
"""

from __future__ import annotations

import argparse
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from helpers import ball, foreign_source, write_scene
from PIL import Image

from svu_mi.capture.loading import load_capture
from svu_mi.export.reading import load_asset
from svu_mi.exr import read_exr, write_exr
from svu_mi.files import read_json
from svu_mi.formats.transforms import write_transforms
from svu_mi.results.record import entries
from svu_mi.results.settling import names_in, settle
from svu_mi.results.writing import DRAFT

SMALL = ("--resolution", "24")
WHOLE = re.compile(r"</html>\n+<!-- svu:page=[0-9a-f]{32} -->\n\Z")  # of a page
LIMIT = 300.0  # seconds that a command may take
TWICE = "is writing there"


@dataclass(frozen=True)
class Command:
    """A command, and how its results are looked at.

    Attributes:
        words: of ``svu`` for the capture A or B, but for its ``-o``.
        record: JSON file of its result; empty for a page.
        read: what reads the result; raises if it is no good.
    """

    words: Callable[[Path, str], Sequence[object]]
    record: str
    read: Callable[[Path], object]


def _maps(folder: Path) -> None:
    for name in ("entropy.exr", "coverage.exr"):
        read_exr(folder / name)
    Image.open(folder / "overview.png").load()


def _plan(folder: Path) -> None:
    count = len(read_json(folder / "guidance.json")["proposals"])
    assert len(list(folder.glob("gain_*.exr"))) == count
    assert len(list((folder / "thumbnails").iterdir())) == count


def _page(path: Path) -> None:
    assert WHOLE.search(path.read_text(encoding="utf-8"))


def _asset(folder: Path) -> None:
    named = [each["file"] for each in read_json(folder / "asset.json")["files"]]
    assert all((folder / name).is_file() for name in named)


def _given(folder: Path, which: str) -> Sequence[object]:
    given = folder / which
    return (given / "transforms.json", "--mesh", given / "ball.ply",
            "--environment", given / "light.exr")  # fmt: skip


COMMANDS = {
    "render": Command(
        lambda at, which: (at / which / "scene.xml", "--spp", 2), "capture.json", load_capture),
    "import": Command(_given, "capture.json", load_capture),
    "entropy": Command(lambda at, which: (at / which / "shot", *SMALL), "run.json", _maps),
    "recover": Command(
        lambda at, which: (at / which / "shot", *SMALL, "--steps", 40, "--checkpoint-seconds", 0),
        "run.json", load_asset),
    "export": Command(lambda at, which: (at / which / "recovered",), "asset.json", _asset),
    "report": Command(lambda at, which: (at / which / "shot", *SMALL), "", _page),
    "guide": Command(
        lambda at, which: (at / which / "shot", *SMALL, "--candidates", 6,
                           "--add", 3 if which == "a" else 2),
        "run.json", _plan),
}  # fmt: skip


def svu(*words: object, wait: bool = True) -> subprocess.Popen[str]:
    """Start ``svu`` in a process group of its own."""
    process = subprocess.Popen(
        [sys.executable, "-m", "svu_mi", *map(str, words)], text=True, start_new_session=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip
    if wait:
        said = process.communicate(timeout=LIMIT)
        assert process.returncode == 0, (words, said)
    return process


def prepare(at: Path) -> None:
    """Make two captures of different objects under different light, and a recovery of each."""
    for which, light in (("a", 1.0), ("b", 0.5)):
        folder = at / which
        foreign = foreign_source(folder)
        write_transforms(folder / "transforms.json", foreign.frames[:2])
        write_exr(folder / "light.exr", {"RGB": np.full((8, 16, 3), light)})
        write_scene(folder, positions=ball().positions * (1.5 if which == "b" else 1.0))
        svu("render", folder / "scene.xml", "-o", folder / "shot", "--spp", 2)
        svu("recover", folder / "shot", *SMALL, "--steps", 20, "-o", folder / "recovered")


@dataclass
class Place:
    """Where results of one command go, with an older one there."""

    name: str
    at: Path
    older: str = ""
    seconds: float = 0.0

    @property
    def command(self) -> Command:
        return COMMANDS[self.name]

    def words(self, which: str, out: Path) -> list[object]:
        return [self.name, *self.command.words(self.at, which), "-o", self.target(out)]

    def target(self, out: Path) -> Path:
        return out if self.command.record else out / "report.html"

    def begin(self) -> Place:
        """Write the older result, and measure how long that takes."""
        out = self.at / "older" / self.name
        for _ in range(2):  # kernels are compiled once
            start = time.monotonic()
            svu(*self.words("a", out))
            self.seconds = time.monotonic() - start
        self.older = self.run(out)
        return self

    def run(self, out: Path) -> str:
        """Return which run's result lies in a folder, after looking at all of it.

        Raises:
            AssertionError: it is not whole.
        """
        settle(out)
        self.command.read(self.target(out))
        if not self.command.record:
            return "page " + str(hash(self.target(out).read_bytes()))
        (entry,) = entries(out / self.command.record)
        lost = [name for name in entry.files if not entry.owns(out, name)]
        assert not lost, lost
        return entry.run

    def copy(self, out: Path) -> Path:
        """Put the older result where it may be lost, as deep as it was: it names its scene."""
        shutil.rmtree(out, ignore_errors=True)
        return Path(shutil.copytree(self.at / "older" / self.name, out))

    def files(self, out: Path) -> list[str]:
        return [name for name in names_in(out) if name != "mine.txt"]


def killed(place: Place, chance: random.Random, out: Path) -> str:
    """Kill a command at a random moment; every second time, while it writes.

    Returns:
        What was left: ``old``, ``new``, or what is wrong.
    """
    place.copy(out)
    (out / "mine.txt").write_text("mine") if place.name not in ("render", "import") else None
    process = svu(*place.words("b", out), wait=False)
    try:
        if chance.random() < 0.5:
            time.sleep(chance.uniform(0, 1.1 * place.seconds))
        else:
            _until_it_writes(process, out)
            time.sleep(chance.choice((0, 1)) * chance.expovariate(20.0))
        os.killpg(process.pid, signal.SIGKILL)
    except ProcessLookupError:
        pass
    process.communicate()
    found = "old" if place.run(out) == place.older else "new"
    again = place.words("b", out)
    if place.name == "recover" and (out / "checkpoint.npz").exists():
        again.append("--resume")
    svu(*again)
    assert place.run(out) != place.older
    left = [name for name in place.files(out) if Path(name).name.startswith(".")]
    assert not left, left
    if place.name not in ("render", "import"):
        assert (out / "mine.txt").read_text() == "mine"
    return found


def _until_it_writes(process: subprocess.Popen[str], out: Path) -> None:
    end = time.monotonic() + LIMIT
    while process.poll() is None and time.monotonic() < end:
        if any(p.name.startswith(DRAFT) or ".tmp" in p.name for p in out.iterdir()):
            return
        time.sleep(0.001)


def met(place: Place, out: Path) -> str:
    """Start a command twice at once; return how it ended: ``one`` or ``both`` have written."""
    place.copy(out)
    both = [svu(*place.words(which, out), wait=False) for which in "ab"]
    said = [process.communicate(timeout=LIMIT)[1] for process in both]
    codes = [process.returncode for process in both]
    assert place.run(out) != place.older
    assert not [name for name in place.files(out) if Path(name).name.startswith(".")]
    if codes == [0, 0]:  # one was done before the other began
        return "both"
    assert sorted(codes) == [0, 2], (codes, said)
    sentence = said[codes.index(2)]
    assert TWICE in sentence and sentence.count("\n") == 1, sentence
    return "one"


def main() -> None:
    """Kill, and let meet, as often as asked; print the tables."""
    import mitsuba as mi

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--pairs", type=int, default=50)
    parser.add_argument("--seed", type=int, default=19)
    options = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    chance, names = random.Random(options.seed), list(COMMANDS)
    with tempfile.TemporaryDirectory(prefix="svu-kills-") as folder:
        at = Path(folder)
        os.environ.setdefault("DRJIT_CACHE_DIR", str(at / "kernels"))
        prepare(at)
        places = {name: Place(name, at).begin() for name in names}
        left, pairs = ({name: Counter[str]() for name in names} for _ in range(2))
        for index in range(options.kills):
            place = places[names[index % len(names)]]
            left[place.name][_found(killed, place, chance, at / "again" / place.name)] += 1
        for index in range(options.pairs):
            place = places[names[index % len(names)]]
            pairs[place.name][_found(met, place, at / "again" / place.name)] += 1
    print("| command | s | killed | old | new | wrong | met | one wrote | in turn | wrong |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    for name in names:
        a, b = left[name], pairs[name]
        wrong = [sum(c.values()) - sum(c[k] for k in ("old", "new", "one", "both")) for c in (a, b)]
        print(f"| `{name}` | {places[name].seconds:.1f} | {a.total()} | {a['old']} | {a['new']} | "
              f"{wrong[0]} | {b.total()} | {b['one']} | {b['both']} | {wrong[1]} |")  # fmt: skip


def _found(attempt: Callable[..., str], *arguments: Any) -> str:
    try:
        return attempt(*arguments)
    except Exception as error:  # whatever it is, it is counted
        print(f"wrong: {type(error).__name__}: {error}", file=sys.stderr)
        return "wrong"


if __name__ == "__main__":
    main()
