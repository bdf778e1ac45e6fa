"""Perspective sensors: descriptions, projection and placement."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import mitsuba as mi
import numpy as np
import scipy

from svu_mi.capture.mesh import arrays
from svu_mi.capture.scene import last_sentence, to_world
from svu_mi.capture.up_direction import up_of_poses
from svu_mi.core.arrays import fibonacci
from svu_mi.core.io.files import refusing
from svu_mi.core.io.schema import NUMBER, WHOLE, Field, checked
from svu_mi.core.validation import require_views
from svu_mi.errors import CaptureError, OptionError

LARGEST = 1e30  # largest number in a description; below the limit of single precision
MAX_SIDE = 2**16  # largest width or height of a film, in pixels
MAX_PIXELS = 2**30  # per photograph; kernels index its 3 values per pixel by 32 bits

SIDES = Field(WHOLE, (2,), 1, MAX_SIDE, "pixels")
SENSOR = {
    "to_world": Field(NUMBER, (4, 4), -LARGEST, LARGEST),
    "x_fov": Field(NUMBER, (), 1e-6, 180 - 1e-6, "degrees"),
    "principal_point_offset": Field(NUMBER, (2,), -LARGEST, LARGEST),
    "clip": Field(NUMBER, (2,), 1 / LARGEST, LARGEST),
    "film": SIDES, "crop_offset": SIDES._replace(low=0), "crop_size": SIDES,
}  # fmt: skip
PIXELS = ("film", "crop_offset", "crop_size")


def affine(linear: Any, offset: Any = 0.0) -> np.ndarray:
    """Return the (4, 4) float64 matrix of the affine map x -> linear x + offset."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = linear, offset
    return matrix


def film_size(sensor: Any) -> tuple[int, int]:
    """Return (width, height) of the crop window: the photograph's size."""
    size = sensor.film().crop_size()
    return int(size[0]), int(size[1])


def describe(sensor: Any) -> dict[str, Any]:
    """Return a JSON-ready description of a perspective sensor.

    ``to_world`` is row-major; camera space is +X left, +Y up, +Z forward. ``x_fov`` is the field of
    view over the full film width, in degrees.
    """
    params, film = mi.traverse(sensor), sensor.film()

    def number(key: str) -> float:
        return float(np.array(params[key]).ravel()[0])

    offset = [number(f"principal_point_offset_{axis}") for axis in "xy"]
    sizes = film.size(), film.crop_offset(), film.crop_size()
    return {
        "to_world": to_world(sensor).tolist(), "x_fov": number("x_fov"),
        "principal_point_offset": offset, "clip": [number("near_clip"), number("far_clip")],
        **{key: [int(n) for n in pair] for key, pair in zip(PIXELS, sizes, strict=True)},
    }  # fmt: skip


def make_sensor(record: Mapping[str, Any], label: str) -> Any:
    """Make a perspective sensor from its description; ``label`` is its id."""
    check_record(record, label)
    (width, height), (left, top), (wide, high) = (map(int, record[key]) for key in PIXELS)
    shift_x, shift_y = map(float, record["principal_point_offset"])
    near, far = map(float, record["clip"])
    film = {
        "type": "hdrfilm", "width": width, "height": height, "crop_offset_x": left,
        "crop_offset_y": top, "crop_width": wide, "crop_height": high, "pixel_format": "rgb",
        "component_format": "float32", "rfilter": {"type": "box"},
    }  # fmt: skip
    try:
        return mi.load_dict({
            "type": "perspective", "id": label, "fov": float(record["x_fov"]), "fov_axis": "x",
            "to_world": mi.ScalarTransform4f(np.array(record["to_world"], np.float64)),
            "principal_point_offset_x": shift_x, "principal_point_offset_y": shift_y,
            "near_clip": near, "far_clip": far, "film": film, "sampler": {"type": "independent"},
        })  # fmt: skip
    except RuntimeError as error:
        reason = last_sentence(str(error))
        raise CaptureError(f"{label}: Mitsuba rejects the sensor: {reason}") from error


def changed_sensor(sensor: Any, **entries: Any) -> Any:
    """Return a copy of a sensor with other ``entries`` of its description (see ``describe``)."""
    return make_sensor({**describe(sensor), **entries}, sensor.id())


def scaled_sensor(sensor: Any, side: int) -> Any:
    """Return a sensor with a film of at most ``side`` pixels in width and height.

    Return ``sensor`` itself if its film is small enough.
    """
    scale = side / max(film_size(sensor))
    return sensor if scale >= 1 else resized_sensor(sensor, scale)


