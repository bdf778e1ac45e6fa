"""The pipeline, capture to posterior: the file to read first.

    capture -> texels -> who sees whom -> plan -> angular statistics       -> posterior
                                               -> SH fit -> power spectra  -> posterior

Memory at its peak, measured (BENCHMARKS.md): 20 bytes per pixel of all photographs (float32
RGB as read, their mean, two flags), 560 bytes per texel (most of it double-precision
temporaries of the texel layout; 800 with angular statistics and what reaches each texel), and
one bit per texel and view.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.angular import gather, reflection
from svu_mi.capture import Capture
from svu_mi.errors import CaptureError, OptionError
from svu_mi.frequency.gather import fit_spectra
from svu_mi.options import AngularPreset, AnyPreset, Method, Preset, Skip
from svu_mi.options import preset as find_preset
from svu_mi.posterior import (
    ParameterGrid,
    Posterior,
    PrincipledGrid,
    angular_grid,
    angular_posterior,
    spectrum_grid,
    spectrum_posterior,
)
from svu_mi.posterior.streaming import log_prior
from svu_mi.progress import Progress
from svu_mi.radiance import Lighting, Surface, Survey, Views, light, pack_views, survey
from svu_mi.radiance.cells import light_cells
from svu_mi.radiance.hemisphere import hemisphere
from svu_mi.skipping import Plan, make_plan, with_known
from svu_mi.surface import Texels

log = logging.getLogger(__name__)

BRIGHTEST = 1e12  # mean radiance; what is in range loses nothing to exposure
DARK = 1e-2  # part of the light that counts as the unit of radiance when all is black


@dataclass(frozen=True)
class Observed:
    """What the photographs of a capture show, and of what.

    Attributes:
        capture: scene, photographs and light.
        views: the photographs that are used, packed.
        lighting: the light.
        texels: the T texels.
        found: who sees whom.
    """

    capture: Capture
    views: Views
    lighting: Lighting
    texels: Texels
    found: Survey

    @cached_property
    def unit(self) -> float:
        """Radiance that sigma is a part of: the photographs' mean, or if that is 0, some of the
        light's, since black under a known light is an observation too."""
        return self.found.scale or DARK * float(self.lighting.environment.coefficients(0).mean())


@dataclass(frozen=True, kw_only=True)
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

    @cached_property
    def entropy(self) -> Any:
        """Normalised entropy (T,) in [0, 1]; exactly 1 for a texel nobody saw (Eq. 5)."""
        return self.posterior.entropy()

    def image(self, name: str) -> np.ndarray:
        """Lay a per-texel result out as an (H, W) float32 texture.

        Args:
            name: ``entropy`` (1 outside the charts) or ``coverage`` (0 outside the charts).

        Raises:
            OptionError: an unknown name.
        """
        if name == "entropy":
            return self.texels.to_image(np.array(self.entropy, np.float32), 1.0)
        if name == "coverage":
            return self.texels.to_image(np.array(self.coverage).astype(np.float32), 0.0)
        raise OptionError(f"Estimate.image(): there is no map {name!r}; use entropy or coverage.")


def estimate(
    capture: Capture,
    texels: Texels,
    method: Method = "angular",
    preset: str | AnyPreset = "default",
    *,
    grid: ParameterGrid | PrincipledGrid | None = None,
    prior: Any | None = None,
    known: Mapping[str, float] | Literal["scene"] | None = None,
    skip: Skip | None = None,
    progress: Progress | None = None,
) -> Estimate:
    """Estimate how much a capture says about the reflectance of every texel.

    Args:
        capture: scene, photographs and light.
        texels: texels of ``capture.mesh``.
        method: the estimator. ``angular`` compares photographs with what the reflection model
            predicts for them, by statistics of all views; ``spectrum`` compares their power
            spectra (Sec. 3.3 of the paper).
        preset: ``default``, ``paper``, ``fast``, ``calibrated`` (angular), or a preset of the
            method.
        grid: nodes of the parameter grid; by default 8 per parameter: roughness, metallic and
            base colour (``PrincipledGrid``), or roughness and Ks (``ParameterGrid``), as the
            preset's ``parameters`` say.
        prior: non-negative weights of the grid's cells; uniform by default.
        known: parameters that are not in question, such as ``{"metallic": 0.0}``: they leave
            the grid, and the entropy is that of the others. ``"scene"`` takes what the scene's
            own ``principled`` material does not vary. Nothing by default: in a scene made for
            photographs, a constant is more often a placeholder than a fact.
        skip: work to leave out where it changes nothing; all of it by default.
        progress: shows what is going on and collects timings.

    Raises:
        OptionError: an unknown method or preset, a grid of other parameters, a bad prior, a
            known value that is none.
        ShapeError: a prior that does not fit the grid.
        CaptureError: no texel is seen in any photograph.
    """
    switches: Any = find_preset(preset, method=method)
    progress, skip = progress or Progress(), skip or Skip()
    angular = isinstance(switches, AngularPreset)
    chosen = angular_grid(grid, switches) if angular else spectrum_grid(grid, switches)
    chosen = with_known(chosen, known, capture.shape)
    tables = log_prior(prior, chosen.shape, "estimate()")  # refused before any work
    with progress.stage("Reading the light"):
        lighting = light(capture, sum(capture.used))
    with progress.stage("Finding silhouettes"):
        views = pack_views(capture, switches.colors)
    with progress.stage("Tracing visibility"):
        surface = Surface.of(texels)
        found = survey(views, surface, skip_blind=skip.blind, skip_pairs=skip.pairs)
    _require_seen(found.per_view, capture)
    _require_range(found.scale)
    plan = make_plan(skip, switches, views, lighting, found, chosen, tables)
    observed = Observed(capture, views, lighting, texels, found)
    run = _Run(observed, chosen, prior, plan, progress)
    posterior = (_from_angles if angular else _from_spectra)(run, switches)
    with progress.stage("Computing entropy"):
        result = Estimate(
            method=method,
            preset=switches,
            texels=texels,
            posterior=posterior,
            coverage=found.coverage,
            seen_per_view=found.per_view,
            skipped=_skipped(capture, texels, found) | plan.skipped,
            timings=progress.timings,
            observed=observed,
        )
        dr.eval(result.entropy)
    return result


