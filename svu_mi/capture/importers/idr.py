"""Importer of IDR and NeuS: ``cameras_sphere.npz``, ``image`` and ``mask``.

Yariv et al., Multiview Neural Surface Reconstruction (NeurIPS 2020). The arrays follow its
DATA_CONVENTION.md, https://github.com/lioryariv/idr; NeuS uses the same:

    world_mat_0, world_mat_1, ...    (4, 4), rows K [R | t] and 0 0 0 1: maps world points to pixels
                                     times depth, in OpenCV's axes
    scale_mat_0, scale_mat_1, ...    (4, 4), maps the unit sphere to the sphere around the object in
                                     the world; all are equal

Photographs and masks are assigned to matrices in the order of their names. Both programs trace the
ray of pixel (0, 0) through the point (0, 0), the centre of the first pixel, as in OpenCV.
"""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import scipy

from svu_mi.capture.image_io import open_image
from svu_mi.capture.importers.registry import ReadOptions
from svu_mi.capture.importers.source import LARGEST, OPENCV, RIGID, Frame, Source
from svu_mi.capture.importers.source_files import find_folder, find_photographs
from svu_mi.capture.match_photographs import list_pictures
from svu_mi.capture.sensors import affine
from svu_mi.core.io.files import refusing
from svu_mi.core.io.npz import read_foreign_arrays
from svu_mi.core.io.schema import NUMBER, Field, checked
from svu_mi.core.validation import MAX_VIEWS
from svu_mi.errors import CaptureError, OptionError

FILES, SUFFIX = ("cameras_sphere.npz", "cameras.npz"), ".npz"
IMAGES, MASKS = ("image", "images"), ("mask", "masks")
WORLD, SCALE = "world_mat", "scale_mat"
NUMBERED = re.compile(rf"(?:{WORLD}|{SCALE})_(?:0|[1-9][0-9]{{0,5}})", re.ASCII)
LARGEST_FILE = 2**26  # bytes: 100 000 cameras and their inverses
MATRIX = Field(NUMBER, (4, 4), -LARGEST, LARGEST)
SKEW = 1e-3  # largest ignored skew, relative to the focal length
SINGULAR = 1e-12  # smallest singular value of a camera, relative to its largest
SAME = 1e-4  # relative tolerance of the equality of unit spheres
FIRST_PIXEL = 0.5  # centre of the first pixel; its corner is (0, 0) in ``Frame``


def recognises(path: Path, _: str) -> bool:
    """Return whether a path is an ``.npz`` file, or a folder with one of ``FILES``."""
    file = path.suffix.lower() == SUFFIX and path.is_file()
    return file or any((path / name).is_file() for name in FILES)


def read(path: Path, options: ReadOptions) -> Source:
    """Read the cameras of the photographs, which are sorted by name.

    Masks are assigned by their order, too. Photographs and masks are next to the file by default.
    """
    files = (path / name for name in FILES if (path / name).is_file())
    file = next(files, path / FILES[0]) if path.is_dir() else path
    worlds, sphere = _matrices(file)
    if sphere is None and options.normalized:
        raise OptionError(f"{file}: has no {SCALE}_0; omit --normalized.")
    root = file.parent
    images = find_photographs(root, options.images, IMAGES, file, len(worlds))
    shapes = _masks(find_folder("masks", options.masks, (root / name for name in MASKS)), images)
    turn = sphere if sphere is not None and options.normalized else np.eye(4)
    return Source(
        format="idr",
        root=root,
        frames=[
            _frame(world @ turn, image, mask, f"{file}: {WORLD}_{index}")
            for index, (world, image, mask) in enumerate(zip(worlds, images, shapes, strict=True))
        ],
        camera_axes=OPENCV,
        notes=_notes(file, sphere, options.normalized),
    )


