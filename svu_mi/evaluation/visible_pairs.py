"""Visible (texel, view) pairs: observed radiance, and the camera ray."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.evaluation.path_trace import UniformScene
from svu_mi.geometry.packed_views import CAMERA_FLOATS, Views
from svu_mi.geometry.sample_view import RAY_OFFSET, TexelLanes, sample_visible
from svu_mi.posterior.observations import Observed

TOLERANCE = 4e-5  # of the object's extent: how far from a texel's tangent plane a ray may land


@dataclass(frozen=True)
class VisiblePairs:
    """P visible pairs of a batch of texels, texel by texel.

    Attributes:
        texel: (P,) int64, place of the texel in the batch.
        radiance: (P, 3) float64, observed.
        contrast: (P,) float64, variance of the pixels it is the mean of.
        rays: (P,) Ray3f from the camera to the texel, world space; None without pairs.
        dropped: number of visible pairs left out: their ray meets something else first.
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
        """(P,) float64, observed grey radiance."""
        return np.asarray(self.radiance.mean(axis=1))


def visible_pairs(observed: Observed, batch: Any, target: UniformScene) -> VisiblePairs:
    """Find the pairs of texels that a camera ray confirms; 100 bytes per texel and view."""
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
        # Channel by channel: together, every number of pairs would compile a kernel of its own.
        radiance=np.stack([x.numpy() for x in radiance], axis=-1).astype(np.float64),
        contrast=contrast.numpy().astype(np.float64),
        rays=rays,
        dropped=visible - dr.width(kept),
    )


def _aim(
    views: Views, surface: TexelLanes, view: Any, target: UniformScene, active: Any
) -> tuple[Any, Any]:
    """Return rays from the cameras to the texels, and whether they are active and land there.

    Landing is within a distance of the texel's tangent plane: rays leak, and sheets are thin.
    """
    camera = mi.Point3f(
        *(dr.gather(mi.Float, views.cameras, view * CAMERA_FLOATS + 12 + k) for k in range(3))
    )
    ray = mi.Ray3f(camera, dr.normalize(surface.position - camera))
    hit = target.scene.ray_intersect(ray, mi.RayFlags.Minimal, True, active=active)
    miss = dr.abs(dr.dot(ray(hit.t) - surface.position, surface.geometric_normal))
    # Opaque: as a literal, every scene of a process would get a kernel of its own.
    on_object = active & hit.is_valid() & (hit.shape == dr.opaque(mi.ShapePtr, target.shape))
    # surface.offset is a fraction of the extent, and already opaque.
    return ray, on_object & (miss < (TOLERANCE / RAY_OFFSET) * surface.offset)
