"""``Source``: a capture of another tool in the conventions of this package.

Readers convert axes, angles and pixel grids of their tool to the conventions of ``Source``, and
writers convert them back. No other module uses the tool's conventions.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from svu_mi.capture.importers.import_options import ENVIRONMENT_AXES as ENVIRONMENT_AXES
from svu_mi.capture.importers.import_options import Light as Light
from svu_mi.capture.importers.lens_distortion import Lens
from svu_mi.capture.importers.nerfstudio_world import AppliedWorld
from svu_mi.capture.scene import to_world
from svu_mi.capture.sensors import affine, film_size, focal_length, make_sensor, principal_point
from svu_mi.capture.tone_curve import SampledCurve, Transfer
from svu_mi.core.io.files import refusing
from svu_mi.core.io.schema import NUMBER, WHOLE, Field, checked
from svu_mi.errors import CaptureError

# Conversion of the columns of a camera-to-world rotation to Mitsuba's camera axes: +X left, +Y
# up, +Z forward. Each matrix is its own inverse.
OPENGL = np.diag([-1.0, 1.0, -1.0, 1.0])  # +X right, +Y up, looks along -Z: Blender, NeRF
OPENCV = np.diag([-1.0, -1.0, 1.0, 1.0])  # +X right, +Y down, +Z forward: COLMAP, IDR
# +X down, +Y right, +Z backwards: LLFF
DOWN_RIGHT_BACK = np.array([[0.0, -1, 0, 0], [-1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])

LARGEST = 1e30  # limit of numbers in a pose, so that products of three are finite
MAX_DISTANCE = 1e9  # units; single precision has no details beyond
MAX_SIDE = 2**16  # pixels; larger values come from damaged files
CAMERA = {
    "size": Field(WHOLE, (2,), 1, MAX_SIDE, "pixels"),
    "exposure": Field(NUMBER, (), 1 / LARGEST, LARGEST),
}
LENS = {
    "focal length": Field(NUMBER, (2,), 1e-3, 1e6, "times the longer side"),
    "principal point": Field(NUMBER, (2,), -1e3, 1e3, "times width and height"),
}
RIGID = 1e-3  # tolerance of the orthogonality and equal length of the axes of a pose
SQUARE = 1e-6  # tolerance of the ratio of focal lengths of square pixels
NEAR, FAR = 1e-4, 1e7  # default clip planes; files contain neither planes nor size of the scene


@dataclass(frozen=True, kw_only=True)
class Frame:
    """One photograph and its camera.

    A uniform scale of the pose is removed, and its rotation is made orthogonal.

    Attributes:
        label: file and frame for messages, such as ``transforms.json: frame 3``.
        image: path of the photograph.
        mask: path of the mask (white = object), or None; an alpha channel also acts as a mask.
        to_world: (4, 4) float64, camera to world, a rotation and a translation; camera space is
            +X left, +Y up, +Z forward.
        focal: (fx, fy) in pixels.
        center: (cx, cy), principal point in pixels; (0, 0) is the corner of the first pixel,
            whose centre is (0.5, 0.5).
        size: (width, height) in pixels that focal and center refer to.
        exposure: exposure gain; the radiance of a pixel is its linear value divided by the gain.
        transfer: encoding of integer images; EXR, HDR and PFM are linear.
        lens: lens distortion; None without distortion.
        original: path of the photograph that was taken, if ``image`` is a copy of it; its EXIF
            data and its name count. None if ``image`` is itself.
        upright: True if pose and size refer to the photograph as its EXIF orientation turns it,
            False if they refer to the pixels as stored.
    """

    label: str
    image: Path
    mask: Path | None = None
    to_world: np.ndarray
    focal: tuple[float, float]
    center: tuple[float, float]
    size: tuple[int, int]
    exposure: float = 1.0
    transfer: Transfer | SampledCurve = "srgb"
    lens: Lens | None = None
    original: Path | None = None
    upright: bool = True

    def __post_init__(self) -> None:
        """Raise CaptureError if numbers are out of range or the pose is not rigid."""
        object.__setattr__(self, "to_world", _rigid(self.to_world, self.label))
        with refusing(self.label, "correct it there"):
            checked({"size": self.size, "exposure": self.exposure}, CAMERA)
            relative = {
                "focal length": [length / max(self.size) for length in self.focal],
                "principal point": [c / n for c, n in zip(self.center, self.size, strict=True)],
            }
            checked(relative, LENS)

    @property
    def taken(self) -> Path:
        """Path of the photograph that was taken."""
        return self.original or self.image

    @property
    def has_square_pixels(self) -> bool:
        """True if both focal lengths are equal."""
        return abs(self.focal[1] / self.focal[0] - 1) <= SQUARE

    def sensor(self, clip: tuple[float, float] = (NEAR, FAR)) -> Any:
        """Return the ``perspective`` sensor of this camera with (near, far) clip planes."""
        if self.lens is not None:
            raise CaptureError(
                f"{self.label}: the lens is distorted; undistort the photograph, or use svu "
                "import, which does."
            )
        if not self.has_square_pixels:
            raise CaptureError(
                f"{self.label}: fl_x and fl_y differ, so the pixels are not square; resample the "
                "photograph, or use svu import, which does."
            )
        return make_sensor(
            {
                "to_world": self.to_world,
                "x_fov": 2 * np.degrees(np.arctan(self.size[0] / 2 / self.focal[0])),
                "principal_point_offset": [0.5 - self.center[k] / self.size[k] for k in (0, 1)],
                "clip": clip,
                "film": self.size,
                "crop_offset": [0, 0],
                "crop_size": self.size,
            },
            self.label,
        )


def pixels(sides: Iterable[float]) -> Any:
    """Return whole numbers as integers, and others as they are, which ``Frame`` refuses."""
    return tuple(int(side) if float(side).is_integer() else float(side) for side in sides)


def frame_of(sensor: Any, image: Path, **fields: Any) -> Frame:
    """Return the frame of a ``perspective`` sensor, for the pixels of its crop window.

    The file ``image`` need not exist; ``fields`` replace other attributes of ``Frame``.
    """
    focal = focal_length(sensor)
    return Frame(**{
        "label": image.name,
        "image": image,
        "to_world": to_world(sensor),
        "focal": (focal, focal),
        "center": principal_point(sensor),
        "size": film_size(sensor),
        **fields,
    })  # fmt: skip


def _rigid(matrix: np.ndarray, label: str) -> np.ndarray:
    """Return the rigid transform (4, 4) nearest to a pose, without its scale."""
    if np.shape(matrix) != (4, 4) or not (np.abs(matrix) < LARGEST).all():  # NaN fails, too
        raise CaptureError(f"{label}: the pose is not a finite 4 x 4 matrix; export it again.")
    if not np.allclose(matrix[3], [0, 0, 0, 1]):
        raise CaptureError(
            f"{label}: the last row of the pose must be 0 0 0 1; export it as camera to world, "
            "row by row."
        )
    if max(abs(matrix[:3, 3])) > MAX_DISTANCE:
        raise CaptureError(
            f"{label}: the camera is {max(abs(matrix[:3, 3])):.2g} units away from the origin, "
            f"farther than {MAX_DISTANCE:g}; use a larger unit, or move the origin to the object."
        )
    rotation = np.array(matrix[:3, :3], np.float64)
    scale = np.cbrt(np.linalg.det(rotation))
    if scale < 0:
        raise CaptureError(
            f"{label}: the pose is mirrored (determinant < 0); export it from a right-handed "
            "program, or negate one column."
        )
    left, _, right = np.linalg.svd(rotation)
    if not np.allclose(left @ right * scale, rotation, atol=RIGID * scale) or scale == 0:
        raise CaptureError(f"{label}: the pose is not a rigid transform; remove its shear.")
    return affine(left @ right, matrix[:3, 3])


@dataclass(frozen=True, kw_only=True)
class Source:
    """Capture of another tool, before its import.

    Attributes:
        format: name of the format, such as ``colmap``.
        root: path of the folder that contains all files.
        frames: V photographs with their cameras, in the order of the capture.
        mesh: path of the object's mesh, in the world of the poses; None if the format has none.
        light: environment map; None if the format has none.
        camera_axes: matrix that converted the tool's camera axes to Mitsuba's (``OPENGL``, ...).
        applied: change of the world before nerfstudio's poses were written; None for other tools.
        points: (P, 3) reconstructed points of object and surroundings; None if unknown.
        notes: sentences about decisions of the reader.
    """

    format: str
    root: Path
    frames: Sequence[Frame]
    mesh: Path | None = None
    light: Light | None = None
    camera_axes: np.ndarray = field(default_factory=lambda: np.eye(4))
    applied: AppliedWorld | None = None
    points: np.ndarray | None = None
    notes: Sequence[str] = ()
