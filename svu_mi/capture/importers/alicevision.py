"""Importer of Meshroom and AliceVision: ``cameras.sfm`` of StructureFromMotion, or ``sfm.json``.

The format is that of https://github.com/alicevision/AliceVision (``sfmDataIO/jsonIO.cpp``). Numbers
are written as text. A rotation is world to camera, column by column, and ``center`` is the camera's
position; camera space is +X right, +Y down, +Z forward (``OPENCV``). Before version 1.2.2, focal
lengths are in pixels; later, they are in millimetres of ``sensorWidth``. The principal point is in
pixels from the image's corner, since 1.2.1 from its centre.
"""

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from svu_mi.capture.importers.lens_distortion import Lens
from svu_mi.capture.importers.registry import ReadOptions
from svu_mi.capture.importers.source import LARGEST, MAX_SIDE, OPENCV, Frame, Source
from svu_mi.capture.importers.source_files import find_file, find_folder, find_masks, substitutions
from svu_mi.capture.sensors import affine
from svu_mi.core.io.files import read_json, refusing
from svu_mi.core.io.schema import ITEMS, NUMBER, OBJECT, TEXT, Axis, Field, checked
from svu_mi.core.validation import MAX_VIEWS
from svu_mi.errors import CaptureError, excerpt

FILES = ("cameras.sfm", "sfm.json", "sfm_data.json", "sfm.sfm")
HEAD = re.compile(rb'(\xef\xbb\xbf)?\s*\{\s*"version"\s*:\s*\[')
IMAGES, MASKS = "images", ("masks", "mask")
NUMBERED = Field(NUMBER, (), 0, 2**32)
POSITIVE = Field(NUMBER, (), 1 / LARGEST, LARGEST)
FLAG = Field(TEXT, default="")  # 1, 0, true or false, as text
SFM = {
    "version": Field(NUMBER, (3,), 0, 1000),
    **{
        name: Field(OBJECT, (Axis(name, 0, MAX_VIEWS),), default=())
        for name in ("views", "intrinsics", "poses")
    },
}
VIEW = {
    "path": Field(TEXT), "poseId": NUMBERED._replace(default=None),
    "intrinsicId": NUMBERED._replace(default=None), "isPoseIndependant": FLAG,
}  # fmt: skip
POSE = {
    "rotation": Field(NUMBER, (9,), -LARGEST, LARGEST),
    "center": Field(NUMBER, (3,), -LARGEST, LARGEST),
}
INTRINSIC = {
    "width": Field(NUMBER, (), 1, MAX_SIDE), "height": Field(NUMBER, (), 1, MAX_SIDE),
    "sensorWidth": POSITIVE._replace(default=36.0), "pixelRatio": POSITIVE._replace(default=1.0),
    "focalLength": POSITIVE._replace(default=None),
    "principalPoint": Field(NUMBER, (2,), -LARGEST, LARGEST, "pixels"),
    "type": Field(TEXT, default="pinhole"), "distortionType": FLAG, "undistortionType": FLAG,
    "distortionParams": Field(NUMBER, (ITEMS,), -LARGEST, LARGEST, default=()),
}  # fmt: skip
# Coefficients of each distortion, which is the type of an intrinsic before version 1.2.6.
DISTORTIONS = {
    "pinhole": (), "none": (), "": (), "radial1": ("k1",), "radialk1": ("k1",),
    "radial3": ("k1", "k2", "k3"), "radialk3": ("k1", "k2", "k3"),
    "brown": ("k1", "k2", "k3", "p1", "p2"),
}  # fmt: skip
FALSE = ("0", "false")
TEXTS = ("path", "type", "distortionType", "undistortionType", "isPoseIndependant")
FIX = "write it again with Meshroom, or export with its node ExportColmap"


def recognises(path: Path, _: str) -> bool:
    """Return whether a path is a file of AliceVision, or a folder with one (no transforms.json)."""
    return _find(path) is not None and not (path / "transforms.json").is_file()


def read(path: Path, options: ReadOptions) -> Source:
    """Read the views that have a pose and intrinsics.

    Photographs are looked for by the end of their path below the folder ``images``, which is next
    to the file by default, or else below the folder of the file.
    """
    file = _find(path) or path
    root = file.parent
    with refusing(file, FIX):
        record = checked(_plain(read_json(file)), SFM)
        version = tuple(map(int, record["version"]))
        cameras = {_id(one, "intrinsicId"): one for one in record["intrinsics"]}
        poses = {_id(one, "poseId"): one for one in record["poses"]}
        views = [checked(_plain(view), VIEW) for view in record["views"]]
    images = find_folder("images", options.images, [root / IMAGES]) or root
    masks = find_folder("masks", options.masks, (root / name for name in MASKS))
    frames, names = [], []
    for number, view in enumerate(views):
        if view["intrinsicId"] not in cameras or view["poseId"] not in poses:
            continue
        label = f"{file}: view {number} ({excerpt(ascii(view['path'][-40:]))})"
        image = find_file(images, view["path"], label, moved=True)
        names.append((view["path"], image))
        with refusing(label, FIX):
            if view["isPoseIndependant"] in FALSE:
                raise ValueError("it is part of a rig of several cameras, which is not read")
            frames.append(_frame(
                label, image, poses[view["poseId"]], cameras[view["intrinsicId"]], version,
            ))  # fmt: skip
    if not frames:
        raise CaptureError(
            f"{file}: no view has a pose and intrinsics; compute the node StructureFromMotion of "
            "Meshroom, and give its cameras.sfm."
        )
    files = find_masks(masks, [Path(frame.image.name) for frame in frames])
    frames = [replace(frame, mask=file) for frame, file in zip(frames, files, strict=True)]
    return Source(
        format="alicevision", root=root, frames=frames, camera_axes=OPENCV,
        notes=_notes(file, len(views), len(frames)) + substitutions(str(file), images, names),
    )  # fmt: skip


