"""Pipeline, capture to posterior: the file to read first.

    capture -> texels -> observed: visibility   -> plan -> statistics of all views   -> posterior
                                                         -> SH fit -> power spectra   -> posterior

``core/memory.py`` estimates the peak memory; ``posterior/tiled.py`` processes many texels in tiles.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture.capture import Capture
from svu_mi.capture.scene import require_light, require_variant
from svu_mi.core.arrays import to_drjit
from svu_mi.core.progress import Progress
from svu_mi.errors import OptionError
from svu_mi.geometry.texels import Texels
from svu_mi.posterior.angular import angular_grid
from svu_mi.posterior.estimators import (
    Run,
    counted,
    from_angles,
    from_spectra,
    make_plan,
    widened,
    with_known,
)
from svu_mi.posterior.grid import ParameterGrid, PrincipledGrid
from svu_mi.posterior.observations import Observed, observe
from svu_mi.posterior.posterior import Posterior
from svu_mi.posterior.row_entropy import log_prior
from svu_mi.posterior.spectrum import spectrum_grid
from svu_mi.posterior.tiled import TiledKernel
from svu_mi.presets import AngularPreset, AnyPreset, Method, Skip
from svu_mi.presets import preset as find_preset


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
        return self.preset if observed is None else widened(self.preset, observed.capture)

    @cached_property
    def entropy(self) -> Any:
        """Normalised entropy (T,) in [0, 1] (Eq. 5).

        That of the prior for a texel nobody saw: exactly 1 without ``prior``, and always where
        the entropy is a part of the prior's (angular ``default`` and ``fast``).
        """
        return self.posterior.entropy()

    def in_one_piece(self, progress: Progress | None = None) -> Estimate:
        """Return the estimate with the statistics of all its texels, made again if they were not
        kept (see ``estimate``)."""
        if not isinstance(self.posterior.kernel, TiledKernel):
            return self
        grid: Any = self.posterior.grid
        method: Any = self.method
        return estimate(
            self, None, method, self.preset, grid=grid, prior=self.prior, whole=True,
            progress=progress,
        )  # fmt: skip

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


def subject_of(
    source: Capture | Observed | Estimate, texels: Texels | None
) -> tuple[Capture, Texels]:
    """Return what a source is about, without any work; arguments and errors of ``observed_of``."""
    if not isinstance(source, Capture):
        seen = _observed_by(source, texels)
        return seen.capture, seen.texels
    if texels is None:
        raise OptionError("A capture needs texels: svu.texels(capture.mesh, resolution).")
    return source, texels


def observed_of(
    source: Capture | Observed | Estimate, texels: Texels | None, progress: Progress | None = None
) -> Observed:
    """Return the ``Observed`` of ``source``; compute it if ``source`` is a capture."""
    if isinstance(source, Capture):
        return observe(*subject_of(source, texels), progress)
    return _observed_by(source, texels)


def _observed_by(source: Observed | Estimate, texels: Texels | None) -> Observed:
    """Return what to go on from; errors of ``observed_of``."""
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


def estimate(
    source: Capture | Observed | Estimate,
    texels: Texels | None = None,
    method: Method = "angular",
    preset: str | AnyPreset = "default",
    *,
    grid: ParameterGrid | PrincipledGrid | None = None,
    prior: Any | None = None,
    known: Mapping[str, float] | Literal["scene"] | None = None,
    skip: Skip | None = None,
    whole: bool = False,
    progress: Progress | None = None,
) -> Estimate:
    """Estimate how much a capture says about the reflectance of every texel.

    Args:
        source: a capture (scene, photographs and light); an estimate of one, whose rays need not
            be traced again.
        texels: texels of ``capture.mesh``; those of the estimate if there is one.
        method: the estimator. ``angular`` compares photographs with what the reflection model
            predicts for them, by statistics of all views; ``spectrum`` compares their power
            spectra (Sec. 3.3 of the paper).
        preset: ``default``, ``paper``, ``fast``, ``fixed`` (angular), or a preset of the
            method.
        grid: nodes of the parameter grid; by default 8 per parameter: roughness, metallic and
            base colour (``PrincipledGrid``), or roughness and Ks (``ParameterGrid``), as the
            preset's ``parameters`` say.
        prior: non-negative weights of the grid's cells, of its shape; or one per roughness. By
            default uniform, but for metallic of angular ``default`` and ``fast``, which is 0 or 1
            with a probability of .8 (the preset's ``metals``); weights take its place.
        known: parameters that are not in question, such as ``{"metallic": 0.0}``: they leave
            the grid, and the entropy is that of the others. ``"scene"`` takes what the scene's
            own ``principled`` material does not vary. Nothing by default: in a scene made for
            photographs, a constant is more often a placeholder than a fact.
        skip: work to leave out where it changes nothing; all of it by default. What is gone on
            from has left out what it has.
        whole: keep the statistics of all texels in memory (3 kB per texel), as recovery and
            guidance need them. Otherwise more than 2^18 texels are worked on tile by tile, and
            what maps do not show is computed again when it is asked for (``TiledKernel``).
        progress: shows what is going on and collects timings.

    Raises:
        OptionError: an unknown method or preset, a grid of other parameters, a bad prior, a
            known value that is none, or texels that do not belong to the source.
        ShapeError: a prior that does not fit the grid.
        CaptureError: no texel is seen in any photograph.
        SceneError: the capture has no light.
        SvuEnvironmentError: no suitable Mitsuba variant is active.
    """
    require_variant()
    switches: Any = find_preset(preset, method=method)
    progress, skip = progress or Progress(), skip or Skip()
    grid_of = angular_grid if isinstance(switches, AngularPreset) else spectrum_grid
    chosen = grid_of(grid, switches)
    capture, layout = subject_of(source, texels)
    chosen = with_known(chosen, known, capture.shape)
    tables = log_prior(prior, chosen.shape, "estimate()")  # refused before any work
    seen = _seen(source, layout, skip, progress)
    plan = make_plan(skip, switches, seen, chosen, tables)
    return _made(Run(seen, chosen, prior, plan, progress, whole), method, switches)


def _made(run: Run, method: Method, switches: Any) -> Estimate:
    """Make the posterior of a run."""
    seen, certain = run.observed, widened(switches, run.observed.capture)
    if isinstance(certain, AngularPreset):
        posterior = from_angles(run, certain)
    else:
        posterior = from_spectra(run, certain)
    with run.progress.stage("Computing entropy"):
        result = Estimate(
            method=method, preset=switches, texels=seen.texels, posterior=posterior,
            coverage=to_drjit(mi.UInt32, counted(seen, switches)),
            seen_per_view=seen.visibility.per_view, skipped=run.plan.skipped,
            timings=run.progress.timings, observed=seen, prior=run.prior,
        )  # fmt: skip
        dr.eval(result.entropy)
    return result


def _seen(
    source: Capture | Observed | Estimate, texels: Texels, skip: Skip, progress: Progress
) -> Observed:
    """Trace which photographs show which texels, unless that is known, and read the light."""
    if isinstance(source, Capture):
        require_light(source)
        seen = observe(
            source, texels, progress,
            skip_unseen=skip.unseen, skip_blind=skip.blind, skip_pairs=skip.pairs,
        )  # fmt: skip
    else:
        seen = _observed_by(source, texels)
    with progress.stage("Reading the light"):
        _ = seen.lighting
    return seen
