"""Importer of ``transforms.json``: NeRF tools, Blender and nerfstudio.

Camera space is +X right, +Y up, and the camera looks along -Z (``OPENGL``). World space depends on
the scene; Blender and nerfstudio have +Z up. The keys follow nerfstudio:
https://docs.nerf.studio/quickstart/data_conventions.html
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from svu_mi.capture.image_io import SUFFIXES, open_image
from svu_mi.capture.importers.lens_distortion import COEFFICIENTS, Lens
from svu_mi.capture.importers.nerfstudio_world import AppliedWorld
from svu_mi.capture.importers.registry import ReadOptions
from svu_mi.capture.importers.source import LARGEST, MAX_SIDE, OPENGL, Frame, Source
from svu_mi.capture.importers.source_files import (
    find_file,
    find_folder,
    find_mask,
    relative_name,
    require_masks,
    substitutions,
)
from svu_mi.core.io.files import read_json, refusing, write_json
from svu_mi.core.io.schema import FLAG, ITEMS, NUMBER, OBJECT, TEXT, Axis, Field, checked
from svu_mi.core.validation import MAX_VIEWS
from svu_mi.errors import CaptureError, OptionError, are, excerpt

FILE = "transforms.json"
SPLITS = ("train", "test", "val")  # usual parts of a data set
ALL, LISTED = "all", "_filenames"  # all parts; end of the names of nerfstudio's lists of a part
FOLDERS = ("images", "masks")  # options
Folders = tuple[Path | None, ...]  # of the photographs and of the masks
OTHER_CAMERAS = ("latlong", "ortho", "ftheta_p0", "from_mitsuba")  # of instant-ngp
UNSUPPORTED = ("k5", "k6")  # coefficients that the lens model lacks
COORDINATE = Field(NUMBER, (), -LARGEST, LARGEST, "pixels", None)
LENGTH = Field(NUMBER, (), 1 / LARGEST, LARGEST, "pixels", None)
ANGLE = Field(NUMBER, (), 1e-6, math.pi - 1e-6, "radians", None)
SIDE = Field(NUMBER, (), 1, MAX_SIDE, "pixels", None)
MATRIX = Field(NUMBER, (Axis("rows", 3, 4), 4), -LARGEST, LARGEST)
FRAME = {
    "transform_matrix": MATRIX, "w": SIDE, "h": SIDE, "cx": COORDINATE, "cy": COORDINATE,
    "fl_x": LENGTH, "fl_y": LENGTH, "camera_angle_x": ANGLE, "camera_angle_y": ANGLE,
    "file_path": Field(TEXT, default=None), "mask_path": Field(TEXT, default=None),
    "exposure": Field(NUMBER, (), 1 / LARGEST, LARGEST, default=1.0),
    "camera_model": Field(TEXT, default=""), "is_fisheye": Field(FLAG, default=False),
    "distortion_params": Field(NUMBER, (ITEMS,), -LARGEST, LARGEST, default=()),
    "rolling_shutter": Field(NUMBER, (ITEMS,), default=()),
    **dict.fromkeys((*COEFFICIENTS, *UNSUPPORTED), COORDINATE._replace(unit="", default=0)),
}  # fmt: skip
TRANSFORMS = {
    "frames": Field(OBJECT, (Axis("photographs", 1, MAX_VIEWS),)),
    "applied_transform": MATRIX._replace(default=np.eye(4)),
    "applied_scale": Field(NUMBER, (), 1 / LARGEST, LARGEST, default=1.0),
}
NOT_PINHOLE = ("FISHEYE", "EQUIRECTANGULAR", "ORTHO", "VR180", "OMNIDIRECTIONAL")  # model names


def recognises(path: Path, split: str) -> bool:
    """Return whether a path is a JSON file, or a folder with ``transforms[_SPLIT].json``."""
    files = (path / FILE, *(_split_file(path, name) for name in (*SPLITS, split)))
    return path.suffix.lower() == ".json" or any(file.is_file() for file in files)


def read(path: Path, options: ReadOptions) -> Source:
    """Read a file, or the file in a folder (see ``read_transforms``)."""
    if not path.is_file():
        part = _split_file(path, options.split)
        if not part.is_file() and options.split not in (*SPLITS, ALL):
            raise OptionError(
                f"{path}: has no {part.name}; use an existing split, usually one of "
                f"{', '.join(SPLITS)}."
            )
        path = part if part.is_file() else path / FILE
    return read_transforms(
        path,
        original_world=options.original_world,
        split=options.split,
        folders=tuple(find_folder(kind, getattr(options, kind), ()) for kind in FOLDERS),
    )


def _split_file(folder: Path, split: str) -> Path:
    return folder / f"transforms_{split}.json"


def read_transforms(
    path: str | Path, *, original_world: bool = False, split: str = ALL,
    folders: Folders = (None, None),
) -> Source:  # fmt: skip
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
        split: part of the photographs to read, if the file lists ``train_filenames`` and others;
            ``all`` reads all.
        folders: folders of the photographs and of the masks, if not below the file's folder.
    """
    path = Path(path)
    record, frames, applied = read_poses(path)
    images = [
        _image_path(path.parent, frame.get("file_path"), f"{path}: frame {k}", folders[0])
        for k, frame in enumerate(frames)
    ]
    numbers, left_out = _of_split(record, images, split, path, folders[0])
    if original_world and applied.scale != 1:
        raise OptionError(
            f"{path}: has an applied_scale of {applied.scale:g}, which --original-world does not "
            "undo; omit that option, and give a mesh in the world of the poses."
        )
    before = np.linalg.inv(applied.transform) if original_world else np.eye(4)
    usual = next((image for image in images if image.is_file()), None)  # its size is that of all
    if usual is None and any(
        "file_path" in frame and {"w", "h"}.isdisjoint([*record, *frame]) for frame in frames
    ):
        raise CaptureError(
            f"{path}: {len(images)} of {len(images)} photographs {are(len(images))} missing, first "
            f"{relative_name(path.parent, images[0])}; move them to the paths in the poses."
        )
    unchanged = np.allclose(applied.transform, np.eye(4)) and applied.scale == 1
    notes = [] if original_world or unchanged else [
        f"{path}: has an applied_transform or applied_scale; poses are in the world after it. "
        "If the mesh is in the world before it, import with --original-world."
    ]  # fmt: skip
    read = [
        parse_frame(record, frames[k], path.parent, f"{path}: frame {k}", before, usual, folders)
        for k in numbers
    ]
    require_masks(folders[1], [frame.mask for frame in read], [frame.image for frame in read])
    for key, attribute, folder in (("file_path", "image", 0), ("mask_path", "mask", 1)):
        files = [getattr(frame, attribute) for frame in read]
        named = zip([frames[k].get(key) for k in numbers], files, strict=True)
        pairs = [(name, file) for name, file in named if name is not None and file is not None]
        notes += substitutions(str(path), folders[folder] or path.parent, pairs)
    return Source(
        format="transforms",
        root=path.parent,
        frames=read,
        camera_axes=OPENGL,
        applied=AppliedWorld(before @ applied.transform, applied.scale),
        notes=(*notes, *left_out),
    )


