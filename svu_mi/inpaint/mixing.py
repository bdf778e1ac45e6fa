"""What likenesses and spreading say of texels, together: a weighted mean."""

from __future__ import annotations

from collections.abc import Container, Iterator

import numpy as np

from svu_mi.inpaint.ground import Ground
from svu_mi.inpaint.likeness import LIKENESSES, NEAR, Examples
from svu_mi.inpaint.record import Weights
from svu_mi.inpaint.spreading import FARTHER, spreads
from svu_mi.recovery.field.field import TextureField

TITLES = (*FARTHER, *(one.title for one in LIKENESSES))


def mixed(ground: Ground, weights: Weights) -> np.ndarray:
    """Return weighted means of all that is said of texels that are not known, (N, T), 0 elsewhere.

    Args:
        ground: what is known.
        weights: of everything.
    """
    titles = {title for used in weights.values() for title, weight in used.items() if weight > 0}
    wanted, mean = np.flatnonzero(~ground.known), np.zeros_like(ground.values)
    for title, guess in guesses(ground, wanted, titles):
        for name, each in weights.items():
            rows = TextureField.rows(name)
            mean[rows, wanted] += each.get(title, 0.0) * guess[rows]
    return mean


def guesses(
    ground: Ground, wanted: np.ndarray, titles: Container[str] = TITLES
) -> Iterator[tuple[str, np.ndarray]]:
    """Yield titles, and what each says (N, w) of wanted texels.

    Args:
        ground: what is known.
        wanted: (w,) numbers of texels that are not.
        titles: what is asked for.
    """
    for title, values in spreads(ground, titles):
        yield title, values[:, wanted]
    likenesses = [one for one in LIKENESSES if one.title in titles]
    if not likenesses:
        return
    texels = np.flatnonzero(ground.known)
    some = Examples(texels, ground.values[:, texels], ground.weights[:, texels])
    instead, near = NEAR.guess(ground.pieces, some, wanted)
    instead = np.where(near, instead, some.mean)  # where nothing else is alike
    for likeness in likenesses:
        if likeness is NEAR:
            yield likeness.title, instead
            continue
        values, alike = likeness.guess(ground.pieces, some, wanted)
        yield likeness.title, np.where(alike, values, instead)
