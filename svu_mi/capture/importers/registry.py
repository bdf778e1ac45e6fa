"""Registry of formats: finds out which tool made a capture, and reads it.

A format is a module of this package with two functions. ``recognises(path, split)`` returns
whether a path is a capture of the format (splits may have separate files); ``read(path, options)``
returns a ``Source``. Modules are imported on first use, to keep the start of the command line fast.
"""

import importlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from svu_mi.core.validation import require_known
from svu_mi.errors import CaptureError, OptionError

if TYPE_CHECKING:
    from svu_mi.capture.importers.source import Source

    Format = str

# Module of each format, in the order of detection. Stanford-ORB also has transforms_train.json;
# AliceVision's file may be JSON, too; the COLMAP model next to tables of LLFF and IDR contains the
# lens.
FORMATS = {
    "stanford-orb": "stanford_orb",
    "alicevision": "alicevision",
    "transforms": "nerf",
    "colmap": "colmap.project",
    "llff": "llff",
    "idr": "idr",
    "owl": "objects_with_lighting",
}
AUTO = "auto"
SEARCHED = 100  # subfolders, if a folder has no known format
FOLDERS = (
    "alicevision",
    "transforms",
    "colmap",
    "llff",
    "idr",
)  # formats without a fixed layout of files
TABLES = ("llff", "idr")  # formats whose file may lie next to files of other formats

if not TYPE_CHECKING:
    Format: Any = Literal[(AUTO, *FORMATS)]


@dataclass(frozen=True, kw_only=True)
class ReadOptions:
    """Options of reading a source."""

    format: Format = AUTO
    """Format of the source; auto detects it. Set it if the folder contains several formats."""
    images: Path | None = None
    """Folder of the photographs, except for data sets with a fixed layout (default: paths in
    transforms.json; images or image near the poses)."""
    masks: Path | None = None
    """Folder of the masks, except for data sets with a fixed layout (default: only those named in
    transforms.json; for other formats masks or mask near the poses, if any)."""
    split: str = "train"
    """Part of the data set: train, test or val, in files or lists of their own; X of
    transforms_X.json; all, without regard to lists. Stanford-ORB: train, test, or the name of
    another capture of the same object."""
    environment_view: str | None = None
    """Stanford-ORB: test photograph whose environment map is the light (default: the first)."""
    original_world: bool = False
    """Undo nerfstudio's applied_transform, for a mesh from the photogrammetry before nerfstudio."""
    normalized: bool = False
    """IDR, NeuS: convert poses to the unit sphere of scale_mat. Use it for meshes of NeuS."""


def read_source(path: str | Path, options: ReadOptions | None = None) -> "Source":
    """Read the cameras and the file paths of a capture that another tool made.

    Args:
        path: file ``transforms.json``, ``cameras.sfm`` (Meshroom), ``poses_bounds.npy`` (LLFF),
            ``cameras_sphere.npz`` or ``cameras.npz`` (IDR, NeuS), or the folder that contains it;
            or the folder of a COLMAP project or model, a Stanford-ORB scene, or an object of
            Objects with Lighting.
        options: options of reading; defaults if None.

    Raises:
        CaptureError: the capture is missing, damaged, or of an unknown format.
        OptionError: the format is unknown, or does not support the options.

    Example:
        >>> from svu_mi.capture.importers.nerf import write_transforms
        >>> from svu_mi.capture.importers.source import frame_of
        >>> files = [capture.source / name for name in capture.names]
        >>> write_transforms("capture/transforms.json", map(frame_of, capture.sensors, files))
        >>> len(svu.read_source("capture/transforms.json").frames)
        12
    """
    path, options = Path(path), options or ReadOptions()
    kind = options.format or AUTO  # None means the same from Python
    require_known([kind], (AUTO, *FORMATS), "format")
    if not path.exists():
        raise CaptureError(
            f"{path}: no such file or folder; give that of a capture, such as my_colmap_project/."
        )
    recognised = kind == AUTO
    if recognised and path.is_file():
        _module("foreign_formats").refuse_foreign(path)
    if recognised:
        kind = next((name for name in FORMATS if _recognises(name, path, options.split)), AUTO)
    if kind == AUTO:
        inner = sorted(child for child in path.glob("*") if child.is_dir())
        for child in inner[:SEARCHED]:
            if any(_recognises(name, child, options.split) for name in FORMATS):
                raise CaptureError(f"{path}: contains a capture in {child}; import that folder.")
        _module("foreign_formats").refuse_foreign(path)
        raise CaptureError(
            f"{path}: not a capture of a known format; give a folder that contains "
            "transforms.json, cameras.sfm, a COLMAP model, poses_bounds.npy, cameras_sphere.npz, "
            "Stanford-ORB or Objects with Lighting."
        )
    if kind not in FOLDERS and (options.images or options.masks):
        raise OptionError(
            "--images and --masks are for transforms.json, Meshroom, COLMAP, LLFF and IDR, but "
            f"{path} is read as {kind}, whose files have fixed names; omit them."
        )
    source: Source = _module(FORMATS[kind]).read(path, options)
    others = [
        f"{path}: is read as {kind}, but also contains poses of {name}; --format {name} reads them."
        for name in (TABLES if recognised and kind not in TABLES else ())
        if _recognises(name, path, options.split)
    ]
    return replace(source, notes=[*source.notes, *others]) if others else source


def _recognises(name: str, path: Path, split: str) -> bool:
    return bool(_module(FORMATS[name]).recognises(path, split))


def _module(name: str) -> Any:
    return importlib.import_module(f"svu_mi.capture.importers.{name}")