def _find(path: Path) -> Path | None:
    files = [path] if path.is_file() else [path / name for name in FILES]
    return next((file for file in files if file.is_file() and _has_head(file)), None)


def _has_head(file: Path) -> bool:
    try:
        with file.open("rb") as opened:
            return HEAD.match(opened.read(256)) is not None
    except OSError:
        return False


def _plain(record: Any) -> Any:
    """Return a record with its texts as numbers, except those of ``TEXTS``, and without ``""``."""
    if not isinstance(record, Mapping):
        raise ValueError("expected an object")
    return {
        name: value if name in TEXTS else _number(value)
        for name, value in record.items() if name in TEXTS or value != ""
    }  # fmt: skip


def _number(value: Any) -> Any:
    if isinstance(value, list):
        return [_number(item) if isinstance(item, str) else item for item in value]
    try:
        return float(value) if isinstance(value, str) else value
    except ValueError:
        return value  # which its field refuses


def _id(record: Any, name: str) -> float:
    return float(checked(_plain(record), {name: NUMBERED})[name])


def _frame(label: str, image: Path, pose: Any, camera: Any, version: tuple[int, ...]) -> Frame:
    transform = checked(
        checked(pose, {"pose": Field(OBJECT)})["pose"], {"transform": Field(OBJECT)}
    )
    place = checked(_plain(transform["transform"]), POSE)
    camera = _plain(camera)
    known = checked(camera, INTRINSIC)
    size = int(known["width"]), int(known["height"])
    first = (0, 0) if version < (1, 2, 1) else (size[0] / 2, size[1] / 2)
    x, y = known["principalPoint"]
    rotation = np.reshape(place["rotation"], (3, 3))  # camera to world, as columns become rows
    return Frame(
        label=label, image=image, size=size,
        to_world=affine(rotation, np.array(place["center"])) @ OPENCV,
        focal=_focal(camera, known, version), center=(x + first[0], y + first[1]),
        lens=_lens(known),
    )  # fmt: skip


def _focal(
    camera: Mapping[str, Any], known: Mapping[str, Any], version: tuple[int, ...]
) -> tuple[float, float]:
    """Return the focal lengths in pixels."""
    if version < (1, 2, 0):
        return (checked(camera, {"pxFocalLength": POSITIVE})["pxFocalLength"],) * 2
    if version < (1, 2, 2):
        both = Field(NUMBER, (2,), 1 / LARGEST, LARGEST)
        x, y = checked(camera, {"pxFocalLength": both})["pxFocalLength"]
        return x, y
    if known["focalLength"] is None:
        raise ValueError("focalLength is missing")
    x, ratio = known["focalLength"] / known["sensorWidth"] * known["width"], known["pixelRatio"]
    if version < (1, 2, 5):
        return x, x / ratio
    if version > (1, 2, 8) and ratio != 1:  # the length has another direction since then
        raise ValueError(f"pixels with the aspect ratio {ratio:g} are not read")
    return x, x * ratio


def _lens(known: Mapping[str, Any]) -> Lens | None:
    kind = known["type"].lower()
    kind = known["distortionType"].lower() or kind if kind == "pinhole" else kind
    if kind not in DISTORTIONS or known["undistortionType"].lower() not in ("", "none"):
        raise ValueError(f"the lens model {excerpt(kind, 40)} is not read")
    names, values = DISTORTIONS[kind], known["distortionParams"]
    if names and len(values) != len(names):
        raise ValueError(f"{kind} has {len(names)} distortionParams, not {len(values)}")
    return Lens(**dict(zip(names, values, strict=True))) if names and any(values) else None


def _notes(file: Path, count: int, used: int) -> list[str]:
    notes = [
        f"{file}: the poses have their own unit and up axis; the mesh must use the same. Meshroom "
        "since 2021 writes meshes turned by 180 degrees about X, which need --fix mesh-x180."
    ]
    if used < count:
        notes.append(f"{file}: {count - used} of {count} views have no pose and are left out.")
    return notes