@dataclass(frozen=True)
class _Run:
    """What both methods start from."""

    observed: Observed
    grid: Any
    prior: Any | None
    plan: Plan
    progress: Progress

    @cached_property
    def surface(self) -> Surface:
        """The texels that are worth any work."""
        return Surface.of(self.observed.texels, self.plan.texels)


def _from_angles(run: _Run, switches: AngularPreset) -> Posterior:
    plan, seen = run.plan, run.observed
    with run.progress.stage("Tracing occlusion"):
        levels = run.grid.roughness_nodes[plan.levels]
        model = reflection(
            seen.views.scene, run.surface, seen.lighting, levels, switches, plan.light_channels
        )
    with run.progress.stage("Gathering statistics"):
        scale = dr.opaque(mi.Float, seen.unit)
        statistics = gather(seen.views, run.surface, seen.found, model, scale, plan.channels)
    return angular_posterior(
        statistics, run.grid, seen.unit, switches,
        prior=run.prior, copies=plan.copies, levels=plan.levels,
    )  # fmt: skip


def _from_spectra(run: _Run, switches: Preset) -> Posterior:
    plan, seen = run.plan, run.observed
    with run.progress.stage("Fitting spectra"):
        spectra = fit_spectra(
            seen.views, seen.lighting, seen.texels, seen.found, switches,
            channels=plan.channels, light_channels=plan.light_channels,
            skip_unseen=plan.texels is not None,
        )  # fmt: skip
    irradiance = None
    if isinstance(run.grid, PrincipledGrid):
        with run.progress.stage("Tracing occlusion"):
            irradiance = _irradiance(run, switches)
    with run.progress.stage("Computing entropy"):
        return spectrum_posterior(
            spectra.incoming,
            spectra.outgoing,
            run.grid,
            preset=switches,
            prefilter=seen.lighting.prefilter,
            prior=run.prior,
            observed=seen.found.coverage > 0,
            samples=mi.Float(seen.found.coverage),
            irradiance=irradiance,
            copies=plan.copies,
        )


def _irradiance(run: _Run, switches: Preset) -> np.ndarray:
    """(T, C) irradiance; if the preset says so, less what the object itself hides."""
    seen = run.observed
    cells = light_cells(seen.lighting.environment, switches.rays)
    arriving = hemisphere(
        seen.views.scene, run.surface, seen.lighting, cells,
        channels=run.plan.light_channels, occluded=switches.occluded, lobes=None,
    )  # fmt: skip
    result = np.zeros((seen.texels.count, run.plan.channels), np.float32)
    light = np.stack([moments[0].numpy() for moments in arriving.diffuse], axis=-1)
    result[run.surface.index.numpy()] = light  # one channel of grey light is all of them
    return result


def _require_seen(counts: np.ndarray, capture: Capture) -> None:
    if not counts.any():
        raise CaptureError(
            f"No texel of '{capture.shape.id()}' is seen in any of {len(counts)} photographs; "
            "check the poses (camera space is +X left, +Y up, +Z forward), masks and normals."
        )
    used = [name for name, used in zip(capture.names, capture.used, strict=True) if used]
    blind = [name for name, count in zip(used, counts, strict=True) if count == 0]
    if blind:
        log.warning("%d photographs show no texel: %s", len(blind), ", ".join(blind[:5]))


def _require_range(radiance: float) -> None:
    """Squares of radiance must fit in single precision: black is an observation, 1e-30 is not."""
    if radiance and not 1 / BRIGHTEST <= radiance <= BRIGHTEST:
        raise CaptureError(
            f"The photographs' mean radiance is {radiance:g}; scale them and the light so that it "
            f"is between {1 / BRIGHTEST:g} and {BRIGHTEST:g}, or mask pixels that are no radiance."
        )


def _skipped(capture: Capture, texels: Texels, found: Survey) -> dict[str, int]:
    width, height = texels.resolution
    return {
        "texels outside the charts": width * height - texels.count - texels.overlapping,
        "texels on overlapping charts": texels.overlapping,
        "texels never seen": int((found.coverage.numpy() == 0).sum()),
        "views left out": capture.count - sum(capture.used),
        "views that show no texel": int((found.per_view == 0).sum()),
    }
