"""What is done with each capture: commands, their words, and what they depend on."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from svu_mi import __version__
from svu_mi.batch.listing import OPTIONS, Item, places_of, real
from svu_mi.capture.folder import FILE, read, stamps
from svu_mi.results.exchange import DRAFT
from svu_mi.results.transaction import CHECKPOINT


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
        unfinished=f".recovered{DRAFT}/{CHECKPOINT}",
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
        if name == "resolution" and name in item.options:
            words += [f"--{name}", *item.options[name].split()]
        elif name in item.options:  # one word, whatever it begins with
            words.append(f"--{name}={item.options[name]}")
    if step.command == "report" and "recover" in steps:
        words += ["--recovered", str(folder / STEPS["recover"].output)]
    return words


def key_of(words: Sequence[str], before: str) -> str:
    """Return a digest of all that a step depends on.

    Args:
        words: of the command.
        before: key of the step before; of the first, ``inputs_key``.
    """
    return _digest([__version__, list(words), before])


def inputs_key(item: Item, output: Path | None = None) -> str:
    """Return a digest of the files of a capture and of its scene, by their sizes and times.

    Args:
        item: the capture, with all its options.
        output: folder of the batch, which may lie beside a scene and is none of its files.

    Raises:
        CaptureError: what a capture folder says cannot be read.
    """
    places, own = places_of(item), None if output is None else real(output)
    scenes = _scenes(places)
    folders = {place for place in places if place.is_dir()}
    files = stamps([*places, *scenes], lambda folder: folder == own)
    for scene in scenes:
        if not any(scene.is_relative_to(folder) for folder in folders):
            files += stamps([scene.parent], partial(_is_apart, own))
            folders.add(scene.parent)
    return _digest(files)


def _digest(value: Any) -> str:
    text = json.dumps(value)
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()[:32]


def _scenes(places: Sequence[Path]) -> list[Path]:
    """Return the scenes that capture folders name in their ``capture.json``."""
    found = [read(place) for place in places if place.is_dir()]
    return [each.scene for each in found if each is not None and each.scene is not None]


def _is_apart(output: Path | None, folder: Path) -> bool:
    """Return whether a folder beside a scene holds none of its files: captures that were made of
    it, the batch's results, and what is hidden."""
    return folder == output or folder.name.startswith(".") or (folder / FILE).is_file()
