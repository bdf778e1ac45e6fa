"""RAW photographs, developed linearly by LibRaw."""

from pathlib import Path
from typing import Any

import numpy as np

from svu_mi.capture.image_formats.color_space import REC_709, ColorSpace, rgb_to_xyz
from svu_mi.capture.image_formats.image_header import ImageHeader, require_plausible, required
from svu_mi.core.silence_openexr import quiet

ORIENTATION_OF_FLIP = {0: 1, 3: 3, 5: 8, 6: 6}  # EXIF orientation by LibRaw's flip
NO_MATRIX = "LibRaw has no colour matrix of this camera; colours are not converted."


def open_raw(path: Path) -> ImageHeader:
    """Read the header of a RAW photograph."""
    rawpy = required("rawpy", path)
    with quiet, rawpy.RawPy() as raw:
        raw.open_file(str(path))
        sizes = raw.sizes
        require_plausible(path, (sizes.raw_width, sizes.raw_height), 2)
        color = _color_space(raw)  # unpacks the pixels
    remarks = () if color.matrix is not None else (NO_MATRIX,)
    return ImageHeader(
        size=(sizes.width, sizes.height), bits=16, color=color,
        orientation=ORIENTATION_OF_FLIP.get(sizes.flip, 1), remarks=remarks,
    )  # fmt: skip


def read_raw(path: Path, _: ImageHeader) -> np.ndarray:
    """Return (H, W, 3) uint16: linear colours of the camera, equal for white daylight.

    The black and white levels are those of the file. White balance is the same for all photographs
    of a camera, because their light is estimated, not removed.
    """
    rawpy = required("rawpy", path)
    with quiet, rawpy.RawPy() as raw:
        raw.open_file(str(path))
        raw.unpack()
        return raw.postprocess(
            gamma=(1, 1), no_auto_bright=True, output_bps=16, user_flip=0,
            output_color=rawpy.ColorSpace.raw, highlight_mode=rawpy.HighlightMode.Clip,
            adjust_maximum_thr=0.0,
        )  # fmt: skip


def _color_space(raw: Any) -> ColorSpace:
    """Return the conversion from white-balanced camera colours: LibRaw's, or that of a DNG."""
    to_camera = np.asarray(raw.rgb_xyz_matrix, np.float64)[:3] @ rgb_to_xyz(REC_709)
    if to_camera.any():
        matrix = np.linalg.inv(to_camera / to_camera.sum(axis=1, keepdims=True))
    else:
        matrix = np.asarray(raw.color_matrix, np.float64)[:, :3]
    if not matrix.any():
        return ColorSpace(transfer="linear")
    return ColorSpace("the camera's colours", "linear", matrix)
