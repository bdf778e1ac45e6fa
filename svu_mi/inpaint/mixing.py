"""What likenesses say of texels, together: a weighted mean."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from svu_mi.inpaint.likeness import LIKENESSES, NEAR, Examples
from svu_mi.inpaint.pieces import Pieces
from svu_mi.inpaint.record import Weights
from svu_mi.recovery.field.field import TextureField


def mixed(
    field: TextureField, pieces: Pieces, known: np.ndarray, wanted: np.ndarray, weights: Weights
) -> np.ndarray:
    """Return means of what likenesses say of what is wanted, (N, T); 0 elsewhere."""
    titles = {title for used in weights.values() for title in used}
    chosen, mean = np.flatnonzero(wanted), np.zeros((len(field.values), len(wanted)))
    used = [number for number, one in enumerate(LIKENESSES) if one.title in titles]
    for number, guess in guesses(field, pieces, known, chosen, used):
        for name, each in weights.items():
            rows = field.rows(name)
            mean[rows, chosen] += each.get(LIKENESSES[number].title, 0.0) * guess[rows]
    return mean


def guesses(
    field: TextureField, pieces: Pieces, known: np.ndarray, wanted: np.ndarray,
    chosen: Sequence[int],
) -> Iterator[tuple[int, np.ndarray]]:  # fmt: skip
    """Yield the number of each chosen likeness, and what it says (N, w) of wanted texels."""
    texels = np.flatnonzero(known)
    some = Examples(texels, field.values[:, texels], 1 / field.deviation[:, texels] ** 2)
    instead, near = NEAR.guess(pieces, some, wanted)
    instead = np.where(near, instead, some.mean)  # where nothing else is alike
    for number in chosen:
        if LIKENESSES[number] is NEAR:
            yield number, instead
            continue
        values, alike = LIKENESSES[number].guess(pieces, some, wanted)
        yield number, np.where(alike, values, instead)
