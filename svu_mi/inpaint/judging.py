"""How far off guesses are: tried on parts of the surface that were seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from svu_mi.inpaint.filling import SUREST
from svu_mi.inpaint.likeness import LIKENESSES
from svu_mi.inpaint.mixing import guesses
from svu_mi.inpaint.pieces import Pieces
from svu_mi.interop import owned
from svu_mi.posterior import intervals
from svu_mi.recovery.field.field import TextureField

TRIED = 3000  # texels of a part that guesses are compared on
GUESSED_BY = 2**16  # texels that they are made of there, at most: evenly chosen, of large textures
POWER = 4  # of the mean squared error, by which likenesses count less
NEVER = 1.05  # part of the squared error of spreading, on any part, above which it stays
HARDLY = 1e-5  # precision of the mean of all where nothing is known, in units of their variance


@dataclass(frozen=True)
class Trial:
    """How far off values of a hidden part are.

    Attributes:
        spread: (N, w) of spreading from the border.
        guesses: (G, N, w) of every likeness.
    """

    spread: np.ndarray
    guesses: np.ndarray

    @staticmethod
    def of(field: TextureField, pieces: Pieces, seen: np.ndarray, hidden: np.ndarray) -> Trial:
        known, texels = seen & ~hidden, np.flatnonzero(hidden)
        some = intervals.spread(np.arange(len(texels)), TRIED)
        spreading, texels = spread(field, known, hidden)[:, some], texels[some]
        true = field.values[:, texels]
        every = range(len(LIKENESSES))
        few = np.zeros(len(known), bool)
        few[intervals.spread(np.flatnonzero(known), GUESSED_BY)] = True
        off = [x - true for _, x in guesses(field, pieces, few, texels, every)]
        return Trial(spreading - true, np.array(off))


@dataclass(frozen=True)
class Judged:
    """How far off the values of one parameter are, of P parts.

    Attributes:
        weights: of the likenesses, by title.
        spread, mixed: (P, C) mean squared errors of spreading, and of the likenesses together.
    """

    weights: dict[str, float]
    spread: np.ndarray
    mixed: np.ndarray

    @staticmethod
    def of(trials: Sequence[Trial], rows: slice) -> Judged:
        squares = np.mean([(t.guesses[:, rows] ** 2).mean(axis=(1, 2)) for t in trials], axis=0)
        weights = np.maximum(squares / squares.max(initial=1e-12), 1e-6) ** -POWER
        weights /= weights.sum()
        titles = [one.title for one in LIKENESSES]
        mixed = [np.tensordot(weights, t.guesses[:, rows], 1) for t in trials]
        return Judged(
            dict(zip(titles, weights.tolist(), strict=True)),
            np.array([(t.spread[rows] ** 2).mean(axis=1) for t in trials]),
            np.array([(off**2).mean(axis=1) for off in mixed]),
        )

    @property
    def never_worse(self) -> bool:
        """Whether likenesses are about as good as spreading on every part."""
        return bool((self.mixed.mean(axis=1) <= NEVER * self.spread.mean(axis=1)).all())

    @property
    def better(self) -> bool:
        """Whether they are better on the whole."""
        return bool(self.mixed.mean() < self.spread.mean())

    def squares(self, used: bool) -> np.ndarray:
        """Return mean squared errors (P, C) of likenesses if they are used, or of spreading."""
        return self.mixed if used else self.spread

    def error(self, used: bool) -> float:
        """Return the root mean square error of all parts."""
        return float(np.sqrt(self.squares(used).mean()))


def spread(field: TextureField, known: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Let values spread from what is known, over links as strong as those between equals.

    Args:
        field: whose values.
        known: (T,) bool, of what they are known.
        wanted: (T,) bool, w texels of which they are not.

    Returns:
        (N, w).
    """
    weights, values = 1 / field.deviation**2, field.values
    mean = np.average(values[:, known], axis=1, weights=weights[:, known])[:, None]
    wide = np.maximum(values[:, known].std(axis=1), SUREST)[:, None]
    trust = np.where(known, weights, HARDLY / wide**2)
    smoother = field.smoother.with_precision(trust, blind=~known)
    target = trust * np.where(known, values, mean)
    solved = np.array(smoother.solve(owned(mi.Float, target.astype("f4").ravel())))
    return np.clip(solved.reshape(trust.shape)[:, wanted], 0, 1)
