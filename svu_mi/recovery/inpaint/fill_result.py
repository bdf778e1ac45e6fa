"""Filled textures, and their precision-weighted fusion with predictions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from svu_mi.recovery.svbrdf_textures import Textures
from svu_mi.recovery.uncertainty import clipped_normal
from svu_mi.recovery.uncertainty.texture_field import TextureField

ImageSource = Literal["photographs", "renders"]
Weights = Mapping[str, Mapping[str, float]]
"""Weight of each predictor, by parameter and title; of a parameter they sum to one."""
TOP_PREDICTORS = 3  # predictors with the largest weights, which are named


@dataclass(frozen=True)
class Answer:
    """Result of a diffusion model on pictures of one kind.

    Attributes:
        source: of the pictures: ``photographs`` of texels that they do not determine, or
            ``renders`` of what none shows.
        pictures: names of the views, in the order in which the model was asked about them.
        reached: (T,) bool, texels that have got their values from it.
        errors: root mean square error on hidden parts, by parameter.
        likeness: the same of filling by likeness, at the same texels.
    """

    source: ImageSource
    pictures: tuple[str, ...]
    reached: np.ndarray
    errors: dict[str, float]
    likeness: dict[str, float]


@dataclass(frozen=True)
class ModelReport:
    """Contribution of a diffusion model.

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
    invented: ModelReport | None = None

    @property
    def likeness(self) -> dict[str, str]:
        """Largest weights by parameter: ``turned about y 41 %, ...``."""
        summaries = {}
        for name, weights in self.weights.items():
            top = sorted(weights.items(), key=lambda item: -item[1])[:TOP_PREDICTORS]
            summaries[name] = ", ".join(f"{title} {100 * weight:.0f} %" for title, weight in top)
        return summaries

    @property
    def textures(self) -> Textures:
        """The textures."""
        return self.field.textures


LEAST_SD = 0.02  # least standard deviation of a prediction


class Fusion:
    """Precision-weighted fusion of texels with predictions.

    Attributes:
        field: the textures as they were.
        shown: (T,) bool, texels that a photograph shows; others have no values of their own.
        values: (N, T), current.
        least: (N, T) standard deviations, never less than before.
    """

    def __init__(
        self, field: TextureField, shown: np.ndarray, start: TextureField | None = None
    ) -> None:
        """Start from the field itself, or from a filled one."""
        start = field if start is None else start
        self.field, self.shown = field, shown
        self.values, self.least = start.values.copy(), start.width.copy()

    def fuse(self, name: str, at: np.ndarray, predicted: np.ndarray, sd: np.ndarray) -> None:
        """Fuse texels ``at`` (T,) with predictions, weighted by precisions."""
        rows = self.field.rows(name)
        sd = np.maximum(sd, LEAST_SD)
        precision = np.where(self.shown, 1 / np.maximum(self.field.sds[rows], LEAST_SD) ** 2, 0)
        total = precision * self.field.values[rows] + predicted / sd**2
        values = np.where(at, total / (precision + 1 / sd**2), self.values[rows])
        # Texels that a photograph shows do not get more certain.
        least = clipped_normal.width_of(values, np.broadcast_to(sd, values.shape))
        least = np.maximum(least, self.field.width[rows])
        self.least[rows] = np.where(at & ~self.shown, least, self.least[rows])
        self.values[rows] = values

    def fused_field(self, filled: np.ndarray) -> TextureField:
        """Return the field with ``filled`` texels, (T,) bool."""
        field = self.field
        laid = field.to_textures(self.values)
        textures = field.textures.but(**{name: laid[name] for name in field.names})
        own = np.where(filled, self.values, field.own_mean)
        return replace(field, textures=textures, own_mean=own, min_width=self.least)
