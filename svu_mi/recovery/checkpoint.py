"""Checkpoints of a descent: one file that is complete or missing, and belongs to one run.

    checkpoint = Checkpoint("run/checkpoint.npz", {"seed": 0, ...}, resume=True)
    descend(objective, start, options, checkpoint=checkpoint)

The settings are everything that the result depends on, and the content is what it works on, as
digests; a checkpoint that was saved under others is refused.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from svu_mi.core.io.npz import LARGEST, Field, read_arrays, require_schema, write_arrays
from svu_mi.errors import OptionError, OutputError, excerpt

FORMAT = 5  # raised whenever a resumed run would continue otherwise than the one that saved
LOWEST = -LARGEST  # any finite number
GROUPS = ("values", "first", "second")  # of a state's arrays by name of the parameter
# Of every checkpoint, whatever the parameters.
HEAD = {
    "format": Field("iu"), "settings": Field("U"), "content": Field("U"), "step": Field("iu", low=0)
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class DescentState:
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
    """A file that states of one run are saved to; attributes are as the arguments."""

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
            settings: names and values that JSON can hold, nested to any depth.
            content: digests of what the run works on, by words for messages, such as ``sensors``.
            resume: whether a descent starts from what the file holds.
            every: seconds between two states; 0 saves whenever losses are read.
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

    def save(self, state: DescentState) -> None:
        """Replace the state that was saved before."""
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
        """Read the state that was saved last; None when there is no file.

        Args:
            shapes: of the run's parameters, by name.
        """
        if not self.path.exists():
            return None
        try:
            stored = read_arrays(self.path)
            require_schema({name: stored[name] for name in HEAD if name in stored}, HEAD)
            self._require_same(stored)
            return _state(stored, shapes)
        except (ValueError, RecursionError) as error:
            raise OutputError(
                f"{self.path}: the checkpoint is damaged ({excerpt(error)}); remove it and start "
                "again."
            ) from error

    def _require_same(self, stored: Mapping[str, np.ndarray]) -> None:
        """Refuse the checkpoint of another run, and say what is different."""
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
                f"{self.path}: the checkpoint belongs to another run ({excerpt(key, 80)} was "
                f"{there} there and is {here} here); resume with the same settings, or remove it "
                "and start again."
            )


def _canonical(settings: Mapping[str, Any]) -> str:
    return json.dumps(settings, sort_keys=True, allow_nan=False)


def _state(stored: Mapping[str, np.ndarray], shapes: Mapping[str, tuple[int, ...]]) -> DescentState:
    """Return what was read as a state; a ValueError if it is none of these parameters."""
    schema = {**HEAD, "losses": Field("f4", (int(stored["step"]),), LOWEST)}
    for name, shape in shapes.items():
        size = (int(np.prod(shape)),)
        schema |= {
            f"values/{name}": Field("f4", shape, LOWEST),
            f"first/{name}": Field("f4", size, LOWEST),
            f"second/{name}": Field("f4", size, low=0),
        }  # fmt: skip
    require_schema(stored, schema)
    groups = {g: {name: stored[f"{g}/{name}"] for name in shapes} for g in GROUPS}
    return DescentState(step=int(stored["step"]), losses=stored["losses"], **groups)


def _changed(mine: Mapping[str, Any], other: Mapping[str, Any]) -> list[str]:
    return sorted(key for key in {**mine, **other} if mine.get(key) != other.get(key))


def _flat(settings: Any, prefix: str = "") -> dict[str, Any]:
    """Return nested settings as one dictionary with dotted names."""
    if not isinstance(settings, Mapping):
        raise ValueError("its settings are not a JSON object")
    flat: dict[str, Any] = {}
    for key, value in settings.items():
        nested = isinstance(value, Mapping)
        flat |= _flat(value, f"{prefix}{key}.") if nested else {f"{prefix}{key}": value}
    return flat
