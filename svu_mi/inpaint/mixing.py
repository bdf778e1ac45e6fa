"""What likenesses and spreading say of texels, together: a weighted mean."""

from __future__ import annotations

from collections.abc import Container, Iterator

import numpy as np

from svu_mi.inpaint.filling import SUREST
from svu_mi.inpaint.likeness import LIKENESSES, NEAR, Examples
from svu_mi.inpaint.pieces import Pieces
from svu_mi.inpaint.record import Weights
from svu_mi.inpaint.spreading import FARTHER, spreads
from svu_mi.recovery.field.field import TextureField

TITLES = (*FARTHER, *(one.title for one in LIKENESSES))


def mixed(
    field: TextureField, pieces: Pieces, known: np.ndarray, weights: Weights
) -> np.ndarray:
    """Return weighted means of all that is said of texels that are not known, (N, T), 0 elsewhere.

    Args:
        field: whose values.
        pieces: its texels.
        known: (T,) bool, of what they are known; no others are looked at.
        weights: of everything.
    """
    titles = {title for used in weights.values() for title, weight in used.items() if weight > 0}
    wanted, mean = np.flatnonzero(~known), np.zeros_like(field.values)
    for title, guess in guesses(field, pieces, known, wanted, titles):
        for name, each in weights.items():
            rows = field.rows(name)
            mean[rows, wanted] += each.get(title, 0.0) * guess[rows]
    return mean


def guesses(
    field: TextureField, pieces: Pieces, known: np.ndarray, wanted: np.ndarray,
    titles: Container[str] = TITLES, examples: np.ndarray | None = None,
) -> Iterator[tuple[str, np.ndarray]]:  # fmt: skip
    """Yield titles, and what each says (N, w) of wanted texels.

    Args:
        field: whose values.
        pieces: its texels.
        known: (T,) bool, of what they are known.
        wanted: (w,) numbers of others.
        titles: what is asked for.
        examples: numbers of the known texels that others may be like; all by default.
    """
    for title, values in spreads(field, pieces, known, titles):
        yield title, values[:, wanted]
    likenesses = [one for one in LIKENESSES if one.title in titles]
    if not likenesses:
        return
    texels = np.flatnonzero(known) if examples is None else examples
    sure = np.maximum(field.deviation[:, texels], SUREST)
    some = Examples(texels, field.values[:, texels], 1 / sure**2)
    instead, near = NEAR.guess(pieces, some, wanted)
    instead = np.where(near, instead, some.mean)  # where nothing else is alike
    for likeness in likenesses:
        if likeness is NEAR:
            yield likeness.title, instead
            continue
        values, alike = likeness.guess(pieces, some, wanted)
        yield likeness.title, np.where(alike, values, instead)
