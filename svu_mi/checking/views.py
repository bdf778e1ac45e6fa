"""How every photograph fits what the capture says: silhouette, edges and colours."""

from __future__ import annotations

import numpy as np

from svu_mi.capture import Capture
from svu_mi.checking.appearance import read_texture
from svu_mi.checking.frames import Frames
from svu_mi.checking.points import look, open_cosines, scatter_points
from svu_mi.checking.poses import outline_contrast
from svu_mi.checking.record import ViewCheck
from svu_mi.checking.silhouettes import contrast, overlap, silhouettes
from svu_mi.checking.sky import DIRECTIONS, Sky, emitter_of


def check_views(capture: Capture) -> tuple[ViewCheck, ...]:
    """Compare every used photograph with the mesh, its texture and the light.

    Args:
        capture: with reduced photographs.
    """
    frames = Frames.of(capture)
    found = zip(
        np.flatnonzero(capture.used).tolist(), silhouettes(frames), frames.masks, frames.radiance,
        _color_errors(capture, frames), strict=True,
    )  # fmt: skip
    return tuple(
        ViewCheck(
            view=view,
            name=capture.names[view],
            overlap=None if mask is None else overlap(seen, mask),
            contrast=outline_contrast(seen, contrast(radiance)),
            color_error=error,
        )
        for view, seen, mask, radiance, error in found
    )


def _color_errors(capture: Capture, frames: Frames) -> list[float | None]:
    """Return the mean error of each view, of a diffuse object; None where none of it is seen, and
    without a light.

    The reflectance is the scene's texture, or one colour, times a factor per channel that the
    photographs ask for.
    """
    emitter = emitter_of(capture)
    if emitter is None:
        return [None] * frames.views.number
    points = scatter_points(capture.shape)
    sightings, texture = look(points, frames), read_texture(capture, points)
    flux = Sky.of(emitter, np.eye(3)).arriving(np.eye(3))
    albedo = 1.0 if texture is None else texture.albedo
    predicted = albedo * (open_cosines(capture.scene, points, DIRECTIONS) @ flux) / np.pi
    view, point = np.nonzero(sightings.seen)
    shown, model = sightings.radiance[view, point], predicted[point]
    ratio = shown / np.maximum(model, 1e-3 * predicted.mean() + 1e-300)
    model = model * (np.median(ratio, axis=0) if len(ratio) else 1.0)
    count = len(sightings.seen)
    error = np.bincount(view, np.abs(shown - model).mean(axis=1), count)
    whole = np.bincount(view, shown.mean(axis=1), count)
    return [float(e / w) if w > 0 else None for e, w in zip(error, whole, strict=True)]
