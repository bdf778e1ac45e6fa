"""Registry of formats: recognise and read a capture of another tool.

A format is a module of this package with two functions: ``recognises(path, split)`` says
whether a path is such a capture (splits may have separate files), and ``read(path, options)``
makes a ``Source`` of it. Modules are imported on first use, since the command line reads
this table at its start.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from svu_mi.core.validation import require_known
from svu_mi.errors import CaptureError, OptionError

if TYPE_CHECKING:
    from svu_mi.capture.importers.source import Source

    Format = str

# Module of each format, in the order of detection: Stanford-ORB has transforms_train.json, too, and
# LLFF's and IDR's tables are often made of a COLMAP model beside them, which knows the lens.
FORMATS = {
    "stanford-orb": "stanford_orb",
    "transforms": "nerf",
    "colmap": "colmap.project",
    "llff": "llff",
    "idr": "idr",
    "owl": "objects_with_lighting",
}
AUTO = "auto"
FOLDERS = ("colmap", "llff", "idr")  # formats without paths of photographs and masks
TABLES = ("llff", "idr")  # formats whose file may lie next to files of other formats

if not TYPE_CHECKING:
    Format: Any = Literal[(AUTO, *FORMATS)]


@dataclass(frozen=True, kw_only=True)
class ReadOptions:
    """Options of reading a source."""

    format: Format = AUTO
    """Format of the source; auto detects it."""
    images: Path | None = None
    """COLMAP, LLFF, IDR: folder of the photographs, such as images_4."""
    masks: Path | None = None
    """COLMAP, LLFF, IDR: folder of the masks."""
    split: str = "train"
    """Part of the data set: train, test, val, or X of transforms_X.json; Stanford-ORB: train,
    test, or another capture of the same object."""
    environment_view: str | None = None
    """Stanford-ORB: test photograph whose environment is the light; by default the first."""
    original_world: bool = False
    """Undo the applied_transform of nerfstudio."""
    normalized: bool = False
    """IDR, NeuS: poses in the unit sphere of scale_mat, as meshes of NeuS are."""


def read_source(path: str | Path, options: ReadOptions | None = None) -> Source:
    """Read a capture.

    Args:
        path: ``transforms.json``, ``poses_bounds.npy`` (LLFF), ``cameras_sphere.npz`` or
            ``cameras.npz`` (IDR, NeuS), the folder of one of these, a COLMAP project or model, a
            scene of Stanford-ORB or an object of Objects with Lighting.
        options: see there.

    Raises:
        CaptureError: it is missing, damaged, or none of these.
        OptionError: an unknown format, or folders that it has no use for.
    """
    path, options = Path(path), options or ReadOptions()
    kind = options.format or AUTO  # None means the same from Python
    require_known([kind], (AUTO, *FORMATS), "format")
    if not path.exists():
        raise CaptureError(f"{path}: no such file or folder; give a capture to import.")
    recognised = kind == AUTO
    if recognised:
        kind = next((name for name in FORMATS if _recognises(name, path, options.split)), AUTO)
    if kind == AUTO:
        raise CaptureError(
            f"{path}: not a known kind of capture; expected transforms.json, a COLMAP model, "
            "poses_bounds.npy, cameras_sphere.npz, Stanford-ORB or Objects with Lighting: choose "
            "one with --format."
        )
    if kind not in FOLDERS and (options.images or options.masks):
        raise OptionError(
            f"--images and --masks are for COLMAP, LLFF and IDR, but {path} is read as {kind}, "
            "which names its photographs and masks itself."
        )
    source: Source = _reader(kind).read(path, options)
    others = [
        f"{path}: is read as {kind}, but has poses of {name}, too; --format {name} reads these."
        for name in (TABLES if recognised and kind not in TABLES else ())
        if _recognises(name, path, options.split)
    ]
    return replace(source, notes=[*source.notes, *others]) if others else source


def _recognises(name: str, path: Path, split: str) -> bool:
    return bool(_reader(name).recognises(path, split))


def _reader(name: str) -> Any:
    return importlib.import_module(f"svu_mi.capture.importers.{FORMATS[name]}")
