"""Straight lines, square pixels, and fewer of them: photographs resampled.

Mitsuba's cameras have no distortion and square pixels. First lines are straightened, then a
photograph whose focal lengths differ is brought to the coarser of the two by area, so that no
detail is made up. Focal lengths and principal point follow exactly, whatever part of a pixel the
last row or column would have been: it is dropped.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy

from svu_mi.errors import CaptureError, OptionError
from svu_mi.formats.source import Frame

NEARLY_SQUARE = 0.05  # pixels that nothing may be displaced by, for pixels to pass as square
WHOLE = 1e-6  # of a pixel that may be missing from the last one
STRIP = 128  # lines that are averaged at a time
SAME_ASPECT = 2.0  # pixels by which a resized photograph may miss the ratio of its sides
EDGE = 257  # points of each edge of a photograph, between which lenses are smooth
WIDEST = 2.0  # sides of a straightened photograph, in parts of those it had; as COLMAP's


def fitted(frame: Frame, size: tuple[int, int]) -> Frame:
    """Return the frame for a photograph that was resized after it was calibrated.

    Args:
        frame: the frame.
        size: (width, height) that the photograph has.

    Raises:
        CaptureError: the photograph has another shape than the frame says.
    """
    if size == frame.size:
        return frame
    scale = size[0] / frame.size[0], size[1] / frame.size[1]
    if abs(frame.size[1] * scale[0] - size[1]) > SAME_ASPECT:
        if abs(frame.size[0] * size[0] / frame.size[1] - size[1]) <= SAME_ASPECT:
            raise CaptureError(
                f"{frame.image}: has {size[0]} x {size[1]} pixels, but {frame.label} is of "
                f"{frame.size[0]} x {frame.size[1]}: the photograph is stored on its side; save "
                "its pixels upright (its EXIF orientation may be set)."
            )
        raise CaptureError(
            f"{frame.image}: has {size[0]} x {size[1]} pixels, but {frame.label} is of "
            f"{frame.size[0]} x {frame.size[1]}, which has another aspect ratio; give the "
            "photograph that was calibrated."
        )
    return replace(_scaled(frame, scale), size=size)


def straightened(frame: Frame) -> Frame:
    """Return the camera that sees straight lines as such, for ``unbent``.

    As COLMAP does it: the focal length is kept, so that nothing changes in the centre, and the
    photograph becomes the largest one without empty borders, at most twice as wide and high.

    Args:
        frame: the frame, as calibrated; without a lens it is returned as it is.

    Raises:
        CaptureError: the lens folds over inside the photograph, or shows nothing of it.
    """
    if frame.lens is None:
        return frame
    focal, center, size = (np.array(v, np.float64) for v in (frame.focal, frame.center, frame.size))
    along, first, last = np.linspace(0, 1, EDGE), np.zeros(EDGE), np.ones(EDGE)
    sides = (first, along), (last, along), (along, first), (along, last)
    seen = np.stack([np.stack(side, axis=-1) for side in sides]) * size
    edges = frame.lens.straightened((seen - center) / focal)
    if not frame.lens.is_one_to_one(edges.reshape(-1, 2)):
        numbers = ", ".join(f"{key} {value:g}" for key, value in frame.lens.record.items() if value)
        raise CaptureError(
            f"{frame.label}: the lens ({numbers}) folds over inside the photograph, so its numbers "
            "do not hold as far as the corners; correct them, crop the photographs, or undistort "
            "them by the camera's own program."
        )
    left, right, top, bottom = edges * focal + center
    beyond = (WIDEST - 1) / 2 * size
    low = np.maximum([left[:, 0].max(), top[:, 1].max()], -beyond)
    high = np.minimum([right[:, 0].min(), bottom[:, 1].min()], size + beyond)
    width, height = (int(n + WHOLE) for n in np.maximum(high - low, 0))
    if min(width, height) < 1:
        raise CaptureError(
            f"{frame.label}: nothing is left of the photograph when its lines are straightened; "
            "correct its lens, or undistort the photographs first."
        )
    x, y = center - low
    return replace(frame, lens=None, size=(width, height), center=(float(x), float(y)))


def unbent(planes: Sequence[np.ndarray], frame: Frame) -> Sequence[np.ndarray]:
    """Look planes of a photograph up where the lens has put them, between the four nearest pixels.

    Args:
        planes: (H, W) each, float32 and finite, of the frame's size.
        frame: the frame, as calibrated; without a lens the planes themselves are returned.

    Returns:
        As many (H', W') float32, of the size that ``straightened`` says.
    """
    if frame.lens is None:
        return planes
    made = straightened(frame)
    (width, height), (fx, fy), (cx, cy) = made.size, made.focal, made.center
    found = [np.empty((height, width), np.float32) for _ in planes]
    x = (np.arange(width) + 0.5 - cx) / fx
    for first in range(0, height, STRIP):
        y = (np.arange(first, min(first + STRIP, height)) + 0.5 - cy) / fy
        points = np.stack(np.broadcast_arrays(x, y[:, None]), axis=-1)
        pixels = frame.lens.bent(points) * frame.focal + frame.center - 0.5
        place = np.ascontiguousarray(pixels[..., ::-1].transpose(2, 0, 1))
        for plane, whole in zip(planes, found, strict=True):
            strip = whole[first : first + STRIP]
            scipy.ndimage.map_coordinates(plane, place, strip, order=1, mode="nearest")
    return found


def squared(frame: Frame, shrink: float = 1.0) -> tuple[Frame, tuple[float, float]]:
    """Return the frame with straight lines and square pixels, and the scale of width and height.

    Args:
        frame: the frame, as calibrated.
        shrink: factor by which pixels become larger, at least 1.

    Raises:
        CaptureError: as ``straightened``.
        OptionError: another factor, or one that leaves no pixel.
    """
    frame = straightened(frame)
    if not (np.isfinite(shrink) and shrink >= 1):
        raise OptionError(f"The factor to shrink photographs by must be at least 1, got {shrink}.")
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


def resampled(image: np.ndarray, scale: tuple[float, float]) -> np.ndarray:
    """Average an image over the area of its new pixels.

    Args:
        image: (H, W, C), finite.
        scale: of width and height, at most 1 each; both 1 returns the image itself.

    Returns:
        (H', W', C) float32; H' and W' are those of ``squared``.
    """
    for axis, factor in ((1, scale[0]), (0, scale[1])):
        if factor != 1:
            image = _averaged(image, factor, axis)
    return image


def _averaged(image: np.ndarray, factor: float, axis: int) -> np.ndarray:
    """Average along one axis, a strip at a time, as double precision takes much memory."""
    lines = np.moveaxis(image, axis, 0)
    count = int(len(lines) * factor + WHOLE)
    made = np.empty((count, *lines.shape[1:]), np.float32)
    for k in range(0, lines.shape[1], STRIP):
        made[:, k : k + STRIP] = _integrated(lines[:, k : k + STRIP], count, factor)
    return np.ascontiguousarray(np.moveaxis(made, 0, axis))


def _integrated(lines: np.ndarray, count: int, factor: float) -> np.ndarray:
    """Return averages: differences of the integral of a piecewise constant function."""
    lines = np.asarray(lines, np.float64)
    integral = np.concatenate([np.zeros_like(lines[:1]), np.cumsum(lines, axis=0)])
    edges = np.minimum(np.arange(count + 1) / factor, len(lines))
    below = np.minimum(edges.astype(int), len(lines) - 1)
    part = (edges - below).reshape(-1, *[1] * (lines.ndim - 1))
    at_edges = integral[below] + part * lines[below]
    return np.diff(at_edges, axis=0) * factor


def _scaled(frame: Frame, scale: tuple[float, float]) -> Frame:
    return replace(
        frame,
        focal=(frame.focal[0] * scale[0], frame.focal[1] * scale[1]),
        center=(frame.center[0] * scale[0], frame.center[1] * scale[1]),
    )
