"""Objects with Lighting, the data set of Ummenhofer et al. (3DV 2024).

Its README has the layout and the conventions, https://github.com/isl-org/objects-with-lighting:
pixels are ``K (R X + t)`` in OpenCV's axes with the centre of the first pixel at (0.5, 0.5),
photographs are ``255 (x 2^exposure)^(1/2.2)``, and environment maps have +Z at the top, +X in the
centre and +Y at u = 1/4 (``blender``).
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import mitsuba as mi
import numpy as np
from PIL import Image

from svu_mi.capture.images import IN_MASK, SATURATED
from svu_mi.capture.picture import decoded, quantized, read_planes
from svu_mi.capture.poses import affine
from svu_mi.errors import CaptureError, OptionError
from svu_mi.files import copy_file, prepare_folder, replacing
from svu_mi.formats.geometry import read_geometry
from svu_mi.formats.resampling import fitted
from svu_mi.formats.source import ENVIRONMENT_AXES, OPENCV, RIGID, Frame, Light, Source

INPUTS = "inputs"
PLACES = (INPUTS, f"test/{INPUTS}", ".")  # of the photographs: in a test, in an object, here
ROTATED, ENVIRONMENT, WORLD_TO_ENV = "env_512_rotated.hdr", "env.hdr", "world_to_env.txt"
EXPOSURE, BOX = "exposure.txt", "object_bounding_box.txt"
# The data has no mesh; the benchmark's own baseline puts its meshes here, with UVs and without.
MESHES = ("prepared_mesh", "neus_mesh")
MESH_SUFFIXES = (".obj", ".ply", ".glb", ".stl")
GAMMA = 2.2
STOPS = 64  # of exposure, either way
LARGEST = 1e12  # number, in any of the text files
LARGEST_TEXT = 2**16  # bytes
RULES = (
    "The benchmark gives the environment map for debugging, not for reconstruction: results found "
    "with it must not be entered there. Its masks are approximate."
)


def find_inputs(path: Path) -> Path | None:
    """Return the folder ``inputs`` of an object or of one of its tests; None without."""
    folders = [Path(os.path.normpath(path / place)) for place in PLACES]
    return next((f for f in folders if (f / EXPOSURE).is_file()), None)


def read_owl(path: Path) -> Source:
    """Read the photographs of an object that are for reconstruction, and their light.

    Args:
        path: the object's folder, ``test`` in it, or ``inputs`` in that.

    Raises:
        CaptureError: a file is missing or damaged, or a camera is no pinhole.
    """
    inputs = find_inputs(path)
    if inputs is None:
        raise CaptureError(
            f"{path}: no object of Objects with Lighting; expected test/{INPUTS}/{EXPOSURE}."
        )
    cameras = sorted(inputs.glob("camera_*.txt"))
    if not cameras:
        raise CaptureError(f"{inputs}: no camera_0000.txt, ...; copy the object again.")
    (stops,) = _numbers(inputs / EXPOSURE, 1)
    if abs(stops) > STOPS:
        raise CaptureError(
            f"{inputs / EXPOSURE}: an exposure of {stops:g} stops; it must be within {STOPS}: copy "
            "the file again."
        )
    test = Path(os.path.normpath(inputs / ".."))
    names = [test / f"{stem}{suffix}" for stem in MESHES for suffix in MESH_SUFFIXES]
    return Source(
        format="owl",
        root=test,
        frames=[_frame(camera, 2.0**stops) for camera in cameras],
        mesh=next((name for name in names if name.is_file()), None),
        light=_light(test),
        camera_axes=OPENCV,
        notes=(f"{test}: {len(cameras)} photographs. {RULES}",),
    )


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
        positions = read_geometry(source.mesh, geometry_only=True).mesh.positions
        corners = np.stack([positions.min(axis=0), positions.max(axis=0)], axis=-1)
        _write_text(inputs / BOX, corners.reshape(1, 6))
    if source.light is not None:
        planes, _ = read_planes(source.light.path)
        pixels = np.stack(planes[:3], axis=-1) * np.float32(source.light.scale)
        with replacing(test / ENVIRONMENT) as temporary:
            mi.Bitmap(np.ascontiguousarray(pixels)).write(str(temporary))
        world_to_env = ENVIRONMENT_AXES["blender"] @ source.light.to_world.T
        _write_text(test / WORLD_TO_ENV, affine(world_to_env))


def _frame(camera: Path, gain: float) -> Frame:
    values = np.array(_numbers(camera, 24)).reshape(8, 3)
    K, rotation, translation, size = values[:3], values[3:6], values[6], values[7]
    if np.abs(K[[0, 1, 2, 2], [1, 0, 0, 1]]).max() > 0 or K[2, 2] != 1:
        raise CaptureError(f"{camera}: the camera has skew; its K must be fx 0 cx 0 fy cy 0 0 1.")
    if (size != np.floor(size)).any():
        raise CaptureError(
            f"{camera}: a photograph of {size[0]:g} x {size[1]:g} pixels; width and height must be "
            "whole numbers: copy the file again."
        )
    try:
        to_world = np.linalg.inv(affine(rotation, translation)) @ OPENCV
    except np.linalg.LinAlgError as error:
        raise CaptureError(f"{camera}: R is no rotation; copy the file again.") from error
    image = camera.with_name(camera.name.replace("camera_", "image_")).with_suffix(".png")
    mask = image.with_name(image.name.replace("image_", "mask_"))
    if not image.is_file():
        raise CaptureError(f"{image}: no such photograph, but its camera; copy the object again.")
    return Frame(
        label=str(camera),
        image=image,
        mask=mask if mask.is_file() else None,
        to_world=to_world,
        focal=(K[0, 0], K[1, 1]),
        center=(K[0, 2], K[1, 2]),
        size=(int(size[0]), int(size[1])),
        exposure=gain,
        transfer="gamma 2.2",
    )


def _light(test: Path) -> Light | None:
    """Return the map turned into the world, or else the map as taken with its rotation."""
    axes = ENVIRONMENT_AXES["blender"]
    if (test / ROTATED).is_file():
        return Light(path=test / ROTATED, to_world=axes)
    if not (test / ENVIRONMENT).is_file():
        return None
    rotation = np.array(_numbers(test / WORLD_TO_ENV, 16)).reshape(4, 4)[:3, :3]
    is_rigid = np.allclose(rotation @ rotation.T, np.eye(3), atol=RIGID)
    if not is_rigid or np.linalg.det(rotation) < 0:
        raise CaptureError(f"{test / WORLD_TO_ENV}: is no rotation; copy the file again.")
    return Light(path=test / ENVIRONMENT, to_world=rotation.T @ axes)


def _radiance(frame: Frame) -> tuple[np.ndarray, np.ndarray | None]:
    """Return (H, W, 3) radiance, infinite where a pixel holds none, and the mask, (H, W)."""
    planes, is_integer = read_planes(frame.image)
    pixels = np.stack(planes[:3], axis=-1)
    radiance = (decoded(pixels, frame.transfer) if is_integer else pixels) / frame.exposure
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
    frame = fitted(frame, radiance.shape[1::-1])
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


def _numbers(path: Path, count: int) -> list[float]:
    """Read numbers from a text file.

    Raises:
        CaptureError: it is missing, or holds anything but that many numbers of a sane size.
    """
    try:
        with path.open(encoding="utf-8") as file:
            numbers = [float(word) for word in file.read(LARGEST_TEXT).split()]
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read ({error.strerror}).") from error
    except ValueError:
        numbers = []
    if len(numbers) != count or not (np.abs(numbers) < LARGEST).all():  # NaN fails, too
        wanted = "one number" if count == 1 else f"{count} numbers"
        raise CaptureError(f"{path}: must hold {wanted}; copy the file again.")
    return numbers
