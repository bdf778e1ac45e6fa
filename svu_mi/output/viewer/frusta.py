"""Cameras as frusta with their photographs, in OpenCV's axes: +X right, +Y down, +Z forward."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from PIL import Image

from svu_mi.capture import Capture
from svu_mi.capture.picture import quantized
from svu_mi.capture.poses import film_size, focal_length, principal_point
from svu_mi.capture.scene import to_world
from svu_mi.capture.shown import tone_mapped
from svu_mi.formats.source import OPENCV


@dataclass(frozen=True, kw_only=True)
class Frustum:
    """A camera whose optical axis goes through the centre of its picture.

    Attributes:
        rotation: (3, 3) float64, camera to world.
        position: (3,) float64, in world space.
        fov: opening angle over the picture's height, in radians.
        aspect: the picture's width over its height.
        image: (h, w, 4) uint8, the photograph in screen colours. Where the principal point is
            not its centre, it is widened by transparent pixels until it is.
    """

    rotation: np.ndarray
    position: np.ndarray
    fov: float
    aspect: float
    image: np.ndarray


def frustum(capture: Capture, view: int, side: int) -> Frustum:
    """Return a camera with its photograph, exposed for the object and at most ``side`` wide."""
    sensor = capture.sensors[view]
    pose = to_world(sensor) @ OPENCV
    width, height = film_size(sensor)
    x, y = principal_point(sensor)
    half = np.array([max(x, width - x), max(y, height - y)])  # of the widened picture
    screen = tone_mapped(capture.images[view], capture.masks[view])
    small = Image.fromarray(quantized(screen))
    small.thumbnail((side, side))
    scale = np.array(small.size) / (width, height)
    before = np.rint((half - (x, y)) * scale).astype(int)
    canvas = Image.new("RGBA", tuple(np.rint(2 * half * scale).astype(int).tolist()))
    canvas.paste(small, tuple(before.tolist()))
    extent = canvas.size / scale  # of whole pixels
    return Frustum(
        rotation=pose[:3, :3], position=pose[:3, 3],
        fov=float(2 * np.arctan(extent[1] / 2 / focal_length(sensor))),
        aspect=float(extent[0] / extent[1]), image=np.array(canvas),
    )  # fmt: skip
