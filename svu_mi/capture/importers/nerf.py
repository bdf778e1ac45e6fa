"""Importer of ``transforms.json``: NeRF tools, Blender and nerfstudio.

Camera space is +X right, +Y up, and the camera looks along -Z (``OPENGL``). World space depends on
the scene; Blender and nerfstudio have +Z up. The keys follow nerfstudio:
https://docs.nerf.studio/quickstart/data_conventions.html
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from svu_mi.capture.image_io import SUFFIXES, open_image
from svu_mi.capture.importers.lens_distortion import COEFFICIENTS, Lens
from svu_mi.capture.importers.source import OPENGL, Frame, Source
from svu_mi.capture.importers.source_files import relative_name, safe_path
from svu_mi.core.io.files import read_json, write_json
from svu_mi.core.validation import require_views
from svu_mi.errors import CaptureError, OptionError, excerpt

if TYPE_CHECKING:
    from svu_mi.capture.importers.registry import ReadOptions

FILE = "transforms.json"
SPLITS = ("train", "test", "val")  # usual parts of a data set
UNSUPPORTED = ("k5", "k6")  # coefficients that the lens model lacks
NOT_PINHOLE = ("FISHEYE", "EQUIRECTANGULAR", "ORTHO", "VR180", "OMNIDIRECTIONAL")  # model names


def recognises(path: Path, split: str) -> bool:
    """Return whether a path is a JSON file, or a folder with ``transforms[_SPLIT].json``."""
    files = (path / FILE, *(_split_file(path, name) for name in (*SPLITS, split)))
    return path.suffix.lower() == ".json" or any(file.is_file() for file in files)


def read(path: Path, options: ReadOptions) -> Source:
    """Read a file, or the file in a folder (see ``read_transforms``)."""
    if not path.is_file():
        part = _split_file(path, options.split)
        if not part.is_file() and options.split not in SPLITS:
            raise OptionError(
                f"{path}: has no {part.name}; use an existing split, usually one of "
                f"{', '.join(SPLITS)}."
            )
        path = part if part.is_file() else path / FILE
    return read_transforms(path, original_world=options.original_world)


def _split_file(folder: Path, split: str) -> Path:
    return folder / f"transforms_{split}.json"


def read_transforms(path: str | Path, *, original_world: bool = False) -> Source:
    """Read poses, intrinsics, and paths of photographs and masks.

    Intrinsics are keys of the frame, else of the file: ``fl_x`` (or ``camera_angle_x``, the opening
    angle in radians), ``fl_y``, ``cx``, ``cy`` (default: the centre), ``w``, ``h`` (default: the
    photograph's size). ``exposure`` is a gain per frame, an extension of svu. A ``file_path``
    without suffix is tried with all suffixes of photographs. Lens coefficients are ``k1``, ``k2``,
    ``k3``, ``k4``, ``p1``, ``p2``, or a list ``distortion_params`` in this order.

    Args:
        path: path of the file.
        original_world: True to undo nerfstudio's ``applied_transform``, for a mesh in the world of
            the photogrammetry tool.
    """
    path = Path(path)
    record, frames = read_poses(path)
    try:
        applied = _matrix(record.get("applied_transform", np.eye(4)))
    except (TypeError, ValueError) as error:
        raise CaptureError(f"{path}: applied_transform must be 3 x 4 numbers.") from error
    before = np.linalg.inv(applied) if original_world else np.eye(4)
    usual = _default_size(path, record, frames)
    notes = [] if original_world or np.allclose(applied, np.eye(4)) else [
        f"{path}: has an applied_transform; poses are in the world after it. "
        "If the mesh is in the world before it, import with --original-world."
    ]  # fmt: skip
    return Source(
        format="transforms",
        root=path.parent,
        frames=[
            parse_frame(record, frame, path.parent, f"{path}: frame {index}", before, usual)
            for index, frame in enumerate(frames)
        ],
        camera_axes=OPENGL,
        notes=tuple(notes),
    )


def read_poses(path: Path) -> tuple[dict[str, Any], list[Any]]:
    """Return the JSON object of a file and its frames; raise CaptureError without frames."""
    record = read_json(path)
    frames = record.get("frames") if isinstance(record, dict) else None
    if not isinstance(frames, list) or not frames:
        raise CaptureError(f'{path}: no poses; expected a list "frames" with transform_matrix.')
    require_views(len(frames), f"{path}: frames", CaptureError)
    return record, frames


def write_transforms(path: str | Path, frames: Sequence[Frame]) -> None:
    """Write frames as ``transforms.json``, with intrinsics per frame.

    Files in the folder of ``path`` are written as relative paths, other files only by their name.
    The files need not exist.
    """
    root = Path(path).parent
    records = [_record(frame, root) for frame in frames]
    write_json(path, {"frames": records})


def _record(frame: Frame, root: Path) -> dict[str, Any]:
    return {
        "file_path": relative_name(root, frame.image),
        **({} if frame.mask is None else {"mask_path": relative_name(root, frame.mask)}),
        **({} if frame.exposure == 1 else {"exposure": frame.exposure}),
        "fl_x": frame.focal[0], "fl_y": frame.focal[1],
        "cx": frame.center[0], "cy": frame.center[1],
        "w": frame.size[0], "h": frame.size[1],
        **({} if frame.lens is None else frame.lens.record),
        "transform_matrix": (frame.to_world @ OPENGL).tolist(),
    }  # fmt: skip


def _matrix(value: Any) -> np.ndarray:
    matrix = np.array(value, np.float64)
    if matrix.shape not in ((4, 4), (3, 4)):
        raise ValueError(f"transform_matrix of shape {matrix.shape}")
    return np.vstack([matrix[:3], [0, 0, 0, 1]])


def parse_frame(
    record: Mapping[str, Any], given: Any, root: Path, label: str, before: np.ndarray,
    usual: tuple[int, int] | None = None,
) -> Frame:  # fmt: skip
    """Read one frame, ``given``, with the common values of ``record``.

    Paths are relative to ``root``, the pose is multiplied by ``before`` (4, 4) from the left, and
    ``usual`` is the size of a missing photograph.
    """
    try:
        known = {**record, **given}
        matrix = _matrix(known["transform_matrix"])
        image = _image_path(root, known.get("file_path"), label)
        masked = known.get("mask_path")
        size = width, height = _size(known, image, usual)
        fl_x = _focal(known, "x", width, label)
        fl_y = _focal(known, "y", height, label, fl_x)
        with np.errstate(all="ignore"):  # the frame refuses infinite values
            return Frame(
                label=label,
                image=image,
                mask=None if masked is None else safe_path(root, masked, label),
                to_world=before @ matrix @ OPENGL,
                focal=(fl_x, fl_y),
                center=(float(known.get("cx", width / 2)), float(known.get("cy", height / 2))),
                size=size,
                exposure=float(known.get("exposure", 1.0)),
                lens=_lens(known, label),
            )
    except (KeyError, TypeError, ValueError, OverflowError, ZeroDivisionError) as error:
        raise CaptureError(
            f"{label}: {excerpt(repr(error))}; a frame needs transform_matrix, w, h, and fl_x or "
            "camera_angle_x."
        ) from error


def _lens(known: Mapping[str, Any], label: str) -> Lens | None:
    """Return the lens, or None without distortion; raise CaptureError for other cameras."""
    model = str(known.get("camera_model", "")).upper()
    if any(name in model for name in NOT_PINHOLE) or known.get("is_fisheye"):
        raise CaptureError(
            f"{label}: {model.lower()[:40] or 'a fisheye'} is not a pinhole camera; undistort the "
            "photographs first."
        )
    numbers = [float(known.get(key) or 0) for key in COEFFICIENTS]
    listed = known.get("distortion_params")
    if listed and any(map(float, listed)):
        if len(listed) != len(COEFFICIENTS):
            raise CaptureError(
                f"{label}: distortion_params must be the {len(COEFFICIENTS)} numbers "
                f"{', '.join(COEFFICIENTS)}, got {len(listed)}; give each by its own name."
            )
        numbers = [float(number) for number in listed]
    if not np.isfinite(numbers).all() or any(known.get(key) for key in UNSUPPORTED):
        raise CaptureError(
            f"{label}: lens coefficients must be finite, and only {', '.join(COEFFICIENTS)} are "
            "supported; undistort the photographs first."
        )
    if not any(numbers):
        return None
    return Lens(**dict(zip(COEFFICIENTS, numbers, strict=True)))


def _size(known: Mapping[str, Any], image: Path, usual: tuple[int, int] | None) -> tuple[int, int]:
    if _has_size(known) or known.get("file_path") is None:
        return int(known["w"]), int(known["h"])
    return usual if usual is not None and not image.is_file() else open_image(image).size


def _has_size(known: Mapping[str, Any]) -> bool:
    return "w" in known or "h" in known


def _default_size(
    path: Path, record: Mapping[str, Any], frames: Sequence[Any]
) -> tuple[int, int] | None:
    """Return the size of the first photograph that exists, for frames without a size."""
    named = {
        k: frame["file_path"] for k, frame in enumerate(frames)
        if isinstance(frame, dict) and "file_path" in frame and not _has_size(frame)
    }  # fmt: skip
    if _has_size(record) or not named:
        return None
    label = f"{path}: frame "
    images = [_image_path(path.parent, name, f"{label}{index}") for index, name in named.items()]
    first = next((image for image in images if image.is_file()), None)
    if first is not None:
        return open_image(first).size
    raise CaptureError(
        f"{path}: {len(named)} of {len(frames)} photographs are missing, first "
        f"{relative_name(path.parent, images[0])}; move them to the paths in the poses."
    )


def _focal(
    known: Mapping[str, Any], axis: str, side: int, label: str, default: float | None = None
) -> float:
    """Return the focal length along an axis in pixels, given directly or as an opening angle."""
    key = f"camera_angle_{axis}"
    if f"fl_{axis}" in known:
        return float(known[f"fl_{axis}"])
    if default is not None and key not in known:
        return default
    angle = float(known[key])
    if not 0 < angle < math.pi:  # NaN fails, too
        raise CaptureError(f"{label}: {key} must be in (0, pi) radians, got {angle:g}; correct it.")
    return side / 2 / math.tan(angle / 2)


def _image_path(root: Path, given: Any, label: str) -> Path:
    """Return the path of a photograph; a path that ends in ``none`` if the frame has none."""
    if given is None:
        return root / "none"
    path = safe_path(root, given, label)
    if path.suffix.lower() in SUFFIXES:
        return path
    suffixes = (*SUFFIXES, *map(str.upper, SUFFIXES))
    files = (path.with_name(path.name + suffix) for suffix in suffixes)
    return next((file for file in files if file.is_file()), path)
