"""Where the mesh would be in the photographs, under any poses."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from svu_mi.capture.rays import film_ray
from svu_mi.checking.frames import Frames
from svu_mi.interop import owned


def silhouettes(frames: Frames) -> list[np.ndarray]:
    """Trace a ray through the centre of every pixel of the small photographs.

    Args:
        frames: V views; their poses need not be those of the capture.

    Returns:
        V arrays (h, w) bool, True where the object is seen.
    """
    shapes = [image.shape[:2] for image in frames.radiance]
    counts = [height * width for height, width in shapes]
    row, column = np.concatenate([np.indices(s).reshape(2, -1) for s in shapes], axis=1) + 0.5
    ray = film_ray(
        frames.views.rays,
        owned(mi.UInt32, np.repeat(np.arange(len(shapes), dtype=np.uint32), counts)),
        owned(mi.Float, column.astype(np.float32)),
        owned(mi.Float, row.astype(np.float32)),
    )
    hit = frames.capture.scene.ray_intersect_preliminary(ray, coherent=True)
    # Opaque: as a literal, every scene would get a kernel of its own.
    seen = hit.is_valid() & (hit.shape == dr.opaque(mi.ShapePtr, frames.capture.shape))
    parts = np.split(np.broadcast_to(np.array(seen, bool), sum(counts)), np.cumsum(counts)[:-1])
    return [part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)]


def overlap(seen: np.ndarray, mask: np.ndarray) -> float:
    """Return intersection over union of two (h, w) masks; 1 if both are empty."""
    union = (seen | mask).sum()
    return float((seen & mask).sum() / union) if union else 1.0


def outline(seen: np.ndarray) -> np.ndarray:
    """Return the pixels (h, w) of an object with a neighbour that is not of it."""
    edge = np.zeros_like(seen)
    edge[1:] |= seen[1:] != seen[:-1]
    edge[:-1] |= seen[1:] != seen[:-1]
    edge[:, 1:] |= seen[:, 1:] != seen[:, :-1]
    edge[:, :-1] |= seen[:, 1:] != seen[:, :-1]
    return edge & seen


def contrast(radiance: np.ndarray) -> np.ndarray:
    """Return how strong an edge every pixel (h, w) lies on: its rank in the photograph, 0 to 1.

    Args:
        radiance: (h, w, 3), NaN = not usable.
    """
    grey = np.nan_to_num(radiance.mean(axis=2), nan=np.nanmax(radiance, initial=0))
    shown = grey / (grey + max(float(np.median(grey)), 1e-12))
    gradient = np.hypot(*np.gradient(shown)) if min(shown.shape) > 1 else np.zeros(shown.shape)
    rank = np.searchsorted(np.sort(gradient.ravel()), gradient, side="left")
    return rank / gradient.size
