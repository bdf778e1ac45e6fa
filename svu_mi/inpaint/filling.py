"""Textures while they are filled: what is known of a texel counts as much as it is sure."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from svu_mi.parameters import NAMES
from svu_mi.recovery.field import clipped
from svu_mi.recovery.field.field import TextureField
from svu_mi.recovery.textures import lay_out

SUREST = 0.02  # standard deviation that no guess is surer than


class Filling:
    """Values of texels, and how sure they are at most.

    Attributes:
        field: the textures as they were.
        shown: (T,) bool, texels that a photograph shows: of all others, nothing is known.
        values: (N, T), as they are by now.
        least: (N, T) standard deviations, never less than before.
    """

    def __init__(
        self, field: TextureField, shown: np.ndarray, start: TextureField | None = None
    ) -> None:
        """Begin with the field itself, or with what was filled of it otherwise."""
        start = field if start is None else start
        self.field, self.shown = field, shown
        self.values, self.least = start.values.copy(), start.width.copy()

    def put(self, name: str, at: np.ndarray, guess: np.ndarray, off: np.ndarray) -> None:
        """Give texels the mean of what is known of them and a guess, weighted by precisions.

        Args:
            name: of a parameter of C values.
            at: (T,) bool, the texels.
            guess: (C, T).
            off: (C, 1) or less, standard deviation of the guess.
        """
        rows = self.field.rows(name)
        off = np.maximum(off, SUREST)
        own = np.where(self.shown, 1 / np.maximum(self.field.sds[rows], SUREST) ** 2, 0)
        both = own * self.field.values[rows] + guess / off**2
        values = np.where(at, both / (own + 1 / off**2), self.values[rows])
        # Of texels that a photograph shows, nothing more is known than was.
        least = clipped.width_of(values, np.broadcast_to(off, values.shape))
        least = np.maximum(least, self.field.width[rows])
        self.least[rows] = np.where(at & ~self.shown, least, self.least[rows])
        self.values[rows] = values

    def done(self, filled: np.ndarray) -> TextureField:
        """Return the field of which some texels, (T,) bool, were filled."""
        field = self.field
        laid = lay_out(field.texels, {name: self.values[field.rows(name)].T for name in NAMES})
        textures = field.textures.but(**{name: laid[name] for name in field.names})
        own = np.where(filled, self.values, field.own)
        return replace(field, textures=textures, own=own, least=self.least)
