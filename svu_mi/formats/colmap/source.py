"""COLMAP: poses and cameras of its sparse models, with the photographs beside them.

Its camera space is +X right, +Y down, +Z forward (``OPENCV``), poses are world to camera, and
the centre of the first pixel is (0.5, 0.5). The world is wherever the reconstruction began.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from svu_mi.capture.poses import affine
from svu_mi.errors import CaptureError, OutputError
from svu_mi.files import copy_file, prepare_folder
from svu_mi.formats.colmap.model import Camera, View, is_model, write_model
from svu_mi.formats.colmap.project import IMAGES, MASKS, Project, read_project
from svu_mi.formats.source import OPENCV, Frame, Source


def read_colmap(path: Path, *, images: Path | None = None, masks: Path | None = None) -> Source:
    """Read a sparse model, in the order of the images' names.

    Args:
        path: the model's folder, or a project with ``sparse/0``, ``sparse`` or ``dense/sparse``.
        images: folder of the photographs; by default ``images`` beside the model.
        masks: folder of the masks, by default ``masks`` beside the model if there is one:
            ``NAME.png`` for the image NAME, as COLMAP has it, or of the same stem.

    Raises:
        CaptureError: there is no model, it is damaged, a lens is distorted, or a photograph is
            missing.
    """
    project = read_project(path, images, masks)
    frames = []
    for view, photograph, mask in zip(
        project.views, project.photographs, project.masks, strict=True
    ):
        camera = project.cameras[view.camera]
        focal, center = _pinhole(camera, f"{project.model}: camera {view.camera}")
        frames.append(Frame(
            label=project.label(view),
            image=photograph,
            mask=mask,
            to_world=_to_world(view),
            focal=focal,
            center=center,
            size=(camera.width, camera.height),
        ))  # fmt: skip
    return Source(
        format="colmap", root=path, frames=frames, camera_axes=OPENCV, notes=list(_notes(project))
    )


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
    numbers: dict[Camera, int] = {}
    views = []
    digits = max(4, len(str(len(source.frames) - 1)))  # names in the order of the frames
    for index, frame in enumerate(source.frames):
        is_integer = frame.image.suffix.lower() in (".png", ".jpg", ".jpeg")
        if frame.exposure != 1 or (is_integer and frame.transfer != "srgb"):
            raise OutputError(
                f"{frame.label}: COLMAP has no place for an exposure of {frame.exposure} or for "
                f"{frame.transfer} pixels; write radiance as EXR first."
            )
        camera = Camera("PINHOLE", *frame.size, (*frame.focal, *frame.center))
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


def _pinhole(camera: Camera, label: str) -> tuple[tuple[float, float], tuple[float, float]]:
    pinhole = camera.pinhole()
    if pinhole is None:
        raise CaptureError(
            f"{label}: the lens is distorted ({camera.model}); svu import undistorts the "
            "photographs with --undistort."
        )
    return pinhole


def _to_world(view: View) -> np.ndarray:
    w, x, y, z = view.rotation
    rotation = Rotation.from_quat([x, y, z, w]).as_matrix()
    return affine(rotation.T, -rotation.T @ view.translation) @ OPENCV


def _view(name: str, camera: int, to_world: np.ndarray) -> View:
    camera_to_world = to_world @ OPENCV
    rotation = camera_to_world[:3, :3].T
    x, y, z, w = Rotation.from_matrix(rotation).as_quat().tolist()
    translation = -rotation @ camera_to_world[:3, 3]
    return View(name, camera, (w, x, y, z), tuple(translation.tolist()))


def _notes(project: Project) -> Iterator[str]:
    yield (
        f"{len(project.views)} images of COLMAP, whose world has a unit and an up axis of its own: "
        "the mesh must be in it."
    )
    folder = project.model.parent
    if project.model.name == "0" and is_model(folder / "1"):
        yield f"{folder}: holds several models, parts of a whole; 0 is taken."
