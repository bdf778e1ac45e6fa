"""Environment maps of any convention as Mitsuba's ``envmap``."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from svu_mi.capture.picture import open_picture
from svu_mi.capture.poses import affine
from svu_mi.capture.radiance import positive
from svu_mi.errors import CaptureError
from svu_mi.exr import write_exr
from svu_mi.formats.source import Light

SUFFIXES = (".exr", ".hdr", ".pfm")
ASPECT, OFF = 2, 0.05  # width over height of a lat-long map, and what it may be off by
MIRROR = np.diag([-1.0, 1.0, 1.0])  # of the envmap's frame: u becomes 1 - u


def write_environment(light: Light, path: Path) -> tuple[np.ndarray, list[str]]:
    """Write a map as EXR, mirrored if its matrix is.

    Args:
        light: the map; its matrix may be mirrored.
        path: the EXR file.

    Returns:
        The (4, 4) ``to_world`` of the emitter, a rotation, and sentences about the map.

    Raises:
        CaptureError: as ``read_environment_map``.
        OutputError: it cannot be written.
    """
    pixels, matrix, notes = read_environment_map(light)
    write_exr(path, {"RGB": pixels})
    return matrix, notes


def read_environment_map(light: Light) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Read a map, mirrored if its matrix is, so that what is left is a rotation.

    Returns:
        (H, W, 3) float32 radiance, the (4, 4) ``to_world`` of Mitsuba's envmap with these pixels,
        and sentences about the map.

    Raises:
        CaptureError: the map cannot be read, has 8 bits, holds NaN or much that is
            negative, or is not a lat-long map.
    """
    if light.path.suffix.lower() not in SUFFIXES:
        raise CaptureError(
            f"{light.path}: the light must be an HDR map ({', '.join(SUFFIXES)}); 8-bit images "
            "clip lamps."
        )
    picture = open_picture(light.path)
    pixels = np.stack(picture.planes()[:3], axis=-1)
    height, width = pixels.shape[:2]
    if abs(width / height / ASPECT - 1) > OFF:
        raise CaptureError(
            f"{light.path}: has {width} x {height} pixels, but a lat-long map is twice as wide as "
            "high; convert it."
        )
    if not np.isfinite(pixels).all():
        raise CaptureError(f"{light.path}: some pixels are NaN or infinite; repair the map.")
    notes = [f"{light.path}: {remark}" for remark in picture.remarks()]
    pixels, note = positive(pixels, str(light.path))
    notes += note
    if not pixels.any():
        raise CaptureError(f"{light.path}: the map is entirely black.")
    rotation = light.to_world
    if np.linalg.det(rotation) < 0:
        pixels, rotation = pixels[:, ::-1], rotation @ MIRROR
    return pixels * np.float32(light.scale), affine(rotation), notes
