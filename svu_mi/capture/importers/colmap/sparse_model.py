"""Reader and writer of COLMAP's sparse models: cameras and poses of images.

Files are parsed here because pycolmap may fill the memory or hang on damaged files. The layout is
https://colmap.github.io/format.html; models with ``rigs`` and ``frames`` have the same two files.
"""

import contextlib
import math
import mmap
import os
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from svu_mi.capture.importers.lens_distortion import Lens
from svu_mi.core.io.files import refusing, replacing
from svu_mi.core.validation import require_views
from svu_mi.errors import CaptureError, excerpt

# Number of parameters of each camera model, in the order of COLMAP's sensor/models.h.
PARAMETERS = {
    "SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8,
    "OPENCV_FISHEYE": 8, "FULL_OPENCV": 12, "FOV": 5, "SIMPLE_RADIAL_FISHEYE": 4,
    "RADIAL_FISHEYE": 5, "THIN_PRISM_FISHEYE": 12, "RAD_TAN_THIN_PRISM_FISHEYE": 16,
    "SIMPLE_DIVISION": 4, "DIVISION": 5, "SIMPLE_FISHEYE": 3, "FISHEYE": 4, "EUCM": 6,
    "EQUIRECTANGULAR": 2,
}  # fmt: skip
# Number of focal lengths. These models are pinholes if all distortion parameters are zero.
FOCAL_LENGTHS = {
    "SIMPLE_PINHOLE": 1, "PINHOLE": 2, "SIMPLE_RADIAL": 1, "RADIAL": 1, "OPENCV": 2,
    "FULL_OPENCV": 2, "SIMPLE_DIVISION": 1, "DIVISION": 2,
}  # fmt: skip
# Distortion parameters of models that ``Lens`` supports.
COEFFICIENTS = {
    "SIMPLE_RADIAL": ("k1",), "RADIAL": ("k1", "k2"), "OPENCV": ("k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("k1", "k2", "p1", "p2", "k3"),  # if k4 to k6 are zero
}  # fmt: skip
CAMERA_FIELDS = ("CAMERA_ID", "MODEL", "WIDTH", "HEIGHT", "PARAMS")
VIEW_FIELDS = ("IMAGE_ID", "QW", "QX", "QY", "QZ", "TX", "TY", "TZ", "CAMERA_ID", "NAME")
LONGEST_NAME = 512  # bytes
TRACK = 8  # bytes of an image of a point in space
FIX = "export the model again"
POINT = 24  # bytes of a point in an image: x, y and the number of the point in space
MOST_POINTS = 20_000  # points that are read, for the extent of the scene
UNIT = 1e-2  # tolerance of the norm of a quaternion


@dataclass(frozen=True)
class ColmapCamera:
    """Camera of COLMAP: model (a key of ``PARAMETERS``), size in pixels, and parameters.

    The parameters are focal length(s), principal point from the corner (0, 0), and distortion.
    """

    model: str
    width: int
    height: int
    parameters: tuple[float, ...]

    @property
    def is_pinhole(self) -> bool:
        """True if the camera has no distortion."""
        return self.model in FOCAL_LENGTHS and not any(self.distortion)

    @property
    def intrinsics(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Focal lengths and principal point, if the model is in ``FOCAL_LENGTHS``."""
        count = FOCAL_LENGTHS[self.model]
        focal, center = self.parameters[:count], self.parameters[count : count + 2]
        return (focal[0], focal[-1]), (center[0], center[1])

    @property
    def distortion(self) -> tuple[float, ...]:
        """Distortion parameters, if the model is in ``FOCAL_LENGTHS``."""
        return self.parameters[FOCAL_LENGTHS[self.model] + 2 :]

    def lens(self) -> Lens | None:
        """Return the lens; None without distortion, or if ``Lens`` does not support the model."""
        names = COEFFICIENTS.get(self.model, ())
        if not names or self.is_pinhole or any(self.distortion[len(names) :]):
            return None
        return Lens(**dict(zip(names, self.distortion, strict=False)))


@dataclass(frozen=True)
class Pose:
    """Pose of an image: world to camera, +X right, +Y down, +Z forward.

    ``rotation`` is a unit quaternion (w, x, y, z).
    """

    name: str
    camera: int
    rotation: tuple[float, ...]
    translation: tuple[float, ...]


def is_model(folder: Path) -> bool:
    """Return whether a folder contains a sparse model."""
    return any((folder / f"cameras{suffix}").is_file() for suffix in (".bin", ".txt"))


def read_model(folder: Path) -> tuple[dict[int, ColmapCamera], list[Pose]]:
    """Read cameras by id, and views sorted by name; prefer ``.bin``, as in COLMAP."""
    suffix = ".bin" if (folder / "cameras.bin").is_file() else ".txt"
    files = folder / f"cameras{suffix}", folder / f"images{suffix}"
    for path in files:
        if not path.is_file():
            raise CaptureError(f"{path}: no such file; a sparse model has cameras and images.")
    if suffix == ".bin":
        cameras, views = _read_cameras(files[0]), _read_views(files[1])
    else:
        cameras, views = _parse_cameras(files[0]), _parse_views(files[1])
    if not views:
        raise CaptureError(f"{files[1]}: has no images; run COLMAP's mapper first.")
    names = set()
    for view in views:
        label = f"{files[1]}: image {excerpt(repr(view.name))}"
        if view.camera not in cameras:
            raise CaptureError(f"{label}: has no camera {view.camera}; export the model again.")
        if not abs(math.hypot(*view.rotation) - 1) < UNIT:
            raise CaptureError(f"{label}: the rotation must be a unit quaternion (w, x, y, z).")
        if view.name in names:
            raise CaptureError(f"{label}: occurs twice; export the model again.")
        names.add(view.name)
    return cameras, sorted(views, key=lambda view: view.name)


def count_images(folder: Path) -> int:
    """Return the number of images of a model; 0 if it is damaged."""
    try:
        return len(read_model(folder)[1])
    except CaptureError:
        return 0


def read_points(folder: Path) -> np.ndarray | None:
    """Return the first reconstructed points (P, 3); None without points, or if damaged."""
    read = _read_points if (folder / "points3D.bin").is_file() else _parse_points
    try:
        points = np.array(list(read(folder)), np.float64)
    except (OSError, ValueError):
        return None
    return points if points.shape[1:] == (3,) and np.isfinite(points).all() else None


def write_model(folder: Path, cameras: Mapping[int, ColmapCamera], views: Sequence[Pose]) -> None:
    """Write ``cameras.bin``, ``images.bin``, and ``points3D.bin`` without points."""
    pack = struct.pack  # binary: names with spaces do not survive in COLMAP's text files
    files = {stem: [pack("<Q", n)] for stem, n in (
        ("cameras", len(cameras)), ("images", len(views)), ("points3D", 0),
    )}  # fmt: skip
    for number, camera in cameras.items():
        model, values = list(PARAMETERS).index(camera.model), camera.parameters
        files["cameras"] += [
            pack("<IiQQ", number, model, camera.width, camera.height),
            pack(f"<{len(values)}d", *values),
        ]
    for number, view in enumerate(views, 1):
        files["images"] += [
            pack("<I7dI", number, *view.rotation, *view.translation, view.camera),
            os.fsencode(view.name) + b"\0",
            pack("<Q", 0),
        ]
    for stem, parts in files.items():
        with replacing(folder / f"{stem}.bin") as temporary:
            temporary.write_bytes(b"".join(parts))


def _camera(model: str, width: int, height: int, parameters: Sequence[float]) -> ColmapCamera:
    if len(parameters) != PARAMETERS[model]:
        raise ValueError(f"{model} has {PARAMETERS[model]} parameters, not {len(parameters)}")
    if not np.isfinite(parameters).all():
        raise ValueError("a number is NaN or infinite")
    return ColmapCamera(model, width, height, tuple(parameters))


class _BinaryReader:
    """Sequential reader of a little-endian binary file."""

    def __init__(self, data: mmap.mmap) -> None:
        self._data = data
        self._at = 0

    def take(self, form: str) -> tuple[Any, ...]:
        start = self.skip(struct.calcsize("<" + form))
        return struct.unpack_from("<" + form, self._data, start)

    def text(self) -> str:
        end = self._data.find(b"\0", self._at, self._at + LONGEST_NAME)
        if end < 0:
            raise ValueError("a name is not terminated")
        start = self.skip(end + 1 - self._at)
        return self._data[start:end].decode()

    def skip(self, size: int) -> int:
        """Skip ``size`` bytes, and return the offset of the first one."""
        start, self._at = self._at, self._at + size
        if self.left < 0:
            raise ValueError("the file ends too early")
        return start

    @property
    def left(self) -> int:
        return len(self._data) - self._at


@contextlib.contextmanager
def _records(path: Path) -> Iterator[_BinaryReader]:
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        records = _BinaryReader(data)
        yield records
        if records.left:
            raise ValueError(f"the file has {records.left} bytes too many")


def _read_cameras(path: Path) -> dict[int, ColmapCamera]:
    cameras, models = {}, list(PARAMETERS)
    with refusing(path, FIX), _records(path) as records:
        for _ in range(_count(records, path)):
            number, model, width, height = records.take("IiQQ")
            if not 0 <= model < len(models):
                raise ValueError(f"camera model {model} is unknown")
            values = records.take(f"{PARAMETERS[models[model]]}d")
            cameras[number] = _camera(models[model], width, height, values)
    return cameras


def _read_views(path: Path) -> list[Pose]:
    views = []
    with refusing(path, FIX), _records(path) as records:
        for _ in range(_count(records, path)):
            _, *pose, camera = records.take("I7dI")
            views.append(Pose(records.text(), camera, tuple(pose[:4]), tuple(pose[4:])))
            records.skip(POINT * records.take("Q")[0])
    return views


def _count(records: _BinaryReader, path: Path) -> int:
    (count,) = records.take("Q")
    require_views(count, f"{path}: {path.stem}", CaptureError)
    return int(count)


def _read_points(folder: Path) -> Iterator[tuple[float, ...]]:
    path = folder / "points3D.bin"
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        records = _BinaryReader(data)
        for _ in range(min(records.take("Q")[0], MOST_POINTS)):
            _, *point = records.take("Q3d")
            yield tuple(point)
            _, _, _, _, seen = records.take("3BdQ")
            records.skip(TRACK * seen)


def _parse_points(folder: Path) -> Iterator[tuple[float, ...]]:
    with (folder / "points3D.txt").open(encoding="utf-8") as lines:
        for line in islice(filter(_has_content, lines), MOST_POINTS):
            _, *point = line.split(maxsplit=4)[:4]
            yield tuple(map(float, point))


def _parse_cameras(path: Path) -> dict[int, ColmapCamera]:
    cameras = {}
    with refusing(path, FIX), path.open(encoding="utf-8") as lines:
        for line in filter(_has_content, lines):
            number, model, width, height, *values = _fields(line, CAMERA_FIELDS, -1)
            if model not in PARAMETERS:
                raise ValueError(f"camera model {model!r} is unknown")
            parameters = [float(value) for value in values]
            cameras[_number(number)] = _camera(model, int(width), int(height), parameters)
            require_views(len(cameras), f"{path}: cameras", CaptureError)
    return cameras


def _parse_views(path: Path) -> list[Pose]:
    views = []
    with refusing(path, FIX), path.open(encoding="utf-8") as lines:
        for line in filter(_has_content, lines):
            _, *fields, camera, name = _fields(line.strip(), VIEW_FIELDS, len(VIEW_FIELDS) - 1)
            if len(name) > LONGEST_NAME:
                raise ValueError("a name is too long")
            pose = [float(field) for field in fields]
            views.append(Pose(name, _number(camera), tuple(pose[:4]), tuple(pose[4:])))
            require_views(len(views), f"{path}: images", CaptureError)
            # Every second line contains the image's points, and may be empty.
            if len(next(lines, "").split()) % 3:
                raise ValueError("a line of points (X Y POINT3D_ID ...) is missing or damaged")
    return views


def _has_content(line: str) -> bool:
    return not line.lstrip().startswith("#") and not line.isspace()


def _fields(line: str, names: Sequence[str], splits: int) -> list[str]:
    fields = line.split(maxsplit=splits)
    if len(fields) < len(names):
        raise ValueError(f"a line does not contain {' '.join(names)}")
    return fields


def _number(text: str) -> int:
    number = int(text)
    if not 0 <= number < 2**32:
        raise ValueError(f"{number} is not a valid id of a camera")
    return number
