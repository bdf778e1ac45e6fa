"""Any capture of another tool: find out what it is, and read it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from svu_mi.errors import CaptureError, OptionError
from svu_mi.formats.colmap import read_colmap
from svu_mi.formats.colmap.project import find_model
from svu_mi.formats.objects_with_lighting import find_inputs, read_owl
from svu_mi.formats.source import Source
from svu_mi.formats.stanford_orb import is_orb, read_orb
from svu_mi.formats.transforms import FILE, read_transforms
from svu_mi.settings import require_known

Format = Literal["transforms", "colmap", "stanford-orb", "owl"]


@dataclass(frozen=True, kw_only=True)
class ReadOptions:
    """How a source is read.

    Attributes:
        format: None = found by the files that are there.
        images: COLMAP: folder of the photographs.
        masks: COLMAP: folder of the masks.
        split: part of the data set: ``train`` or ``test``.
        environment_view: Stanford-ORB: name of the test photograph whose light is taken.
        original_world: transforms.json: undo nerfstudio's ``applied_transform``.
    """

    format: Format | None = None
    images: Path | None = None
    masks: Path | None = None
    split: str = "train"
    environment_view: str | None = None
    original_world: bool = False


def read_source(path: str | Path, options: ReadOptions | None = None) -> Source:
    """Read a capture.

    Args:
        path: ``transforms.json`` or its folder, a COLMAP project or model, a scene of Stanford-ORB
            or an object of Objects with Lighting.
        options: see there.

    Raises:
        CaptureError: it is missing, damaged, or none of these.
        OptionError: an unknown format, or folders that it has no use for.
    """
    path, options = Path(path), options or ReadOptions()
    if options.format is not None:
        require_known([options.format], get_args(Format), "format")
    if not path.exists():
        raise CaptureError(f"{path}: no such file or folder; give a capture to import.")
    kind = options.format or _guess(path, options.split)
    if kind != "colmap" and (options.images or options.masks):
        raise OptionError(
            f"--images and --masks are for COLMAP, but {path} is read as {kind}, which names its "
            "photographs and masks itself."
        )
    if kind == "colmap":
        return read_colmap(path, images=options.images, masks=options.masks)
    if kind == "stanford-orb":
        return read_orb(path, split=options.split, environment_view=options.environment_view)
    if kind == "owl":
        return read_owl(path)
    file = path if path.is_file() else _transforms_in(path, options.split)
    return read_transforms(file, original_world=options.original_world)


def _guess(path: Path, split: str) -> Format:
    if is_orb(path):  # it has transforms_train.json, too
        return "stanford-orb"
    if path.suffix.lower() == ".json" or _transforms_in(path, split).is_file():
        return "transforms"
    if find_model(path) is not None:
        return "colmap"
    if find_inputs(path) is not None:
        return "owl"
    raise CaptureError(
        f"{path}: no known capture; expected {FILE}, a COLMAP model, Stanford-ORB or Objects with "
        "Lighting. Say which with --format."
    )


def _transforms_in(folder: Path, split: str) -> Path:
    parts = folder / f"transforms_{split}.json"
    return parts if parts.is_file() else folder / FILE
