"""The pipeline, capture to posterior: the file to read first.

    capture -> texels -> observe in every view -> angular statistics       -> posterior
                                               -> SH fit -> power spectra  -> posterior

Memory at its peak, measured (BENCHMARKS.md): 26 bytes per pixel of all photographs (float32
RGB as read, a packed copy, two flags), 560 bytes per texel (most of it double-precision
temporaries of the texel layout; 800 with angular statistics and what reaches each texel), and
nothing that grows with texels times views.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.angular import gather, reflection
from svu_mi.capture import Capture
from svu_mi.errors import CaptureError, OptionError
from svu_mi.frequency import fit_lanes, power_lanes, scatter_rows, solver_groups
from svu_mi.options import AngularPreset, AnyPreset, Method, Preset
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
from svu_mi.radiance import Lighting, Surface, Survey, Views, light, observe, pack_views, survey
from svu_mi.radiance.cells import light_cells
from svu_mi.radiance.hemisphere import as_channels, hemisphere, mirror_free
from svu_mi.surface import Texels

log = logging.getLogger(__name__)

DARK = 1e-2  # part of the light that counts as the unit of radiance when all is black


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
    """

    method: str
    preset: AnyPreset
    texels: Texels
    posterior: Posterior
    coverage: Any
    seen_per_view: np.ndarray
    skipped: dict[str, int]
    timings: dict[str, float] = field(default_factory=dict)

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


@dataclass(frozen=True)
class Spectra:
    """Power spectra of T texels, TensorXf (T, l* + 1, C) in squared radiance; C is 3, or 1."""

    incoming: Any
    outgoing: Any


