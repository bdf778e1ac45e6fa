"""Photographs, light, texels and visibility of a capture, shared by all later stages.

Estimates, recovery, guidance and references reuse one ``Observed``. Silhouettes, rays to cameras
and rays to light cells are computed once, on first use.
"""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import mitsuba as mi
import numpy as np

from svu_mi.capture.capture import Capture
from svu_mi.capture.content_hash import capture_key
from svu_mi.capture.scene import environment_of, has_lamps, lamps_of, require_light
from svu_mi.capture.surroundings import reflecting_shapes
from svu_mi.capture.up_direction import up_direction
from svu_mi.core.arrays import to_drjit
from svu_mi.core.io.array_cache import ArrayCache
from svu_mi.core.progress import Progress
from svu_mi.errors import CaptureError, OptionError, counted
from svu_mi.frequency.fit_samples import MirroredLight
from svu_mi.frequency.sh_lobes import ShLobes
from svu_mi.geometry.packed_views import Views, pack_views
from svu_mi.geometry.pixel_footprint import as_channels
from svu_mi.geometry.sample_view import TexelLanes, ViewSample
from svu_mi.geometry.shared_texels import shared_texels
from svu_mi.geometry.texels import Texels
from svu_mi.geometry.visibility import Visibility, trace_visibility
from svu_mi.light.above_plane import above_plane
from svu_mi.light.band_limited import Lighting, read_lighting
from svu_mi.light.flash_light import FlashLight
from svu_mi.light.lamps import Lamps, trace_lamps
from svu_mi.light.light_tree import LightTree, build_light_tree
from svu_mi.light.light_visibility import (
    LightVisibility,
    SampleBits,
    trace_light_visibility,
    trace_mirror,
    trace_samples,
)
from svu_mi.light.near_light import NearLight, trace_near_light
from svu_mi.posterior.kept_results import (
    pack_light_visibility,
    pack_visibility,
    restore_light_visibility,
    restore_visibility,
)
from svu_mi.posterior.object_appearance import near_surfaces
from svu_mi.posterior.sample_statistics import sample_statistics
from svu_mi.presets import AngularPreset, AnyPreset, Preset, Skip
from svu_mi.reflection.near_surfaces import NearSurfaces
from svu_mi.reflection.principled import alpha_from_roughness
from svu_mi.reflection.reflection_model import IncidentLight, ReflectionModel
from svu_mi.statistics.gather_statistics import UNIFORM, Weighting, rounding_sums
from svu_mi.statistics.statistics import Statistics

log = logging.getLogger(__name__)

BRIGHTEST = 1e12  # maximum mean radiance, 1 / BRIGHTEST the minimum: squares fit single precision
COARSE = 8  # number of fine light cells per coarse cell, on average
DARK = 1e-2  # radiance unit of black photographs, relative to the mean radiance of the light


