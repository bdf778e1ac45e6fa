"""Checkpoints of a descent: one file that is whole or not there, and knows whose it is.

    checkpoint = Checkpoint("run/checkpoint.npz", {"seed": 0, ...}, resume=True)
    descend(objective, start, options, checkpoint=checkpoint)

The settings are everything that the result depends on, as far as the caller can say it, and the
content is what it works on, by digests; a checkpoint that was saved under others is refused.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from svu_mi.errors import OptionError, OutputError, excerpt
from svu_mi.npz import read_arrays, write_arrays

FORMAT = 5  # raised whenever a resumed run would go on otherwise than the one that saved
GROUPS = ("values", "first", "second")  # of a state's arrays by name of the parameter
RECORDS = ("format", "settings", "content", "step", "losses")


@dataclass(frozen=True, kw_only=True)
class State:
    """A descent after a number of steps; NumPy copies, so nothing of it changes any more.

    Attributes:
        step: number of steps that were taken.
        values: the parameters, by name, as textures (H, W, C) float32.
        first, second: Adam's means of the gradient and of its square, flat float32, by name.
        losses: (step,) float32.
    """

    step: int
    values: dict[str, np.ndarray]
    first: dict[str, np.ndarray]
    second: dict[str, np.ndarray]
    losses: np.ndarray

    def require_fit(self, label: str, shapes: Mapping[str, tuple[int, ...]], steps: int) -> None:
        """Refuse a state of other parameters, or behind the end of a run.

        Args:
            label: names the file in messages.
            shapes: of the run's parameters, by name.
            steps: that the run takes at most.

        Raises:
            OptionError: it does not fit.
        """
        stored = {name: value.shape for name, value in self.values.items()}
        if dict(shapes) != stored:
            raise OptionError(
                f"{label}: the checkpoint has the parameters {excerpt(stored)}, but this run has "
                f"{shapes}; remove it and start again."
            )
        if self.step > steps:
            raise OptionError(
                f"{label}: the checkpoint has {self.step} steps, but this run takes at most "
                f"{steps}; remove it and start again."
            )


class Checkpoint:
    """A file that states of one run are saved to.

    Attributes:
        path: the file; there is none before the first state is saved.
        settings: what the run's result depends on, as JSON has it.
        content: digests of what it works on, by words for messages, such as ``sensors``.
        resume: go on from the file, if there is one.
        every: seconds between two states.
    """

    def __init__(
        self,
        path: str | Path,
        settings: Mapping[str, Any],
        *,
        content: Mapping[str, str] | None = None,
        resume: bool = False,
        every: float = 30.0,
    ) -> None:
        """Name a file and what is saved in it; neither is touched yet.

        Args:
            path: the file, ``.npz``; its folder must exist.
            settings: names and values that JSON can hold; nested dictionaries and lists are
                fine.
            content: digests of what the run works on, by name.
            resume: whether a descent starts from what the file holds.
            every: seconds between two states; 0 saves whenever losses are read.

        Raises:
            OptionError: ``every`` is negative, or a setting cannot be written as JSON.
        """
        if not every >= 0:
            raise OptionError(f"Checkpoint: every must be at least 0 seconds, got {every!r}.")
        self.path, self.resume, self.every = Path(path), resume, every
        self.content = dict(content or {})
        try:
            self.settings: dict[str, Any] = json.loads(_canonical(settings))
        except (TypeError, ValueError) as error:
            raise OptionError(
                f"Checkpoint: a setting cannot be written as JSON ({error}); give numbers, text, "
                "lists and dictionaries."
            ) from error
        self._saved = time.monotonic()

    @property
    def due(self) -> bool:
        """Whether ``every`` seconds have passed since a state was saved."""
        return time.monotonic() - self._saved >= self.every

    def save(self, state: State) -> None:
        """Write a state in the place of the one before; never half of it.

        Raises:
            OutputError: the file cannot be written.
        """
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

    def load(self) -> State | None:
        """Read the state that was saved last; None when there is no file.

        Raises:
            OutputError: the file is damaged.
            OptionError: it was saved by another run, or by another version of svu_mi.
        """
        if not self.path.exists():
            return None
        try:
            stored = read_arrays(self.path)
            if _whole(stored, "format") != FORMAT:
                raise OptionError(
                    f"{self.path}: the checkpoint was written by another version of svu_mi; "
                    "remove it and start again."
                )
            settings, content = _object(stored, "settings"), _object(stored, "content")
            state = _state(stored)
        except ValueError as error:
            raise OutputError(
                f"{self.path}: the checkpoint is damaged ({error}); remove it and start again."
            ) from error
        self._require_content(content)
        self._require_same(settings)
        return state

    def _require_content(self, stored: dict[str, Any]) -> None:
        """Refuse the checkpoint of a run that worked on something else, and say what it is."""
        mine = self.content
        changed = sorted(key for key in mine | stored if mine.get(key) != stored.get(key))
        if changed:
            raise OptionError(
                f"{self.path}: the checkpoint belongs to another run (changed since: "
                f"{excerpt(', '.join(changed))}); resume with the original inputs, or remove "
                "it and start again."
            )

    def _require_same(self, stored: dict[str, Any]) -> None:
        """Refuse the checkpoint of another run, and say what is different."""
        mine, other = _flat(self.settings), stored
        changed = sorted(key for key in mine | other if mine.get(key) != other.get(key))
        if changed:
            key = changed[0]
            raise OptionError(
                f"{self.path}: the checkpoint belongs to another run ({excerpt(key, 80)} was "
                f"{_shown(other.get(key))} there and is {_shown(mine.get(key))} here); resume with "
                "the same settings, or remove it and start again."
            )


def _shown(value: Any) -> str:
    return excerpt(repr(value), 80)


def _canonical(settings: Mapping[str, Any]) -> str:
    return json.dumps(settings, sort_keys=True, allow_nan=False)


def _state(stored: Mapping[str, np.ndarray]) -> State:
    """Return what was read as a state.

    Raises:
        ValueError: something is missing, or is not what a descent saves.
    """
    groups: dict[str, dict[str, np.ndarray]] = {group: {} for group in GROUPS}
    for key, array in stored.items():
        group, separator, name = key.partition("/")
        if separator and group in groups:
            groups[group][name] = array
        elif key not in RECORDS:
            raise ValueError(f"it has an unknown array {excerpt(key, 40)!r}")
    step, values = _whole(stored, "step"), groups["values"]
    moments = {name: (value.size,) for name, value in values.items()}
    textures = {name: value.shape for name, value in values.items()}
    shapes: dict[str, Any] = {"values": textures, "first": moments, "second": moments}
    for group, wanted in shapes.items():
        if {name: array.shape for name, array in groups[group].items()} != wanted:
            raise ValueError(f"the arrays of {group!r} are not those of its parameters")
    if "losses" not in stored or stored["losses"].shape != (step,):
        raise ValueError(f"it does not have one loss for each of its {step} steps")
    for array in (stored["losses"], *(a for group in groups.values() for a in group.values())):
        if array.dtype != np.float32 or not np.isfinite(array).all():
            raise ValueError("it has values that are NaN, infinite or not float32")
    if any(array.size and array.min() < 0 for array in groups["second"].values()):
        raise ValueError("a mean of squares is negative")
    return State(step=step, losses=stored["losses"], **groups)


def _whole(stored: Mapping[str, np.ndarray], name: str) -> int:
    array = stored.get(name)
    if array is None or array.shape or array.dtype.kind not in "iu" or array < 0:
        raise ValueError(f"{name!r} is not a whole number")
    return int(array)


def _object(stored: Mapping[str, np.ndarray], name: str) -> dict[str, Any]:
    """Return a JSON object, nested names and all (``_flat``)."""
    array = stored.get(name)
    if array is None or array.shape or array.dtype.kind != "U":
        raise ValueError(f"{name!r} is not text")
    try:
        found = json.loads(str(array))
        if isinstance(found, dict):
            return _flat(found)
    except RecursionError:
        pass
    raise ValueError(f"{name!r} is not a JSON object")


def _flat(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested settings as one dictionary with dotted names."""
    found: dict[str, Any] = {}
    for key, value in settings.items():
        if isinstance(value, Mapping):
            found |= _flat(value, f"{prefix}{key}.")
        else:
            found[f"{prefix}{key}"] = value
    return found
