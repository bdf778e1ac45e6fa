"""How every photograph fits what the capture says: silhouette, edges and colours."""

from __future__ import annotations

import numpy as np

from svu_mi.capture import Capture
from svu_mi.capture.scene import find_environment
from svu_mi.checking.appearance import read_texture
from svu_mi.checking.frames import reduced
from svu_mi.checking.points import Points, Sightings, look, scatter_points
from svu_mi.checking.poses import outline_contrast
from svu_mi.checking.record import ViewCheck
from svu_mi.checking.silhouettes import contrast, overlap, silhouettes
from svu_mi.checking.sky import Sky, open_cosines
from svu_mi.light.environment import read_environment

SIDE = 128  # pixels of the photographs that are compared


def check_views(capture: Capture) -> tuple[ViewCheck, ...]:
    """Compare every used photograph with the mesh, its texture and the light."""
    frames = reduced(capture, SIDE)
    points = scatter_points(capture.shape)
    errors = _color_errors(capture, points, look(capture, points, frames))
    found = []
    for index, seen in enumerate(silhouettes(capture, frames)):
        mask, view = frames.masks[index], frames.views[index]
        found.append(
            ViewCheck(
                view=view,
                name=capture.names[view],
                overlap=None if mask is None else overlap(seen, mask),
                contrast=outline_contrast(seen, contrast(frames.radiance[index])),
                color_error=errors[index],
            )
        )
    return tuple(found)


def _color_errors(capture: Capture, points: Points, sightings: Sightings) -> list[float | None]:
    """Return the mean error of each view, of a diffuse object; None where none of it is seen.

    The reflectance is the scene's texture, or one colour, times a factor per channel that the
    photographs ask for.
    """
    emitter = find_environment(capture.scene, str(capture.source or "scene"))
    sky = Sky.of(read_environment(emitter), np.eye(3))
    directions, cosines = open_cosines(capture.scene, points)
    texture = read_texture(capture, points)
    albedo = 1.0 if texture is None else texture.albedo
    predicted = albedo * (cosines @ sky.arriving(directions, np.eye(3))) / np.pi
    view, point = np.nonzero(sightings.seen)
    shown, model = sightings.radiance[view, point], predicted[point]
    ratio = shown / np.maximum(model, 1e-3 * predicted.mean() + 1e-300)
    model = model * (np.median(ratio, axis=0) if len(ratio) else 1.0)
    count = len(sightings.seen)
    error = np.bincount(view, np.abs(shown - model).mean(axis=1), count)
    whole = np.bincount(view, shown.mean(axis=1), count)
    return [float(e / w) if w > 0 else None for e, w in zip(error, whole, strict=True)]
