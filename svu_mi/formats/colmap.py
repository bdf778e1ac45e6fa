"""COLMAP: poses and cameras of its sparse models, with the photographs beside them.

Its camera space is +X right, +Y down, +Z forward (``OPENCV``), poses are world to camera, and
the centre of the first pixel is (0.5, 0.5). The world is wherever the reconstruction began.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from svu_mi.capture.picture import SUFFIXES
from svu_mi.errors import CaptureError, OutputError
from svu_mi.files import copy_file, prepare_folder
from svu_mi.formats.colmap_model import Camera, View, is_model, read_model, write_model
from svu_mi.formats.paths import inside
from svu_mi.formats.source import OPENCV, Frame, Source

# Undistorted models go before those they were made from: both have the same world.
PLACES = ("dense/sparse", "dense/0/sparse", "sparse/0", "sparse", ".")
IMAGES, MASKS = "images", "masks"


def find_model(path: Path) -> Path | None:
    """Return the folder of the sparse model in a project, or the folder itself; None without."""
    folders = [Path(os.path.normpath(path / place)) for place in PLACES]
    return next((folder for folder in folders if is_model(folder)), None)


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
    model = model_in(path)
    cameras, views = read_model(model)
    numbers = sorted({view.camera for view in views})
    pinholes = {number: _pinhole(cameras[number], f"{model}: camera {number}") for number in numbers}
    folder = images_folder(model, images)
    masks = masks_folder(model, masks)
    frames = []
    for view, file in zip(views, photographs(model, views, folder), strict=True):
        camera, (focal, center) = cameras[view.camera], pinholes[view.camera]
        frames.append(Frame(
            label=_label(model, view),
            image=file,
            mask=None if masks is None else find_mask(masks, file.relative_to(folder)),
            to_world=_to_world(view),
            focal=focal,
            center=center,
            size=(camera.width, camera.height),
        ))  # fmt: skip
    return Source(
        format="colmap",
        root=path,
        frames=frames,
        camera_axes=OPENCV,
        notes=list(_notes(model, len(views))),
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
    write_model(model, {number: camera for camera, number in numbers.items()}, views)


def images_folder(model: Path, images: Path | None) -> Path:
    """Return the folder of the photographs: the one given, or ``images`` beside the model.

    Raises:
        CaptureError: there is none.
    """
    folder = images or _beside(model, IMAGES)
    if folder is None or not folder.is_dir():
        missing = f"no folder {IMAGES!r} is beside it" if folder is None else f"no folder {folder}"
        raise CaptureError(f"{model}: {missing}; give that of the photographs with --images.")
    return folder


def photographs(model: Path, views: Sequence[View], folder: Path) -> list[Path]:
    """Return the file of each image.

    Raises:
        CaptureError: a name leaves the folder, or a file is missing.
    """
    files = [inside(folder, view.name, _label(model, view)) for view in views]
    missing = [file for file in files if not file.is_file()]
    if missing:
        raise CaptureError(
            f"{folder}: {len(missing)} of {len(files)} photographs are missing, "
            f"{missing[0].relative_to(folder)} first; give their folder with --images."
        )
    return files


def masks_folder(model: Path, masks: Path | None) -> Path | None:
    """Return the folder of the masks, None if there is none beside the model.

    Raises:
        CaptureError: the folder that was given is not there.
    """
    if masks is not None and not masks.is_dir():
        raise CaptureError(f"{masks}: no such folder of masks.")
    return masks or _beside(model, MASKS)


def find_mask(folder: Path, name: Path) -> Path | None:
    """Return the mask of an image: ``name.jpg.png``, ``name.jpg``, or ``name`` with any suffix."""
    names = (f"{name}.png", name, *(name.with_suffix(suffix) for suffix in SUFFIXES))
    return next((folder / n for n in names if (folder / n).is_file()), None)


def model_in(path: Path) -> Path:
    """Return the folder of the sparse model, as ``find_model``.

    Raises:
        CaptureError: there is none.
    """
    model = find_model(path)
    if model is None:
        raise CaptureError(f"{path}: no COLMAP model; expected cameras.bin or .txt in sparse/0.")
    return model


def _label(model: Path, view: View) -> str:
    return f"{model}: image {view.name!r}"


def _pinhole(camera: Camera, label: str) -> tuple[tuple[float, float], tuple[float, float]]:
    pinhole = camera.pinhole()
    if pinhole is None:
        raise CaptureError(
            f"{label}: the lens is distorted ({camera.model}); svu import undistorts the "
            "photographs with --undistort."
        )
    return pinhole


def _beside(model: Path, name: str) -> Path | None:
    """Return a folder in the model's own or one of the two above, as far as projects nest it."""
    folders = [Path(os.path.normpath(model / up / name)) for up in (".", "..", "../..")]
    return next((folder for folder in folders if folder.is_dir()), None)


def _to_world(view: View) -> np.ndarray:
    w, x, y, z = view.rotation
    rotation = Rotation.from_quat([x, y, z, w]).as_matrix()
    camera_to_world = np.eye(4)
    camera_to_world[:3, :3] = rotation.T
    camera_to_world[:3, 3] = -rotation.T @ view.translation
    return camera_to_world @ OPENCV


def _view(name: str, camera: int, to_world: np.ndarray) -> View:
    camera_to_world = to_world @ OPENCV
    rotation = camera_to_world[:3, :3].T
    x, y, z, w = Rotation.from_matrix(rotation).as_quat().tolist()
    translation = -rotation @ camera_to_world[:3, 3]
    return View(name, camera, (w, x, y, z), tuple(translation.tolist()))


def _notes(model: Path, count: int) -> Iterator[str]:
    yield (
        f"{model}: {count} images. COLMAP's world has a unit and an up axis of its own; the mesh "
        "must be in it."
    )
    if model.name == "0" and is_model(model.parent / "1"):
        yield f"{model.parent}: holds several models, parts of a whole; 0 is taken."
