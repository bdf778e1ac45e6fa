"""COLMAP projects: a sparse model and its photographs as a ``Source``.

COLMAP's camera space is +X right, +Y down, +Z forward (``OPENCV``), poses are world to camera, and
the centre of the first pixel is (0.5, 0.5). World axes and unit are arbitrary.
"""

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy

from svu_mi.capture.importers.colmap.sparse_model import (
    ColmapCamera,
    Pose,
    count_images,
    is_model,
    read_model,
    read_points,
)
from svu_mi.capture.importers.registry import ReadOptions
from svu_mi.capture.importers.source import OPENCV, Frame, Source
from svu_mi.capture.importers.source_files import (
    find_file,
    find_folder,
    find_masks,
    missing_folder,
    substitutions,
)
from svu_mi.capture.sensors import affine
from svu_mi.errors import CaptureError, are, counted, excerpt

# Undistorted models come before their distorted originals; both have the same world.
# nerfstudio keeps the project in colmap/, next to the photographs.
# A place with a number may have several models, of parts of the scene that COLMAP did not connect.
NUMBER = "[0-9]*"
PLACES = (
    "dense/sparse", f"dense/{NUMBER}/sparse", f"sparse/{NUMBER}", "sparse",
    f"colmap/sparse/{NUMBER}", ".", NUMBER,
)  # fmt: skip
IMAGES, MASKS = "images", "masks"
SHOWN = 5  # other models in a note


@dataclass(frozen=True, kw_only=True)
class Project:
    """Sparse model: cameras by their id, and V views sorted by name.

    ``others`` are models of other parts of the scene. ``images`` is the folder of the V
    photographs; ``masks`` contains None for missing masks.
    """

    model: Path
    others: Sequence[Path]
    cameras: dict[int, ColmapCamera]
    views: Sequence[Pose]
    images: Path
    photographs: Sequence[Path]
    masks: Sequence[Path | None]


def recognises(path: Path, _: str) -> bool:
    """Return whether a folder contains a sparse model."""
    return bool(_find_models(path))


def read(path: Path, options: ReadOptions) -> Source:
    """Read a sparse model; its views are sorted by name.

    ``path`` is the folder of the model, the folder ``sparse`` that contains its ``0``, or a project
    with ``sparse/0``, ``sparse`` or ``dense/sparse``. Of several models ``0``, ``1``, ..., the one
    with most images is read. By default, ``images`` and ``masks`` are near the model. For
    names of masks, see ``find_mask``.
    """
    project = read_project(path, options.images, options.masks, partly=True)
    frames = []
    for view, image, mask in zip(project.views, project.photographs, project.masks, strict=True):
        camera = project.cameras[view.camera]
        lens = camera.lens()
        if lens is None and not camera.is_pinhole:
            raise CaptureError(
                f"{project.model}: camera {view.camera}: the lens is distorted ({camera.model}); "
                "svu import undistorts the photographs with --undistort."
            )
        focal, center = camera.intrinsics
        w, x, y, z = view.rotation
        rotation = scipy.spatial.transform.Rotation.from_quat([x, y, z, w]).as_matrix()
        with np.errstate(invalid="ignore"):  # an infinite pose is refused with all others
            to_world = affine(rotation.T, -rotation.T @ view.translation) @ OPENCV
        frames.append(Frame(
            label=_label(project.model, view),
            image=image,
            mask=mask,
            to_world=to_world,
            focal=focal,
            center=center,
            size=(camera.width, camera.height),
            lens=lens,
        ))  # fmt: skip
    pairs = [(view.name, f) for view, f in zip(project.views, project.photographs, strict=True)]
    moved = substitutions(str(project.model), project.images, pairs)
    return Source(
        format="colmap",
        root=path,
        frames=frames,
        camera_axes=OPENCV,
        points=read_points(project.model),
        notes=[*project_notes(project), *moved],
    )


def _find_models(path: Path) -> list[Path]:
    """Return the folders of sparse models in the first of ``PLACES`` that has any, by number."""
    for place in PLACES:
        folders = [path] if place == "." else path.glob(place)
        if models := [Path(os.path.normpath(folder)) for folder in folders if is_model(folder)]:
            return sorted(models, key=lambda model: (len(str(model)), model))
    return []


def read_project(
    path: Path, images: Path | None, masks: Path | None, *, partly: bool = False
) -> Project:
    """Read a model and find its pictures; with ``partly``, photographs may be missing.

    Paths are as in ``read``.
    """
    models = _find_models(path)
    if not models:
        raise CaptureError(f"{path}: not a COLMAP model; expected cameras.bin or .txt in sparse/0.")
    model = max(models, key=count_images) if len(models) > 1 else models[0]
    cameras, views = read_model(model)
    images = find_folder(IMAGES, images, _possible_folders(model, IMAGES))
    if images is None:
        raise missing_folder(IMAGES, model / IMAGES)
    masks = find_folder(MASKS, masks, _possible_folders(model, MASKS))
    files = [find_file(images, view.name, _label(model, view)) for view in views]
    missing = [file for file in files if not file.is_file()]
    if missing and not (partly and len(missing) < len(files)):
        raise CaptureError(
            f"{images}: {len(missing)} of {len(files)} photographs {are(len(missing))} missing, "
            f"first {excerpt(missing[0].relative_to(images))}; give their folder with --images."
        )
    return Project(
        model=model,
        others=[other for other in models if other != model],
        cameras=cameras,
        views=views,
        images=images,
        photographs=files,
        masks=find_masks(masks, [file.relative_to(images) for file in files]),
    )


def _label(model: Path, view: Pose) -> str:
    return f"{model}: image {excerpt(repr(view.name))}"


def _possible_folders(model: Path, name: str) -> list[Path]:
    """Return possible paths of the folder ``name``: in the model, and in its parents."""
    nested = model.absolute().parts[-3:-2] == ("colmap",)
    ways = (".", "..", "../..", *(["../../.."] if nested else []))
    return [Path(os.path.normpath(model / up / name)) for up in ways]


def project_notes(project: Project) -> Iterator[str]:
    """Yield sentences about the model that was chosen."""
    images = counted(len(project.views), "image")
    yield (
        f"{images} of COLMAP; its world has its own unit and up axis, and the mesh must use the "
        "same."
    )
    if project.others:
        counts = ", ".join(f"{other} has {count_images(other)}" for other in project.others[:SHOWN])
        yield (
            f"{project.model}: the largest of {len(project.others) + 1} models of parts of the "
            f"scene is used, with {images} ({counts}); to use another, import "
            "its folder instead."
        )