@dataclass(eq=False, kw_only=True)
class Observed:
    """Photographs, light, texels and visibility of a capture; computed on first use.

    Attributes:
        visibility: visibility of T texels in V views.
        seen: (S,) int64, texels to compute: all seen texels, or all T if none are skipped.
        cache: results of earlier commands, for the capture, the texels and ``seen``.
        plane: albedo of a plane below the object that replaces the light from below, or None.
    """

    capture: Capture
    texels: Texels
    views: Views
    visibility: Visibility
    seen: np.ndarray
    cache: ArrayCache = ArrayCache()
    plane: float | None = None
    _of_light: dict[Any, Any] = field(default_factory=dict, repr=False)
    _rays: dict[Any, Any] = field(default_factory=dict, repr=False)

    def subset(self, texels: np.ndarray) -> "Observed":
        """Return a copy that computes only (t,) ``texels``, with the same light."""
        return replace(self, seen=texels, cache=ArrayCache(), _rays={})

    def on_plane(self, albedo: float) -> "Observed":
        """Return a copy with the light above a plane (see ``above_plane``)."""
        cache = self.cache.under("plane", albedo)
        return replace(self, plane=albedo, cache=cache, _of_light={}, _rays={})

    def among(self, surfaces: NearSurfaces) -> "Observed":
        """Return a copy with known surfaces around texels, for presets with ``bounces``."""
        return replace(self, _of_light={**self._of_light, ("around", True): surfaces})

    def without(self, texels: np.ndarray, groups: Sequence[np.ndarray]) -> "Observed":
        """Return (t,) texels once for each group of views, without these (see ``Visibility``).

        Rays that were traced for ``seen`` are not traced again.
        """
        numbers = np.tile(texels, len(groups))
        lanes = self.lane[numbers]
        return replace(
            self, texels=self.texels.subset(numbers), seen=np.arange(len(numbers)),
            cache=ArrayCache(),
            visibility=self.visibility.without(texels, groups),
            _rays={key: rays.subset(lanes) for key, rays in self._rays.items()},
        )  # fmt: skip

    @cached_property
    def coverage(self) -> np.ndarray:
        """(T,) uint32, number of photographs in which each texel is visible and not saturated."""
        return np.array(self.visibility.coverage)

    @cached_property
    def clipped_coverage(self) -> np.ndarray | None:
        """(T,) uint32, number of photographs in which a texel is saturated; None if never."""
        seen = self.visibility
        return None if seen.clipped is None else np.asarray(seen.clipped_coverage)

    @property
    def shown(self) -> np.ndarray:
        """(T,) uint32, number of photographs that show each texel, saturated or not."""
        clipped = self.clipped_coverage
        return self.coverage if clipped is None else np.asarray(self.coverage + clipped, np.uint32)

    @property
    def scale(self) -> float:
        """Mean radiance of all samples; 0 if all are black."""
        return self.visibility.scale

    @cached_property
    def unit(self) -> float:
        """Radiance unit: mean of the photographs; a fraction of the light if they are black."""
        return self.scale or DARK * float(self.distant_light.environment.coefficients(0).mean())

    @property
    def lighting(self) -> Lighting:
        """Environment light, for methods that support no lamps."""
        environment_of(self.capture)
        return self.distant_light

    @property
    def distant_light(self) -> Lighting:
        """Environment light, read on first use; black without an environment."""
        if "lighting" not in self._of_light:
            require_light(self.capture)
            found = read_lighting(self.capture, sum(self.capture.used))
            if self.plane is not None:
                light = above_plane(found.environment, up_direction(self.capture), self.plane)
                found = replace(found, environment=light)
            self._of_light["lighting"] = found
        lighting: Lighting = self._of_light["lighting"]
        return lighting

    def light_tree(self, fine: int) -> LightTree:
        """Return the tree of light cells with ``fine`` fine cells; cached."""
        if fine not in self._of_light:
            coarse = min(max(fine // COARSE, 64), fine)
            self._of_light[fine] = build_light_tree(self.distant_light.environment, coarse, fine)
        tree: LightTree = self._of_light[fine]
        return tree

    @cached_property
    def surface(self) -> TexelLanes:
        """Positions and normals of the texels in ``seen``: S lanes."""
        return self.lanes(self.seen)

    @cached_property
    def lane(self) -> np.ndarray:
        """(T,) int64, lane of each texel in ``surface``; -1 if not in ``seen``."""
        lanes = np.full(self.texels.count, -1)
        lanes[self.seen] = np.arange(len(self.seen))
        return lanes

    @property
    def mirrors(self) -> SampleBits:
        """Visibility of the mirror direction of each sample; traced on first use."""
        scene, surface = self.views.scene, self.surface
        return self._traced("mirrors", lambda seen, _, on: trace_mirror(scene, surface, seen, on))

    @property
    def flash(self) -> FlashLight | None:
        """Flash and its shadows, traced on first use; None without one."""
        if self.capture.flash is None:
            return None
        order = self.visibility.order.numpy()
        light = FlashLight.of(self.capture.flash, [self.capture.used_sensors[k] for k in order])
        return replace(
            light, lit=self._traced("flash", partial(light.trace, self.views.scene, self.surface))
        )

    def flash_of(self, sensors: Sequence[Any]) -> FlashLight:
        """Return the flash of the photographs, then of other sensors; its shadows are traced."""
        assert self.capture.flash is not None
        light = FlashLight.of(self.capture.flash, [*self.capture.used_sensors, *sensors])
        return replace(light, scene=self.views.scene)

    def _traced(self, name: str, trace: Callable[[ViewSample, Any, Any], Any]) -> SampleBits:
        if name not in self._rays:
            lane = to_drjit(mi.UInt32, np.maximum(self.lane, 0).astype(np.uint32))
            self._rays[name] = trace_samples(self.views, self.surface, self.visibility, lane, trace)
        bits: SampleBits = self._rays[name]
        return bits

    def light_visibility(self, cells: int, *, occluded: bool = True) -> LightVisibility:
        """Return the visibility of ``cells`` fine light cells from S texels; cached."""
        key = (cells, occluded)
        if key not in self._rays:
            tree, owners = self.light_tree(cells), shared_texels(self.texels, self.seen)
            traced, place = np.unique(owners, return_inverse=True)
            places = to_drjit(mi.UInt32, place.astype(np.uint32))
            self._rays[key] = self.cache.recall(
                "occlusion", key,
                lambda: trace_light_visibility(
                    self.views.scene, self.lanes(traced), tree, places, occluded=occluded
                ),
                pack_light_visibility,
                partial(restore_light_visibility, tree=tree, place=places),
            )  # fmt: skip
        known: LightVisibility = self._rays[key]
        return known

    @cached_property
    def has_reflectors(self) -> bool:
        """True if other shapes reflect light onto the object."""
        return bool(reflecting_shapes(self.capture.scene, self.capture.shape))

    def trace_light(self, switches: AngularPreset) -> None:
        """Trace the light of all directions from S texels, if not done yet."""
        self.light_visibility(switches.cells, occluded=switches.occluded)
        self.near_light(switches)
        self.lamps(switches)

    def near_light(self, switches: AngularPreset) -> NearLight | None:
        """Return the light from other surfaces at S texels, traced on first use; None without."""
        if not self.lit_by_surfaces(switches):
            return None
        key = "near", switches.bounces
        if key not in self._rays:
            self._rays[key] = trace_near_light(self._surfaces(switches), self.surface)
        near: NearLight = self._rays[key]
        return near

    def _surfaces(self, switches: AngularPreset) -> NearSurfaces:
        """Return the surfaces around texels; cached."""
        if switches.bounces and self.capture.flash is not None:
            raise OptionError(
                "Light that the object reflects onto itself is not supported with a flash; omit "
                "--bounces."
            )
        key = "around", switches.bounces
        if key not in self._of_light:
            self._of_light[key] = near_surfaces(self, switches)
        surfaces: NearSurfaces = self._of_light[key]
        return surfaces

    def lamps(self, switches: AngularPreset) -> Lamps | None:
        """Return the light of lamps at S texels, traced on first use; None without lamps."""
        lamps = lamps_of(self.capture.scene)
        key = "lamps", switches.occluded
        if lamps and key not in self._rays:
            self._rays[key] = trace_lamps(
                self.views.scene, lamps, self.surface, occluded=switches.occluded
            )
        return self._rays.get(key)

    def lit_by_surfaces(self, switches: AnyPreset) -> bool:
        """Return whether light from other surfaces is modelled, and there is some."""
        if not isinstance(switches, AngularPreset) or not switches.with_surfaces:
            return False
        return switches.bounces or self.has_reflectors

    def grey_light(self, switches: AnyPreset) -> bool:
        """Return whether R, G and B of the light are equal; other light than distant is not."""
        lit = self.lit_by_surfaces(switches) or has_lamps(self.capture)
        return self.distant_light.environment.grey and not lit

    def irradiance(self, switches: Preset, channels: int) -> list[Any]:
        """Return the irradiance of S texels: an (S,) Float per channel, 3 or 1."""
        if not switches.occluded:
            return as_channels(self.lighting.irradiance(self.surface.normal), channels)
        moments = self.light_visibility(switches.rays).diffuse(
            self.surface, self.distant_light, channels
        )
        return [of_channel[0] for of_channel in moments]

    def model(
        self, roughness: np.ndarray, switches: AngularPreset, channels: int,
        texels: np.ndarray | None = None,
    ) -> ReflectionModel:  # fmt: skip
        """Return the reflection model of texels (default: ``seen``) at (R,) roughness levels."""
        if texels is not None and (self.lane[texels] < 0).any():  # their light was not traced
            return self.subset(texels).model(roughness, switches, channels)
        if texels is not None and np.array_equal(texels, self.seen):
            texels = None

        def part_of(light: Any) -> Any:
            return light if texels is None or light is None else light.subset(self.lane[texels])

        surface = self.surface if texels is None else self.lanes(texels)
        visibility, fitted = None, None
        if switches.traced:
            cells = self.light_visibility(switches.cells, occluded=switches.occluded)
            visibility = part_of(cells)
        else:
            _ = self.lighting  # refuses lamps
        if switches.fit is not None:
            chosen = self.seen if texels is None else texels
            mirrored = MirroredLight(self, switches.fit, channels, chosen)
            fitted = ShLobes.of(mirrored, alpha_from_roughness(roughness), switches)
        light = IncidentLight(
            self.distant_light, visibility, channels, part_of(self.near_light(switches)),
            part_of(self.lamps(switches)), self.flash,
        )  # fmt: skip
        return ReflectionModel.of(surface, light, roughness, switches, fitted)

    def statistics(
        self, roughness: np.ndarray, switches: AngularPreset, channels: int, *,
        weighting: Weighting = UNIFORM, texels: np.ndarray | None = None,
    ) -> Statistics:  # fmt: skip
        """Gather the statistics of texels (default: ``seen``) over all photographs.

        ``channels`` is 3, or 1 for the mean of R, G and B. Saturated samples count as lower bounds
        (``censored``) if ``weighting`` has a finite kappa and no ``current``, else are ignored.
        """
        model = self.model(roughness, switches, channels, texels)
        return sample_statistics(self, model, channels, weighting)

    def rounding(self, weighting: Weighting) -> np.ndarray | None:
        """Return the rounding variance, (S,) squared radiance; None if photographs are floats."""
        total = rounding_sums(self.views, self.visibility, self.surface, weighting)
        return None if total is None else total / np.maximum(self.coverage[self.seen], 1)

    def lanes(self, texels: np.ndarray) -> TexelLanes:
        """Return positions and normals of (t,) texels."""
        return TexelLanes.of(self.texels, to_drjit(mi.UInt32, texels.astype(np.uint32)))


def observe(
    capture: Capture, texels: Texels, progress: Progress | None = None, skip: Skip | None = None
) -> Observed:
    """Trace the visibility of texels in a capture's views; ``skip`` does not change results."""
    progress, skip = progress or Progress(), skip or Skip()
    with progress.stage("Finding silhouettes"):
        views = pack_views(capture)

    def trace() -> Visibility:
        with progress.stage("Tracing visibility"):
            return trace_visibility(
                views, TexelLanes.of(texels), skip_blind=skip.blind, skip_pairs=skip.pairs
            )

    cache = _cache_of(capture, texels, skip)
    visibility = cache.recall(
        "visibility", (), trace, pack_visibility,
        partial(
            restore_visibility, views=views.number, texels=texels.count,
            clipped=views.clipped is not None, dense=not skip.pairs,
        ),
    )  # fmt: skip
    require_seen(visibility.per_view, capture, clipped=bool(np.any(visibility.clipped_coverage)))
    require_range(visibility.scale)
    all_texels = np.arange(texels.count)
    observed = Observed(
        capture=capture, views=views, texels=texels, visibility=visibility, seen=all_texels,
        cache=cache,
    )  # fmt: skip
    return replace(observed, seen=np.flatnonzero(observed.shown)) if skip.unseen else observed


def _cache_of(capture: Capture, texels: Texels, skip: Skip) -> ArrayCache:
    """Return the cache of the capture for results of these texels."""
    if capture.cache.folder is None:
        return capture.cache
    layout = texels.resolution, texels.index.numpy(), texels.position.numpy()
    return capture.cache.under(capture_key(capture), layout, skip)


def require_seen(counts: np.ndarray, capture: Capture, *, clipped: bool = False) -> None:
    """Check (V,) numbers of visible texels; warn of views without any, raise if all are 0."""
    if not counts.any() and clipped:
        raise CaptureError(
            f"All texels of '{capture.shape.id()}' are saturated in all {len(counts)} photographs; "
            "use shorter exposures."
        )
    if not counts.any():
        raise CaptureError(
            f"No texel of '{capture.shape.id()}' is seen in any of {len(counts)} photographs; "
            "check poses (camera space is +X left, +Y up, +Z forward), units, masks and normals."
        )
    used = [name for name, used in zip(capture.names, capture.used, strict=True) if used]
    blind = [name for name, count in zip(used, counts, strict=True) if count == 0]
    if blind:
        log.warning("No texel in %s: %s", counted(len(blind), "photograph"), ", ".join(blind[:5]))


def require_range(radiance: float) -> None:
    """Raise an error if squares of the mean radiance exceed single precision; 0 is valid."""
    if radiance and not 1 / BRIGHTEST <= radiance <= BRIGHTEST:
        raise CaptureError(
            f"The photographs' mean radiance is {radiance:g}; scale them and the light so that it "
            f"is between {1 / BRIGHTEST:g} and {BRIGHTEST:g}, or mask pixels that are not radiance."
        )
