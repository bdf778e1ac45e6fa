"""Fill what nobody knows by a diffusion model, between what is known (Sec. 5.3 of the paper).

In one view after the other, the model invents maps that agree with what is certain there
(``model.blend``); texels take their values from the first view that shows them well, and are what
later views have to agree with. What the model makes of a texel counts by its precision, beside
what the photographs say of that texel by theirs:

    x = (x_p / s_p^2 + x_m / s_m^2) / (1 / s_p^2 + 1 / s_m^2)

s_m is found out on the object itself: parts of what is certain are hidden, guessed in the same
way, and compared. What no view shows well is filled by symmetry (``fill.py``), and so
are the pictures that the model is shown where it has not been yet.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import inf
from pathlib import Path
from typing import get_args

import numpy as np

from svu_mi.capture.capture import Capture
from svu_mi.core.progress import Progress
from svu_mi.parameters import NAMES
from svu_mi.recovery.inpaint.cross_validation import hidden_parts
from svu_mi.recovery.inpaint.diffusion.conditioning_views import Shots
from svu_mi.recovery.inpaint.diffusion.load_weights import load_model
from svu_mi.recovery.inpaint.diffusion.model_interface import DiffusionOptions, Inventor
from svu_mi.recovery.inpaint.fill import by_likeness, fill, variance
from svu_mi.recovery.inpaint.fill_result import Answer, Filled, Filling, Invented, Source
from svu_mi.recovery.inpaint.texel_hierarchy import Ground
from svu_mi.recovery.uncertainty.texture_field import TextureField


@dataclass(frozen=True)
class Task:
    """What a model is asked about.

    Attributes:
        values: (N, T), the textures so far.
        known: (T,) bool, texels that stay as they are.
        wanted: (T,) bool, texels that the model is asked about.
    """

    values: np.ndarray
    known: np.ndarray
    wanted: np.ndarray


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
        ground = Ground.of(self.field, ~start.filled)
        parts = hidden_parts(ground)
        parts = parts[:: max(len(parts) // TRIALS, 1)][:TRIALS]
        trials = [
            Task(by_likeness(ground.without(part), start.weights), ground.known & ~part, part)
            for part in parts
        ]
        filling, answers = Filling(self.field, self.shown, start.field), []
        unlike = variance(self.field, ground.known)
        rest = Task(start.field.values, ground.known, start.filled)
        used = tuple(np.flatnonzero(self.capture.used).tolist())
        for source in get_args(Source):
            photographed = source == "photographs"
            shots = Shots(
                self.capture, self.field, self.options.side, used if photographed else None
            )
            task = replace(rest, wanted=start.filled & (self.shown == photographed))
            found = self._answer(source, shots, task, trials) if task.wanted.any() else None
            if found is None:
                continue
            answer, values = found
            rest = replace(rest, values=values, known=rest.known | answer.reached)
            answers.append(answer)
            for name, error in answer.errors.items():
                rows = self.field.rows(name)
                off = np.sqrt(np.maximum(error**2, 0 if photographed else unlike[rows]))
                filling.put(name, answer.reached, values[rows], off)
        reached = start.filled & rest.known
        invented = Invented(self.model.title, self.model.licence, tuple(answers), reached)
        return replace(start, field=filling.done(start.filled), invented=invented)

    def _answer(
        self, source: Source, shots: Shots, task: Task, trials: Sequence[Task]
    ) -> tuple[Answer, np.ndarray] | None:
        """Return how far the model gets with pictures of a kind, and all values (N, T); None if it
        reaches nothing that is hidden, so that its error is unknown."""
        with self.progress.stage(f"Asking the model about {source}") as stage:
            places = [shots.cover(trial.wanted, TRIAL_VIEWS) for trial in trials]
            chosen = shots.cover(task.wanted, self.options.views)
            pictures = sum(map(len, places)) + len(chosen)
            done, total = itertools.count(1), pictures * self.model.runs * self.options.steps

            def ask(one: Task, some: Sequence[int], number: int) -> tuple[np.ndarray, np.ndarray]:
                seed = (self.options.seed, get_args(Source).index(source), number)
                return self._guess(shots, one, some, seed, lambda: stage.update(next(done), total))

            guesses = [ask(*each) for each in zip(trials, places, range(len(trials)), strict=True)]
            if not any(reached.any() for _, reached in guesses):
                return None
            likeness = [(t.values, at) for t, (_, at) in zip(trials, guesses, strict=True)]
            values, reached = ask(task, chosen, len(trials))
        return Answer(
            source, tuple(shots.name(place) for place in chosen), reached,
            self._errors(guesses), self._errors(likeness),
        ), values  # fmt: skip

    def _guess(
        self, shots: Shots, task: Task, places: Sequence[int], seed: Sequence[int],
        after_step: Callable[[], None],
    ) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
        """Return all values (N, T), and which texels (T,) the model has reached."""
        values, known, reached = task.values.copy(), task.known.copy(), np.zeros_like(task.known)
        for number, place in enumerate(places):
            seeds = np.random.SeedSequence([*seed, number]).generate_state(2)
            paths, noise = (int(one) for one in seeds)
            picture = shots.picture(place, values, known, paths)
            options = self.options
            maps = self.model.invent(picture, options.steps, options.free, noise, after_step)
            found, seen = shots.carried(picture.sensor, maps)
            new = task.wanted & seen & ~reached
            for name, of_texels in found.items():
                values[self.field.rows(name), new] = of_texels[:, new]
            known, reached = known | new, reached | new
        return values, reached

    def _errors(self, guesses: Sequence[tuple[np.ndarray, np.ndarray]]) -> dict[str, float]:
        """Return root mean square errors of values (N, T) in some texels (T,), by parameter."""
        off = [(values - self.field.values)[:, at] for values, at in guesses]
        means = (np.concatenate(off, axis=1) ** 2).mean(axis=1)
        return {name: float(np.sqrt(means[self.field.rows(name)].mean())) for name in NAMES}
