"""Undistortion, square pixels and downsampling of photographs.

Mitsuba's cameras have no distortion and square pixels. Photographs are first undistorted. If the
focal lengths differ, area averages reduce the finer axis, so that no detail is interpolated. Focal
lengths and principal point are exact; a partial last row or column is dropped.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy

from svu_mi.capture.importers.source import Frame
from svu_mi.errors import CaptureError, OptionError

NEARLY_SQUARE = 0.05  # largest displacement, in pixels, for pixels to count as square
WHOLE = 1e-6  # share of the last pixel that may be missing
STRIP = 128  # lines per block of averages
SAME_ASPECT = 2.0  # tolerance of the aspect ratio of a resized photograph, in pixels
EDGE = 257  # sample points per edge of a photograph
WIDEST = 2.0  # largest growth of an undistorted photograph's sides, as in COLMAP


def with_size(frame: Frame, size: tuple[int, int]) -> Frame:
    """Return the frame of a photograph that was resized after calibration."""
    if size == frame.size:
        return frame
    (width, height), (made_width, made_height) = frame.size, size
    if abs(height * made_width / width - made_height) > SAME_ASPECT:
        differ = (
            f"{frame.image}: has {made_width} x {made_height} pixels, but {frame.label} has "
            f"{width} x {height}"
        )
        if abs(width * made_width / height - made_height) <= SAME_ASPECT:
            raise CaptureError(
                f"{differ}: the photograph is stored on its side; save its pixels upright."
            )
        raise CaptureError(
            f"{differ}, which has another aspect ratio; give the photograph that was calibrated."
        )
    return replace(_scaled(frame, (made_width / width, made_height / height)), size=size)


def undistorted_frame(frame: Frame) -> Frame:
    """Return the pinhole camera of the undistorted photograph; unchanged without a lens.

    As in COLMAP, the focal length is kept, so that the resolution in the centre does not change.
    The size is the largest one without empty borders, at most twice as wide and high.
    """
    if frame.lens is None:
        return frame
    focal, center, size = (np.array(v, np.float64) for v in (frame.focal, frame.center, frame.size))
    along, first, last = np.linspace(0, 1, EDGE), np.zeros(EDGE), np.ones(EDGE)
    sides = (first, along), (last, along), (along, first), (along, last)
    seen = np.stack([np.stack(side, axis=-1) for side in sides]) * size
    edges = frame.lens.undistort((seen - center) / focal)
    if not frame.lens.is_one_to_one(edges.reshape(-1, 2)):
        numbers = ", ".join(f"{key} {value:g}" for key, value in frame.lens.record.items() if value)
        raise CaptureError(
            f"{frame.label}: the lens ({numbers}) folds over inside the photograph, so its "
            "coefficients are not valid up to the corners; correct them, crop the photographs, or "
            "undistort them with the camera's program."
        )
    left, right, top, bottom = edges * focal + center
    beyond = (WIDEST - 1) / 2 * size
    low = np.maximum([left[:, 0].max(), top[:, 1].max()], -beyond)
    high = np.minimum([right[:, 0].min(), bottom[:, 1].min()], size + beyond)
    width, height = (int(n + WHOLE) for n in np.maximum(high - low, 0))
    if min(width, height) < 1:
        raise CaptureError(
            f"{frame.label}: the undistorted photograph is empty; correct the lens "
            "coefficients, or undistort the photographs first."
        )
    x, y = center - low
    return replace(frame, lens=None, size=(width, height), center=(float(x), float(y)))


def undistort_planes(planes: Sequence[np.ndarray], frame: Frame) -> Sequence[np.ndarray]:
    """Undistort finite float32 planes (H, W) of a photograph by bilinear interpolation.

    The result has the size of ``undistorted_frame(frame)``. Without a lens, return ``planes``.
    """
    if frame.lens is None:
        return planes
    made = undistorted_frame(frame)
    (width, height), (fx, fy), (cx, cy) = made.size, made.focal, made.center
    pinhole = [np.empty((height, width), np.float32) for _ in planes]
    x = (np.arange(width) + 0.5 - cx) / fx
    for first in range(0, height, STRIP):
        y = (np.arange(first, min(first + STRIP, height)) + 0.5 - cy) / fy
        points = np.stack(np.broadcast_arrays(x, y[:, None]), axis=-1)
        pixels = frame.lens.distort(points) * frame.focal + frame.center - 0.5
        place = np.ascontiguousarray(pixels[..., ::-1].transpose(2, 0, 1))
        for plane, whole in zip(planes, pinhole, strict=True):
            strip = whole[first : first + STRIP]
            scipy.ndimage.map_coordinates(plane, place, strip, order=1, mode="nearest")
    return pinhole


def square_pixel_frame(frame: Frame, shrink: float = 1.0) -> tuple[Frame, tuple[float, float]]:
    """Return the undistorted frame with square pixels, and the scale of width and height.

    Args:
        frame: calibrated camera of the photograph.
        shrink: factor, at least 1, by which the side of a pixel grows.
    """
    frame = undistorted_frame(frame)
    if not (np.isfinite(shrink) and shrink >= 1):
        raise OptionError(f"--shrink must be at least 1, got {shrink}.")
    fx, fy = frame.focal
    if abs(fx / fy - 1) * max(frame.size) / 2 < NEARLY_SQUARE:
        fx = fy = float(np.sqrt(fx * fy))
    target = min(fx, fy) / shrink
    scale = target / fx, target / fy
    width, height = (int(n * s + WHOLE) for n, s in zip(frame.size, scale, strict=True))
    if min(width, height) < 1:
        raise OptionError(f"{frame.label}: shrinking by {shrink} leaves no pixel; shrink less.")
    made = replace(_scaled(frame, scale), size=(width, height), focal=(target, target))
    return made, scale


def average_area(image: np.ndarray, scale: tuple[float, float]) -> np.ndarray:
    """Average an image (H, W, C) over the area of its new pixels.

    ``scale`` is the scale of width and height, at most 1. The new size is as in
    ``square_pixel_frame``.
    """
    for axis, factor in ((1, scale[0]), (0, scale[1])):
        if factor != 1:
            image = _average_axis(image, factor, axis)
    return image


def _average_axis(image: np.ndarray, factor: float, axis: int) -> np.ndarray:
    """Average along one axis, in strips to save memory."""
    lines = np.moveaxis(image, axis, 0)
    count = int(len(lines) * factor + WHOLE)
    made = np.empty((count, *lines.shape[1:]), np.float32)
    for k in range(0, lines.shape[1], STRIP):
        made[:, k : k + STRIP] = _integral_averages(lines[:, k : k + STRIP], count, factor)
    return np.ascontiguousarray(np.moveaxis(made, 0, axis))


def _integral_averages(lines: np.ndarray, count: int, factor: float) -> np.ndarray:
    """Return ``count`` averages of ``lines``, as differences of their cumulative sum."""
    lines = np.asarray(lines, np.float64)
    integral = np.concatenate([np.zeros_like(lines[:1]), np.cumsum(lines, axis=0)])
    edges = np.minimum(np.arange(count + 1) / factor, len(lines))
    below = np.minimum(edges.astype(int), len(lines) - 1)
    part = (edges - below).reshape(-1, *[1] * (lines.ndim - 1))
    at_edges = integral[below] + part * lines[below]
    return np.diff(at_edges, axis=0) * factor


def _scaled(frame: Frame, scale: tuple[float, float]) -> Frame:
    (fx, fy), (cx, cy), (x, y) = frame.focal, frame.center, scale
    return replace(frame, focal=(fx * x, fy * y), center=(cx * x, cy * y))
