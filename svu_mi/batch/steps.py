"""What is done with each capture: commands, their words, and what they depend on."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from svu_mi import __version__
from svu_mi.batch.listing import OPTIONS, PATHS, Item
from svu_mi.capture.folder import stamps


@dataclass(frozen=True)
class Step:
    """A command of a batch.

    Attributes:
        command: its first word.
        output: file or folder that it writes, in the folder of the capture's results.
        proof: file that is there when it is done.
        options: those of ``OPTIONS`` that it takes.
        unfinished: file that it leaves when it is killed, and goes on from with ``--resume``; empty
            if it begins again.
    """

    command: str
    output: str
    proof: str
    options: tuple[str, ...] = ()
    unfinished: str = ""

    def left_in(self, folder: Path) -> Path | None:
        """Return where the folder of a capture's results has what was left unfinished, if this
        command leaves anything."""
        return folder / self.unfinished if self.unfinished else None


STEPS = {
    "entropy": Step("entropy", "entropy", "entropy/run.json", OPTIONS),
    "recover": Step(
        "recover", "recovered", "recovered/run.json",
        tuple(name for name in OPTIONS if name != "preset"),
        unfinished="recovered/checkpoint.npz",
    ),
    "report": Step(
        "report", "report.html", "report.html",
        tuple(name for name in OPTIONS if name != "resolution"),
    ),
    "export": Step("export", "asset", "asset/asset.json"),
}  # fmt: skip


def words_of(step: Step, item: Item, folder: Path, steps: Sequence[str]) -> list[str]:
    """Return the words of a command.

    Args:
        step: which.
        item: the capture, with all its options.
        folder: of its results.
        steps: names of all steps that are taken.
    """
    if step.command == "export":
        return ["export", str(folder / STEPS["recover"].output), "-o", str(folder / step.output)]
    words = [step.command, str(item.capture), "-o", str(folder / step.output)]
    for name in step.options:
        if name in item.options:
            words += [f"--{name}", *item.options[name].split()]
    if step.command == "report" and "recover" in steps:
        words += ["--recovered", str(folder / STEPS["recover"].output)]
    return words


def key_of(words: Sequence[str], item: Item, before: str) -> str:
    """Return a digest of all that a step depends on: its command, the files of the capture, by
    their sizes and times, and the steps before it."""
    text = json.dumps([__version__, list(words), before, stamps(_places(item))])
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()[:32]


def _places(item: Item) -> list[Path]:
    capture = item.capture if item.capture.is_dir() else item.capture.parent
    return [capture, *(Path(item.options[name]) for name in PATHS if name in item.options)]
