"""Importer of LLFF: ``poses_bounds.npy`` and the photographs in ``images``.

Mildenhall et al., Local Light Field Fusion (SIGGRAPH 2019), https://github.com/Fyusion/LLFF. Each
row has 17 numbers: a 3 x 5 matrix, row by row, and the distances of the nearest and the farthest
point. The matrix is [R | t | (height, width, focal)], camera to world; the columns of R are the
camera's axes down, right and backwards. The focal length is in pixels of a photograph of this
height and width. The format has no lens data: centred principal point, no distortion.
"""

from pathlib import Path

import numpy as np

from svu_mi.capture.importers.registry import ReadOptions
from svu_mi.capture.importers.source import DOWN_RIGHT_BACK, LARGEST, Frame, Source, pixels
from svu_mi.capture.importers.source_files import find_folder, find_masks, find_photographs
from svu_mi.capture.sensors import affine
from svu_mi.core.io.files import refusing
from svu_mi.core.io.npz import read_foreign_array
from svu_mi.core.io.schema import NUMBER, Axis, Field, checked
from svu_mi.core.validation import MAX_VIEWS

FILE, SUFFIX = "poses_bounds.npy", ".npy"
IMAGES, MASKS = ("images",), ("masks", "mask")
COLUMNS = 17  # of the table: a 3 x 5 matrix and two distances
POSES = Field(NUMBER, (Axis("photographs", 1, MAX_VIEWS), COLUMNS), -LARGEST, LARGEST)
LARGEST_FILE = 2**24  # bytes: ten times the poses of the most photographs


def recognises(path: Path, _: str) -> bool:
    """Return whether a path is an ``.npy`` file, or a folder with poses_bounds.npy."""
    file = path.suffix.lower() == SUFFIX and path.is_file()
    return file or (path / FILE).is_file()


def read(path: Path, options: ReadOptions) -> Source:
    """Read the poses of the photographs, which are sorted by name.

    Photographs may be resized with the same aspect ratio. Masks have the names of photographs with
    any suffix. Both are in folders next to the file by default.
    """
    file = path / FILE if path.is_dir() else path
    with refusing(file, "export them again"):
        table = {"poses": read_foreign_array(file, LARGEST_FILE)}
        rows = np.asarray(checked(table, {"poses": POSES})["poses"])
    root = file.parent
    files = find_photographs(root, options.images, IMAGES, file, len(rows))
    folder = find_folder("masks", options.masks, (root / name for name in MASKS))
    masks = find_masks(folder, [Path(file.name) for file in files])
    return Source(
        format="llff",
        root=root,
        frames=[
            _frame(row, image, mask, f"{file}: pose {index}")
            for index, (row, image, mask) in enumerate(zip(rows, files, masks, strict=True))
        ],
        camera_axes=DOWN_RIGHT_BACK,
        notes=[
            f"{file}: the poses have their own unit and up axis; the mesh must use the same. LLFF "
            "has no lens: photographs are assumed to be undistorted, with the principal point in "
            "their centre."
        ],
    )


def _frame(row: np.ndarray, image: Path, mask: Path | None, label: str) -> Frame:
    matrix = row[:15].reshape(3, 5)
    height, width, focal = map(float, matrix[:, 4])
    return Frame(
        label=label,
        image=image,
        mask=mask,
        to_world=affine(matrix[:, :3], matrix[:, 3]) @ DOWN_RIGHT_BACK,
        focal=(focal, focal),
        center=(width / 2, height / 2),
        size=pixels((width, height)),
    )
