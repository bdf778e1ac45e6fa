"""Export of textured meshes to other programs.

export_asset("out", "asset")
export_asset(Asset.of(capture, recovery, estimate), "asset", ExportOptions(bits=16))
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

from svu_mi.core.io.files import prepare_folder
from svu_mi.core.io.output_folder import writing
from svu_mi.core.validation import require, require_types
from svu_mi.output.export import asset_scenes, glb
from svu_mi.output.export.asset import RECORD, TEXTURES, Asset, AssetFile
from svu_mi.output.export.asset_images import write_exr_images, write_png_images
from svu_mi.output.export.load_asset import load_asset
from svu_mi.output.export.uv_gutters import at_vertices, with_gutters
from svu_mi.output.object_views import Axis
from svu_mi.output.run_record import environment_record, write_manifest

FORMAT, VERSION = "svu-asset", 1
MODEL = "principled, specular 0.5 (F0 = 0.04), alpha = roughness^2: glTF's metallic-roughness"
Format = Literal["exr", "png", "glb", "xml", "materialx"]
FORMATS: tuple[Format, ...] = get_args(Format)
NEEDS: dict[Format, Format] = {"xml": "exr", "materialx": "png"}
"""Formats that refer to textures in another, which is then written, too."""


@dataclass(frozen=True, kw_only=True)
class ExportOptions:
    """Files to write, and their formats."""

    formats: tuple[Format, ...] = FORMATS
    """``exr``: linear masters; ``png``: sRGB base colour, grey maps and the packed ``orm``;
    ``glb``: one file with mesh and textures, and another with entropy as vertex colours; ``xml``:
    an object for Mitsuba scenes and a preview; ``materialx``: ``standard_surface`` and an OBJ."""

    bits: int = 8
    """Of PNG, per channel: 8 or 16. The textures inside a GLB always have 8."""

    half: bool = False
    """EXR in half instead of single precision."""

    gutter: int | None = None
    """Texels that charts are carried on over their borders; None fills everything between them,
    which no reduction of the textures (mip-mapping) can look beyond."""

    up: Axis | None = None
    """Axis of the world that points upwards; None is the asset's own, as its cameras have it. glTF
    has +Y up: a +Z-up world is turned in the GLB, and there alone."""

    def __post_init__(self) -> None:
        require_types(self)
        known = all(name in FORMATS for name in self.formats)
        require(self, known and bool(self.formats), "formats", f"of {', '.join(FORMATS)}")
        require(self, self.bits in (8, 16), "bits", "8 or 16")
        fits = self.gutter is None or (type(self.gutter) is int and self.gutter >= 0)
        require(self, fits, "gutter", "None or a whole number, at least 0")
        require(self, self.up in (None, *get_args(Axis)), "up", "None, y or z")

    @property
    def written(self) -> tuple[Format, ...]:
        """The formats, and those they need."""
        needed = {*self.formats, *(NEEDS[name] for name in self.formats if name in NEEDS)}
        return tuple(name for name in FORMATS if name in needed)


def export_asset(
    asset: Asset | str | Path, folder: str | os.PathLike[str], options: ExportOptions | None = None
) -> Path:
    """Write an object with its textures for other programs.

    All of it takes the place of an older export in one step;
    ``asset.json`` says what each file is.

    Args:
        asset: an ``Asset``, or the folder that ``svu recover`` wrote.
        folder: made if missing.
        options: which files, and how.

    Returns:
        The path of ``asset.json``.

    Raises:
        CaptureError: the folder to read lacks something, or its maps belong to another mesh.
        MeshError: the mesh has no UVs, or they cannot carry texels.
        OutputError: a file cannot be written.
    """
    options = options or ExportOptions()
    asset = asset if isinstance(asset, Asset) else load_asset(asset)
    asset = with_gutters(asset, options.gutter)
    with writing(folder, "export", RECORD, capture=asset.capture) as draft:
        prepare_folder(draft.folder / TEXTURES)
        files = _write(asset, draft.folder, options)
        record = _record(asset, options, files)
        write_manifest(draft.folder / RECORD, {**record, **draft.entries()})
    return Path(folder) / RECORD


def _write(asset: Asset, folder: Path, options: ExportOptions) -> list[AssetFile]:
    files, up, formats = [], options.up or asset.up, options.written
    if "exr" in formats:
        files += write_exr_images(asset, folder, half=options.half)
    if "png" in formats:
        files += write_png_images(asset, folder, bits=options.bits)
    if "glb" in formats:
        vertex_maps = {name: at_vertices(asset.mesh, image) for name, image in asset.maps.items()}
        files.append(glb.write_asset_glb(asset, folder, vertex_maps, up=up))
        if "entropy" in vertex_maps:
            files.append(glb.write_entropy_glb(asset, folder, vertex_maps["entropy"], up=up))
    if "xml" in formats:
        files += asset_scenes.write_mitsuba(asset, folder, up=up)
    if "materialx" in formats:
        files += asset_scenes.write_materialx(asset, folder)
    return files


def _record(asset: Asset, options: ExportOptions, files: list[AssetFile]) -> dict[str, Any]:
    """Return the content of ``asset.json``."""
    low, high = asset.mesh.positions.min(axis=0), asset.mesh.positions.max(axis=0)
    return {
        "format": FORMAT,
        "version": VERSION,
        "name": asset.name,
        "source": asset.source,
        "files": files,
        "mesh": {
            "vertices": len(asset.mesh.positions),
            "triangles": len(asset.mesh.faces),
            "normals": asset.mesh.normals is not None,
            "two_sided": asset.two_sided,
            "bounds": [low, high],
            "up": options.up or asset.up,
        },
        "textures": {"resolution": asset.textures.resolution, "model": MODEL},
        "settings": options,
        "environment": environment_record(),
    }
