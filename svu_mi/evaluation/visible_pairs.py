"""Visible (texel, view) pairs with observed radiance and camera rays."""

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.evaluation.path_trace import UniformScene
from svu_mi.geometry.packed_views import CAMERA_FLOATS, Views
from svu_mi.geometry.sample_view import RAY_OFFSET, TexelLanes, sample_visible
from svu_mi.posterior.observations import Observed

TOLERANCE = 4e-5  # largest distance of a hit from the texel's plane, relative to the extent


@dataclass(frozen=True)
class VisiblePairs:
    """P visible pairs of a batch of texels, ordered by texel.

    Attributes:
        texel: (P,) int64, index of the texel in the batch.
        radiance: (P, 3) float64, observed radiance, a mean over nearby pixels.
        contrast: (P,) float64, variance of the nearby pixels.
        rays: (P,) Ray3f from the camera to the texel, world space; None without pairs.
        dropped: Number of visible pairs whose camera ray hits another surface first.
    """

    texel: np.ndarray
    radiance: np.ndarray
    contrast: np.ndarray
    rays: Any
    dropped: int

    @property
    def count(self) -> int:
        """Number of pairs P."""
        return len(self.texel)

    @property
    def observed(self) -> np.ndarray:
        """Observed grey radiance, (P,) float64."""
        return np.asarray(self.radiance.mean(axis=1))


def visible_pairs(observed: Observed, batch: Any, target: UniformScene) -> VisiblePairs:
    """Return the visible pairs whose camera ray hits the texel (100 bytes per texel and view)."""
    views, texels = observed.views, observed.texels
    lane = dr.arange(mi.UInt32, dr.width(batch) * views.number)
    place = lane // views.count
    view = lane - place * views.count
    surface = TexelLanes.of(texels, dr.gather(mi.UInt32, batch, place))
    is_visible = observed.visibility.bits.test(view, surface.index)
    sample = sample_visible(views, surface, view, is_visible)
    rays, hit = _aim(views, surface, view, target, is_visible)
    values = place, sample.radiance, sample.contrast, rays
    dr.eval(values, is_visible, hit)
    visible, kept = dr.count(is_visible)[0], dr.compress(hit)
    if not dr.width(kept):
        return VisiblePairs(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0), None, visible)
    place, radiance, contrast, rays = (dr.gather(type(x), x, kept) for x in values)
    dr.eval(place, radiance, contrast, rays)
    return VisiblePairs(
        texel=place.numpy().astype(np.int64),
        # Per channel: a joint copy would compile a kernel for every number of pairs.
        radiance=np.stack([x.numpy() for x in radiance], axis=-1).astype(np.float64),
        contrast=contrast.numpy().astype(np.float64),
        rays=rays,
        dropped=visible - dr.width(kept),
    )


def _aim(
    views: Views, surface: TexelLanes, view: Any, target: UniformScene, active: Any
) -> tuple[Any, Any]:
    """Return rays from the cameras to the texels, and flags of active rays that hit the texel.

    Hits farther than ``TOLERANCE`` from the texel's tangent plane, such as on the back of a thin
    sheet, are misses.
    """
    camera = mi.Point3f(
        *(dr.gather(mi.Float, views.cameras, view * CAMERA_FLOATS + 12 + k) for k in range(3))
    )
    ray = mi.Ray3f(camera, dr.normalize(surface.position - camera))
    hit = target.scene.ray_intersect(ray, mi.RayFlags.Minimal, True, active=active)
    miss = dr.abs(dr.dot(ray(hit.t) - surface.position, surface.geometric_normal))
    # Opaque: a literal shape would compile a new kernel for every scene.
    on_object = active & hit.is_valid() & (hit.shape == dr.opaque(mi.ShapePtr, target.shape))
    # surface.offset is a fraction of the extent, and already opaque.
    return ray, on_object & (miss < (TOLERANCE / RAY_OFFSET) * surface.offset)
