"""Conversion of environment maps to Mitsuba's ``envmap``."""

from pathlib import Path

import numpy as np

from svu_mi.capture.image_io import clamp_negative, open_image
from svu_mi.capture.importers.source import Light
from svu_mi.capture.scene_xml import POLES, ROWS
from svu_mi.capture.sensors import affine
from svu_mi.core.io.exr import write_exr
from svu_mi.errors import CaptureError

SUFFIXES = (".exr", ".hdr", ".pfm")
FINE = 512  # rows; larger maps get only one more row
ASPECT, OFF = 2, 0.05  # width over height of a lat-long map, and its tolerance
MIRROR = np.diag([-1.0, 1.0, 1.0])  # mirrors the envmap's frame: u becomes 1 - u


def write_environment(light: Light, path: Path) -> tuple[np.ndarray, list[str]]:
    """Write a map as EXR; return the emitter's rotation ``to_world`` (4, 4), and notes."""
    pixels, matrix, notes = read_environment_map(light)
    write_exr(path, {"RGB": pixels}, {ROWS: POLES})
    return matrix, notes


def read_environment_map(light: Light) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Read a map with rows as in Mitsuba's envmap; mirror it if its matrix is mirrored.

    The first row of most files is centred half a row below the pole. Mitsuba's first and last rows
    are the poles, so rows are interpolated. Maps for Mitsuba are not resampled: they have the mark
    of ``write_environment``, or one row more than half the number of columns.

    Returns:
        Radiance (N, W, 3) as float32, the rotation ``to_world`` (4, 4) of the emitter, and
        sentences about the map. A file with H rows has N = 2 H + 1 (every second row is original),
        N = H + 1 if H exceeds ``FINE``, or N = H if it was made for Mitsuba.
    """
    if light.path.suffix.lower() not in SUFFIXES:
        raise CaptureError(
            f"{light.path}: the light must be an HDR map ({', '.join(SUFFIXES)}); 8-bit images "
            "clip lamps."
        )
    picture = open_image(light.path)
    pixels = np.stack(picture.planes()[:3], axis=-1)
    height, width = pixels.shape[:2]
    says_poles = picture.header.attributes.get(ROWS) == POLES and height > 1
    if not says_poles and abs(width / height / ASPECT - 1) > OFF:
        raise CaptureError(
            f"{light.path}: has {width} x {height} pixels, but a lat-long map is twice as wide as "
            "high; convert it."
        )
    if not np.isfinite(pixels).all():
        raise CaptureError(f"{light.path}: some pixels are NaN or infinite; repair the map.")
    notes = [f"{light.path}: {remark}" for remark in picture.remarks()]
    pixels, note = clamp_negative(pixels, str(light.path))
    notes += note
    if not pixels.any():
        raise CaptureError(f"{light.path}: the map is entirely black.")
    rotation = light.to_world
    if np.linalg.det(rotation) < 0:
        pixels, rotation = pixels[:, ::-1], rotation @ MIRROR
    if not says_poles and width != ASPECT * (height - 1):
        pixels = _with_pole_rows(pixels)
    return pixels * np.float32(light.scale), affine(rotation), notes


def _with_pole_rows(pixels: np.ndarray) -> np.ndarray:
    """Resample (H, W, 3) pixels linearly to rows that begin and end at the poles."""
    between = np.empty((len(pixels) + 1, *pixels.shape[1:]), np.float32)
    between[1:-1] = (pixels[1:] + pixels[:-1]) / 2
    between[0], between[-1] = (row.mean(axis=0, dtype=np.float64) for row in pixels[[0, -1]])
    if len(pixels) > FINE:
        return between
    rows = np.empty((2 * len(pixels) + 1, *pixels.shape[1:]), np.float32)
    rows[::2], rows[1::2] = between, pixels
    return rows