def _of_split(
    record: Mapping[str, Any], images: Sequence[Path], split: str, path: Path, folder: Path | None
) -> tuple[Sequence[int], list[str]]:
    """Return the numbers of the frames of a split, and a note about others.

    As in nerfstudio, files without ``train_filenames``, ``val_filenames`` and ``test_filenames``
    are not split here.
    """
    lists = [name for name in (f"{part}{LISTED}" for part in SPLITS) if name in record]
    if split == ALL or not lists:
        return range(len(images)), []
    key = f"{split}{LISTED}"
    if key not in lists:
        raise OptionError(f"{path}: has {', '.join(lists)}, but no {key}; use another --split.")
    with refusing(path, f"correct it there, or import all photographs with --split {ALL}"):
        names = checked(record, {key: Field(TEXT, (ITEMS,))})[key]
        wanted = {_image_path(path.parent, name, f"{path}: {key}", folder) for name in names}
        if unknown := wanted - set(images):
            name = excerpt(relative_name(path.parent, min(unknown)), 40)
            raise ValueError(f"{key} contains {name}, which has no pose")
        numbers = [k for k, image in enumerate(images) if image in wanted]
        if not numbers:
            raise ValueError(f"{key} is empty")
    count = len(images) - len(numbers)
    return numbers, [
        f"{path}: {count} of {len(images)} photographs {are(count)} not in {key} and left out; "
        f"import all of them with --split {ALL}."
    ] if count else []


def read_poses(path: Path) -> tuple[dict[str, Any], list[Any], AppliedWorld]:
    """Return the JSON object of a file, its frames, and the change of its world."""
    record = read_json(path)
    with refusing(f"{path}: no poses", "export them again"):
        known = checked(record, TRANSFORMS)
    applied = AppliedWorld(_matrix(known["applied_transform"]), known["applied_scale"])
    return record, known["frames"], applied


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
    return np.vstack([np.array(value, np.float64)[:3], [0, 0, 0, 1]])


