"""Undistortion of COLMAP photographs and masks by pycolmap.

Only needed for lenses outside of OpenCV's model (``lens_distortion``), such as fisheyes.

pycolmap runs in a separate process: it aborts on unexpected input, and its copy of zlib conflicts
with Pillow's. It only reads models and pictures that this package could decode.
"""

import importlib.util
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from svu_mi.capture.image_io import open_image, quantized
from svu_mi.capture.importers.colmap.project import IMAGES, MASKS, project_notes, read, read_project
from svu_mi.capture.importers.colmap.sparse_model import ColmapCamera, Pose, read_model, write_model
from svu_mi.capture.importers.registry import ReadOptions
from svu_mi.capture.importers.resampling import undistorted_frame
from svu_mi.capture.importers.source import Frame, Source
from svu_mi.capture.photographs import read_mask
from svu_mi.core.io.files import prepare_folder
from svu_mi.errors import CaptureError, SvuEnvironmentError, excerpt

KINDS = (".png", ".jpg", ".jpeg")  # COLMAP resamples eight bits
# A JPEG file is compressed a second time.
SCRIPT = "import sys, pycolmap; pycolmap.undistort_images(*sys.argv[1:], jpeg_quality=100)"
LONGEST = 160  # letters of pycolmap's reason in a message


def read_undistorted(path: Path, scratch: Path, options: ReadOptions) -> Source:
    """Read a project with undistorted copies of its photographs, which ``undistort`` writes."""
    made = undistort(path, scratch, images=options.images, masks=options.masks)
    project = read_project(path, options.images, options.masks)
    source = read(made, replace(options, images=None, masks=None))
    frames = []
    for frame in source.frames:
        name = frame.image.relative_to(made / IMAGES)
        label = f"{project.model}: image {excerpt(repr(name.as_posix()))}"
        frames.append(replace(frame, label=label, original=project.images / name))
    return replace(source, root=path, frames=frames, notes=[*project_notes(project)])


def undistort(
    path: Path, scratch: Path, *, images: Path | None = None, masks: Path | None = None
) -> Path:
    """Write an undistorted copy of a project, next to other files of an empty folder; return it.

    ``images`` and ``masks`` are folders as in ``project.read``. Without masks, alpha channels
    become masks.
    """
    if importlib.util.find_spec("pycolmap") is None:
        raise SvuEnvironmentError(
            "Photographs are undistorted by pycolmap, which is not installed: "
            "pip install 'svu_mi[colmap]'."
        )
    project = read_project(path, images, masks)
    views = [
        replace(view, name=file.relative_to(project.images).as_posix())
        for view, file in zip(project.views, project.photographs, strict=True)
    ]
    cameras = {view.camera: project.cameras[view.camera] for view in views}
    for number, camera in cameras.items():
        _require_one_to_one(camera, f"{project.model}: camera {number}")
    made, masked = scratch / "made", []
    made.mkdir()
    for view, file, given in zip(views, project.photographs, project.masks, strict=True):
        mask = _read_mask(cameras[view.camera], file, given)
        if mask is not None:
            masked.append(replace(view, name=f"{view.name}.png"))
            file = scratch / MASKS / masked[-1].name
            file.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(mask).save(file)
    straight = _run_pycolmap(cameras, views, project.images, scratch / "photographs")
    (straight / IMAGES).rename(made / IMAGES)
    (straight / "sparse").rename(made / "sparse")
    if masked:
        straight = _run_pycolmap(cameras, masked, scratch / MASKS, scratch / "shapes")
        (straight / IMAGES).rename(made / MASKS)
    return made


def _require_one_to_one(camera: ColmapCamera, label: str) -> None:
    """Raise CaptureError if the lens folds over: COLMAP would write rings."""
    lens = camera.lens()
    if lens is None:
        return
    focal, center = camera.intrinsics
    undistorted_frame(Frame(
        label=label, image=Path(), to_world=np.eye(4), focal=focal, center=center,
        size=(camera.width, camera.height), lens=lens,
    ))  # fmt: skip


def _read_mask(camera: ColmapCamera, file: Path, mask: Path | None) -> np.ndarray | None:
    """Read a photograph and return its mask, (H, W) uint8."""
    if file.suffix.lower() not in KINDS:
        raise CaptureError(
            f"{file}: COLMAP undistorts only {', '.join(KINDS)}; undistort the photographs first."
        )
    planes = replace(open_image(file), upright=False).planes()  # as COLMAP reads it
    given = planes[3] if planes[3:] else None
    height, width = planes[0].shape
    if (width, height) != (camera.width, camera.height):
        raise CaptureError(
            f"{file}: has {width} x {height} pixels, but its camera has {camera.width} x "
            f"{camera.height}; give the photographs that COLMAP was run on."
        )
    if mask is not None:
        given = read_mask(mask, (height, width)).astype(np.float32)
    return None if given is None else quantized(given)


def _run_pycolmap(
    cameras: Mapping[int, ColmapCamera], views: Sequence[Pose], pictures: Path, output: Path
) -> Path:
    """Run pycolmap; return its folder with ``images`` and ``sparse``."""
    model = prepare_folder(output / "distorted")
    write_model(model, cameras, views)
    arguments = [str(folder.absolute()) for folder in (output, model, pictures)]
    done = subprocess.run(
        [sys.executable, "-P", "-c", SCRIPT, *arguments],
        capture_output=True, text=True, errors="replace",
    )  # fmt: skip
    if done.returncode != 0:
        lines = done.stderr.strip().splitlines() or ["the process was killed"]
        reason = next((line for line in lines if "Check failed" in line), lines[-1])
        raise CaptureError(
            f"{pictures}: COLMAP cannot undistort them ({reason[-LONGEST:]}); check the cameras."
        )
    for camera in read_model(output / "sparse")[0].values():
        if not camera.is_pinhole:
            raise CaptureError(
                f"{pictures}: COLMAP cannot undistort cameras of model {camera.model}; undistort "
                "the photographs first."
            )
    return output
