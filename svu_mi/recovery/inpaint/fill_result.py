"""Filled textures, and the fusion of guesses with what is known by their precisions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from svu_mi.recovery.svbrdf_textures import Textures
from svu_mi.recovery.uncertainty import clipped_normal
from svu_mi.recovery.uncertainty.texture_field import TextureField

Source = Literal["photographs", "renders"]
Weights = Mapping[str, Mapping[str, float]]
"""How much each guess counts, by parameter and by title: they sum to one."""
NAMED = 3  # guesses that count most, which are named


@dataclass(frozen=True)
class Answer:
    """What a model has made of pictures of one kind.

    Attributes:
        source: of the pictures: ``photographs`` of texels that they do not determine, or
            ``renders`` of what none shows.
        pictures: names of the views, in the order in which the model was asked about them.
        reached: (T,) bool, texels that have got their values from it.
        errors: root mean square error on hidden parts, by parameter.
        likeness: the same of filling by likeness, at the same texels.
    """

    source: Source
    pictures: tuple[str, ...]
    reached: np.ndarray
    errors: dict[str, float]
    likeness: dict[str, float]


@dataclass(frozen=True)
class Invented:
    """What a model was asked.

    Attributes:
        model: for people.
        licence: of its weights, for people.
        answers: by kind of picture, of those that there was something to ask about.
        reached: (T,) bool, texels that have got their values from it.
    """

    model: str
    licence: str
    answers: tuple[Answer, ...]
    reached: np.ndarray


@dataclass(frozen=True)
class Filled:
    """Textures without holes.

    Attributes:
        field: the textures, and how sure they are; where they were filled, no standard deviation
            gets smaller before values are clipped to [0, 1].
        filled: (T,) bool, texels that were filled.
        weights: how much each likeness, and what spreads from the border, counts in what a
            parameter was filled with; nothing for what was not recovered, or if nothing was filled.
        errors: root mean square error of that on hidden parts, by parameter.
        invented: what a model has made of texels (``fill_by_diffusion``), instead of likeness; None
            if none was asked.
    """

    field: TextureField
    filled: np.ndarray
    weights: Weights
    errors: dict[str, float]
    invented: Invented | None = None

    @property
    def likeness(self) -> dict[str, str]:
        """By parameter, what counts most: ``turned about y 41 %, ...``."""
        found = {}
        for name, weights in self.weights.items():
            most = sorted(weights.items(), key=lambda one: -one[1])[:NAMED]
            found[name] = ", ".join(f"{title} {100 * weight:.0f} %" for title, weight in most)
        return found

    @property
    def textures(self) -> Textures:
        """The textures."""
        return self.field.textures


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
        """Give texels the mean of what is known of them and a guess, weighted by precisions."""
        rows = self.field.rows(name)
        off = np.maximum(off, SUREST)
        own = np.where(self.shown, 1 / np.maximum(self.field.sds[rows], SUREST) ** 2, 0)
        both = own * self.field.values[rows] + guess / off**2
        values = np.where(at, both / (own + 1 / off**2), self.values[rows])
        # Of texels that a photograph shows, nothing more is known than was.
        least = clipped_normal.width_of(values, np.broadcast_to(off, values.shape))
        least = np.maximum(least, self.field.width[rows])
        self.least[rows] = np.where(at & ~self.shown, least, self.least[rows])
        self.values[rows] = values

    def done(self, filled: np.ndarray) -> TextureField:
        """Return the field of which some texels, (T,) bool, were filled."""
        field = self.field
        laid = field.laid(self.values)
        textures = field.textures.but(**{name: laid[name] for name in field.names})
        own = np.where(filled, self.values, field.own)
        return replace(field, textures=textures, own=own, least=self.least)