def parse_frame(
    record: Mapping[str, Any], given: Mapping[str, Any], root: Path, label: str,
    before: np.ndarray, usual: Path | None = None, folders: Folders = (None, None),
) -> Frame:  # fmt: skip
    """Read one frame, ``given``, with the common values of ``record``.

    Paths are relative to ``root`` or looked for in ``folders``, the pose is multiplied by
    ``before`` (4, 4) from the left, and ``usual`` has the size of a missing photograph.
    """
    with refusing(label, "a frame needs transform_matrix, w, h, and fl_x or camera_angle_x"):
        both = {**record, **given}
        known = checked(both, FRAME)
        if other := [name for name in OTHER_CAMERAS if both.get(name)]:
            raise ValueError(f"{other[0]} is not supported")
        if any(known["rolling_shutter"]):
            raise ValueError("rolling_shutter is not supported")
        image = _image_path(root, known["file_path"], label, folders[0])
        size = width, height = _size(known, image, usual)
        fl_x, fl_y = _focal(known, "x", width), _focal(known, "y", height)
        if fl_x is None:
            raise ValueError("fl_x and camera_angle_x are missing")
    cx, cy = known["cx"], known["cy"]
    with np.errstate(all="ignore"):  # the frame refuses infinite values
        return Frame(
            label=label,
            image=image,
            mask=_mask_path(root, known["mask_path"], label, folders[1], image),
            to_world=before @ _matrix(known["transform_matrix"]) @ OPENGL,
            focal=(fl_x, fl_x if fl_y is None else fl_y),
            center=(width / 2 if cx is None else cx, height / 2 if cy is None else cy),
            size=size,
            exposure=known["exposure"],
            lens=_lens(known, label),
        )


def _lens(known: Mapping[str, Any], label: str) -> Lens | None:
    """Return the lens, or None without distortion; raise CaptureError for other cameras."""
    model, listed = known["camera_model"].upper(), known["distortion_params"]
    if any(name in model for name in NOT_PINHOLE) or known["is_fisheye"]:
        raise CaptureError(
            f"{label}: {model.lower()[:40] or 'a fisheye'} is not a pinhole camera; undistort the "
            "photographs first."
        )
    if any(listed) and len(listed) != len(COEFFICIENTS) or any(known[key] for key in UNSUPPORTED):
        raise CaptureError(
            f"{label}: lens coefficients must be {', '.join(COEFFICIENTS)}, or all "
            f"{len(COEFFICIENTS)} as distortion_params; undistort the photographs first."
        )
    numbers = listed if any(listed) else [known[key] for key in COEFFICIENTS]
    return Lens(**dict(zip(COEFFICIENTS, numbers, strict=True))) if any(numbers) else None


def _size(known: Mapping[str, Any], image: Path, usual: Path | None) -> tuple[int, int]:
    sides = known["w"], known["h"]
    if None not in sides:
        return int(sides[0]), int(sides[1])
    if sides != (None, None) or known["file_path"] is None:
        raise ValueError("w or h is missing")
    return open_image(image if usual is None or image.is_file() else usual).size


def _focal(known: Mapping[str, Any], axis: str, side: int) -> float | None:
    """Return the focal length along an axis in pixels, given directly or as an opening angle."""
    length, angle = known[f"fl_{axis}"], known[f"camera_angle_{axis}"]
    if length is not None or angle is None:
        return length
    return side / 2 / math.tan(angle / 2)


def _image_path(root: Path, given: Any, label: str, folder: Path | None) -> Path:
    """Return the path of a photograph; a path that ends in ``none`` if the frame has none."""
    if given is None:
        return root / "none"
    has_suffix = isinstance(given, str) and Path(given).suffix.lower() in SUFFIXES
    suffixes = ("",) if has_suffix else (*SUFFIXES, *map(str.upper, SUFFIXES))
    return find_file(folder or root, given, label, suffixes, moved=folder is not None)


def _mask_path(root: Path, given: Any, label: str, folder: Path | None, image: Path) -> Path | None:
    """Return the path of a mask; in a folder, also by the name of its photograph."""
    if given is not None:
        return find_file(folder or root, given, label, moved=folder is not None)
    return None if folder is None else find_mask(folder, Path(image.name))
