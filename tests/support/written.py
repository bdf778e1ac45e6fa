"""Captures written in every format that can be imported."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import trimesh
from PIL import Image
from trimesh.visual.material import PBRMaterial

from support.colmap import write_colmap
from support.owl import write_owl
from support.photographs import white_of
from svu_mi.bench.orb.orb_results import OrbCapture, OrbPhotograph, write_orb
from svu_mi.calibration.checks.surface_samples import base_color
from svu_mi.capture.capture import Capture
from svu_mi.capture.image_io import quantized, srgb
from svu_mi.capture.importers.import_capture import ImportOptions
from svu_mi.capture.importers.mesh_files import read_textured_mesh
from svu_mi.capture.importers.mesh_materials import write_pictures
from svu_mi.capture.importers.nerf import write_transforms
from svu_mi.capture.importers.registry import Format
from svu_mi.capture.importers.source import Light, Source, frame_of
from svu_mi.capture.importers.stanford_orb import MESH, TRUTH
from svu_mi.capture.mesh import MeshArrays, arrays, flipped_v
from svu_mi.capture.scene import find_environment, to_world
from svu_mi.capture.sensors import affine
from svu_mi.core.io.exr import read_exr, write_exr
from svu_mi.core.io.files import prepare_folder
from svu_mi.light.environment import read_environment
from svu_mi.light.latlong import directions, radiance_from
from svu_mi.light.prefiltered import rasterized

PLACE = "object_scene001"  # name of a capture of Stanford-ORB
TEXTURE = 512  # texels per side
ROWS = 256  # of a map in the frame of a camera


@dataclass(frozen=True)
class Written:
    """Files of some tool.

    Attributes:
        path: what is given to ``svu import``.
        options: what the format has no place for.
    """

    path: Path
    options: ImportOptions


def write(capture: Capture, form: Format, folder: Path) -> Written:
    """Write a capture that has a folder of its own.

    Args:
        capture: HDR photographs with masks, poses, a textured mesh, and the light.
        form: of the files.
        folder: an empty one.

    Raises:
        OutputError: a file cannot be written.
    """
    parts, root = prepare_folder(folder / "parts"), prepare_folder(folder / form)
    source = source_of(capture, parts)
    if form == "owl":
        path = as_owl(root, source, exposure=-float(np.log2(white_of(capture))))
    elif form == "stanford-orb":
        path = as_orb(root, in_camera_frame(source, parts))
    else:
        path = WRITERS[form](root, source)
    is_whole = form in ("owl", "stanford-orb")
    return Written(path, ImportOptions() if is_whole else ImportOptions(
        mesh=source.mesh, environment=source.light))  # fmt: skip


def source_of(capture: Capture, folder: Path) -> Source:
    """Write mesh (GLB) and light (EXR) of a capture; its photographs stay where they are."""
    emitter = find_environment(capture.scene, "The scene")
    write_exr(folder / "light.exr", {"RGB": rasterized(read_environment(emitter))})
    assert capture.source is not None
    write_glb(folder / "mesh.glb", arrays(capture.shape), _texture(capture))
    return Source(
        format="svu",
        root=capture.source,
        frames=[
            frame_of(sensor, capture.source / name)
            for sensor, name in zip(capture.sensors, capture.names, strict=True)
        ],
        mesh=folder / "mesh.glb",
        light=Light(path=folder / "light.exr", to_world=to_world(emitter)[:3, :3]),
    )


def _texture(capture: Capture) -> np.ndarray:
    """Return the base colour of a capture's object as (TEXTURE, TEXTURE, 3) bytes, sRGB."""
    center = (np.arange(TEXTURE) + 0.5) / TEXTURE
    uv = np.stack(np.meshgrid(center, center), axis=-1).reshape(-1, 2)
    color = srgb(np.clip(base_color(capture.shape, uv), 0, 1))
    return quantized(color).reshape(TEXTURE, TEXTURE, 3)


