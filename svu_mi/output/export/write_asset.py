"""Export of textured meshes to other programs.

export_asset("out", "asset")
export_asset(Asset.of(capture, recovery, estimate), "asset", ExportOptions(bits=16))
"""

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
"""Formats that use the textures of another format, which is then written, too."""


@dataclass(frozen=True, kw_only=True)
class ExportOptions:
    """Formats of an exported asset.

    Example:
        >>> svu.ExportOptions(formats=("materialx",)).written
        ('png', 'materialx')
    """

    formats: tuple[Format, ...] = FORMATS
    """Formats to write; default: all. ``exr``: linear textures and maps. ``png``: base colour in
    sRGB, grey maps, packed ``orm``. ``glb``: mesh with textures in one file, entropy as vertex
    colours in another. ``xml``: object for Mitsuba scenes, and a preview. ``materialx``:
    ``standard_surface`` with an OBJ mesh. Choose fewer to save time and space."""

    bits: int = 8
    """Bits per channel of PNG files, 8 or 16; 16 avoids banding in smooth textures. Textures inside
    a GLB always have 8."""

    half: bool = False
    """Write EXR in half instead of single precision: half the size, about three digits."""

    gutter: int | None = None
    """Dilation of the charts in texels, at least 0. Default None fills all texels outside the
    charts, which is safe for mip-mapping; set a number to keep the space between charts."""

    up: Axis | None = None
    """Upward axis of the world, ``y`` or ``z``; default None derives it from the cameras. glTF has
    +Y up, so a world with another direction is rotated in the GLB, and only there. Set it if the
    object lies on its side."""

    def __post_init__(self) -> None:
        require_types(self)
        require(self, bool(self.formats), "formats", f"one or more of {', '.join(FORMATS)}")
        require(self, self.bits in (8, 16), "bits", "8 or 16")
        fits = self.gutter is None or (type(self.gutter) is int and self.gutter >= 0)
        require(self, fits, "gutter", "None or a whole number, at least 0")
        require(self, self.up in (None, *get_args(Axis)), "up", "None, y or z")

    @property
    def written(self) -> tuple[Format, ...]:
        """Formats to write, including the images that chosen formats refer to."""
        needed = {*self.formats, *(NEEDS[name] for name in self.formats if name in NEEDS)}
        return tuple(name for name in FORMATS if name in needed)


def export_asset(
    asset: Asset | str | Path, folder: str | os.PathLike[str], options: ExportOptions | None = None
) -> Path:
    """Write an object with its textures for other programs.

    An older export in the folder is replaced in one step. ``asset.json`` describes all files.

    Args:
        asset: Asset, or path of a folder that ``svu recover`` wrote.
        folder: Path of the folder; created if missing.
        options: Formats; default: all.

    Returns:
        Path of ``asset.json``.

    Raises:
        CaptureError: a file of the folder is missing, or its maps belong to another mesh.
        MeshError: the mesh has no UVs, or no texel lies on its charts.
        OutputError: a file cannot be written.

    Example:
        >>> asset = svu.Asset.of(capture, recovery, estimate)
        >>> path = svu.export_asset(asset, "asset", svu.ExportOptions(formats=("exr", "xml")))
        >>> path.name, (path.parent / "object.xml").is_file()
        ('asset.json', True)
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