def resized_sensor(sensor: Any, scale: float) -> Any:
    """Return a sensor whose film's width and height are scaled."""
    record = describe(sensor)
    lowest = {"film": 1, "crop_offset": 0, "crop_size": 1}
    return changed_sensor(sensor, **{
        key: [max(low, int(value * scale)) for value in record[key]] for key, low in lowest.items()
    })  # fmt: skip


def windowed_sensor(
    sensor: Any, corner: tuple[int, int], size: tuple[int, int], scale: float
) -> Any:
    """Return a sensor whose film is a resampled window of another sensor's film.

    Args:
        sensor: Original sensor.
        corner: Upper left corner (x, y) of the window in original pixels; may be outside the film.
        size: Size (width, height) of the new film in new pixels.
        scale: New pixels per original pixel, along one side.
    """
    focal, center = focal_length(sensor) * scale, principal_point(sensor)
    return changed_sensor(
        sensor, x_fov=float(2 * np.degrees(np.arctan(size[0] / 2 / focal))),
        principal_point_offset=[0.5 - (center[k] - corner[k]) * scale / size[k] for k in range(2)],
        film=list(size), crop_offset=[0, 0], crop_size=list(size),
    )  # fmt: skip


def focal_length(sensor: Any) -> float:
    """Return the focal length in pixels."""
    record = describe(sensor)
    return float(record["film"][0] / 2 / np.tan(np.radians(record["x_fov"]) / 2))


def principal_point(sensor: Any) -> tuple[float, float]:
    """Return the principal point in pixels from the film's corner."""
    record = describe(sensor)
    film, offset, crop = (record[k] for k in ("film", "principal_point_offset", "crop_offset"))
    x, y = (film[k] * (0.5 - offset[k]) - crop[k] for k in range(2))
    return x, y


