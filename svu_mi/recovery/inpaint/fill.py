"""Filling of unseen texels by symmetry and total variation, with standard deviations.

No predictor is right for all objects. So a texel gets the weighted mean of all of them
(``combine_predictors``), for each parameter separately; cross-validation on seen parts of the
surface, hidden in turn, gives the weights and the error of that mean (``cross_validation``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import inf

import numpy as np

from svu_mi.core.progress import Progress, Stage
from svu_mi.errors import CaptureError, OptionError, ShapeError
from svu_mi.parameters import NAMES
from svu_mi.recovery.inpaint.combine_predictors import mixed
from svu_mi.recovery.inpaint.cross_validation import Judged, Trial, distances, hidden_parts
from svu_mi.recovery.inpaint.fill_result import Filled, Filling, Weights
from svu_mi.recovery.inpaint.texel_hierarchy import Ground
from svu_mi.recovery.uncertainty.texture_field import TextureField

DECIDES = "base_color"  # what photographs tell best, and so how far anything is alike


def fill(
    field: TextureField, seen: np.ndarray, above: float = inf, *, progress: Progress | None = None
) -> Filled:
    """Fill texels that nobody saw, or that are less sure than asked.

    Args:
        field: recovered textures, and how sure they are.
        seen: (T,) bool, texels that a photograph shows.
        above: standard deviation of any parameter from which on one that was seen is filled, too;
            what is known of it counts as much as it is sure.
        progress: shows what is going on.

    Raises:
        CaptureError: nothing is seen, or nothing surely enough, or too little to guess from.
        ShapeError: flags of other texels.
        OptionError: ``above`` is not positive.
    """
    shown = np.asarray(seen).astype(bool)
    if shown.shape != (field.texels.count,):
        raise ShapeError(
            f"fill(): seen must have one flag for each of {field.texels.count} texels, got shape "
            f"{shown.shape}."
        )
    if not above > 0:
        raise OptionError(f"fill(): above must be positive, got {above}.")
    seen = shown & (field.sds <= above).all(axis=0)
    if seen.any() and seen.all():
        return Filled(field, ~seen, {name: {} for name in NAMES}, {name: 0.0 for name in NAMES})
    with (progress or Progress()).stage("Looking for likeness") as stage:
        ground = Ground.of(field, seen)
        parts = hidden_parts(ground.small) if seen.any() else []
        if not parts:
            raise _too_few(shown, above)
        judged = _judged(field, ground, parts, stage)
        most = judged[DECIDES].share if DECIDES in judged else 1.0
        weights = {n: judged[n].weights(most) if n in judged else {} for n in NAMES}
        return _filled(Filling(field, shown), ground, judged, weights)


def _too_few(shown: np.ndarray, above: float) -> CaptureError:
    """Return what is wrong where nothing can be hidden."""
    if above == inf or shown.sum() < 2:
        return CaptureError(
            f"{shown.sum()} of {len(shown)} texels are seen: too few to fill the others by; add "
            "photographs of the object."
        )
    return CaptureError(
        "fill(): too few texels are seen surely enough to fill others by; allow more (above=).",
        shell="Too few texels are seen surely enough to fill others by; give a larger --above.",
    )


def _judged(
    field: TextureField, ground: Ground, parts: Sequence[np.ndarray], stage: Stage
) -> dict[str, Judged]:
    """Return how far off guesses are of every parameter that was recovered."""
    far, trials = distances(ground, np.flatnonzero(~ground.known)), []
    for done, hidden in enumerate(parts):
        stage.update(done, len(parts) + 1)
        trials.append(Trial.of(ground.small, hidden, far))
    stage.update(len(parts), len(parts) + 1)
    return {name: Judged.of(trials, field.rows(name)) for name in field.names}


def _filled(
    filling: Filling, ground: Ground, judged: Mapping[str, Judged], weights: Weights
) -> Filled:
    """Fill what is not known by weighted means of all guesses."""
    guess, unlike = mixed(ground, weights), variance(filling.field, ground.known)
    errors = {name: 0.0 for name in NAMES}
    for name, each in judged.items():
        rows, squares = TextureField.rows(name), each.squares(weights[name])
        errors[name] = float(np.sqrt(squares.mean()))
        off = np.sqrt(np.maximum(squares.max(axis=0)[:, None], unlike[rows]))
        filling.put(name, ~ground.known, guess[rows], off)
    return Filled(filling.done(~ground.known), ~ground.known, weights, errors)


def variance(field: TextureField, known: np.ndarray) -> np.ndarray:
    """Return how unlike each other known texels (T,) are, (N, 1): nothing says that what nobody saw
    is any more like what it is filled with."""
    return np.asarray(field.values[:, known].var(axis=1, keepdims=True))


def by_likeness(ground: Ground, weights: Weights) -> np.ndarray:
    """Return all values, those that are not known filled as others have been."""
    values, found = ground.values.copy(), mixed(ground, weights)
    for name, used in weights.items():
        if used:
            rows = TextureField.rows(name)
            values[rows] = np.where(ground.known, values[rows], found[rows])
    return values
