"""Fill what nobody knows by a diffusion model, between what is known (Sec. 5.3 of the paper).

In one view after the other, the model invents maps that agree with what is certain there
(``model.blend``); texels take their values from the first view that shows them well, and are what
later views have to agree with. What the model makes of a texel counts by its precision, beside
what the photographs say of that texel by theirs:

    x = (x_p / s_p^2 + x_m / s_m^2) / (1 / s_p^2 + 1 / s_m^2)

s_m is found out on the object itself: parts of what is certain are hidden, guessed in the same way,
and compared. What no view shows well is filled by likeness (``svu_mi.inpaint.fill``), and so are
the pictures that the model is shown where it has not been yet.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf
from pathlib import Path
from typing import get_args

import numpy as np

from svu_mi.capture import Capture
from svu_mi.inpaint.cross_validation import hidden_parts
from svu_mi.inpaint.diffusion.conditioning_views import Shots
from svu_mi.inpaint.diffusion.load_weights import load_model
from svu_mi.inpaint.diffusion.model_interface import DiffusionOptions, Inventor
from svu_mi.inpaint.fill import by_likeness, fill, variance
from svu_mi.inpaint.fill_result import Answer, Filled, Filling, Invented, Source
from svu_mi.inpaint.texel_hierarchy import Ground
from svu_mi.parameters import NAMES
from svu_mi.progress import Progress, Stage
from svu_mi.recovery.field.field import TextureField


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
        """Return what the model makes of a task."""
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


TRIALS = 2  # parts that are hidden, of each kind of picture
TRIAL_VIEWS = 2  # pictures of each


def fill_by_diffusion(
    capture: Capture,
    field: TextureField,
    seen: np.ndarray,
    model: str | Path | Inventor,
    above: float = inf,
    options: DiffusionOptions | None = None,
    *,
    progress: Progress | None = None,
) -> Filled:
    """Fill texels that nobody saw, or that are less sure than asked, by a diffusion model.

    Args:
        capture: the photographs.
        field: recovered textures, and how sure they are.
        seen: (T,) bool, texels that a photograph shows.
        model: folder of weights (``load_model``); or what stands in for a model.
        above: standard deviation of any parameter from which on a texel that was seen is filled,
            too (``fill``).
        options: how the model is asked.
        progress: shows what is going on.

    Raises:
        SvuEnvironmentError: PyTorch, diffusers or transformers are not installed.
        OptionError: the folder holds no weights that are known.
        CaptureError: nothing is seen, or nothing surely enough, or too little to guess from.
        ShapeError: flags of other texels.
    """
    options, progress = options or DiffusionOptions(), progress or Progress()
    inventor = load_model(model, options.device) if isinstance(model, str | Path) else model
    start = fill(field, seen, above, progress=progress)
    asked = _Object(capture, field, np.asarray(seen, bool), inventor, options, progress)
    return asked.filled(start) if start.filled.any() else start


@dataclass(frozen=True)
class _Trial:
    """A part of what is known that is hidden.

    Attributes:
        hidden: (T,) bool.
        without: (N, T), all values, filled by likeness where nothing is known of it.
    """

    hidden: np.ndarray
    without: np.ndarray


@dataclass(frozen=True)
class _Object:
    """An object that a model is asked about; attributes as ``fill_by_diffusion`` has them."""

    capture: Capture
    field: TextureField
    shown: np.ndarray
    model: Inventor
    options: DiffusionOptions
    progress: Progress

    def filled(self, start: Filled) -> Filled:
        """Return what likeness has filled, filled by the model as far as it reaches."""
        trials = self._trials(start)
        filling, answers = Filling(self.field, self.shown, start.field), []
        unlike = variance(self.field, ~start.filled)
        rest = Task(start.field.values, ~start.filled, start.filled, ())
        for source, shots in self._sources().items():
            task = replace(rest, wanted=start.filled & (self.shown == (source == "photographs")))
            answer, guess = self._answer(source, shots, task, trials)
            if answer is None:
                continue
            rest = replace(rest, values=guess.values, known=rest.known | guess.reached)
            answers.append(answer)
            for name, error in answer.errors.items():
                rows = self.field.rows(name)
                least = unlike[rows] if source == "renders" else np.zeros((1, 1))
                off = np.sqrt(np.maximum(error**2, least))
                filling.put(name, guess.reached, guess.values[rows], off)
        reached = start.filled & rest.known
        invented = Invented(self.model.title, self.model.licence, tuple(answers), reached)
        return replace(start, field=filling.done(start.filled), invented=invented)

    def _sources(self) -> dict[Source, Shots]:
        used = tuple(int(view) for view in np.flatnonzero(self.capture.used))
        shots = Shots(self.capture, self.field, self.options.side)
        return {"photographs": replace(shots, photographs=used), "renders": shots}

    def _trials(self, start: Filled) -> list[_Trial]:
        ground = Ground.of(self.field, ~start.filled)
        parts = hidden_parts(ground)
        some = parts[:: max(len(parts) // TRIALS, 1)][:TRIALS]
        return [_Trial(part, by_likeness(ground.without(part), start.weights)) for part in some]

    def _answer(
        self, source: Source, shots: Shots, task: Task, trials: Sequence[_Trial]
    ) -> tuple[Answer | None, Guess]:
        """Return what the model makes of a task, and how far off it is with pictures of a kind;
        None if there is nothing to ask, or nobody could say how far off it is."""
        nothing = Guess(task.values, np.zeros_like(task.known))
        if not task.wanted.any():
            return None, nothing
        number = get_args(Source).index(source)
        with self.progress.stage(f"Asking the model about {source}") as stage:
            tasks = [Task(t.without, task.known & ~t.hidden, t.hidden,
                          shots.cover(t.hidden, TRIAL_VIEWS)) for t in trials]  # fmt: skip
            task = replace(task, chosen=shots.cover(task.wanted, self.options.views))
            asking = Asking(shots, self.model, self.options, stage)
            asking.expect([*tasks, task])
            guesses = [asking.guess(one, (self.options.seed, number, k))
                       for k, one in enumerate(tasks)]  # fmt: skip
            errors = self._errors(tasks, guesses)
            if not errors:
                return None, nothing
            guess = asking.guess(task, (self.options.seed, number, len(tasks)))
        pictures = tuple(shots.places.names[place] for place in task.chosen)
        return Answer(source, pictures, guess.reached, *errors), guess

    def _errors(
        self, tasks: Sequence[Task], guesses: Sequence[Guess]
    ) -> tuple[dict[str, float], ...]:
        """Return how far off the model was where it was tried, and likeness at the same texels:
        root mean squares by parameter; nothing if it was nowhere."""
        squares = [
            (values[:, guess.reached] - self.field.values[:, guess.reached]) ** 2
            for task, guess in zip(tasks, guesses, strict=True)
            for values in (guess.values, task.values)
        ]
        if not any(part.size for part in squares):
            return ()
        means = (np.concatenate(squares[k::2], axis=1).mean(axis=1) for k in range(2))
        return tuple(
            {name: float(np.sqrt(mean[self.field.rows(name)].mean())) for name in NAMES}
            for mean in means
        )
