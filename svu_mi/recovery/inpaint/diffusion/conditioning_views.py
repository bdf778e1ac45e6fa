"""Input views of a diffusion model, and the transfer of the model's maps to texels.

Uncertain texels use the photographs that show them, as in the paper. Unseen texels use renders of
the textures filled so far, under the capture's light. Renders resemble the photographs that models
are trained on, and contain only information from the photographs.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture.capture import Capture
from svu_mi.capture.sensors import film_size, scaled_sensor, sensors_like, windowed_sensor
from svu_mi.capture.tonemap import ObjectView, object_only_scene, resized, white_radiance
from svu_mi.core.arrays import to_drjit
from svu_mi.geometry.dilate import dilate
from svu_mi.geometry.packed_views import LARGEST_FILM, Views, pack_sensors
from svu_mi.geometry.sample_view import TexelLanes, sample_view, sample_visible
from svu_mi.parameters import CHANNELS, NAMES
from svu_mi.recovery.inpaint.diffusion.model_interface import ModelInput
from svu_mi.recovery.relighting import relight
from svu_mi.recovery.svbrdf_textures import Textures
from svu_mi.recovery.uncertainty.texture_field import TextureField

CANDIDATES = 100  # candidate views on a sphere
STEEPEST = 0.3  # least cosine between normal and camera direction of well visible texels
COVERED_TEXELS = 2**16  # maximum sample of texels for the choice of views
LEAST_ADDED = 0.01  # least fraction of holes that a further view must add
SPP = 64  # samples per pixel of a render
MARGIN = 0.06  # around the object, relative to its size
KNOWN_PIXEL = 0.999  # least known fraction of a pixel that counts as known


@dataclass(frozen=True)
class ConditioningViews:
    """Candidate views, either photographs or renders.

    Attributes:
        capture: Capture with scene and photographs.
        field: Textures to fill.
        side: Maximum number of pixels of the longer side of an image.
        photographs: Indices of the photographs to use; None for renders from all around.
    """

    capture: Capture
    field: TextureField
    side: int
    photographs: tuple[int, ...] | None = None

    @cached_property
    def sensors(self) -> tuple[Any, ...]:
        """Sensors of the candidate views."""
        capture = self.capture
        if self.photographs is None:
            return sensors_like(capture.used_sensors or capture.sensors, capture.shape, CANDIDATES)
        return tuple(capture.sensors[view] for view in self.photographs)

    def name(self, place: int) -> str:
        """Return the name of the candidate view with index ``place``."""
        if self.photographs is None:
            return str(self.sensors[place].id())
        return self.capture.names[self.photographs[place]]

    def choose_views(self, holes: np.ndarray, max_views: int) -> list[int]:
        """Return indices of views that cover the ``holes`` (T,), chosen greedily."""
        texels = np.flatnonzero(holes)
        texels = texels[:: -(-len(texels) // COVERED_TEXELS) or 1]
        surface = TexelLanes.of(self.field.texels, to_drjit(mi.UInt32, texels.astype(np.uint32)))
        views = pack_sensors(self.capture.scene, self.capture.shape, self.sensors)
        shown = np.array([_well_seen(views, surface, k) for k in range(views.number)])
        chosen: list[int] = []
        while len(chosen) < max_views:
            added = shown.sum(axis=1)
            best = int(added.argmax())
            if added[best] <= LEAST_ADDED * len(texels):
                break
            chosen.append(best)
            shown = shown & ~shown[best]
        return chosen

    def input_of(self, place: int, values: np.ndarray, known: np.ndarray, seed: int) -> ModelInput:
        """Return the input of a model for one view."""
        sensor, part = self._framed(place)
        textures = self.field.to_textures(values)
        maps, usable = self._maps(sensor, textures, known), self._usable(sensor)
        if self.photographs is None:
            shown = relight(self.capture, textures, None, [sensor], SPP, seed=seed)[0]
        else:
            photograph = self.capture.images[self.photographs[place]]
            shown = resized(photograph[part], film_size(sensor))
        white = white_radiance(shown, usable)
        return ModelInput(
            # NaN marks missing radiance, in most cases saturation: white.
            photograph=np.clip(np.nan_to_num(shown / white, nan=1.0), 0, 1).astype(np.float32),
            certain=usable & (maps.pop("known") > KNOWN_PIXEL), maps=maps, sensor=sensor,
        )  # fmt: skip

    def to_texels(
        self, sensor: Any, maps: Mapping[str, np.ndarray]
    ) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Sample maps of a view at texels: values (C, T), and a mask of well visible ones."""
        surface, views = TexelLanes.of(self.field.texels), self._packed(sensor)
        seen = _well_seen(views, surface, 0)
        values = {}
        for name, image in maps.items():
            color = np.repeat(image[..., None], 3, axis=-1) if image.ndim == 2 else image
            at = replace(views, pixels=to_drjit(mi.Float, color.astype(np.float32).ravel()))
            shown = sample_visible(at, surface, dr.opaque(mi.UInt32, 0), to_drjit(mi.Bool, seen))
            values[name] = np.array(shown.radiance)[: CHANNELS[name]]
        return values, seen

    def _framed(self, place: int) -> tuple[Any, tuple[slice, slice]]:
        """Return a sensor cropped to the object, and the crop's rows and columns."""
        sensor, rendered = self.sensors[place], self.photographs is None
        small = scaled_sensor(sensor, LARGEST_FILM)  # the resolution of ``choose_views``
        shown = self._usable(small)
        columns, rows = (np.flatnonzero(shown.any(axis=axis)) for axis in (0, 1))
        middle = np.array([columns[0] + columns[-1] + 1, rows[0] + rows[-1] + 1]) / 2
        scale = np.divide(film_size(sensor), film_size(small))
        longest = max(np.ptp(columns), np.ptp(rows)) + 1
        length = (1 + 2 * MARGIN) * longest * float(scale.max())
        low = np.floor(middle * scale - length / 2).astype(int)
        high = low + int(np.ceil(length))
        if not rendered:
            low, high = np.maximum(low, 0), np.minimum(high, film_size(sensor))
        factor = self.side / float((high - low).max())
        factor = factor if rendered else min(factor, 1.0)
        width, height = (max(int(round(factor * size)), 1) for size in high - low)
        (x, y), (right, bottom) = low.tolist(), high.tolist()
        window = windowed_sensor(sensor, (x, y), (width, height), factor)
        return window, (slice(y, bottom), slice(x, right))

    def _usable(self, sensor: Any) -> np.ndarray:
        """Return a mask (h, w) of the usable pixels of a sensor."""
        width, height = film_size(sensor)
        return np.array(self._packed(sensor).usable).reshape(height, width)

    def _packed(self, sensor: Any) -> Views:
        size = max(film_size(sensor))
        return pack_sensors(self.capture.scene, self.capture.shape, [sensor], size)

    @cached_property
    def _alone(self) -> Any:
        return object_only_scene(self.capture)

    def _maps(self, sensor: Any, textures: Textures, known: np.ndarray) -> dict[str, np.ndarray]:
        """Return maps of all parameters in a view, and a map ``known`` of known texels."""
        seen = ObjectView.of(self._alone, sensor)
        maps = {}
        for name in NAMES:
            image = np.array(textures[name])
            shown = seen.values(np.broadcast_to(image, (*image.shape[:2], 3)))
            maps[name] = shown if CHANNELS[name] > 1 else shown[..., 0]
        texels = self.field.texels
        # Flags also need gutters, or seams would count as unknown.
        flags = dilate(texels.to_image(known), texels.inside(), float(np.hypot(*image.shape[:2])))
        maps["known"] = seen.values(np.repeat(flags[..., None], 3, axis=-1))[..., 0]
        return maps


def _well_seen(views: Views, surface: TexelLanes, number: int) -> np.ndarray:
    """Return a mask (t,) of texels that a view shows at cosines above STEEPEST."""
    seen = sample_view(views, surface, dr.opaque(mi.UInt32, number))
    return np.array(seen.seen & (seen.cosine > dr.opaque(mi.Float, STEEPEST)))
