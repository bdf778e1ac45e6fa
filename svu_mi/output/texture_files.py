"""Recovered textures (EXR) and their scene ``recovered.xml``: reading and writing."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import svu_mi
from svu_mi.capture import scene_xml
from svu_mi.capture.capture import Capture
from svu_mi.capture.content_hash import capture_key, mesh_key
from svu_mi.capture.image_io import decoded, open_image
from svu_mi.capture.mesh import MeshArrays, arrays
from svu_mi.capture.normal_map import normal_map
from svu_mi.capture.replace_material import is_same, is_two_sided, other_shapes, with_normals
from svu_mi.capture.surroundings import path_length
from svu_mi.core.io.exr import read_exr, write_exr
from svu_mi.core.io.files import prepare_folder
from svu_mi.core.io.folder_exchange import restore
from svu_mi.core.io.provenance import marks_of, mesh_of, require_one_run, require_recovery
from svu_mi.core.io.schema import OBJECT, Field, read_record
from svu_mi.errors import CaptureError, SvuError, excerpt
from svu_mi.output.maps import ENTROPY
from svu_mi.output.run_record import RECORD
from svu_mi.parameters import CHANNELS, NAMES
from svu_mi.recovery.svbrdf_textures import Textures

FILES = {name: f"{name}.exr" for name in NAMES}
SCENE, ASSETS = "recovered.xml", "assets"
MESH, NORMALS = f"{ASSETS}/mesh.ply", f"{ASSETS}/normals.exr"
KINDS = (".exr", ".png")  # accepted from other programs


def write_textures(
    textures: Textures,
    folder: str | Path,
    attributes: Mapping[str, str | int | float] | None = None,
    *,
    half: bool = False,
) -> None:
    """Write ``base_color.exr`` (R, G, B), ``roughness.exr`` and ``metallic.exr`` (Y).

    Linear values in [0, 1]; row 0 is v = 0. Texels outside the charts are expected to be filled
    with their neighbours (``lay_out``).

    Raises:
        OutputError: a file cannot be written, or a value is NaN or infinite.
    """
    header = {"svu:version": svu_mi.__version__, **(attributes or {})}
    for name, tensor in textures.items():
        channels = "RGB" if CHANNELS[name] == 3 else "Y"
        image = np.array(tensor, np.float32)
        write_exr(Path(folder) / FILES[name], {channels: image}, header, half=half)


def write_scene(
    capture: Capture,
    textures: Textures,
    folder: str | Path,
    *,
    attributes: Mapping[str, str | int | float] | None = None,
) -> Path:
    """Write the capture's scene with recovered textures; return the path of ``recovered.xml``.

    ``mitsuba.load_file`` loads it without svu_mi. It contains the object with the texels' UVs, all
    other shapes, the light, and one sensor per photograph (``view_0000``, ...). Textures are in the
    same folder, meshes and the environment map in ``assets``. File names are relative, so the
    folder can be moved. ``-D spp=N`` sets samples per pixel.

    Raises:
        OutputError: the folder or a file cannot be written.
    """
    folder = prepare_folder(folder)
    prepare_folder(folder / ASSETS)
    write_textures(textures, folder, attributes)
    scene, target = capture.scene, capture.shape
    root = scene_xml.scene()
    root.append(scene_xml.plugin("integrator", "path", max_depth=path_length(scene)))
    for light in scene.emitters():
        if light.is_environment():
            root.append(scene_xml.environment(light, folder, ASSETS))
        elif light.get_shape() is None:
            root.append(scene_xml.lamp(light))
    root.append(object_node(
        target.id(), arrays(capture.mesh), folder, two_sided=is_two_sided(target.bsdf()),
        layer=normal_map(target.bsdf()) if is_same(capture.mesh, target) else None,
    ))  # fmt: skip
    for number, other in enumerate(other_shapes(scene, target)):
        root.append(scene_xml.shape(other, folder, f"{ASSETS}/other_{number}"))
    root.extend(map(scene_xml.sensor, capture.sensors, _sensor_ids(capture)))
    scene_xml.write_document(root, folder / SCENE)
    return folder / SCENE


def _sensor_ids(capture: Capture) -> list[str]:
    """Return the names of the photographs if they can be ids, so that they match; else numbers."""
    stems = [Path(name).stem for name in capture.files or capture.names]
    if all(re.fullmatch(r"\w[\w-]*", stem) for stem in stems) and len(set(stems)) == len(stems):
        return stems
    return [f"view_{k:04d}" for k in range(capture.count)]


def object_node(
    name: str, mesh: MeshArrays, folder: Path, *, file: str = MESH,
    textures: Mapping[str, str] = FILES, two_sided: bool = False, layer: Any = None,
    normals: str = NORMALS,
) -> Any:  # fmt: skip
    """Write a mesh to ``folder``; return its node with textures within a normal map ``layer``."""
    node, bsdf = scene_xml.mesh(mesh, folder, file, name), scene_xml.principled(name, textures)
    if layer is not None:
        bsdf = scene_xml.mapped(layer, bsdf, folder, normals)
    node.append(scene_xml.on_both_sides(name, bsdf) if two_sided else bsdf)
    return node


def recovery_settings(folder: str | Path, kind: str = "used") -> dict[str, Any]:
    """Return ``Recovery.settings`` from a folder's ``run.json``; empty if it cannot be read.

    With the kind ``given``, return the options of the command.
    """
    try:
        schema = {"settings": Field({kind: Field(OBJECT)})}
        record = read_record(Path(folder) / RECORD, schema, "recover it again")
    except SvuError:
        return {}
    return dict(record["settings"][kind])


def read_textures(folder: str | Path, *, one_run: bool = True) -> Textures:
    """Read the three files of ``write_textures``.

    Roughness and metallic may also have the channel R, or three equal channels.

    Raises:
        CaptureError: a file is missing or damaged, has other channels, another size or values
            outside [0, 1], or comes from another run than the others (unless ``one_run`` is False).
    """
    folder = Path(folder)
    restore(folder)
    require_recovery(folder, list(FILES.values()), RECORD, ENTROPY)
    if one_run:
        require_one_run(folder, list(FILES.values()), RECORD, "recover")
    images = {name: _read_exr_texture(folder / FILES[name], CHANNELS[name]) for name in NAMES}
    sizes = {name: image.shape[:2] for name, image in images.items()}
    if len(set(sizes.values())) > 1:
        words = ", ".join(f"{FILES[name]} {size[1]} x {size[0]}" for name, size in sizes.items())
        raise CaptureError(f"{folder}: the textures differ in size ({words}); resample them.")
    return Textures.of(images)


def capture_of_textures(capture: Capture, folder: str | Path) -> Capture:
    """Return the capture that textures were recovered from; raise an error for another mesh.

    It has the normals of the folder, if ``svu recover --normals`` refined them, and a warning if
    ``run.json`` names another capture of the same mesh.
    """
    folder = Path(folder)
    run, key = marks_of(folder / FILES["base_color"])
    label = excerpt(capture.source or capture.shape.id(), 300)
    mesh = mesh_of(folder / RECORD, run)
    if mesh and mesh != mesh_key(capture.mesh):
        raise CaptureError(
            f"{folder}: these textures belong to another mesh or other UVs than {label}; give a "
            "folder that svu recover wrote for this capture."
        )
    if key and key != capture_key(capture):
        if (folder / NORMALS).is_file():
            refined = with_normals(capture, _read_exr_texture(folder / NORMALS, 3))
            if key == capture_key(refined):
                return refined
        return capture.warned(
            f"{folder}: these textures come from another capture than {label}; their values are "
            "used as they are."
        )
    return capture


def find_textures(folder: Path) -> dict[str, Path]:
    """Return the texture files of a folder by parameter, EXR before PNG."""
    files = {name: [folder / f"{name}{kind}" for kind in KINDS] for name in NAMES}
    return {name: file for name in NAMES for file in reversed(files[name]) if file.is_file()}


def read_texture(path: Path, name: str) -> tuple[np.ndarray, str]:
    """Read a texture from EXR (linear) or PNG (base colour in sRGB).

    Returns (H, W, C) float32 in [0, 1], and a note on the conversion, which may be empty.

    Raises:
        CaptureError: the file is damaged, has other channels, or values that are not in [0, 1].
    """
    if path.suffix.lower() == ".exr":
        return _read_exr_texture(path, CHANNELS[name]), ""
    picture = open_image(path)
    planes = picture.planes()[:3]
    if CHANNELS[name] == 1:
        return _single_channel(path, planes), ""
    image = decoded(np.stack(planes, axis=-1))
    return image, f"{path}: {picture.bits} bits, decoded as sRGB."


def _read_exr_texture(path: Path, count: int) -> np.ndarray:
    """Return (H, W, count) float32."""
    channels = read_exr(path)
    wanted = "RGB" if count == 3 else next((c for c in "YR" if c in channels), "Y")
    if not set(wanted) <= set(channels):
        found = excerpt(", ".join(channels))
        raise CaptureError(f"{path}: expected the channels {', '.join(wanted)}, found {found}.")
    if count == 1:
        image = _single_channel(path, [channels[wanted], *channels.values()])
    else:
        image = np.stack([channels[letter] for letter in wanted], axis=-1)
    bad = int((~((image >= 0) & (image <= 1))).sum())  # NaN fails both
    if bad:
        raise CaptureError(f"{path}: {bad} values are outside [0, 1] or NaN; clip them.")
    return image


def _single_channel(path: Path, planes: Sequence[np.ndarray]) -> np.ndarray:
    """Return the first channel (H, W, 1); raise an error if the channels differ."""
    if not all(np.array_equal(planes[0], plane) for plane in planes):
        raise CaptureError(f"{path}: a grey texture has unequal channels; export one channel.")
    return planes[0][..., None]
