"""Predictions of unknown texels: total-variation inpainting, symmetry, and weighted means."""

from __future__ import annotations

from collections.abc import Container, Iterator

import numpy as np
import scipy

from svu_mi.recovery.inpaint.fill_result import SUREST, Weights
from svu_mi.recovery.inpaint.symmetry_predictors import LIKENESSES, NEAR, Examples
from svu_mi.recovery.inpaint.texel_hierarchy import Ground, Pieces
from svu_mi.recovery.uncertainty.texture_field import TextureField

FARTHER = {"from the border": 1e-5, "cautiously from the border": 1e-2}
"""By title, how much the mean of all that is known counts at a texel of a hole, as a precision in
units of the variance of that: the more, the less far from the border anything spreads."""
AGAIN = 2  # times that links go by what has spread: edges go on into a hole
NEAREST = 8  # known texels that a hole is filled by to begin with


def spreads(ground: Ground, titles: Container[str] = FARTHER) -> Iterator[tuple[str, np.ndarray]]:
    """Let values spread from what is known: first over links as strong as those between equals,
    then over links that are weak across edges of what has spread [Vogel and Oman 1996]. Pieces of
    which nothing is known are as the mean of all. Of many texels groups come first, and what
    has spread over these says where edges are.
    """
    known, values, weights = ground.known, ground.values, ground.weights
    mean = np.average(values[:, known], axis=1, weights=weights[:, known])[:, None]
    wide = np.maximum(values[:, known].std(axis=1), SUREST)[:, None]
    border = np.bincount(ground.pieces.piece, known)[ground.pieces.piece] > 0
    for title, found, edges in _starts(ground, titles, border, mean):
        trust = np.where(known, weights, FARTHER[title] * ground.size / wide**2)
        right = trust * np.where(known, values, mean)
        for hidden in [None] if edges else [~known, *[None] * AGAIN]:
            smoother = ground.smoother.with_precision(trust, found, hidden)
            found = np.where(known, values, smoother.fill(right, found, border))
        yield title, np.clip(found, 0, 1)


def _starts(
    ground: Ground, titles: Container[str], border: np.ndarray, mean: np.ndarray
) -> Iterator[tuple[str, np.ndarray, bool]]:
    """Yield titles, values (N, T) to begin with, and whether these know where edges are."""
    if ground.many:
        groups, owner = ground.halved
        for title, found in spreads(groups, titles):
            yield title, np.where(ground.known, ground.values, found[:, owner]), True
        return
    start = np.where(border, _nearest(ground.pieces, ground.values, ground.known), mean)
    for title in FARTHER:
        if title in titles:
            yield title, start, False


def _nearest(pieces: Pieces, values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return values of which those that are not known are as what is near, (N, T)."""
    places, found = pieces.apart(pieces.point), values.copy()
    tree = scipy.spatial.cKDTree(places[known])
    count = min(NEAREST, int(known.sum()))
    away, which = tree.query(places[~known], [*range(1, count + 1)], workers=-1)
    weights = 1 / np.maximum(away, 1e-9) ** 2
    weights /= weights.sum(axis=1, keepdims=True)
    for row, some in zip(found, values[:, known], strict=True):
        row[~known] = (some[which] * weights).sum(axis=1)
    return found


TITLES = (*FARTHER, *(one.title for one in LIKENESSES))


def mixed(ground: Ground, weights: Weights) -> np.ndarray:
    """Return weighted means of the predictions of unknown texels, (N, T), 0 elsewhere."""
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
    """Yield titles, and what each says (N, w) of wanted texels."""
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
