"""What any capture tool says, in one form: readers make it, the importer and writers take it.

Conventions end here. A reader turns its tool's axes, angles and pixel grids into those of this
record, a writer turns them back, and nothing else in the package knows another convention.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

Transfer = Literal["srgb", "gamma 2.2", "linear"]

# Columns of a camera-to-world rotation that change their sign on the way to Mitsuba's camera:
# +X left, +Y up, +Z forward. Each matrix is its own inverse.
OPENGL = np.diag([-1.0, 1.0, -1.0, 1.0])  # +X right, +Y up, looks along -Z: Blender, NeRF
OPENCV = np.diag([-1.0, -1.0, 1.0, 1.0])  # +X right, +Y down, +Z forward: COLMAP

# Rotations from the frame of Mitsuba's envmap (+Y top row, +Z centre, +X at u = 1/4) to the world,
# by the convention that a map was made in.
ENVIRONMENT_AXES = {
    "mitsuba": np.eye(3),
    "opengl": np.diag([-1.0, 1.0, -1.0]),  # +Y top, -Z centre, -X at u = 1/4
    "threejs": np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]),  # +Y top, +X centre
    "blender": np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]),  # +Z top, +X centre, +Y at u = 1/4
}


@dataclass(frozen=True, kw_only=True)
class Frame:
    """One photograph and its camera.

    Attributes:
        label: the file and frame, for messages, such as ``transforms.json: frame 3``.
        image: the photograph's file.
        mask: file of its mask (white = object), or None; an alpha channel counts as one, too.
        to_world: (4, 4) float64, camera to world, a rotation and a translation; camera space is
            +X left, +Y up, +Z forward.
        focal: (fx, fy) in pixels.
        center: (cx, cy), principal point in pixels; (0, 0) is the corner of the first pixel,
            whose centre is (0.5, 0.5).
        size: (width, height) in pixels that focal and center refer to.
        exposure: gain of the photograph: radiance is its linear pixels divided by it.
        transfer: how an integer image encodes linear values; EXR, HDR and PFM are linear.
    """

    label: str
    image: Path
    mask: Path | None = None
    to_world: np.ndarray
    focal: tuple[float, float]
    center: tuple[float, float]
    size: tuple[int, int]
    exposure: float = 1.0
    transfer: Transfer = "srgb"


@dataclass(frozen=True, kw_only=True)
class Light:
    """An environment map.

    Attributes:
        path: an HDR or EXR lat-long map.
        to_world: (3, 3) float64, from the frame of Mitsuba's envmap to the world: a rotation,
            such as one of ``ENVIRONMENT_AXES``.
        scale: factor of its radiance.
    """

    path: Path
    to_world: np.ndarray = field(default_factory=lambda: np.eye(3))
    scale: float = 1.0


@dataclass(frozen=True, kw_only=True)
class Source:
    """A capture as some tool has written it.

    Attributes:
        format: name of the format, such as ``colmap``.
        root: folder that all files must lie in.
        frames: V photographs with their cameras, in the order they get in the capture.
        mesh: file of the object, if the format has one; its axes are those of the poses.
        light: the environment, if the format has one.
        camera_axes: matrix that turned the tool's camera axes into Mitsuba's (``OPENGL``, ...).
        notes: sentences about what was found and decided while reading.
    """

    format: str
    root: Path
    frames: Sequence[Frame]
    mesh: Path | None = None
    light: Light | None = None
    camera_axes: np.ndarray = field(default_factory=lambda: np.eye(4))
    notes: Sequence[str] = ()
