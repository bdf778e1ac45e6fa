"""Checkpoints of a descent, in one file that is replaced atomically.

    checkpoint = Checkpoint("run/checkpoint.npz", {"seed": 0, ...}, resume=True)
    descend(objective, start, options, checkpoint=checkpoint)

A checkpoint stores the settings of its run and digests of its inputs. Loading raises an error if
these differ in the present run.
"""

import json
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from svu_mi.core.io.npz import read_arrays, write_arrays
from svu_mi.core.io.schema import LARGEST, TEXT, WHOLE, Field, checked
from svu_mi.errors import OptionError, OutputError, excerpt

FORMAT = 6  # incremented when older checkpoints would give other results
LOWEST = -LARGEST  # lower limit of finite numbers
GROUPS = ("values", "first", "second")  # attributes of a state with one array per parameter
# Arrays of every checkpoint.
HEAD = {
    "format": Field(WHOLE), "settings": Field(TEXT), "content": Field(TEXT),
    "step": Field(WHOLE, low=0, high=2**31),
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class DescentState:
    """State of a descent after a number of steps, as NumPy copies.

    Attributes:
        step: Number of steps taken.
        values: Parameters by name: (H, W, C) float32 textures.
        first, second: Adam's means of gradients and of squared gradients: flat float32, by name.
        losses: (step,) float32, loss before each step.
    """

    step: int
    values: dict[str, np.ndarray]
    first: dict[str, np.ndarray]
    second: dict[str, np.ndarray]
    losses: np.ndarray


class Checkpoint:
    """Checkpoint file of one run. Attributes are the arguments of ``__init__``."""

    def __init__(
        self,
        path: str | Path,
        settings: Mapping[str, Any],
        *,
        content: Mapping[str, str] | None = None,
        resume: bool = False,
        every: float = 30.0,
    ) -> None:
        """Define a checkpoint without accessing the file.

        Args:
            path: Path of the file, ``.npz``, in an existing folder.
            settings: All settings that affect the result, as values that JSON can store.
            content: Digests of the inputs, by the names in messages, such as ``sensors``.
            resume: True to start descents from the stored state.
            every: Seconds between saved states; 0 saves whenever losses are read.
        """
        if not every >= 0:
            raise OptionError(f"Checkpoint: every must be at least 0 seconds, got {every!r}.")
        self.path, self.resume, self.every = Path(path), resume, every
        self.content = dict(content or {})
        try:
            self.settings: dict[str, Any] = json.loads(_canonical(settings))
        except (TypeError, ValueError) as error:
            raise OptionError(
                f"Checkpoint: a setting cannot be written as JSON ({error}); use numbers, strings, "
                "lists and dictionaries."
            ) from error
        self._saved = time.monotonic()

    @property
    def due(self) -> bool:
        """True if ``every`` seconds have passed since the last save."""
        return time.monotonic() - self._saved >= self.every

    def save(self, state: DescentState) -> None:
        """Write a state; replaces the file atomically."""
        arrays: dict[str, Any] = {
            "format": FORMAT,
            "settings": _canonical(self.settings),
            "content": _canonical(self.content),
            "step": state.step,
            "losses": np.asarray(state.losses, np.float32),
        }
        for group in GROUPS:
            arrays |= {f"{group}/{name}": a for name, a in getattr(state, group).items()}
        write_arrays(self.path, arrays)
        self._saved = time.monotonic()

    def load(self, shapes: Mapping[str, tuple[int, ...]]) -> DescentState | None:
        """Read the saved state; None if the file does not exist.

        Args:
            shapes: Expected shapes of the parameters, by name.

        Raises:
            OptionError: The checkpoint belongs to another run or version.
            OutputError: The file is damaged.
        """
        if not self.path.exists():
            return None
        try:
            stored = read_arrays(self.path)
            self._require_same(checked(stored, HEAD))
            return _state(stored, shapes)
        except (ValueError, RecursionError) as error:
            raise OutputError(
                f"{self.path}: the checkpoint is damaged ({excerpt(error)}); remove it and start "
                "again."
            ) from error

    def _require_same(self, stored: Mapping[str, np.ndarray]) -> None:
        """Raise an error that names the difference if ``stored`` is of another run."""
        if int(stored["format"]) != FORMAT:
            raise OptionError(
                f"{self.path}: the checkpoint was written by another version of svu_mi; remove it "
                "and start again."
            )
        content, settings = (_flat(json.loads(str(stored[key]))) for key in ("content", "settings"))
        if changed := _changed(self.content, content):
            raise OptionError(
                f"{self.path}: the checkpoint belongs to another run (changed since: "
                f"{excerpt(', '.join(changed))}); resume with the original inputs, or remove "
                "it and start again."
            )
        mine = _flat(self.settings)
        for key in _changed(mine, settings):
            there, here = (excerpt(repr(each.get(key)), 80) for each in (settings, mine))
            raise OptionError(
                f"{self.path}: the checkpoint belongs to another run ({excerpt(key, 80)} is "
                f"{there} in the file, {here} now); resume with the same settings, or remove it "
                "and start again."
            )


def _canonical(settings: Mapping[str, Any]) -> str:
    return json.dumps(settings, sort_keys=True, allow_nan=False)


def _state(stored: Mapping[str, np.ndarray], shapes: Mapping[str, tuple[int, ...]]) -> DescentState:
    """Convert stored arrays to a state; raise a ValueError for wrong shapes."""
    schema = {**HEAD, "losses": Field("f4", (int(stored["step"]),), LOWEST)}
    for name, shape in shapes.items():
        size = (int(np.prod(shape)),)
        schema |= {
            f"values/{name}": Field("f4", shape, LOWEST),
            f"first/{name}": Field("f4", size, LOWEST),
            f"second/{name}": Field("f4", size, low=0),
        }  # fmt: skip
    checked(stored, schema, closed=True)
    groups = {g: {name: stored[f"{g}/{name}"] for name in shapes} for g in GROUPS}
    return DescentState(step=int(stored["step"]), losses=stored["losses"], **groups)


def _changed(mine: Mapping[str, Any], other: Mapping[str, Any]) -> list[str]:
    return sorted(key for key in {**mine, **other} if mine.get(key) != other.get(key))


def _flat(settings: Any, prefix: str = "") -> dict[str, Any]:
    """Flatten nested settings into one dictionary with dotted keys."""
    if not isinstance(settings, Mapping):
        raise ValueError("the settings are not a JSON object")
    flat: dict[str, Any] = {}
    for key, value in settings.items():
        nested = isinstance(value, Mapping)
        flat |= _flat(value, f"{prefix}{key}.") if nested else {f"{prefix}{key}": value}
    return flat