def estimate(
    capture: Capture,
    texels: Texels,
    method: Method = "angular",
    preset: str | AnyPreset = "default",
    *,
    grid: ParameterGrid | PrincipledGrid | None = None,
    prior: Any | None = None,
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
        progress: shows what is going on and collects timings.

    Raises:
        OptionError: an unknown method or preset, a grid of other parameters, a bad prior.
        ShapeError: a prior that does not fit the grid.
        CaptureError: no texel is seen in any photograph.
    """
    switches: Any = find_preset(preset, method=method)
    progress = progress or Progress()
    angular = isinstance(switches, AngularPreset)
    chosen = angular_grid(grid, switches) if angular else spectrum_grid(grid, switches)
    log_prior(prior, chosen.shape, "estimate()")  # a bad one is refused before any work
    with progress.stage("Reading the light"):
        lighting = light(capture, sum(capture.used))
    with progress.stage("Finding silhouettes"):
        views = pack_views(capture)
    run = _Run(capture, views, lighting, texels, chosen, prior, progress)
    posterior, found = (_from_angles if angular else _from_spectra)(run, switches)
    with progress.stage("Computing entropy"):
        result = Estimate(
            method=method,
            preset=switches,
            texels=texels,
            posterior=posterior,
            coverage=found.coverage,
            seen_per_view=found.per_view.numpy().astype(np.int64),
            skipped=_skipped(capture, texels, found),
            timings=progress.timings,
        )
        dr.eval(result.entropy)
    return result


@dataclass(frozen=True)
class _Run:
    """What both methods start from."""

    capture: Capture
    views: Views
    lighting: Lighting
    texels: Texels
    grid: Any
    prior: Any | None
    progress: Progress

    def survey(self) -> Survey:
        with self.progress.stage("Tracing visibility"):
            found = survey(self.views, Surface.of(self.texels))
        _require_seen(found.per_view, self.capture)
        return found

    def unit(self, found: Survey) -> float:
        """Radiance that sigma is a part of: the photographs' mean, or if that is 0, some of the
        light's, since black under a known light is an observation too."""
        return found.scale or DARK * float(self.lighting.environment.coefficients(0).mean())


def _from_angles(run: _Run, switches: AngularPreset) -> tuple[Posterior, Survey]:
    surface = Surface.of(run.texels)
    # Only these weights ask for the capture's mean radiance before all views were seen.
    scale = run.unit(run.survey()) if switches.noise == "heteroscedastic" else 1.0
    with run.progress.stage("Tracing occlusion"):
        levels = run.grid.roughness_nodes
        model = reflection(run.views.scene, surface, run.lighting, levels, switches)
    with run.progress.stage("Gathering statistics"):
        statistics = gather(run.views, surface, model, dr.opaque(mi.Float, scale))
    found = statistics.survey
    assert found is not None
    _require_seen(found.per_view, run.capture)
    posterior = angular_posterior(statistics, run.grid, run.unit(found), switches, prior=run.prior)
    return posterior, found


def _from_spectra(run: _Run, switches: Preset) -> tuple[Posterior, Survey]:
    found = run.survey()
    with run.progress.stage("Fitting spectra"):
        spectra = fit_spectra(run.views, run.lighting, run.texels, found.coverage, switches)
    irradiance = None
    if isinstance(run.grid, PrincipledGrid):
        with run.progress.stage("Tracing occlusion"):
            irradiance = _irradiance(run, switches, switches.colors)
    with run.progress.stage("Computing entropy"):
        posterior = spectrum_posterior(
            spectra.incoming,
            spectra.outgoing,
            run.grid,
            preset=switches,
            prefilter=run.lighting.prefilter,
            prior=run.prior,
            observed=found.coverage > 0,
            samples=mi.Float(found.coverage),
            irradiance=irradiance,
        )
    return posterior, found


def _irradiance(run: _Run, switches: Preset, channels: int) -> np.ndarray:
    """(T, C) irradiance; if the preset says so, less what the object itself hides."""
    cells = light_cells(run.lighting.environment, 0, switches.rays)
    arriving = hemisphere(
        run.views.scene, Surface.of(run.texels), run.lighting, cells,
        channels=channels, occluded=switches.occluded, lobes=False,
    )  # fmt: skip
    return np.stack([moments[0].numpy() for moments in arriving.diffuse], axis=-1)


def fit_spectra(
    views: Views, lighting: Lighting, texels: Texels, seen: Any, switches: Preset
) -> Spectra:
    """Gather, fit and take power spectra in one kernel per solver; samples are never stored.

    Args:
        views: the packed capture.
        lighting: its band-limited light.
        texels: the T texels.
        seen: (T,) UInt32, number of views that see each.
        switches: degree, regulariser, R_00 of Eq. 12, channels and occlusion.
    """
    colors = switches.colors
    shape = (texels.count, switches.degree + 1, colors)
    outgoing, incoming = dr.zeros(mi.TensorXf, shape), dr.zeros(mi.TensorXf, shape)
    dr.eval(outgoing, incoming)
    for group in solver_groups(seen, switches.degree):
        coefficients = fit_lanes(
            partial(sample, views, lighting, Surface.of(texels, group.selection), switches),
            views.count,
            degree=switches.degree,
            channels=2 * colors,
            regularizer=switches.regularizer,
            penalize_constant=switches.penalize_constant,
            method=group.method,
            capacity=group.capacity,
        )
        power = power_lanes(coefficients)
        for spectra, channels in ((outgoing, slice(colors)), (incoming, slice(colors, None))):
            scatter_rows(spectra.array, [row[channels] for row in power], group.selection)
        dr.eval(outgoing, incoming)
    return Spectra(incoming=incoming, outgoing=outgoing)


def sample(
    views: Views, lighting: Lighting, surface: Surface, switches: Preset, view: Any
) -> tuple[Any, Any, list[Any]]:
    """One row of Eq. 12: view direction, w = |cos theta|, and both right-hand sides.

    Outgoing radiance B is indexed by the direction to the camera; so is incoming radiance L,
    which is looked up where the mirror sends that direction.
    """
    seen = observe(views, surface, view)
    lit = mirror_free(views.scene, surface, seen) if switches.occluded else seen.seen

    def mirrored(direction: Any, normal: Any) -> Any:
        return lighting.radiance(2 * dr.dot(normal, direction) * normal - direction)

    incoming = dr.if_stmt(
        args=(seen.direction, mi.Vector3f(surface.normal)),
        cond=lit,
        true_fn=mirrored,
        false_fn=lambda *_: dr.zeros(mi.Color3f),
    )
    colors = switches.colors
    both = (*as_channels(seen.radiance, colors), *as_channels(incoming, colors))
    return seen.direction, seen.cosine, list(both)


def _require_seen(seen_per_view: Any, capture: Capture) -> None:
    counts = seen_per_view.numpy()
    if not counts.any():
        raise CaptureError(
            f"No texel of '{capture.shape.id()}' is seen in any of {len(counts)} photographs; "
            "check the poses (camera space is +X left, +Y up, +Z forward), masks and normals."
        )
    used = [name for name, used in zip(capture.names, capture.used, strict=True) if used]
    blind = [name for name, count in zip(used, counts, strict=True) if count == 0]
    if blind:
        log.warning("%d photographs show no texel: %s", len(blind), ", ".join(blind[:5]))


def _skipped(capture: Capture, texels: Texels, found: Survey) -> dict[str, int]:
    width, height = texels.resolution
    return {
        "texels outside the charts": width * height - texels.count - texels.overlapping,
        "texels on overlapping charts": texels.overlapping,
        "texels never seen": int((found.coverage.numpy() == 0).sum()),
        "views left out": capture.count - sum(capture.used),
        "views that show no texel": int((found.per_view.numpy() == 0).sum()),
    }
