"""Filling of unknown texels by a diffusion model (Sec. 5.3 of the paper).

Views are processed in sequence. In each, the model predicts maps that agree with certain pixels
(``latent_diffusion.blend``). A texel takes its value from the first view that shows it well, and is
certain in later views. Values of model and photographs are fused by their precisions:

    x = (x_p / s_p^2 + x_m / s_m^2) / (1 / s_p^2 + 1 / s_m^2)

s_m is the error on held-out certain parts of the same object. Texels that no view shows well are
filled by symmetry (``fill.py``), which also provides the initial maps of the model.
"""

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
from svu_mi.recovery.inpaint.cross_validation import holdout_masks
from svu_mi.recovery.inpaint.diffusion.conditioning_views import ConditioningViews
from svu_mi.recovery.inpaint.diffusion.load_weights import load_model
from svu_mi.recovery.inpaint.diffusion.model_interface import DiffusionOptions, MaterialModel
from svu_mi.recovery.inpaint.fill import fill, filled_values
from svu_mi.recovery.inpaint.fill_result import Answer, Filled, Fusion, ImageSource, ModelReport
from svu_mi.recovery.inpaint.texel_hierarchy import TexelGraph
from svu_mi.recovery.uncertainty.texture_field import TextureField


@dataclass(frozen=True)
class Task:
    """Texels to fill by a model.

    Attributes:
        values: (N, T), present values of the textures.
        known: (T,) bool, True for texels to keep.
        wanted: (T,) bool, True for texels to fill.
    """

    values: np.ndarray
    known: np.ndarray
    wanted: np.ndarray


TRIALS = 2  # held-out parts per kind of images
TRIAL_VIEWS = 2  # images per held-out part


def fill_by_diffusion(
    capture: Capture,
    field: TextureField,
    seen: np.ndarray,
    model: str | Path | MaterialModel,
    above: float = inf,
    options: DiffusionOptions | None = None,
    *,
    progress: Progress | None = None,
) -> Filled:
    """Fill unseen or uncertain texels by a diffusion model.

    Args:
        capture: Capture with scene and photographs.
        field: Recovered textures with standard deviations.
        seen: (T,) bool, True for texels that a photograph shows.
        model: Folder of weights (``load_model``), or a ``MaterialModel``.
        above: Limit of standard deviations above which seen texels are filled (``fill``).
        options: Number of views and steps, resolution, seed and device.
        progress: Display of stages.

    Raises:
        SvuEnvironmentError: PyTorch, diffusers or transformers are not installed.
        OptionError: The folder does not contain weights of a supported model.
        CaptureError: Too few texels are seen, or certain enough, for cross-validation.
        ShapeError: The shape of ``seen`` is not (T,).
    """
    options, progress = options or DiffusionOptions(), progress or Progress()
    loaded = load_model(model, options.device) if isinstance(model, str | Path) else model
    start = fill(field, seen, above, progress=progress)
    run = _MultiViewInference(capture, field, np.asarray(seen, bool), loaded, options, progress)
    return run.filled(start) if start.filled.any() else start


@dataclass(frozen=True)
class _MultiViewInference:
    """Sequential inference over views, with the arguments of ``fill_by_diffusion``."""

    capture: Capture
    field: TextureField
    shown: np.ndarray
    model: MaterialModel
    options: DiffusionOptions
    progress: Progress

    def filled(self, start: Filled) -> Filled:
        """Return ``start`` with the model's values at all filled texels that it reaches."""
        graph = TexelGraph.of(self.field, ~start.filled)
        masks = holdout_masks(graph)
        masks = masks[:: max(len(masks) // TRIALS, 1)][:TRIALS]
        trials = [
            Task(filled_values(graph.with_hidden(mask), start.weights), graph.known & ~mask, mask)
            for mask in masks
        ]
        fusion, answers = Fusion(self.field, self.shown, start.field), []
        rest = Task(start.field.values, graph.known, start.filled)
        used = tuple(np.flatnonzero(self.capture.used).tolist())
        for source in get_args(ImageSource):
            photographed = source == "photographs"
            views = ConditioningViews(
                self.capture, self.field, self.options.side, used if photographed else None
            )
            task = replace(rest, wanted=start.filled & (self.shown == photographed))
            inferred = self._infer(source, views, task, trials) if task.wanted.any() else None
            if inferred is None:
                continue
            answer, values = inferred
            rest = replace(rest, values=values, known=rest.known | answer.reached)
            answers.append(answer)
            for name, error in answer.errors.items():
                rows = self.field.rows(name)
                least = 0 if photographed else graph.known_variance[rows]
                sd = np.sqrt(np.maximum(error**2, least))
                fusion.fuse(name, answer.reached, values[rows], sd)
        reached = start.filled & rest.known
        invented = ModelReport(self.model.title, self.model.licence, tuple(answers), reached)
        return replace(start, field=fusion.fused_field(start.filled), invented=invented)

    def _infer(
        self, source: ImageSource, views: ConditioningViews, task: Task, trials: Sequence[Task]
    ) -> tuple[Answer, np.ndarray] | None:
        """Return the result on photographs or renders (``source``), and all values (N, T).

        Returns None if the model reaches no held-out texel, because its error is then unknown.
        """
        with self.progress.stage(f"Running the model on {source}") as stage:
            places = [views.choose_views(trial.wanted, TRIAL_VIEWS) for trial in trials]
            chosen = views.choose_views(task.wanted, self.options.views)
            pictures = sum(map(len, places)) + len(chosen)
            done, total = itertools.count(1), pictures * self.model.runs * self.options.steps

            def run(of: Task, at: Sequence[int], number: int) -> tuple[np.ndarray, np.ndarray]:
                seed = (self.options.seed, get_args(ImageSource).index(source), number)
                return self._predict(views, of, at, seed, lambda: stage.update(next(done), total))

            results = [run(*each) for each in zip(trials, places, range(len(trials)), strict=True)]
            if not any(reached.any() for _, reached in results):
                return None
            likeness = [(t.values, at) for t, (_, at) in zip(trials, results, strict=True)]
            values, reached = run(task, chosen, len(trials))
        return Answer(
            source, tuple(views.name(place) for place in chosen), reached,
            self._errors(results), self._errors(likeness),
        ), values  # fmt: skip

    def _predict(
        self, views: ConditioningViews, task: Task, places: Sequence[int], seed: Sequence[int],
        after_step: Callable[[], None],
    ) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
        """Return all values (N, T), and a mask (T,) of texels that the model reached."""
        values, known, reached = task.values.copy(), task.known.copy(), np.zeros_like(task.known)
        for number, place in enumerate(places):
            seeds = np.random.SeedSequence([*seed, number]).generate_state(2)
            paths, noise = (int(state) for state in seeds)
            picture = views.input_of(place, values, known, paths)
            options = self.options
            maps = self.model.predict(picture, options.steps, options.free, noise, after_step)
            predicted, seen = views.to_texels(picture.sensor, maps)
            new = task.wanted & seen & ~reached
            for name, of_texels in predicted.items():
                values[self.field.rows(name), new] = of_texels[:, new]
            known, reached = known | new, reached | new
        return values, reached

    def _errors(self, results: Sequence[tuple[np.ndarray, np.ndarray]]) -> dict[str, float]:
        """Return RMS errors by parameter, given values (N, T) and a mask (T,) per trial."""
        errors = [(values - self.field.values)[:, at] for values, at in results]
        means = (np.concatenate(errors, axis=1) ** 2).mean(axis=1)
        return {name: float(np.sqrt(means[self.field.rows(name)].mean())) for name in NAMES}
