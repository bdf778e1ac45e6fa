"""Write captures in the layout of Objects with Lighting, as ``objects_with_lighting`` reads it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import mitsuba as mi
import numpy as np
from PIL import Image

from support.photographs import copy_file
from svu_mi.capture.image_io import quantized, read_planes
from svu_mi.capture.importers.mesh_files import read_textured_mesh
from svu_mi.capture.importers.objects_with_lighting import (
    ENVIRONMENT,
    EXPOSURE,
    INPUTS,
    MESHES,
    STOPS,
    WORLD_TO_ENV,
)
from svu_mi.capture.importers.resampling import with_size
from svu_mi.capture.importers.source import ENVIRONMENT_AXES, OPENCV, Frame, Source
from svu_mi.capture.photographs import IN_MASK, SATURATED
from svu_mi.capture.sensors import affine
from svu_mi.capture.tone_curve import linearize
from svu_mi.core.io.files import prepare_folder, replacing
from svu_mi.errors import OptionError

BOX = "object_bounding_box.txt"
GAMMA = 2.2


def write_owl(root: Path, source: Source, *, exposure: float | None = None) -> None:
    """Write an object with its ``test`` folder: photographs, masks, mesh and light.

    The light is written as it is, with ``world_to_env.txt``, and not resampled. Of the mesh, the
    one file is copied, not what it refers to. Nothing is written for evaluation.

    Args:
        root: the object's folder, made if missing.
        source: the capture.
        exposure: stops by which radiance is brighter in the photographs; what exceeds 1 then is
            clipped, and pixels that hold no radiance are white. None = as bright as can be while
            nothing on the object is clipped.

    Raises:
        CaptureError: a photograph, a mask or the light cannot be read.
        MeshError: the mesh cannot be read.
        OptionError: no such exposure.
        OutputError: a file cannot be written.
    """
    exposure = _fitting_exposure(source.frames) if exposure is None else exposure
    if not abs(exposure) <= STOPS:  # NaN fails, too
        raise OptionError(f"An exposure must be within {STOPS} stops, got {exposure}.")
    test = prepare_folder(root / "test")
    inputs = prepare_folder(test / INPUTS)
    for index, frame in enumerate(source.frames):
        _write_frame(inputs, index, frame, exposure)
    _write_text(inputs / EXPOSURE, [[exposure]])
    if source.mesh is not None:
        copy_file(source.mesh, test / f"{MESHES[1]}{source.mesh.suffix.lower()}")
        positions = read_textured_mesh(source.mesh, geometry_only=True).mesh.positions
        corners = np.stack([positions.min(axis=0), positions.max(axis=0)], axis=-1)
        _write_text(inputs / BOX, corners.reshape(1, 6))
    if source.light is not None:
        planes, _ = read_planes(source.light.path)
        pixels = np.stack(planes[:3], axis=-1) * np.float32(source.light.scale)
        with replacing(test / ENVIRONMENT) as temporary:
            mi.Bitmap(np.ascontiguousarray(pixels)).write(str(temporary))
        world_to_env = ENVIRONMENT_AXES["blender"] @ source.light.to_world.T
        _write_text(test / WORLD_TO_ENV, affine(world_to_env))


def _radiance(frame: Frame) -> tuple[np.ndarray, np.ndarray | None]:
    """Return (H, W, 3) radiance, infinite where a pixel holds none, and the mask, (H, W)."""
    planes, is_integer = read_planes(frame.image)
    colors = [
        linearize(plane, frame.transfer, channel) if is_integer else plane
        for channel, plane in enumerate(planes[:3])
    ]
    radiance = np.stack(colors, axis=-1) / frame.exposure
    radiance[~(np.isfinite(radiance) & (radiance >= 0)).all(axis=-1)] = np.inf
    mask = read_planes(frame.mask)[0][0] if frame.mask else planes[3] if planes[3:] else None
    return radiance, mask


def _fitting_exposure(frames: Sequence[Frame]) -> float:
    brightest = float(np.finfo(np.float32).tiny)
    for frame in frames:
        radiance, mask = _radiance(frame)
        peaks = radiance.max(axis=-1)[... if mask is None else mask >= IN_MASK]
        peaks = peaks[np.isfinite(peaks)]
        brightest = max(brightest, float(peaks.max(initial=0)))
    return float(np.clip(np.log2(SATURATED[8] ** GAMMA / brightest), -STOPS, STOPS))


def _write_frame(inputs: Path, index: int, frame: Frame, exposure: float) -> None:
    radiance, mask = _radiance(frame)
    frame = with_size(frame, radiance.shape[1::-1])
    tone = np.clip(radiance * 2.0**exposure, 0, 1) ** (1 / GAMMA)
    _write_png(inputs / f"image_{index:04d}.png", tone)
    if mask is not None:
        _write_png(inputs / f"mask_{index:04d}.png", mask)
    K = [[frame.focal[0], 0, frame.center[0]], [0, frame.focal[1], frame.center[1]], [0, 0, 1]]
    world_to_camera = np.linalg.inv(frame.to_world @ OPENCV)[:3]
    rotation, translation = world_to_camera[:, :3], world_to_camera[:, 3]
    rows = [*K, *rotation, translation, [*frame.size, 3]]
    _write_text(inputs / f"camera_{index:04d}.txt", rows)


def _write_png(path: Path, values: np.ndarray) -> None:
    with replacing(path) as temporary:
        Image.fromarray(quantized(values)).save(temporary)


def _write_text(path: Path, rows: Sequence[Sequence[float]] | np.ndarray) -> None:
    with replacing(path) as temporary:
        np.savetxt(temporary, np.array(rows, np.float64))
