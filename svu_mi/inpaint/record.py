"""What filling has made of textures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from svu_mi.recovery.field.field import TextureField
from svu_mi.recovery.textures import Textures

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
