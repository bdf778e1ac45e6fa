"""Assets that other programs can use.

export_asset("out", "asset")
export_asset(Asset.of(capture, recovery, estimate), "asset", ExportOptions(bits=16))
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from svu_mi.export import glb, materialx, mitsuba_xml
from svu_mi.export.asset import RECORD, TEXTURES, Asset, Written
from svu_mi.export.charts import at_vertices, with_gutters
from svu_mi.export.images import write_exr_images, write_png_images
from svu_mi.export.options import ExportOptions
from svu_mi.export.reading import load_asset
from svu_mi.files import prepare_folder
from svu_mi.output.manifest import environment_record, write_manifest
from svu_mi.results.transaction import writing

FORMAT, VERSION = "svu-asset", 1
MODEL = "principled, specular 0.5 (F0 = 0.04), alpha = roughness^2: glTF's metallic-roughness"


def export_asset(
    asset: Asset | str | Path, folder: str | os.PathLike[str], options: ExportOptions | None = None
) -> Path:
    """Write an object with its textures for other programs.

    All of it takes the place of an older export in one step (``results.transaction``);
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


def _write(asset: Asset, folder: Path, options: ExportOptions) -> list[Written]:
    files, up = [], options.up or asset.up
    if "exr" in options.written:
        files += write_exr_images(asset, folder, half=options.half)
    if "png" in options.written:
        files += write_png_images(asset, folder, bits=options.bits)
    if "glb" in options.written:
        found = {name: at_vertices(asset.mesh, image) for name, image in asset.maps.items()}
        files.append(glb.write_asset_glb(asset, folder, found, up=up))
        if "entropy" in found:
            files.append(glb.write_entropy_glb(asset, folder, found["entropy"], up=up))
    if "xml" in options.written:
        files += mitsuba_xml.write_mitsuba(asset, folder, up=up)
    if "materialx" in options.written:
        files += materialx.write_materialx(asset, folder)
    return files


def _record(asset: Asset, options: ExportOptions, files: list[Written]) -> dict[str, Any]:
    """Return what ``asset.json`` says."""
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
