"""Write captures as projects of COLMAP, as ``formats.colmap`` reads them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from support.photographs import copy_file
from svu_mi.capture.importers.colmap.project import IMAGES, MASKS
from svu_mi.capture.importers.colmap.sparse_model import ColmapCamera, Pose, write_model
from svu_mi.capture.importers.source import OPENCV, Source
from svu_mi.core.io.files import prepare_folder
from svu_mi.errors import OutputError


def write_colmap(root: Path, source: Source) -> None:
    """Write a project: ``sparse/0``, ``images/view_0000...`` and ``masks`` if there are any.

    COLMAP has no place for the mesh and the light.

    Args:
        root: its folder, made if missing.
        source: the capture; its photographs and masks are copied.

    Raises:
        CaptureError: a photograph or mask is missing.
        OutputError: a photograph has an exposure or an encoding that COLMAP cannot tell, or
            a file cannot be written.
    """
    numbers: dict[ColmapCamera, int] = {}
    views = []
    digits = max(4, len(str(len(source.frames) - 1)))  # names in the order of the frames
    for index, frame in enumerate(source.frames):
        is_integer = frame.image.suffix.lower() in (".png", ".jpg", ".jpeg")
        if frame.exposure != 1 or (is_integer and frame.transfer != "srgb"):
            raise OutputError(
                f"{frame.label}: COLMAP has no place for an exposure of {frame.exposure} or for "
                f"{frame.transfer} pixels; write radiance as EXR first."
            )
        camera = ColmapCamera("PINHOLE", *frame.size, (*frame.focal, *frame.center))
        number = numbers.setdefault(camera, len(numbers) + 1)
        name = f"view_{index:0{digits}d}{frame.image.suffix.lower()}"
        views.append(_view(name, number, frame.to_world))
        copy_file(frame.image, root / IMAGES / name)
        if frame.mask is not None:
            suffix = frame.mask.suffix.lower()  # COLMAP's own are all PNG
            mask = f"{name}.png" if suffix == ".png" else Path(name).with_suffix(suffix)
            copy_file(frame.mask, root / MASKS / mask)
    model = prepare_folder(root / "sparse" / "0")
    write_model(model, dict(enumerate(numbers, 1)), views)


def _view(name: str, camera: int, to_world: np.ndarray) -> Pose:
    camera_to_world = to_world @ OPENCV
    rotation = camera_to_world[:3, :3].T
    x, y, z, w = Rotation.from_matrix(rotation).as_quat().tolist()
    translation = -rotation @ camera_to_world[:3, 3]
    return Pose(name, camera, (w, x, y, z), tuple(translation.tolist()))