def write_glb(path: Path, mesh: MeshArrays, base_color: np.ndarray) -> None:
    """Write a mesh with UVs and a texture, (H, W, 3) bytes."""
    assert mesh.uvs is not None
    uvs = flipped_v(mesh.uvs)  # trimesh has V upwards
    picture = Image.fromarray(base_color)
    material = PBRMaterial(baseColorTexture=picture, metallicFactor=0.0, roughnessFactor=1.0)
    visual = trimesh.visual.TextureVisuals(uvs, material)
    trimesh.Trimesh(
        mesh.positions, mesh.faces, vertex_normals=mesh.normals, visual=visual, process=False
    ).export(path)


def in_camera_frame(source: Source, folder: Path) -> Source:
    """Return the source with its light as the first camera sees it, as Stanford-ORB has it."""
    assert source.light is not None
    emitter = mi.load_dict({
        "type": "envmap",
        "filename": str(source.light.path),
        "to_world": mi.ScalarTransform4f(affine(source.light.to_world)),
    })  # fmt: skip
    pose = source.frames[0].to_world[:3, :3]
    grid = directions(2 * ROWS, ROWS)
    light = radiance_from(emitter, grid.reshape(-1, 3) @ pose.T).reshape(grid.shape)
    write_exr(folder / "camera.exr", {"RGB": light})
    return replace(source, light=Light(path=folder / "camera.exr", to_world=pose))


def as_transforms(root: Path, source: Source) -> Path:
    """Write transforms.json with the photographs beside it; return what is to be imported."""
    frames = []
    for frame in source.frames:
        shutil.copy(frame.image, root / frame.image.name)
        frames.append(replace(frame, image=root / frame.image.name))
    write_transforms(root / "transforms.json", frames)
    return root


def as_colmap(root: Path, source: Source) -> Path:
    """Write a project of COLMAP; return what is to be imported."""
    write_colmap(root, source)
    return root


def as_owl(root: Path, source: Source, exposure: float | None = None) -> Path:
    """Write an object of Objects with Lighting; return what is to be imported."""
    write_owl(root, source, exposure=exposure)
    return root


def as_orb(root: Path, source: Source) -> Path:
    """Write one capture of Stanford-ORB; return what is to be imported.

    Its test camera stands in the frame of the light.
    """
    assert source.light is not None and source.mesh is not None
    records = []
    for frame in source.frames:
        channels = read_exr(frame.image)
        image = np.stack([channels[name] for name in "RGB"], axis=-1)
        records.append(OrbPhotograph(image=image, mask=channels["A"], to_world=frame.to_world))
    light = np.stack([read_exr(source.light.path)[name] for name in "RGB"], axis=-1)
    test = replace(
        records[0], to_world=affine(source.light.to_world), environment=light,
        albedo=records[0].image,
    )  # fmt: skip
    first = source.frames[0]
    x_fov = 2 * np.degrees(np.arctan(first.size[0] / 2 / first.focal[0]))
    capture = OrbCapture(
        name=PLACE, x_fov=float(x_fov), world=np.eye(4), train=records, test=[test]
    )
    geometry = read_textured_mesh(source.mesh)
    write_orb(root, geometry.mesh, [capture])
    if "base_color" in geometry.textures:
        _paint(root / TRUTH / PLACE / MESH, geometry.textures["base_color"])
    return root / "blender_HDR" / PLACE


def _paint(mesh: Path, base_color: np.ndarray) -> None:
    """Give a texture to an OBJ file without a material."""
    write_pictures({"base_color": base_color}, mesh.parent)
    mesh.with_suffix(".mtl").write_text("newmtl paint\nmap_Kd base_color.png\n", encoding="utf-8")
    words = f"mtllib {mesh.stem}.mtl\nusemtl paint\n"
    mesh.write_text(words + mesh.read_text(encoding="utf-8"), encoding="utf-8")


WRITERS: dict[Format, Callable[[Path, Source], Path]] = {
    "transforms": as_transforms,
    "colmap": as_colmap,
    "owl": as_owl,
    "stanford-orb": as_orb,
}
