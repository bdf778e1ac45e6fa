"""Importer of Objects with Lighting, the data set of Ummenhofer et al. (3DV 2024).

Layout and conventions are in its README, https://github.com/isl-org/objects-with-lighting:
pixels are ``K (R X + t)`` in OpenCV's axes with the centre of the first pixel at (0.5, 0.5),
photographs are ``255 (x 2^exposure)^(1/2.2)``, and environment maps have +Z at the top, +X in the
centre and +Y at u = 1/4 (``blender``).
"""

import os
from pathlib import Path

import numpy as np

from svu_mi.capture.importers.registry import ReadOptions
from svu_mi.capture.importers.source import (
    ENVIRONMENT_AXES,
    OPENCV,
    RIGID,
    Frame,
    Light,
    Source,
    pixels,
)
from svu_mi.capture.importers.source_files import read_lines
from svu_mi.capture.sensors import affine
from svu_mi.core.io.files import refusing
from svu_mi.core.io.schema import NUMBER, Field, checked
from svu_mi.core.validation import require_views
from svu_mi.errors import CaptureError, counted

INPUTS = "inputs"
# Places of photographs, relative to a test, to an object, and to itself.
PLACES = (INPUTS, f"test/{INPUTS}", ".")
ROTATED, ENVIRONMENT, WORLD_TO_ENV = "env_512_rotated.hdr", "env.hdr", "world_to_env.txt"
EXPOSURE = "exposure.txt"
# The data has no mesh; the baseline of the benchmark writes these, with and without UVs.
MESHES = ("prepared_mesh", "neus_mesh")
MESH_SUFFIXES = (".obj", ".ply", ".glb", ".stl")
STOPS = 64  # limit of the exposure, positive or negative
LARGEST = 1e12  # limit of numbers in the text files
RULES = (
    "The environment map of the benchmark is for debugging: results that use it must not be "
    "submitted. Its masks are approximate."
)


def find_inputs(path: Path) -> Path | None:
    """Return the folder ``inputs`` of an object or of one of its tests; None if missing."""
    folders = [Path(os.path.normpath(path / place)) for place in PLACES]
    return next((f for f in folders if (f / EXPOSURE).is_file()), None)


def recognises(path: Path, _: str) -> bool:
    """Return whether a folder is an object of this data set."""
    return find_inputs(path) is not None


def read(path: Path, _: ReadOptions) -> Source:
    """Read the reconstruction photographs of an object, and their light.

    ``path`` is the object's folder, ``test`` in it, or ``inputs`` in that.
    """
    inputs = find_inputs(path)
    if inputs is None:
        raise CaptureError(
            f"{path}: not an object of Objects with Lighting; expected test/{INPUTS}/{EXPOSURE}."
        )
    cameras = sorted(inputs.glob("camera_*.txt"))
    if not cameras:
        raise CaptureError(f"{inputs}: no camera_0000.txt, ...; copy the object again.")
    require_views(len(cameras), f"{inputs}: cameras", CaptureError)
    (stops,) = _numbers(inputs / EXPOSURE, 1, STOPS)
    test = Path(os.path.normpath(inputs / ".."))
    names = [test / f"{stem}{suffix}" for stem in MESHES for suffix in MESH_SUFFIXES]
    return Source(
        format="owl",
        root=test,
        frames=[_frame(camera, 2.0**stops) for camera in cameras],
        mesh=next((name for name in names if name.is_file()), None),
        light=_light(test),
        camera_axes=OPENCV,
        notes=(f"{test}: {counted(len(cameras), 'photograph')}. {RULES}",),
    )


def _frame(camera: Path, gain: float) -> Frame:
    values = np.array(_numbers(camera, 24)).reshape(8, 3)
    K, rotation, translation, size = values[:3], values[3:6], values[6], values[7]
    if np.abs(K[[0, 1, 2, 2], [1, 0, 0, 1]]).max() > 0 or K[2, 2] != 1:
        raise CaptureError(f"{camera}: the camera has skew; its K must be fx 0 cx 0 fy cy 0 0 1.")
    with refusing(f"{camera}: R is not a rotation", "copy the file again"):
        to_world = np.linalg.inv(affine(rotation, translation)) @ OPENCV
    image = camera.with_name(camera.name.replace("camera_", "image_")).with_suffix(".png")
    mask = image.with_name(image.name.replace("image_", "mask_"))
    if not image.is_file():
        raise CaptureError(f"{image}: no such photograph for its camera; copy the object again.")
    return Frame(
        label=str(camera),
        image=image,
        mask=mask if mask.is_file() else None,
        to_world=to_world,
        focal=(K[0, 0], K[1, 1]),
        center=(K[0, 2], K[1, 2]),
        size=pixels(size[:2]),
        exposure=gain,
        transfer="gamma 2.2",
    )


def _light(test: Path) -> Light | None:
    """Return the map in world axes, else the original map and its rotation; None without any."""
    axes = ENVIRONMENT_AXES["blender"]
    if (test / ROTATED).is_file():
        return Light(path=test / ROTATED, to_world=axes)
    if not (test / ENVIRONMENT).is_file():
        return None
    rotation = np.array(_numbers(test / WORLD_TO_ENV, 16)).reshape(4, 4)[:3, :3]
    is_rigid = np.allclose(rotation @ rotation.T, np.eye(3), atol=RIGID)
    if not is_rigid or np.linalg.det(rotation) < 0:
        raise CaptureError(f"{test / WORLD_TO_ENV}: not a rotation; copy the file again.")
    return Light(path=test / ENVIRONMENT, to_world=rotation.T @ axes)


def _numbers(path: Path, count: int, largest: float = LARGEST) -> list[float]:
    """Read numbers from a text file."""
    with refusing(path, "copy the file again"):
        lines = read_lines(path, "a file of numbers", "copy it again")
        words = [float(word) for _, text in lines for word in text.split()]
        wanted = Field(NUMBER, (count,), -largest, largest)
        return list(checked({"content": words}, {"content": wanted})["content"])
