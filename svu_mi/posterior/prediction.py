"""Prediction of held-out photographs.

Posterior means without a fold of the views predict the samples of its photographs. The mean of a
texel's other samples is a second prediction, which knows nothing of the mesh, the light and the
material: a model that predicts no better is wrong somewhere. Errors are those of compressed
radiance (``residuals``).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

CAUSES = {
    "": "the mesh, light, poses or exposures do not fit",
    "gains": "the photographs differ in brightness (--gains estimate)",
    "objects": "some photographs show another object, or the object was moved",
    "turning light": "the light turns with the camera, as on a turntable",
    "surroundings": "something below the object, such as a table, shades it or is mirrored in it",
    "light": "the light is another one, or is turned",
    "poses": "the poses are off, or the mesh is turned or moved",
    "mesh": "the mesh is of another object",
}
MARGIN = 0.95  # largest ratio of the variances that a model and means of texels leave unexplained
LEAST, GOOD = 0.6, 0.85  # R^2 of a reliable model below and above this ratio
NOISY = 0.95  # share of samples in 90 % intervals from which noise explains all errors
ODD = 0.8  # coverage relative to the median photograph below which a photograph is odd: on our own
# objects, sound ones have at least .90, blurred ones or ones turned by four pixels at most .73
SIDES = ("+x", "-x", "+y", "-y", "+z", "-z")  # directions of normals, in world space


@dataclass(frozen=True)
class PartPrediction:
    """Prediction of one photograph, or of one side of the object; NaN with few samples.

    Attributes:
        r2: 1 minus the mean squared error, relative to the variance of all samples.
        coverage: share of the samples in the 90 % interval of their prediction.
    """

    r2: float
    coverage: float


@dataclass(frozen=True)
class HeldOutPrediction:
    """How well held-out photographs are predicted.

    Attributes:
        r2: R^2 of the reflection model: 1 is perfect, 0 as good as the mean of all samples.
        r2_of_means: R^2 of the mean of each texel's other samples.
        r2_of_diffuse: R^2 of a diffuse surface, fitted to the other samples.
        coverage: share of the samples in the 90 % interval of their prediction.
        cause: likely cause of unreliable results, a key of ``CAUSES``.
        photographs: prediction of each used photograph.
        sides: prediction by the axis that is nearest to the normal, in world space.
    """

    r2: float
    r2_of_means: float
    r2_of_diffuse: float = np.nan
    coverage: float = np.nan
    cause: str = ""
    photographs: tuple[PartPrediction, ...] = field(default=(), repr=False)
    sides: Mapping[str, PartPrediction] = field(default_factory=dict, repr=False)

    @property
    def reliable(self) -> bool:
        """True if the model or noise explains most, and no pattern of a mistake is seen."""
        return (self.r2 >= self.limit or self.coverage >= NOISY) and not self.cause

    def odd(self) -> list[int]:
        """Return the numbers of photographs that are predicted much worse than the others."""
        held = np.array([part.coverage for part in self.photographs])
        known = held[np.isfinite(held)]
        return np.flatnonzero(held < ODD * np.median(known)).tolist() if len(known) else []

    @property
    def limit(self) -> float:
        """R^2 from which results are reliable."""
        alike = 1 - self.r2 > MARGIN * (1 - self.r2_of_means)
        return GOOD if alike else LEAST

    def sentence(self) -> str:
        """Return a sentence with both figures, and the likely cause of unreliable results."""
        r2, means = f"R^2 {self.r2:.2f}", f"{self.r2_of_means:.2f}"
        if self.reliable:
            good = f"good from {self.limit:g}" if self.r2 >= self.limit else "the rest is noise"
            return f"Predicts held-out photographs: {r2}, {good} (means of texels: {means})."
        likely = f"perhaps, {CAUSES[self.cause]}" if self.cause else CAUSES[self.cause]
        poses = ", and try svu refine" if self.cause in ("poses", "mesh") else ""
        return (
            f"Unreliable: held-out photographs are predicted with {r2}, by means of texels with "
            f"{means}; {likely}: run svu check{poses}."
        )


@dataclass(frozen=True)
class FoldTest:
    """Test of a posterior by folds of the views.

    Attributes:
        spread: factors of standard deviations by parameter (``spread_factors``).
        prediction: how well held-out photographs are predicted; None if not tested.
    """

    spread: Mapping[str, float] = field(default_factory=dict)
    prediction: HeldOutPrediction | None = None
