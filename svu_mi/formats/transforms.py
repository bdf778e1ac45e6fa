"""``transforms.json``: poses as NeRF tools, Blender and nerfstudio write and read them.

There, camera space is +X right, +Y up, and the camera looks along -Z (OpenGL); here it is +X
left, +Y up, +Z forward (Mitsuba): two columns change their sign. World space is the scene's own.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from svu_mi.capture.poses import describe, film_size, focal_length, make_sensor
from svu_mi.capture.scene import check_sensor
from svu_mi.errors import CaptureError
from svu_mi.files import read_json, replacing

FLIP = np.diag([-1.0, 1.0, -1.0, 1.0])
SQUARE = 1e-3  # part by which the focal lengths of x and y may differ
NEAR, FAR = 1e-4, 1e7  # clip planes: the file has none, nor the size of the scene


def write_transforms(path: str | Path, sensors: Sequence[Any], names: Sequence[str]) -> None:
    """Write sensors as ``transforms.json``, with intrinsics per frame.

    Args:
        path: the file.
        sensors: V perspective sensors.
        names: V names of photographs, which need not exist.

    Raises:
        OutputError: the file cannot be written.
    """
    frames = [
        {"file_path": name, **_intrinsics(sensor), "transform_matrix": _opengl(sensor)}
        for sensor, name in zip(sensors, names, strict=True)
    ]
    with replacing(path) as temporary:
        temporary.write_text(json.dumps({"frames": frames}, indent=1) + "\n", encoding="utf-8")


def read_transforms(path: str | Path) -> tuple[Any, ...]:
    """Read sensors from ``transforms.json``.

    Intrinsics are taken from the frame, or else from the file: ``fl_x`` (or ``camera_angle_x``,
    the opening angle in radians), ``cx``, ``cy`` (the centre by default), ``w``, ``h``.

    Raises:
        CaptureError: the file is no such JSON, a frame lacks something, or its pixels are not
            square or its lens not straight.
        SceneError: a pose is mirrored, or no rotation.
    """
    path = Path(path)
    record = read_json(path)
    frames = record.get("frames") if isinstance(record, dict) else None
    if not isinstance(frames, list) or not frames:
        raise CaptureError(f'{path}: no poses; expected a list "frames" with transform_matrix.')
    made = []
    for index, frame in enumerate(frames):
        label = f"{path}: frame {index}"
        made.append(_sensor(record, frame, label))
        check_sensor(made[-1], label)
    return tuple(made)


def _intrinsics(sensor: Any) -> dict[str, Any]:
    record, (width, height) = describe(sensor), film_size(sensor)
    film, offset, crop = (record[k] for k in ("film", "principal_point_offset", "crop_offset"))
    focal = focal_length(sensor)
    center = [film[k] / 2 - offset[k] * film[k] - crop[k] for k in range(2)]
    return {"fl_x": focal, "fl_y": focal, "cx": center[0], "cy": center[1],
            "w": width, "h": height}  # fmt: skip


def _opengl(sensor: Any) -> list[list[float]]:
    return (np.array(describe(sensor)["to_world"]) @ FLIP).tolist()


def _sensor(record: Mapping[str, Any], frame: Any, label: str) -> Any:
    try:
        known = {**record, **frame}
        matrix = np.array(known["transform_matrix"], np.float64)
        if matrix.shape not in ((4, 4), (3, 4)):
            raise CaptureError(f"{label}: transform_matrix must be 4 x 4, got {matrix.shape}.")
        matrix = np.vstack([matrix[:3], [0, 0, 0, 1]])
        size = [int(known["w"]), int(known["h"])]
        focal = _focal(known, size)
        upright = float(known.get("fl_y", focal))
        center = [float(known.get("cx", size[0] / 2)), float(known.get("cy", size[1] / 2))]
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise CaptureError(
            f"{label}: {error!r}; a frame needs transform_matrix, w, h, and fl_x or camera_angle_x."
        ) from error
    if not (np.isfinite(focal) and focal > 0 and min(size) > 0):
        raise CaptureError(f"{label}: focal length and size must be positive.")
    if not abs(upright / focal - 1) <= SQUARE:  # NaN fails, too
        raise CaptureError(f"{label}: fl_x and fl_y differ; resample to square pixels.")
    if "FISHEYE" in str(known.get("camera_model", "")).upper():
        raise CaptureError(f"{label}: a fisheye is no pinhole; undistort the photographs first.")
    if any(known.get(key) for key in ("k1", "k2", "k3", "k4", "p1", "p2")):
        raise CaptureError(f"{label}: the lens is distorted; undistort the photographs first.")
    return make_sensor(
        {
            "to_world": matrix @ FLIP,
            "x_fov": 2 * np.degrees(np.arctan(size[0] / 2 / focal)),
            "principal_point_offset": [0.5 - center[k] / size[k] for k in range(2)],
            "clip": [NEAR, FAR],
            "film": size,
            "crop_offset": [0, 0],
            "crop_size": size,
        },
        label,
    )


def _focal(known: Mapping[str, Any], size: list[int]) -> float:
    if "fl_x" in known:
        return float(known["fl_x"])
    return float(size[0] / 2 / np.tan(float(known["camera_angle_x"]) / 2))
