"""Fill what nobody saw by what it is like, and say how sure that is.

No likeness is right for all objects, and which are shows only in part. So what a texel may be is a
mean of what all of them say, and of what spreads from the border (``mixing``), each parameter by
itself; how much each counts is found out on parts of the surface that were seen, hidden in turn,
and so is how far off that mean is (``judging``).
"""

from __future__ import annotations

from math import inf

import numpy as np

from svu_mi.errors import CaptureError, OptionError, ShapeError
from svu_mi.inpaint.filling import Filling
from svu_mi.inpaint.hiding import hidden_parts
from svu_mi.inpaint.judging import Judged, Trial, distances
from svu_mi.inpaint.mixing import mixed
from svu_mi.inpaint.pieces import Pieces
from svu_mi.inpaint.record import Filled, Weights
from svu_mi.parameters import NAMES
from svu_mi.recovery.field.field import TextureField

DECIDES = "base_color"  # what photographs tell best, and so how far anything is alike


def fill(field: TextureField, seen: np.ndarray, above: float = inf) -> Filled:
    """Fill texels that nobody saw, or that are less sure than asked.

    Args:
        field: recovered textures, and how sure they are.
        seen: (T,) bool, texels that a photograph shows.
        above: standard deviation of any parameter from which on one that was seen is filled, too;
            what is known of it counts as much as it is sure.

    Raises:
        CaptureError: nothing is seen, or nothing surely enough, or too little to guess from.
        ShapeError: flags of other texels.
        OptionError: ``above`` is not positive.
    """
    shown = require_seen(field, seen)
    if not above > 0:
        raise OptionError(f"fill(): above must be positive, got {above}.")
    seen = shown & (field.sds <= above).all(axis=0)
    if seen.any() and seen.all():
        return Filled(field, ~seen, {name: {} for name in NAMES}, {name: 0.0 for name in NAMES})
    pieces = Pieces.of(field.texels, field.smoother.around)
    parts = hidden_parts(pieces, seen) if seen.any() else []
    if not parts and (above == inf or shown.sum() < 2):
        raise CaptureError(
            f"{shown.sum()} of {len(shown)} texels are seen: too few to fill the others by; add "
            "photographs of the object."
        )
    if not parts:
        raise CaptureError(
            "fill(): too few texels are seen surely enough to fill others by; allow more (above=).",
            shell="Too few texels are seen surely enough to fill others by; give a larger --above.",
        )
    far = distances(pieces, seen, np.flatnonzero(~seen))
    trials = [Trial.of(field, pieces, seen, hidden, far) for hidden in parts]
    judged = {name: Judged.of(trials, field.rows(name)) for name in field.names}
    alike = judged[DECIDES].share if DECIDES in judged else 1.0
    weights: dict[str, dict[str, float]] = {name: {} for name in NAMES}
    weights |= {name: each.weights(alike) for name, each in judged.items()}
    guess, unlike = mixed(field, pieces, seen, weights), variance(field, seen)
    filling, errors = Filling(field, shown), {name: 0.0 for name in NAMES}
    for name, each in judged.items():
        rows, squares = field.rows(name), each.squares(weights[name])
        errors[name] = float(np.sqrt(squares.mean()))
        off = np.sqrt(np.maximum(squares.max(axis=0)[:, None], unlike[rows]))
        filling.put(name, ~seen, guess[rows], off)
    return Filled(filling.done(~seen), ~seen, weights, errors)


def variance(field: TextureField, known: np.ndarray) -> np.ndarray:
    """Return how unlike each other known texels (T,) are, (N, 1): nothing says that what nobody saw
    is any more like what it is filled with."""
    return np.asarray(field.values[:, known].var(axis=1, keepdims=True))


def require_seen(field: TextureField, seen: np.ndarray) -> np.ndarray:
    """Return flags of all texels, (T,) bool.

    Raises:
        ShapeError: there are others.
    """
    flags = np.asarray(seen)
    if flags.shape != (field.texels.count,):
        raise ShapeError(
            f"fill(): seen must have one flag for each of {field.texels.count} texels, got shape "
            f"{flags.shape}."
        )
    return flags.astype(bool)


def by_likeness(field: TextureField, known: np.ndarray, weights: Weights) -> np.ndarray:
    """Return all values as if only some were known, and the others filled as others have been.

    Args:
        field: recovered textures.
        known: (T,) bool, of what nothing else is looked at.
        weights: of ``Filled``.

    Returns:
        (N, T).
    """
    pieces = Pieces.of(field.texels, field.smoother.around)
    values, found = field.values.copy(), mixed(field, pieces, known, weights)
    for name, used in weights.items():
        if used:
            rows = field.rows(name)
            values[rows] = np.where(known, values[rows], found[rows])
    return values
