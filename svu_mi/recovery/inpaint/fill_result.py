"""Filled textures, and their precision-weighted fusion with predictions."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from svu_mi.recovery.svbrdf_textures import Textures
from svu_mi.recovery.uncertainty import clipped_normal
from svu_mi.recovery.uncertainty.texture_field import TextureField

ImageSource = Literal["photographs", "renders"]
Weights = Mapping[str, Mapping[str, float]]
"""Weight of each predictor, by parameter and title. Weights of a parameter sum to 1."""
TOP_PREDICTORS, SMALLEST_SHOWN = 3, 0.005  # predictors in a summary, and their least weight


@dataclass(frozen=True)
class Answer:
    """Result of a diffusion model on images of one kind.

    Attributes:
        source: Kind of images: ``photographs`` for uncertain texels, ``renders`` for unseen ones.
        pictures: Names of the views, in order of inference.
        reached: (T,) bool, texels with values of the model.
        errors: RMS error of the model on held-out parts, by parameter.
        likeness: RMS error of filling by symmetry at the same texels, by parameter.
    """

    source: ImageSource
    pictures: tuple[str, ...]
    reached: np.ndarray
    errors: dict[str, float]
    likeness: dict[str, float]


@dataclass(frozen=True)
class ModelReport:
    """Contribution of a diffusion model to filled textures.

    Attributes:
        model: Title of the model.
        licence: Licence of its weights.
        answers: Results on photographs and on renders, if needed.
        reached: (T,) bool, texels with values of the model.
    """

    model: str
    licence: str
    answers: tuple[Answer, ...]
    reached: np.ndarray


@dataclass(frozen=True)
class Filled:
    """Filled textures.

    Attributes:
        field: Textures with standard deviations, which filling never reduces (before clipping).
        filled: (T,) bool, True for filled texels.
        weights: Weights of the predictors, by parameter and title; empty for parameters that were
            not recovered, and if no texel was filled.
        errors: RMS error of the predictions on held-out parts, by parameter.
        invented: Contribution of a diffusion model (``fill_by_diffusion``), or None.

    Example:
        >>> field = svu.texture_field(recovery, mesh=capture.mesh)
        >>> filled = svu.fill(field, recovery.coverage > 0)
        >>> filled.filled.shape == (texels.count,), filled.invented is None
        (True, True)
    """

    field: TextureField
    filled: np.ndarray
    weights: Weights
    errors: dict[str, float]
    invented: ModelReport | None = None

    @property
    def likeness(self) -> dict[str, str]:
        """Summary of the largest weights, by parameter: ``turned about y 41 %, ...``."""
        summaries = {}
        for name, weights in self.weights.items():
            top = sorted(weights.items(), key=lambda item: -item[1])[:TOP_PREDICTORS]
            words = [f"{title} {100 * x:.0f} %" for title, x in top if x >= SMALLEST_SHOWN]
            summaries[name] = ", ".join(words)
        return summaries

    @property
    def textures(self) -> Textures:
        """Textures of ``field``."""
        return self.field.textures


LEAST_SD = 0.02  # least standard deviation of a prediction


class Fusion:
    """Precision-weighted fusion of texels with predictions.

    Attributes:
        field: Textures before filling.
        shown: (T,) bool, texels that a photograph shows; predictions replace all others.
        values: (N, T), fused values.
        least: (N, T), lower limits of standard deviations before clipping.
    """

    def __init__(
        self, field: TextureField, shown: np.ndarray, start: TextureField | None = None
    ) -> None:
        """Initialise fused values with those in ``start`` (default: ``field``)."""
        start = field if start is None else start
        self.field, self.shown = field, shown
        self.values, self.least = start.values.copy(), start.width.copy()

    def fuse(self, name: str, at: np.ndarray, predicted: np.ndarray, sd: np.ndarray) -> None:
        """Fuse texels of a mask ``at`` (T,) with predictions of a parameter and their ``sd``."""
        rows = self.field.rows(name)
        sd = np.maximum(sd, LEAST_SD)
        precision = np.where(self.shown, 1 / np.maximum(self.field.sds[rows], LEAST_SD) ** 2, 0)
        total = precision * self.field.values[rows] + predicted / sd**2
        values = np.where(at, total / (precision + 1 / sd**2), self.values[rows])
        # Predictions do not reduce the standard deviation of seen texels.
        least = clipped_normal.width_of(values, np.broadcast_to(sd, values.shape))
        least = np.maximum(least, self.field.width[rows])
        self.least[rows] = np.where(at & ~self.shown, least, self.least[rows])
        self.values[rows] = values

    def fused_field(self, filled: np.ndarray) -> TextureField:
        """Return the field with fused values and standard deviations."""
        field = self.field
        laid = field.to_textures(self.values)
        textures = field.textures.but(**{name: laid[name] for name in field.names})
        own = np.where(filled, self.values, field.own_mean)
        return replace(field, textures=textures, own_mean=own, min_width=self.least)
