"""What the photographs of a capture show, and of what: made once, and passed on.

Whatever looks at a capture goes on from here: silhouettes are found once, rays to the cameras
and to the cells of the light are traced once, whichever estimate, recovery, forecast or
reference asks first.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import inf
from typing import Any

import mitsuba as mi
import numpy as np

from svu_mi.capture import Capture
from svu_mi.capture.scene import require_light
from svu_mi.errors import CaptureError
from svu_mi.frequency.mirrored import MirroredLight
from svu_mi.interop import owned
from svu_mi.light import LightCells, Lighting, light, light_cells
from svu_mi.options import AngularPreset, Fit, Preset
from svu_mi.progress import Progress
from svu_mi.reflection.model import Arriving, Model
from svu_mi.statistics import Statistics, gather
from svu_mi.statistics.censored import PASSES, best_models
from svu_mi.statistics.gather import ALIKE, Weighting
from svu_mi.statistics.rounding import rounding_variance
from svu_mi.surface import Texels
from svu_mi.visibility import Surface, Survey, Views, pack_views, survey
from svu_mi.visibility.pixels import as_channels
from svu_mi.visibility.reach import Mirrors, Reach, trace_mirrors, trace_reach

log = logging.getLogger(__name__)

BRIGHTEST = 1e12  # mean radiance; what is in range loses nothing to exposure
DARK = 1e-2  # part of the light that counts as the unit of radiance when all is black
COARSE = 8  # fine cells of the light per coarse one, on average


@dataclass(eq=False)
class Observed:
    """A capture's photographs, light, texels and their visibility; traced when first needed.

    Attributes:
        capture: scene, photographs and light.
        views: the photographs that are used, packed.
        texels: the T texels.
        found: which view sees which texel.
        seen: (S,) int64, the texels that are worth any work: those that a photograph shows, or
            all if nothing may be skipped.
    """

    capture: Capture
    views: Views
    texels: Texels
    found: Survey
    seen: np.ndarray
    _reached: dict[Any, Reach] = field(default_factory=dict, repr=False)
    _of_light: dict[Any, Any] = field(default_factory=dict, repr=False)

    @property
    def lighting(self) -> Lighting:
        """The light; read when first asked for.

        Raises:
            SceneError: there is none, it cannot be read, or it is black.
        """
        if "lighting" not in self._of_light:
            require_light(self.capture)
            self._of_light["lighting"] = light(self.capture, sum(self.capture.used))
        found: Lighting = self._of_light["lighting"]
        return found

    def part(self, texels: np.ndarray) -> Observed:
        """Return the same, of which only some texels are worth any work; the light is read once.

        Args:
            texels: (t,) their numbers among all T.
        """
        return replace(self, seen=texels, _reached={})

    @cached_property
    def unit(self) -> float:
        """Radiance that noise is a part of: the photographs' mean, or if that is 0, some of the
        light's, since black under a known light is an observation too."""
        return self.found.scale or DARK * float(self.lighting.environment.coefficients(0).mean())

    @cached_property
    def surface(self) -> Surface:
        """The texels of ``seen``: S lanes."""
        return self._lanes(self.seen)

    @cached_property
    def lane(self) -> np.ndarray:
        """(T,) int64, the lane of ``surface`` that a texel is; -1 for all others."""
        lanes = np.full(self.texels.count, -1)
        lanes[self.seen] = np.arange(len(self.seen))
        return lanes

    @property
    def coverage(self) -> np.ndarray:
        """(T,) uint32, number of photographs that show each texel with nothing clipped."""
        return np.array(self.found.coverage)

    @property
    def shown(self) -> np.ndarray:
        """(T,) uint32, number of photographs that show each texel, clipped or not."""
        return np.asarray(self.coverage + self.found.clipped_coverage, np.uint32)

    @cached_property
    def mirrors(self) -> Mirrors:
        """Whether nothing stands in the mirror direction of a sample; traced when first asked."""
        lane = owned(mi.UInt32, np.maximum(self.lane, 0).astype(np.uint32))
        return trace_mirrors(self.views, self.surface, self.found, lane)

    def reach(self, cells: int, *, occluded: bool = True) -> Reach:
        """Return what the texels of ``seen`` see of the light; traced when first asked for.

        Args:
            cells: number of fine cells.
            occluded: whether anything hides light.
        """
        key = (cells, occluded)
        if key not in self._reached:
            self._reached[key] = trace_reach(
                self.views.scene, self.surface, self._tree(cells), occluded=occluded
            )
        return self._reached[key]

    def _tree(self, cells: int) -> LightCells:
        """Return the cells of the light, gathered when first asked for."""
        if cells not in self._of_light:
            coarse = min(max(cells // COARSE, 64), cells)
            self._of_light[cells] = light_cells(self.lighting.environment, coarse, cells)
        found: LightCells = self._of_light[cells]
        return found

    def irradiance(self, switches: Preset, channels: int) -> list[Any]:
        """Return the irradiance of the texels of ``seen``: a Float per channel.

        Args:
            switches: how many cells are traced, and whether anything hides light.
            channels: 3, or 1 for the mean of R, G and B.
        """
        if not switches.occluded:
            return as_channels(self.lighting.irradiance(self.surface.normal), channels)
        moments = self.reach(switches.rays).diffuse(self.surface, self.lighting, channels)
        return [of_channel[0] for of_channel in moments]

    def model(
        self, roughness: np.ndarray, switches: AngularPreset, channels: int,
        texels: np.ndarray | None = None,
    ) -> Model:  # fmt: skip
        """Return the reflection model of texels.

        Args:
            roughness: (R,) its levels.
            switches: which model.
            channels: 3, or 1 for the mean of R, G and B.
            texels: (t,) their numbers among all T, seen or not; by default those of ``seen``.
        """
        surface, reach = self.surface if texels is None else self._lanes(texels), None
        if switches.traced:
            reach = self._reach_of(texels, switches)
        mirrored = self.mirrored(switches.fit, channels, texels)
        light = Arriving(self.lighting, reach, channels, mirrored)
        return Model.of(surface, light, roughness, switches)

    def mirrored(
        self, fit: Fit | None, channels: int, texels: np.ndarray | None = None
    ) -> MirroredLight | None:
        """Return the light that texels mirror into their photographs, to be fitted.

        Args:
            fit: how; None if it is not.
            channels: 3, or 1 for the mean of R, G and B.
            texels: (t,) their numbers among all T; by default those of ``seen``.
        """
        if fit is None:
            return None
        return MirroredLight(self, fit, channels, self.seen if texels is None else texels)

    def _lanes(self, texels: np.ndarray) -> Surface:
        """Texels, by their numbers among all T, as a launch."""
        return Surface.of(self.texels, owned(mi.UInt32, texels.astype(np.uint32)))

    def _reach_of(self, texels: np.ndarray | None, switches: AngularPreset) -> Reach:
        """What texels see of the light; those that are not worth other work are traced now."""
        known = self.reach(switches.cells, occluded=switches.occluded)
        if texels is None or np.array_equal(texels, self.seen):
            return known
        lanes = self.lane[texels]
        new = lanes < 0
        if new.any():
            others = self._lanes(texels[new])
            known = known.joined(
                trace_reach(self.views.scene, others, known.cells, occluded=switches.occluded)
            )
            lanes[new] = len(self.seen) + np.arange(int(new.sum()))
        return known.at(lanes)

    def statistics(
        self, roughness: np.ndarray, switches: AngularPreset, channels: int, *,
        light_channels: int | None = None, weighting: Weighting = ALIKE,
        texels: np.ndarray | None = None,
    ) -> Statistics:  # fmt: skip
        """Gather what the photographs say of texels.

        Args:
            roughness: (R,) levels.
            switches: the reflection model.
            channels: of the photographs, 3, or 1 for their mean.
            light_channels: of the light; 1 if it is grey.
            weighting: how much samples count; all alike by default. Where samples that are clipped
                count by what they say (``statistics.censored``), it has a finite kappa and no
                ``current``; otherwise they do not count.
            texels: (t,) numbers of texels; by default those of ``seen``.
        """
        def gathered(weighting: Weighting, texels: np.ndarray | None) -> Statistics:
            model = self.model(roughness, switches, light_channels or channels, texels)
            mirrors = self.mirrors if model.reads_mirrors else None
            return gather(self.views, self.found, model, mirrors, channels, weighting)

        found = gathered(weighting, texels)
        stay_out = weighting.current is not None or not weighting.kappa < inf
        if self.found.clipped is None or stay_out:
            return found
        number = found.texel.numpy()
        lanes = np.flatnonzero(self.found.bits.count()[number] != found.views.numpy())
        lanes = np.union1d(lanes, np.flatnonzero(self.found.clipped.count()[number]))
        if not len(lanes):
            return found
        some = found.at(lanes)
        for _ in range(PASSES):
            some = gathered(
                replace(weighting, models=best_models(some)), number[lanes].astype(np.int64)
            )
        return found.replaced(lanes, some)


    def rounding(self, weighting: Weighting) -> np.ndarray | None:
        """Return the variance of a sample of weight 1 by rounding alone, of the texels of ``seen``:
        (S,); None of floats."""
        return rounding_variance(self.views, self.found, self.surface, weighting)


def observe(
    capture: Capture, texels: Texels, progress: Progress | None = None, *,
    skip_unseen: bool = True, skip_blind: bool = True, skip_pairs: bool = True,
) -> Observed:  # fmt: skip
    """Find out which views of a capture see which texels.

    Args:
        capture: scene, photographs and light.
        texels: of ``capture.mesh``.
        progress: shows what is going on.
        skip_unseen: no work for texels that no photograph shows.
        skip_blind: none for photographs that show no texel.
        skip_pairs: none for texels and views that do not see each other.

    Raises:
        CaptureError: no texel is seen in any photograph, or radiance is out of range.
    """
    progress = progress or Progress()
    with progress.stage("Finding silhouettes"):
        views = pack_views(capture)
    with progress.stage("Tracing visibility"):
        found = survey(views, Surface.of(texels), skip_blind=skip_blind, skip_pairs=skip_pairs)
    _require_seen(found, capture)
    _require_range(found.scale)
    observed = Observed(capture, views, texels, found, np.arange(texels.count))
    return replace(observed, seen=np.flatnonzero(observed.shown)) if skip_unseen else observed


def _require_seen(found: Survey, capture: Capture) -> None:
    counts = found.per_view
    if not counts.any() and np.any(found.clipped_coverage):
        raise CaptureError(
            f"All that {len(counts)} photographs show of '{capture.shape.id()}' is clipped; expose "
            "for the object."
        )
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
            f"is between {1 / BRIGHTEST:g} and {BRIGHTEST:g}, or mask pixels that are not radiance."
        )
