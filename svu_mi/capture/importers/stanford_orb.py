"""Importer of Stanford-ORB: real objects under several lights, with scans.

Kuang et al., Stanford-ORB: A Real-World 3D Object Inverse Rendering Benchmark (NeurIPS 2023).
A capture is an object in one place, such as ``teapot_scene001``:

    DATA/blender_HDR/CAPTURE/            or blender_LDR, with PNG instead of EXR
        train/0000.exr, train_mask/0000.png, test/..., test_mask/...
        transforms_{train,test,novel}.json
    DATA/ground_truth/CAPTURE/
        env_map/0000.exr                 one for each test photograph
        mesh_blender/mesh.obj, pseudo_gt_albedo/0000.png

Poses follow ``transforms.json``. Frames of ``novel`` are test photographs of the same object in
other places, ``scene_name``, with poses relative to the object of this capture. An environment map
is in the frame of its photograph's camera, with the viewing direction in its centre and +Y up, so
its ``to_world`` is the camera's rotation.
"""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from svu_mi.capture.image_io import open_image
from svu_mi.capture.importers.nerf import parse_frame, read_poses
from svu_mi.capture.importers.registry import ReadOptions
from svu_mi.capture.importers.source import OPENGL, Frame, Light, Source
from svu_mi.capture.importers.source_files import safe_path
from svu_mi.errors import CaptureError, OptionError

Split = Literal["train", "test", "novel"]

SUFFIXES = {"blender_HDR": ".exr", "blender_LDR": ".png"}
TRUTH = "ground_truth"
MESH = "mesh_blender/mesh.obj"
ENVIRONMENTS, ALBEDO = "env_map", "pseudo_gt_albedo"


@dataclass(frozen=True, kw_only=True)
class OrbView:
    """Photograph of the data set.

    Attributes:
        capture: name of the photograph's capture; ``novel`` views are from other captures.
        frame: photograph, mask and camera, in the world of the capture that was read.
        light: environment map; None if missing.
        albedo: path of a picture of the base colour (sRGB); None if missing.
    """

    capture: str
    frame: Frame
    light: Light | None
    albedo: Path | None

    @property
    def name(self) -> str:
        """Name of the photograph without suffix, such as ``0000``."""
        return self.frame.image.stem


def recognises(path: Path, _: str) -> bool:
    """Return whether a folder has the layout of this data set."""
    return path.absolute().parent.name in SUFFIXES and (path / _file("train")).is_file()


def read(path: Path, options: ReadOptions) -> Source:
    """Read a capture (see ``read_orb``)."""
    return read_orb(path, split=options.split, environment_view=options.environment_view)


def read_orb(
    path: str | Path, *, split: str = "train", environment_view: str | None = None
) -> Source:
    """Read a capture of Stanford-ORB.

    Args:
        path: path of the folder, ``DATA/blender_HDR/CAPTURE`` (or ``blender_LDR``).
        split: ``train``, ``test``, or the name of another capture of this object, for its
            ``novel`` views.
        environment_view: name of the test photograph, such as ``0003``, whose environment map is
            the light; the first one by default. Maps differ because people and clouds move.
    """
    path = Path(os.path.abspath(path))
    if split in ("train", "test"):
        views = read_views(path, "train" if split == "train" else "test")
        lit = read_views(path, "test") if split == "train" else views
    else:
        views = lit = tuple(v for v in read_views(path, "novel") if v.capture == split)
        if not views:
            raise OptionError(f"{path / _file('novel')}: has no photographs of {split!r}.")
    light, notes = _light(lit, environment_view, path)
    mesh = path.parent.parent / TRUTH / path.name / MESH
    if mesh.is_file():
        notes.append(
            f"{mesh}: the scans of this data set have normals rotated by 90 degrees (y and z "
            "exchanged); normals that contradict their triangles are recomputed."
        )
    return Source(
        format="stanford-orb",
        root=path.parent.parent,
        frames=tuple(view.frame for view in views),
        mesh=mesh if mesh.is_file() else None,
        light=light,
        camera_axes=OPENGL,
        notes=tuple(notes),
    )


def read_views(path: str | Path, split: Split) -> tuple[OrbView, ...]:
    """Read the photographs of a split (``train``, ``test``, ``novel``) with their environments.

    Photographs of ``train`` have no environment maps.
    """
    path = Path(os.path.abspath(path))
    if path.parent.name not in SUFFIXES:
        raise CaptureError(
            f"{path}: not a capture of Stanford-ORB; give DATA/blender_HDR/CAPTURE or "
            "DATA/blender_LDR/CAPTURE."
        )
    record, frames, _ = read_poses(path / _file(split))
    return tuple(
        _view(path, record, frame, f"{path / _file(split)}: frame {index}")
        for index, frame in enumerate(frames)
    )


def _file(split: Split) -> str:
    return f"transforms_{split}.json"


def _view(path: Path, record: dict[str, Any], given: Any, label: str) -> OrbView:
    root, kind = path.parent.parent, path.parent.name
    capture = safe_path(path.parent, given.get("scene_name", path.name), label)
    if capture.parent != path.parent:
        raise CaptureError(f"{label}: scene_name must be the name of a capture.")
    name = given.get("file_path")
    if not isinstance(name, str):
        raise CaptureError(f"{label}: file_path must be text.")
    image = safe_path(capture, name + SUFFIXES[kind], label)
    mask = image.parent.with_name(f"{image.parent.name}_mask") / f"{image.stem}.png"
    width, height = open_image(image).size
    files = {"file_path": image.relative_to(root).as_posix(), "w": width, "h": height}
    if mask.is_file():
        files["mask_path"] = mask.relative_to(root).as_posix()
    frame = parse_frame(record, {**given, **files}, root, label, np.eye(4))
    environment = root / TRUTH / capture.name / ENVIRONMENTS / f"{image.stem}.exr"
    albedo = root / TRUTH / capture.name / ALBEDO / f"{image.stem}.png"
    light = Light(path=environment, to_world=frame.to_world[:3, :3])
    return OrbView(
        capture=capture.name,
        frame=frame,
        light=light if environment.is_file() else None,
        albedo=albedo if albedo.is_file() else None,
    )


def _light(
    views: tuple[OrbView, ...], wanted: str | None, path: Path
) -> tuple[Light | None, list[str]]:
    """Return one of the environment maps, and a note about the choice."""
    lights = {view.name: view.light for view in views if view.light is not None}
    if not lights:
        folder = path.parent.parent / TRUTH / views[0].capture / ENVIRONMENTS
        return None, [f"{folder}: no environment map; give the light with --environment."]
    if wanted is not None and wanted not in lights:
        raise OptionError(
            f"{path}: no environment map for the test photograph {wanted!r}; use one of "
            f"{', '.join(lights)}."
        )
    chosen = wanted or next(iter(lights))
    note = (
        f"{path}: {len(lights)} environment maps, one per test photograph; the map of {chosen} "
        "is used for all."
    )
    return lights[chosen], [note] if len(lights) > 1 else []