def projected(sensor: Any, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Project world points (N, 3) to pixels (N, 2) and depths (N,).

    Pixel coordinates are meaningless if the depth is not positive.
    """
    pose = to_world(sensor)
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    depth = local[:, 2]
    # Mitsuba's camera space is +X left, +Y up, +Z forward.
    away = focal_length(sensor) * local[:, :2] / np.where(depth > 0, depth, 1)[:, None]
    return np.array(principal_point(sensor)) - away, depth


def sphere_sensors(
    shape: Any, count: int, resolution: tuple[int, int], fov: float = 35.0, *,
    distance: float | None = None, up: Sequence[float] = (0.0, 1.0, 0.0), lowest: float = -1.0,
) -> tuple[Any, ...]:  # fmt: skip
    """Place sensors on a sphere around an object (Fibonacci spiral).

    Args:
        shape: The object; sensors face the centre of its bounding box.
        count: Number of sensors.
        resolution: Film size (width, height) in pixels.
        fov: Field of view over the film's shorter side, in degrees.
        distance: Radius of the sphere in scene units; by default the object just fits the film.
        up: Direction of the pole; need not have unit length.
        lowest: Sine of the lowest elevation: -1 for the sphere, 0 for the upper hemisphere.
    """
    if count < 1 or min(resolution) < 1:
        raise OptionError(
            f"Cannot place {count} sensors of {resolution[0]} x {resolution[1]} pixels; "
            "all three numbers must be at least 1."
        )
    require_views(count, "Sensors around an object")
    if not -1 <= lowest < 1:
        raise OptionError(f"The sine of the lowest elevation must be in [-1, 1), got {lowest}.")
    center, radius = bounding_sphere(shape)
    if distance is None:
        distance = 1.05 * radius / np.sin(np.radians(fov) / 2)
    if not (np.isfinite(distance) and distance > 0):
        raise OptionError(f"The distance from the object must be positive, got {distance}.")
    wide = max(1.0, resolution[0] / resolution[1])
    x_fov = 2 * np.degrees(np.arctan(np.tan(np.radians(fov) / 2) * wide))
    directions = fibonacci(count, lowest, start=0.5)[:, ::-1] @ _rotation(up).T
    poses = [_look_at(center + distance * direction, center, up) for direction in directions]
    return tuple(
        object_sensor(pose, float(x_fov), distance, resolution, f"view_{k:04d}")
        for k, pose in enumerate(poses)
    )


def object_sensor(
    pose: np.ndarray, x_fov: float, distance: float, size: tuple[int, int], label: str
) -> Any:
    """Make a sensor with centred principal point, and clip planes for an object at a distance."""
    return make_sensor({
        "to_world": pose, "x_fov": x_fov, "principal_point_offset": [0.0, 0.0],
        "clip": [distance * 1e-2, distance * 1e2], "film": size, "crop_offset": [0, 0],
        "crop_size": size,
    }, label)  # fmt: skip


def sensors_like(
    used: Sequence[Any], shape: Any, count: int, *, distance: float | None = None,
    up: Sequence[float] | None = None, lowest: float = -1.0,
) -> tuple[Any, ...]:  # fmt: skip
    """Place sensors around an object; film and field of view are those of ``used[0]``.

    The default ``distance`` is the median one of ``used``, and the default ``up`` is theirs; other
    arguments: see ``sphere_sensors``.
    """
    if up is None:
        up = up_of_poses(np.array([to_world(sensor) for sensor in used])).tolist()
    if distance is None:
        center, _ = bounding_sphere(shape)
        offsets = [to_world(sensor)[:3, 3] - center for sensor in used]
        distance = float(np.median(np.linalg.norm(offsets, axis=1)))
    size = film_size(used[0])
    x_fov = float(2 * np.degrees(np.arctan(size[0] / 2 / focal_length(used[0]))))
    wide = max(1.0, size[0] / size[1])
    fov = 2 * np.degrees(np.arctan(np.tan(np.radians(x_fov) / 2) / wide))
    return sphere_sensors(shape, count, size, float(fov), distance=distance, up=up, lowest=lowest)


def _rotation(up: Sequence[float]) -> np.ndarray:
    """Return the smallest rotation (3, 3) from +Y to a direction."""
    length = np.linalg.norm(up)
    if not (np.isfinite(length) and length > 0):
        raise OptionError(f"up must be a direction, got {list(up)}.")
    x, y, z = np.array(up, np.float64) / length
    quaternion = (z, 0, -x, 1 + y) if y > -1 + 1e-9 else (1, 0, 0, 0)
    return np.asarray(scipy.spatial.transform.Rotation.from_quat(quaternion).as_matrix())


def bounding_sphere(shape: Any) -> tuple[np.ndarray, float]:
    """Return centre and radius of a shape's bounding sphere."""
    bounds = shape.bbox()
    low, high = np.array(bounds.min, np.float64), np.array(bounds.max, np.float64)
    center = (low + high) / 2
    points = arrays(shape).positions if shape.is_mesh() else np.stack([low, high])
    return center, float(np.linalg.norm(points - center, axis=1).max())


def directions_of(sensors: Iterable[Any], center: np.ndarray) -> np.ndarray:
    """Return unit vectors (V, 3) from a point to sensors; +Y for a sensor at the point."""
    offsets = np.array([to_world(sensor)[:3, 3] - center for sensor in sensors]).reshape(-1, 3)
    lengths = np.linalg.norm(offsets, axis=1, keepdims=True)
    return np.where(lengths > 0, offsets / np.maximum(lengths, 1e-30), (0.0, 1.0, 0.0))


def _look_at(origin: np.ndarray, target: np.ndarray, up: Sequence[float]) -> np.ndarray:
    """Return a look-at matrix; replace ``up`` if it is parallel to the viewing direction."""
    forward = (target - origin) / np.linalg.norm(target - origin)
    above = np.array(up, np.float64) / np.linalg.norm(up)
    if abs(forward @ above) >= 0.999:  # any other direction will do
        above = np.roll(above, 1) if abs(forward @ np.roll(above, 1)) < 0.999 else above[[0, 2, 1]]
    pose = mi.ScalarTransform4d().look_at(origin=origin, target=target, up=above)
    return np.array(pose.matrix, np.float64)


def check_record(record: Any, label: str) -> None:
    """Raise if a sensor description is incomplete or invalid."""
    with refusing(label, "render or import it again"):
        checked(record, SENSOR)
        film, offset, size = (np.array(record[key], np.float64) for key in PIXELS)
        near, far = record["clip"]
        last = np.array(record["to_world"], np.float64)[3]
        broken = [rule for rule, holds in {
            "to_world must have the last row 0 0 0 1": np.allclose(last, [0, 0, 0, 1]),
            "clip must be in order, near and far": near < far,
            f"film must have at most {MAX_PIXELS} pixels": size.prod() <= MAX_PIXELS,
            "crop_size must be a window inside the film": (offset + size <= film).all(),
        }.items() if not holds]  # fmt: skip
        if broken:
            raise ValueError(broken[0])
