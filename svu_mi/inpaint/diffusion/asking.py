"""Ask a model about one view after the other, each in agreement with those before it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from svu_mi.inpaint.diffusion.options import DiffusionOptions
from svu_mi.inpaint.diffusion.picture import Inventor
from svu_mi.inpaint.diffusion.shots import Shots
from svu_mi.progress import Stage


@dataclass(frozen=True)
class Task:
    """What a model is asked about.

    Attributes:
        values: (N, T), the textures so far.
        known: (T,) bool, texels that stay as they are.
        wanted: (T,) bool, texels that the model is asked about.
        chosen: numbers of the places of the pictures (``Shots.cover``).
    """

    values: np.ndarray
    known: np.ndarray
    wanted: np.ndarray
    chosen: Sequence[int]


@dataclass(frozen=True)
class Guess:
    """What a model makes of texels.

    Attributes:
        values: (N, T), of all texels; its guesses where it has reached them.
        reached: (T,) bool.
    """

    values: np.ndarray
    reached: np.ndarray


class Asking:
    """A model that is asked about views of one kind.

    Args:
        shots: where pictures come from.
        model: who is asked.
        options: how.
        stage: shows the steps.
    """

    def __init__(
        self, shots: Shots, model: Inventor, options: DiffusionOptions, stage: Stage
    ) -> None:
        self._shots, self._model, self._options, self._stage = shots, model, options, stage
        self._done = self._total = 0

    def expect(self, tasks: Sequence[Task]) -> None:
        """Say what is to come, for the bar."""
        pictures = sum(len(task.chosen) for task in tasks)
        self._total += pictures * self._model.runs * self._options.steps

    def guess(self, task: Task, seed: Sequence[int]) -> Guess:
        """Return what the model makes of a task.

        Args:
            task: what is asked.
            seed: numbers of no other task.
        """
        field = self._shots.field
        values, known, reached = task.values.copy(), task.known.copy(), np.zeros_like(task.known)
        for number, place in enumerate(task.chosen):
            seeds = np.random.SeedSequence([*seed, number]).generate_state(2)
            paths, noise = (int(one) for one in seeds)
            picture = self._shots.picture(place, values, known, paths)
            options = self._options
            maps = self._model.invent(picture, options.steps, options.free, noise, self._step)
            found, seen = self._shots.carried(picture.sensor, maps)
            new = task.wanted & seen & ~reached
            for name, of_texels in found.items():
                values[field.rows(name), new] = of_texels[:, new]
            known, reached = known | new, reached | new
        return Guess(values, reached)

    def _step(self) -> None:
        self._done += 1
        self._stage.update(self._done, self._total)
