"""Result of an estimate, from which later stages start."""

from dataclasses import dataclass, field
from functools import cached_property
from itertools import compress
from typing import Any

import numpy as np

from svu_mi.capture.capture import Capture
from svu_mi.capture.replace_material import other_shapes
from svu_mi.core.progress import Progress
from svu_mi.errors import OptionError, counted, first_of
from svu_mi.geometry.texels import Texels
from svu_mi.posterior.estimators import inflated
from svu_mi.posterior.observations import Observed, observe
from svu_mi.posterior.posterior import Posterior
from svu_mi.posterior.prediction import HeldOutPrediction
from svu_mi.presets import AnyPreset, Skip

NAMED = 3  # photographs in a sentence


@dataclass(frozen=True, kw_only=True, repr=False)
class Estimate:
    """Posterior of each of T texels, and statistics of the run.

    Attributes:
        method: name of the estimator, ``angular`` or ``spectrum``.
        preset: options of the estimator.
        texels: texels of the results.
        posterior: p(psi | B, L) of each texel.
        coverage: (T,) UInt32, number of views that show each texel.
        seen_per_view: (V,) int64, number of visible texels in each used view.
        skipped: number of skipped items (texels, views, channels, levels), by reason.
        timings: duration of each stage [s], synchronised.
        observed: photographs, light and visibility, reused by later stages; keeps the photographs
            in memory.
        prior: weights of the grid's bins, as given to ``estimate()``; None for the default.
        prediction: how well the model predicts held-out photographs; None if not tested.

    Example:
        >>> estimate.entropy.shape == (texels.count,)
        True
        >>> low, high = estimate.posterior.interval("roughness")
    """

    method: str
    preset: AnyPreset
    texels: Texels
    posterior: Posterior
    coverage: Any
    seen_per_view: np.ndarray
    skipped: dict[str, int]
    timings: dict[str, float] = field(default_factory=dict)
    observed: Observed | None = field(default=None, repr=False)
    prior: Any | None = field(default=None, repr=False)
    prediction: HeldOutPrediction | None = None

    def __repr__(self) -> str:
        seen = np.array(self.coverage) > 0
        mean = float(np.array(self.entropy, np.float64).mean())
        return (
            f"<Estimate {self.method}: mean entropy {mean:.2f} of {self.texels.count} texels, "
            f"{seen.mean():.0%} seen in {counted(len(self.seen_per_view), 'photograph')}>"
        )

    @property
    def switches(self) -> AnyPreset:
        """The preset, with overdispersion increased by the uncertainty of estimated light."""
        observed = self.observed
        return self.preset if observed is None else inflated(self.preset, observed.capture)

    @cached_property
    def entropy(self) -> Any:
        """Normalised entropy, (T,) in [0, 1] (Eq. 5).

        Unseen texels have the prior's entropy, which is 1 unless ``prior`` is given. It is always
        1 if entropies are divided by the prior's (angular ``default`` and ``fast``).
        """
        return self.posterior.entropy()

    @property
    def prediction_sentence(self) -> str | None:
        """How well held-out photographs are predicted, and whether the light knew them."""
        if self.prediction is None:
            return None
        capture = None if self.observed is None else self.observed.capture
        light = self._plane_sentence(self.prediction.cause)
        if capture is not None and capture.found_light is not None:
            others = ""
            if other_shapes(capture.scene, capture.shape):
                others = ", as if the object were alone: give the light, or leave other shapes out"
            light = f"The light was estimated from all photographs{others}."
        return " ".join(filter(None, [self.prediction.sentence(), self.odd_sentence, light]))

    @property
    def odd_sentence(self) -> str:
        """Sentence that names photographs which are predicted much worse than others, or ""."""
        odd = self.prediction.odd() if self.prediction else []
        if not odd or self.observed is None:
            return ""
        capture = self.observed.capture
        used = list(compress(capture.names, capture.used))
        return (
            f"Predicted much worse than the others: {first_of([used[k] for k in odd], NAMED)}. If "
            "blurred or with a wrong pose, remove such photographs and use --missing leave-out."
        )

    def _plane_sentence(self, cause: str) -> str:
        """Return a sentence about the plane below the object, or ""; ``cause``: of errors."""
        albedo = self.observed and self.observed.plane
        if albedo is None:
            return ""
        assumed = f"Instead of the light from below, a grey plane of albedo {albedo:g} is assumed"
        if cause != "surroundings":
            return f"{assumed}."
        return (
            f"{assumed}; for the object's shadow, add a table to the scene, or import again with "
            f"--table 0 --table-albedo {albedo:g}."
        )

    def image(self, name: str) -> np.ndarray:
        """Return a per-texel result as a float32 texture.

        Args:
            name: ``entropy`` (1 outside the charts), ``coverage`` (0 outside the charts), or a
                parameter with ``_mean``, ``_sd``, ``_low`` or ``_high``, such as
                ``roughness_mean`` (NaN outside the charts). ``_low`` and ``_high`` are the ends of
                the 90 % interval.

        Returns:
            (H, W), or (H, W, 3) for parameters with a value per channel.

        Raises:
            OptionError: an unknown name.
        """
        if name == "entropy":
            return self.texels.to_image(np.array(self.entropy, np.float32), 1.0)
        if name == "coverage":
            return self.texels.to_image(np.array(self.coverage).astype(np.float32), 0.0)
        parameter, _, what = str(name).rpartition("_")
        if parameter in self.posterior.axes and what in ("mean", "sd", "low", "high"):
            if what in ("low", "high"):
                values = self.posterior.interval(parameter)[what == "high"]
            else:
                values = getattr(self.posterior, what)(parameter)
            return self.texels.to_image(np.array(values, np.float32), np.nan)
        raise OptionError(
            f"Estimate.image(): unknown map {name!r}; use entropy, coverage, or "
            f"{', '.join(self.posterior.axes)} with _mean, _sd, _low or _high."
        )


def capture_and_texels(
    source: Capture | Observed | Estimate, texels: Texels | None
) -> tuple[Capture, Texels]:
    """Return capture and texels of a source, without computation."""
    if not isinstance(source, Capture):
        seen = _observed_by(source, texels)
        return seen.capture, seen.texels
    if texels is None:
        raise OptionError("A capture needs texels: svu.texels(capture.mesh, resolution).")
    return source, texels


def observations_of(
    source: Capture | Observed | Estimate, texels: Texels | None,
    progress: Progress | None = None, skip: Skip | None = None,
) -> Observed:  # fmt: skip
    """Return the ``Observed`` of ``source``; trace visibility if ``source`` is a capture."""
    if isinstance(source, Capture):
        return observe(*capture_and_texels(source, texels), progress, skip)
    return _observed_by(source, texels)


def _observed_by(source: Observed | Estimate, texels: Texels | None) -> Observed:
    """Return the ``Observed`` of ``source``; raise an error if the texels differ."""
    if isinstance(source, Estimate):
        if source.observed is None:
            raise OptionError(
                "The estimate has no observations; use an estimate returned by svu.estimate()."
            )
        source = source.observed
    if texels is not None and texels is not source.texels:
        raise OptionError("The texels differ from the estimate's; omit them, or pass the capture.")
    return source