def _matrices(file: Path) -> tuple[list[np.ndarray], np.ndarray | None]:
    """Return all ``world_mat``, and the common ``scale_mat`` or None."""
    fix = (
        f"write the cameras again, with {WORLD}_0, {WORLD}_1, ... and all or none of {SCALE}_0, ..."
    )
    with refusing(file, fix):
        arrays = read_foreign_arrays(file, NUMBERED, LARGEST_FILE, 2 * MAX_VIEWS)
        kinds = (WORLD, SCALE) if any(name.startswith(SCALE) for name in arrays) else (WORLD,)
        count = max(sum(name.startswith(WORLD) for name in arrays), 1)
        checked(arrays, {f"{kind}_{k}": MATRIX for kind in kinds for k in range(count)})
        for name, matrix in arrays.items():
            if matrix.shape != (4, 4) or not np.allclose(matrix[3], [0, 0, 0, 1]):
                raise ValueError(f"the last row of {name} must be 0 0 0 1")
    worlds = [arrays[f"{WORLD}_{k}"] for k in range(count)]
    if SCALE not in kinds:
        return worlds, None
    spheres = [arrays[f"{SCALE}_{k}"] for k in range(count)]
    sphere = spheres[0]
    size = np.cbrt(max(np.linalg.det(sphere[:3, :3]), 0.0))
    if not 0 < size < LARGEST or not np.allclose(
        sphere[:3, :3].T @ sphere[:3, :3] / size**2, np.eye(3), atol=RIGID
    ):
        raise CaptureError(
            f"{file}: {SCALE}_0 must be a positive uniform scale and a translation; normalize the "
            "cameras again."
        )
    for index, other in enumerate(spheres):
        if np.abs(other - sphere).max() > SAME * np.abs(sphere).max():
            raise CaptureError(
                f"{file}: {SCALE}_{index} differs from {SCALE}_0, but all photographs need the "
                "same unit sphere; normalize the cameras again."
            )
    return worlds, sphere


def _frame(matrix: np.ndarray, image: Path, mask: Path | None, label: str) -> Frame:
    K, to_world = decompose_projection(matrix[:3], label)
    return Frame(
        label=label,
        image=image,
        mask=mask,
        to_world=to_world @ OPENCV,
        focal=(float(K[0, 0]), float(K[1, 1])),
        center=(float(K[0, 2]) + FIRST_PIXEL, float(K[1, 2]) + FIRST_PIXEL),
        size=open_image(image).size,
    )


def decompose_projection(matrix: np.ndarray, label: str) -> tuple[np.ndarray, np.ndarray]:
    """Decompose a projection matrix (3, 4), world to pixel times depth, into K and pose.

    Returns:
        K (3, 3), upper triangular with positive focal lengths and K[2, 2] = 1, and the pose
        (4, 4), camera to world in OpenCV's axes. A positive factor of the matrix has no effect.
    """
    left = matrix[:, :3] / max(np.abs(matrix[:, :3]).max(), 1 / LARGEST)
    values = np.linalg.svd(left, compute_uv=False)
    if values[-1] <= SINGULAR * values[0]:
        raise CaptureError(
            f"{label}: is singular, not a camera matrix K [R | t]; calibrate it again."
        )
    if np.linalg.det(left) < 0:
        raise CaptureError(
            f"{label}: is mirrored (determinant < 0), not K [R | t] with a rotation R and "
            "positive focal lengths; write it again from a right-handed camera, or negate it."
        )
    K, rotation = scipy.linalg.rq(left)
    signs = np.sign(np.diag(K))  # RQ does not determine signs: K S and S R have the same product
    K, rotation = K * signs, signs[:, None] * rotation
    K = K / K[2, 2]
    if not abs(K[0, 1]) <= SKEW * K[0, 0]:
        raise CaptureError(
            f"{label}: the camera has a skew of {K[0, 1]:.3g} for a focal length of {K[0, 0]:.5g} "
            "pixels; calibrate it without skew, or resample the photographs."
        )
    eye = -np.linalg.solve(matrix[:, :3], matrix[:, 3])
    return K, affine(rotation.T, eye)


def _masks(folder: Path | None, files: Sequence[Path]) -> Sequence[Path | None]:
    """Return the masks sorted by name; in DTU, their names differ from the photographs'."""
    if folder is None:
        return [None] * len(files)
    masks = list_pictures(folder)
    if len(masks) != len(files):
        raise CaptureError(
            f"{folder}: has {len(masks)} masks for {len(files)} photographs; add the missing "
            "masks, or give another folder with --masks."
        )
    return masks


def _notes(file: Path, sphere: np.ndarray | None, normalized: bool) -> list[str]:
    if sphere is None:
        return []
    size, center = np.cbrt(np.linalg.det(sphere[:3, :3])), sphere[:3, 3]
    where = f"scale {size:.6g} and centre {', '.join(f'{c:.6g}' for c in center)}"
    note = f"the unit sphere of {SCALE} ({where})"
    if normalized:
        note = f"{note}; a mesh in the world of {WORLD} needs an import without --normalized."
    else:
        note = f"the world of {WORLD}; a mesh in {note}, as meshes of NeuS are, needs --normalized."
    return [f"{file}: poses are in {note}"]
