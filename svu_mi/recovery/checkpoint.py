"""Checkpoints of a descent: one file that is whole or not there, and knows whose it is.

    checkpoint = Checkpoint("run/checkpoint.npz", {"seed": 0, ...}, resume=True)
    descend(objective, start, options, checkpoint=checkpoint)

The settings are everything that the result depends on, as far as the caller can say it; a
checkpoint that was saved under others is refused.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from svu_mi.errors import OptionError, OutputError
from svu_mi.files import replacing

FORMAT = 3  # raised whenever a resumed run would go on otherwise than the one that saved


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


class Checkpoint:
    """A file that states of one run are saved to.

    Attributes:
        path: the file; there is none before the first state is saved.
        settings: what the run's result depends on, as JSON has it.
        resume: go on from the file, if there is one.
        every: seconds between two states.
    """

    def __init__(
        self,
        path: str | Path,
        settings: Mapping[str, Any],
        *,
        resume: bool = False,
        every: float = 30.0,
    ) -> None:
        """Name a file and what is saved in it; neither is touched yet.

        Args:
            path: the file, ``.npz``; its folder must exist.
            settings: names and values that JSON can hold; nested dictionaries and lists are
                fine.
            resume: whether a descent starts from what the file holds.
            every: seconds between two states; 0 saves whenever losses are read.

        Raises:
            OptionError: ``every`` is negative, or a setting cannot be written as JSON.
        """
        if not every >= 0:
            raise OptionError(f"Checkpoint: every must be seconds, at least 0, got {every!r}.")
        self.path, self.resume, self.every = Path(path), resume, every
        try:
            self.settings: dict[str, Any] = json.loads(_canonical(settings))
        except (TypeError, ValueError) as error:
            raise OptionError(
                f"Checkpoint: a setting cannot be written down ({error}); give numbers, text, "
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
            "step": np.array(state.step),
            "losses": np.asarray(state.losses, np.float32),
        }
        for group in ("values", "first", "second"):
            arrays |= {f"{group}/{name}": a for name, a in getattr(state, group).items()}
        text = _canonical(self.settings)
        arrays |= {
            "format": np.array(FORMAT),
            "settings": np.array(text),
            "digest": np.array(_digest(text, arrays)),
        }
        with replacing(self.path) as temporary:
            np.savez(temporary, **arrays)
        self._saved = time.monotonic()

    def load(self) -> State | None:
        """Read the state that was saved last; None when there is no file.

        Raises:
            OutputError: the file is damaged.
            OptionError: it was saved by a run with other settings.
        """
        if not self.path.exists():
            return None
        stored = self._read()
        self._require_same(json.loads(str(stored["settings"])))
        groups: dict[str, dict[str, np.ndarray]] = {"values": {}, "first": {}, "second": {}}
        for key, array in stored.items():
            group, _, name = key.partition("/")
            if name:
                groups[group][name] = array
        return State(step=int(stored["step"]), losses=stored["losses"], **groups)

    def _read(self) -> dict[str, np.ndarray]:
        """Read all arrays and see whether they are those that were written."""
        try:
            # Opened here: NumPy leaves its own file open when the archive is broken.
            with self.path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
                stored = dict(archive)
            found = int(stored.pop("format"))
            digest = str(stored.pop("digest"))
            text = str(stored["settings"])
            whole = digest == _digest(text, {k: a for k, a in stored.items() if k != "settings"})
        except Exception as error:  # a broken archive fails in any way that a zip file can
            raise OutputError(
                f"{self.path}: the checkpoint is damaged ({error}); remove it and start again."
            ) from error
        if found != FORMAT:
            raise OptionError(
                f"{self.path}: the checkpoint was written by another version of svu_mi; remove "
                "it and start again."
            )
        if not whole:
            raise OutputError(
                f"{self.path}: the checkpoint is damaged (its digest does not fit); remove it "
                "and start again."
            )
        return stored

    def _require_same(self, stored: dict[str, Any]) -> None:
        """Refuse the checkpoint of another run, and say what is different."""
        mine, other = _flat(self.settings), _flat(stored)
        changed = sorted(key for key in mine | other if mine.get(key) != other.get(key))
        if changed:
            key = changed[0]
            raise OptionError(
                f"{self.path}: the checkpoint belongs to another run ({key} was "
                f"{other.get(key)!r} there and is {mine.get(key)!r} here); resume with the same "
                "settings, or choose another file."
            )


def _canonical(settings: Mapping[str, Any]) -> str:
    return json.dumps(settings, sort_keys=True, allow_nan=False)


def _digest(text: str, arrays: Mapping[str, np.ndarray]) -> str:
    total = hashlib.sha256(text.encode())
    for key in sorted(arrays):
        array = np.ascontiguousarray(arrays[key])
        total.update(f"{key} {array.dtype} {array.shape} ".encode())
        total.update(array.tobytes())
    return total.hexdigest()


def _flat(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested settings as one dictionary with dotted names."""
    found: dict[str, Any] = {}
    for key, value in settings.items():
        if isinstance(value, Mapping):
            found |= _flat(value, f"{prefix}{key}.")
        else:
            found[f"{prefix}{key}"] = value
    return found
