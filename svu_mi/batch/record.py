"""What became of a capture: kept beside its results, so that nothing is done twice."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from svu_mi.errors import SvuError
from svu_mi.files import read_json, write_json

FILE = "batch.json"
INDEX, TABLE = "index.html", "index.csv"  # of all captures, beside their folders


@dataclass
class Done:
    """The steps of one capture that are done, by name: key, seconds and bytes at the peak.

    Attributes:
        folder: of its results.
        steps: what ``batch.json`` says of them.
        begun: keys of those that were begun and did not get done.
    """

    folder: Path
    steps: dict[str, dict[str, Any]] = field(default_factory=dict)
    begun: dict[str, str] = field(default_factory=dict)

    @staticmethod
    def read(folder: Path) -> Done:
        """Read what earlier runs have done; nothing, where the file is missing or damaged."""
        try:
            found = read_json(folder / FILE)
            steps = {
                name: {"key": str(step["key"]), "seconds": float(step["seconds"]),
                       "peak_bytes": int(step["peak_bytes"])}
                for name, step in found["steps"].items()
            }  # fmt: skip
            return Done(folder, steps, dict(found.get("begun", {})))
        except (OSError, SvuError, ValueError, TypeError, KeyError, AttributeError):
            return Done(folder)

    def has(self, name: str, key: str, proof: Path) -> bool:
        """Return whether a step is done, of the same inputs."""
        return self.steps.get(name, {}).get("key") == key and proof.is_file()

    def begin(self, name: str, key: str, unfinished: Path | None) -> None:
        """Take a step out, before it is done again.

        Args:
            name: of the step.
            key: of its inputs.
            unfinished: what an interrupted command leaves to go on from. Of other inputs, or of
                nobody knows what, it is removed: no command would go on from it.
        """
        if unfinished is not None and self.begun.get(name) != key:
            unfinished.unlink(missing_ok=True)
        self.steps.pop(name, None)
        self.begun[name] = key
        self._write()

    def add(self, name: str, key: str, seconds: float, peak: int) -> None:
        """Keep that a step is done."""
        self.begun.pop(name, None)
        self.steps[name] = {"key": key, "seconds": round(seconds, 2), "peak_bytes": peak}
        self._write()

    def _write(self) -> None:
        write_json(self.folder / FILE, {"steps": self.steps, "begun": self.begun})


@dataclass(frozen=True)
class Outcome:
    """What became of a capture.

    Attributes:
        name: of the capture.
        folder: of its results.
        sentence: why it failed; empty if it did not.
        seconds: that all its steps took, also those of earlier runs.
        peak: bytes of the largest of its processes.
        made: number of steps that this run has done.
        done: names of the steps whose results are there, of what the capture and options are now.
        figures: what was found, by name: ``seen``, ``entropy`` and ``known``, parts in [0, 1].
    """

    name: str
    folder: Path
    sentence: str = ""
    seconds: float = 0.0
    peak: int = 0
    made: int = 0
    done: tuple[str, ...] = ()
    figures: dict[str, float] = field(default_factory=dict)


def figures_of(folder: Path) -> dict[str, float]:
    """Read what ``svu entropy`` has found of a capture; nothing, where it has not run."""
    try:
        found = read_json(folder / "entropy" / "run.json")["result"]
        intervals = found["intervals"]
        values = {
            "seen": intervals["seen_part"], "entropy": found["mean_entropy_of_seen"],
            "known": intervals["all_known_part"],
        }  # fmt: skip
        return {name: float(value) for name, value in values.items()}
    except (OSError, SvuError, ValueError, TypeError, KeyError):
        return {}
