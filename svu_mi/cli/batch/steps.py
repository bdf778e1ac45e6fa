"""Steps of a batch: commands, arguments, keys of inputs, and completed steps."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from svu_mi import __version__
from svu_mi.capture.capture_folder import FILE, read, stamps
from svu_mi.cli.batch.capture_list import OPTIONS, BatchItem, capture_paths, real_path
from svu_mi.core.io.files import write_json
from svu_mi.core.io.folder_exchange import DRAFT
from svu_mi.core.io.hashes import Key
from svu_mi.core.io.output_folder import CHECKPOINT
from svu_mi.core.io.schema import NAMES, NUMBER, TEXT, WHOLE, Field, read_record
from svu_mi.errors import SvuError

DONE = "batch.json"  # in the folder of results of a capture
STEP = {
    "key": Field(TEXT), "seconds": Field(NUMBER, (), 0, 1e9, "seconds"),
    "peak_bytes": Field(WHOLE, (), 0, 2**60, "bytes"),
}  # fmt: skip
RECORD = {"steps": Field(STEP, (NAMES,))}


@dataclass(frozen=True)
class Step:
    """Command of a batch.

    Attributes:
        command: Name of the command.
        output: Output file or folder, relative to the results of the capture.
        proof: File that exists when the step is complete.
        options: Subset of ``OPTIONS`` that the command accepts.
        checkpoint: File for ``--resume`` that remains if the command is killed; may be empty.
    """

    command: str
    output: str
    proof: str
    options: tuple[str, ...] = ()
    checkpoint: str = ""


STEPS = {
    "entropy": Step("entropy", "entropy", "entropy/run.json", OPTIONS),
    "recover": Step(
        "recover", "recovered", "recovered/run.json",
        tuple(name for name in OPTIONS if name != "preset"),
        checkpoint=f".recovered{DRAFT}/{CHECKPOINT}",
    ),
    "report": Step(
        "report", "report.html", "report.html",
        tuple(name for name in OPTIONS if name != "resolution"),
    ),
    "export": Step("export", "asset", "asset/asset.json"),
}  # fmt: skip


def command_words(step: Step, item: BatchItem, folder: Path, steps: Sequence[str]) -> list[str]:
    """Return the arguments of ``svu`` for a step."""
    recovered, output = (
        path_word(folder / STEPS[name].output) for name in ("recover", step.command)
    )
    if step.command == "export":
        return ["export", recovered, "-o", output]
    words = [step.command, path_word(item.capture), "-o", output]
    for name in step.options:
        if name == "resolution" and name in item.options:
            words += [f"--{name}", *item.options[name].split()]
        elif name in item.options:  # one word, as the value may start with a dash
            words.append(f"--{name}={item.options[name]}")
    if step.command == "report" and "recover" in steps:
        words += ["--recovered", recovered]
    return words


def path_word(path: Path) -> str:
    """Return a path as an argument that does not start with a dash."""
    return f"./{path}" if str(path).startswith("-") else str(path)


def step_key(words: Sequence[str], before: str) -> str:
    """Return a digest of the version of svu, the words of a step, and the key of its input."""
    return Key(__version__, list(words), before).digest()


def inputs_key(item: BatchItem, output: Path | None = None) -> str:
    """Return a digest of all files of a capture and its scene, from their sizes and times."""
    places, own = capture_paths(item), None if output is None else real_path(output)
    folders = {place for place in places if place.is_dir()}
    described = [read(folder) for folder in places if folder in folders]
    scenes = [each.scene for each in described if each is not None and each.scene is not None]
    files = stamps([*places, *scenes], lambda folder: folder == own)

    def is_separate(folder: Path) -> bool:  # an output, another capture, or hidden
        return folder == own or folder.name.startswith(".") or (folder / FILE).is_file()

    for scene in scenes:
        if not any(scene.is_relative_to(folder) for folder in folders):
            files += stamps([scene.parent], is_separate)
            folders.add(scene.parent)
    return Key([list(file) for file in files]).digest()


def read_done(folder: Path) -> dict[str, dict[str, Any]]:
    """Read key, seconds and peak memory of completed steps; an empty dictionary if damaged."""
    try:
        return dict(read_record(folder / DONE, RECORD, "run the batch again")["steps"])
    except SvuError:
        return {}


def write_done(folder: Path, steps: dict[str, dict[str, Any]]) -> None:
    """Write the completed steps (see ``read_done``)."""
    write_json(folder / DONE, {"steps": steps})
