"""What the photographs of a capture show, and of what: made once, and passed on.

Whatever looks at a capture goes on from here: silhouettes are found once, rays to the cameras
and to the cells of the light are traced once, whichever estimate, recovery, forecast or
reference asks first.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import mitsuba as mi
import numpy as np

from svu_mi.capture import Capture
from svu_mi.errors import CaptureError
from svu_mi.evidence import Evidence, OfAllViews, Wanted
from svu_mi.frequency.mirrored import MirroredLight
from svu_mi.interop import owned
from svu_mi.light import LightCells, light_cells
from svu_mi.options import AngularPreset, Fit, Preset
from svu_mi.progress import Progress
from svu_mi.reflection.model import Arriving, Model
from svu_mi.statistics import Factors, Statistics, gather
from svu_mi.statistics.gather import Weighting, clipped_samples
from svu_mi.statistics.rounding import rounding_sums
from svu_mi.statistics.sums import Gathered
from svu_mi.surface import Texels
from svu_mi.visibility import Surface, Survey, Views, pack_views, survey
from svu_mi.visibility.ahead import read_ahead
from svu_mi.visibility.bits import Bits
from svu_mi.visibility.pixels import as_channels
from svu_mi.visibility.reach import Mirrors, Reach, trace_mirrors, trace_reach

log = logging.getLogger(__name__)

BRIGHTEST = 1e12  # mean radiance; what is in range loses nothing to exposure
COARSE = 8  # fine cells of the light per coarse one, on average


@dataclass(eq=False, kw_only=True)
class Observed(Evidence):
    """A capture's photographs, light, texels and their visibility; traced when first needed.

    Attributes:
        views: the photographs that are used, packed.
        found: which view sees which texel.
    """

    views: Views
    found: Survey
    _reached: dict[Any, Reach] = field(default_factory=dict, repr=False)
    _last: dict[str, Any] = field(default_factory=dict, repr=False)

    def part(self, texels: np.ndarray) -> Observed:
        """Return the same, of which only some texels are worth any work (see ``Evidence``)."""
        return replace(self, seen=texels, _reached={}, _last={})

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

    @cached_property
    def all_views(self) -> OfAllViews:
        """What all photographs together show (see ``Evidence``)."""
        found = self.found
        return OfAllViews(
            coverage=np.array(found.coverage),
            clipped=None if found.clipped is None else np.asarray(found.clipped_coverage),
            per_view=found.per_view, grey=self.views.grey, scale=found.scale,
        )  # fmt: skip

    def prepare(self, switches: AngularPreset, progress: Progress) -> None:
        """Trace what light reaches the texels of ``seen``, if the model asks for that."""
        if switches.traced:
            with progress.stage("Tracing occlusion"):
                self.reach(switches.cells, occluded=switches.occluded)

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
                self.views.scene, self.surface, self.cells(cells), occluded=occluded
            )
        return self._reached[key]

    def cells(self, fine: int) -> LightCells:
        """Return the cells of the light, so many fine ones, gathered when first asked for."""
        if fine not in self._of_light:
            coarse = min(max(fine // COARSE, 64), fine)
            self._of_light[fine] = light_cells(self.lighting.environment, coarse, fine)
        found: LightCells = self._of_light[fine]
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

    def _gather(self, wanted: Wanted) -> Statistics:
        return self._gathered(wanted).statistics()

    def _factor(self, wanted: Wanted) -> Factors:
        return self._gathered(wanted).factor()

    def _gathered(self, wanted: Wanted) -> Gathered:
        model = self.model(
            wanted.roughness, wanted.switches, wanted.light_channels, wanted.texels
        )
        mirrors, weighting = self.mirrors if model.reads_mirrors else None, wanted.weighting
        if weighting.models is None:  # else they have just been read
            read_ahead(self.views, model.surface)
        else:
            samples = self._clipped_samples(wanted.texels, model.surface)
            weighting = replace(weighting, models=replace(weighting.models, samples=samples))
        return gather(self.views, self.found, model, mirrors, wanted.channels, weighting)

    def _clipped_samples(self, texels: np.ndarray | None, surface: Surface) -> Bits:
        """Return which samples have clipped channels; several passes ask for those of the same
        texels."""
        chosen = self.seen if texels is None else texels
        if "clipped" not in self._last or self._last["clipped"][0] is not chosen:
            self._last["clipped"] = chosen, clipped_samples(self.views, self.found, surface)
        found: Bits = self._last["clipped"][1]
        return found

    def _rounded(self, weighting: Weighting) -> np.ndarray | None:
        return rounding_sums(self.views, self.found, self.surface, weighting)


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
    require_seen(found.per_view, capture, clipped=bool(np.any(found.clipped_coverage)))
    require_range(found.scale)
    observed = Observed(
        capture=capture, views=views, texels=texels, found=found, seen=np.arange(texels.count)
    )
    return replace(observed, seen=np.flatnonzero(observed.shown)) if skip_unseen else observed


def require_seen(counts: np.ndarray, capture: Capture, *, clipped: bool = False) -> None:
    """Refuse photographs that show no texel; warn of each.

    Args:
        counts: (V,) number of texels that each photograph that is used shows.
        capture: what they are of.
        clipped: whether some show texels that are clipped.

    Raises:
        CaptureError: none shows any.
    """
    if not counts.any() and clipped:
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


def require_range(radiance: float) -> None:
    """Squares of radiance must fit in single precision: black is an observation, 1e-30 is not.

    Raises:
        CaptureError: they do not.
    """
    if radiance and not 1 / BRIGHTEST <= radiance <= BRIGHTEST:
        raise CaptureError(
            f"The photographs' mean radiance is {radiance:g}; scale them and the light so that it "
            f"is between {1 / BRIGHTEST:g} and {BRIGHTEST:g}, or mask pixels that are not radiance."
        )
