"""The result of an estimate, and what later stages go on from."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from svu_mi.capture.capture import Capture
from svu_mi.core.progress import Progress
from svu_mi.errors import OptionError
from svu_mi.geometry.texels import Texels
from svu_mi.posterior.estimators import inflated
from svu_mi.posterior.observations import Observed, observe
from svu_mi.posterior.posterior import Posterior
from svu_mi.presets import AnyPreset, Skip


@dataclass(frozen=True, kw_only=True, repr=False)
class Estimate:
    """What the photographs say about each of T texels.

    Attributes:
        method: name of the estimator.
        preset: the switches it ran with.
        texels: where the values belong.
        posterior: p(psi | B, L) of each texel.
        coverage: (T,) UInt32, number of views that see each texel.
        seen_per_view: (V,) int64, number of texels each used view sees.
        skipped: what was not computed, by reason, as counts.
        timings: seconds per stage, synchronised.
        observed: what it was made from, for those who go on from here; it keeps the photographs
            in memory.
        prior: the weights of cells that it was asked with, None for the usual ones.
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

    def __repr__(self) -> str:
        seen = np.array(self.coverage) > 0
        mean = float(np.array(self.entropy, np.float64).mean())
        return (
            f"<Estimate {self.method}: mean entropy {mean:.2f} of {self.texels.count} texels, "
            f"{seen.mean():.0%} seen in {len(self.seen_per_view)} photographs>"
        )

    @property
    def switches(self) -> AnyPreset:
        """The preset, as much less certain as the light is (``with_light``)."""
        observed = self.observed
        return self.preset if observed is None else inflated(self.preset, observed.capture)

    @cached_property
    def entropy(self) -> Any:
        """Normalised entropy (T,) in [0, 1] (Eq. 5).

        That of the prior for a texel nobody saw: exactly 1 without ``prior``, and always where
        the entropy is a part of the prior's (angular ``default`` and ``fast``).
        """
        return self.posterior.entropy()

    def image(self, name: str) -> np.ndarray:
        """Lay a per-texel result out as a float32 texture.

        Args:
            name: ``entropy`` (1 outside the charts), ``coverage`` (0 outside the charts), or of a
                parameter, say roughness: ``roughness_mean``, ``roughness_sd``,
                ``roughness_low`` and ``roughness_high`` (ends of the 90 % interval; NaN outside
                the charts).

        Returns:
            (H, W), or (H, W, 3) where channels have their own.

        Raises:
            OptionError: an unknown name.
        """
        if name == "entropy":
            return self.texels.to_image(np.array(self.entropy, np.float32), 1.0)
        if name == "coverage":
            return self.texels.to_image(np.array(self.coverage).astype(np.float32), 0.0)
        parameter, _, what = name.rpartition("_")
        if parameter in self.posterior.axes and what in ("mean", "sd", "low", "high"):
            if what in ("low", "high"):
                values = self.posterior.interval(parameter)[what == "high"]
            else:
                values = getattr(self.posterior, what)(parameter)
            return self.texels.to_image(np.array(values, np.float32), np.nan)
        raise OptionError(
            f"Estimate.image(): there is no map {name!r}; use entropy, coverage, or "
            f"{', '.join(self.posterior.axes)} with _mean, _sd, _low or _high."
        )


def capture_and_texels(
    source: Capture | Observed | Estimate, texels: Texels | None
) -> tuple[Capture, Texels]:
    """Return what a source is about, without any work; errors of ``observations_of``."""
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
    """Return what to go on from; errors of ``observations_of``."""
    if isinstance(source, Estimate):
        if source.observed is None:
            raise OptionError(
                "The estimate does not know its capture; use what svu.estimate() returns of one."
            )
        source = source.observed
    if not isinstance(source, Observed):
        raise OptionError(
            f"A capture or an estimate is needed, got {type(source).__name__}; read a capture with "
            "svu.load_capture(path)."
        )
    if texels is not None and texels is not source.texels:
        raise OptionError(
            "The texels differ from those that were observed; omit them, or pass the capture."
        )
    return source
