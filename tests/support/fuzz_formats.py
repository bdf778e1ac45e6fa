"""A small valid file of each input format, and the call that reads it."""

from __future__ import annotations

import contextlib
import io
import json
import logging
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import mitsuba as mi
import numpy as np
import OpenEXR
import pillow_heif
import trimesh
from PIL import Image

from support import image_files
from support.colmap import write_colmap
from support.helpers import ball, sensor_xml, write_scene
from support.owl import write_owl
from svu_mi.bench.orb.orb_results import OrbCapture, OrbPhotograph, write_orb
from svu_mi.capture import capture_folder, loading
from svu_mi.capture import mesh as capture_mesh
from svu_mi.capture.capture_folder import Description
from svu_mi.capture.image_io import open_image
from svu_mi.capture.importers.convert_photographs import convert_photograph, with_response
from svu_mi.capture.importers.envmap import write_environment
from svu_mi.capture.importers.exposure_list import with_exif_gains, with_listed_gains
from svu_mi.capture.importers.lens_distortion import Lens
from svu_mi.capture.importers.mesh_files import read_textured_mesh
from svu_mi.capture.importers.mesh_materials import write_pictures
from svu_mi.capture.importers.nerf import write_transforms
from svu_mi.capture.importers.nerfstudio_world import AppliedWorld, read_normalisation
from svu_mi.capture.importers.registry import read_source
from svu_mi.capture.importers.resampling import square_pixel_frame, with_size
from svu_mi.capture.importers.source import Frame, Light, Source
from svu_mi.capture.loading import load_capture
from svu_mi.capture.scene import load_scene
from svu_mi.capture.target import find_target
from svu_mi.capture.unwrap import UNWRAPPED, unwrap, unwrap_cached
from svu_mi.cli.main import main
from svu_mi.core.io.exr import write_exr
from svu_mi.core.io.output_folder import Draft
from svu_mi.errors import SvuError

WIDTH, HEIGHT = 16, 8  # of all pictures, so that each may be a lat-long map


@dataclass(frozen=True, kw_only=True)
class Format:
    """One format.

    Attributes:
        name: for messages.
        make: writes valid files into a folder.
        read: reads the folder's files; may write into a second folder.
        targets: pattern of the names of files that are damaged.
        share: 10 = a tenth as many variants as of others, because reading takes longer.
    """

    name: str
    make: Callable[[Path], object]
    read: Callable[[Path, Path], object]
    targets: str = "*"
    share: int = 1


def frame_of(image: Path, mask: Path | None = None) -> Frame:
    return Frame(label=f"{image.parent}: frame 0", image=image, mask=mask, to_world=np.eye(4),
                 focal=(20.0, 20.0), center=(8.0, 4.0), size=(WIDTH, HEIGHT))  # fmt: skip


def picture(folder: Path, out: Path) -> None:
    """Read a picture as a photograph and as its mask."""
    path = next(folder.glob("picture.*"))
    frame = with_size(frame_of(path, mask=path), open_image(path).size)
    convert_photograph(frame, out / "view.exr", (1.0, 1.0))


def light(folder: Path, out: Path) -> None:
    """Read a picture as a photograph and as the light."""
    picture(folder, out)
    write_environment(Light(path=next(folder.glob("picture.*"))), out / "environment.exr")


def mesh(folder: Path, out: Path) -> None:
    """Read a mesh with its textures, unwrap it if need be, and write it."""
    path = next(folder.glob("mesh.*"))
    geometry = read_textured_mesh(path)
    made = capture_mesh.make_mesh("object", geometry.mesh)
    if geometry.mesh.uvs is None:
        made = unwrap(made, str(path))
    made.write_ply(str(out / "mesh.ply"))
    write_pictures(geometry.textures, out)


def source(folder: Path, out: Path, *, place: str = ".") -> None:
    """Read poses, make their sensors, and straighten a photograph of a distorted lens."""
    source = read_source(folder / place)
    for frame in source.frames:
        frame = with_size(frame, open_image(frame.image).size)
        made, scale = square_pixel_frame(frame)
        made.sensor()
        if frame.lens is not None:
            convert_photograph(frame, out / "view.exr", scale)
    if source.light is not None:
        write_environment(source.light, out / "environment.exr")


def exposures(folder: Path, out: Path) -> None:
    """Read exposures of a photograph from a list, and from its EXIF data."""
    frame = frame_of(folder / "view_0000.jpg")
    with_exif_gains(with_listed_gains([frame], folder / "gains.txt"))


def normalisation(folder: Path, out: Path) -> None:
    """Move a mesh out of nerfstudio's normalised world."""
    applied = AppliedWorld(np.diag([1.0, -1, -1, 1]), 2.0)
    assert np.isfinite(read_normalisation(folder / "dataparser_transforms.json", applied)).all()


def response(folder: Path, out: Path) -> None:
    """Decode a photograph by what was measured."""
    (frame,) = with_response([frame_of(folder / "view_0000.png")], folder / "curve.txt")
    convert_photograph(frame, out / "view.exr", (1.0, 1.0))


def capture(folder: Path, out: Path) -> None:
    """Read a capture folder, without what is kept there when a mesh has lost its UVs."""
    with mock.patch.object(loading, "unwrap_cached", lambda shape, _: unwrap_cached(shape, None)):
        load_capture(folder)


def scene(folder: Path, out: Path) -> None:
    """Load a scene; the library that lies about, here a text, must not be tried."""
    try:
        load_scene(folder / "scene.xml")
    except SvuError as error:
        assert ".so" not in str(error) or "Mitsuba would run" in str(error), error
        raise


def target(folder: Path, out: Path) -> None:
    """Choose the object of a scene of primitives by a word."""
    path, word = folder / "scene.xml", folder / "shape.txt"
    find_target(load_scene(path), word.read_text("latin-1") if word.is_file() else "", str(path))


def kept_uvs(folder: Path, out: Path) -> None:
    """Take UVs that were kept, or make them again."""
    for path in out.iterdir():
        path.unlink()
    with contextlib.suppress(OSError):  # a folder or a link in its place
        shutil.copy(folder / UNWRAPPED, out)
    said: list[str] = []
    mesh = capture_mesh.arrays(_made_again(out, said))
    assert mesh.uvs.min() >= 0 and mesh.uvs.max() <= 1 and np.isfinite(mesh.normals).all()
    if said:
        raise SvuError(*said)


def _made_again(folder: Path, said: list[str]) -> Any:
    """Unwrap a ball, and keep what is logged about the file in the folder."""
    bare = capture_mesh.make_mesh("ball", replace(ball(6, 4), uvs=None))
    log = logging.getLogger(unwrap_cached.__module__)
    with mock.patch.object(log, "warning", lambda text, *values: said.append(text % values)):
        return unwrap_cached(bare, folder)


def program(folder: Path, out: Path) -> None:
    """Run ``svu import``, and raise what it says when it refuses."""
    target = out / "capture"
    shutil.rmtree(target, ignore_errors=True)
    with contextlib.redirect_stderr(io.StringIO()) as said, contextlib.redirect_stdout(None):
        status = main([
            "import", str(folder), "-o", str(target), "--mesh", str(folder / "mesh.glb"),
            "--environment", str(folder / "light.pfm"),
        ])  # fmt: skip
    if status == 0:
        assert (target / capture_folder.FILE).is_file() and not said.getvalue()
        return
    assert status == 2 and not list(out.iterdir()), (status, said.getvalue(), list(out.iterdir()))
    first, *others = said.getvalue().splitlines()
    assert first.startswith("svu: ") and not others, said.getvalue()
    raise SvuError(first)


def _pixels(channels: int = 3) -> np.ndarray:
    values = np.random.default_rng(2201).uniform(0, 1, (HEIGHT, WIDTH, channels))
    return values.astype(np.float32)


def _exr(folder: Path, *, parts: int = 1, **header: object) -> None:
    planes = {name: np.ascontiguousarray(_pixels(4)[..., k]) for k, name in enumerate("RGBA")}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **header}
    file = OpenEXR.File([OpenEXR.Part(dict(header), dict(planes), f"{k}") for k in range(parts)])
    file.write(str(folder / "picture.exr"))


def write_integers(folder: Path, name: str, mode: str, **options: object) -> None:
    pixels = _pixels(len(mode) if mode.startswith("RGB") else 1) * (65535 if ";" in mode else 255)
    image = Image.fromarray(np.squeeze(pixels).astype(np.uint16 if ";" in mode else np.uint8))
    image.convert(mode).save(folder / name, **options)


def _floats(folder: Path, name: str) -> None:
    mi.Bitmap(_pixels()).write(str(folder / name))


def _other_image(folder: Path, suffix: str) -> None:
    """Write a picture with an ICC profile in a format of 8, 16 or float channels."""
    profile, path = image_files.icc(image_files.P3, image_files.SRGB_PARA), folder / suffix
    codes = image_files.codes(_pixels(), 8)
    if suffix == "picture.dng":
        image_files.dng(path, np.kron(_pixels(), np.ones((4, 4, 1))))
    elif suffix == "picture.heic":
        pillow_heif.from_pillow(Image.fromarray(codes)).save(path)
    elif suffix in ("picture.webp", "picture.avif"):
        Image.fromarray(codes).save(path, icc_profile=profile)
    elif suffix == "picture.tif":
        image_files.with_oiio(path, image_files.codes(_pixels()), profile=profile)
    elif suffix == "picture.png":
        image_files.png(path, codes, iCCP=image_files.iccp(profile))
    else:
        image_files.with_oiio(path, _pixels(), profile=None)


def write_mesh(folder: Path, name: str, *, painted: bool = False, **options: object) -> None:
    made = trimesh.creation.box()
    if painted:
        texture = Image.fromarray((_pixels() * 255).astype(np.uint8))
        material = trimesh.visual.material.PBRMaterial(
            baseColorTexture=texture, metallicRoughnessTexture=texture, roughnessFactor=0.5
        )
        uvs = made.vertices[:, :2] + 0.5
        made.visual = trimesh.visual.TextureVisuals(
            uvs, material=material if "gl" in name else material.to_simple()
        )
    made.export(folder / name, **options)
    if name.endswith(".gltf"):  # textures in files of their own, which trimesh reads but writes not
        write_integers(folder, "texture.png", "RGB")
        record = json.loads((folder / name).read_text())
        record["images"] = [{"uri": "texture.png"}] * 2
        (folder / name).write_text(json.dumps(record))


def _obj_material(folder: Path) -> None:
    """A mesh whose material has options, comments, and statements that are not read."""
    write_mesh(folder, "mesh.obj", painted=True)
    write_integers(folder, "base color.png", "RGB")
    (folder / "material.mtl").write_text(
        "# exported\nnewmtl material_0\nKa 1 1 1\nKd .8 0.8 1e-1 # grey\nNs 250.5\nillum 2\n"
        'map_Kd -o 0 0 0 -s 1 1 -mm 0 1 -clamp on "base color.png"\n'
        "map_Bump -bm 0.5 \\\nmaterial_0.png\nnorm material_0.png\nPr 0.5\nPm 0\n\n"
        "newmtl other\nKd 1 0 0\nmap_Kd material_0.png\n"
    )


def _source(folder: Path, **fields: Any) -> Source:
    """Write a photograph, a mask and a light, and return two frames of them."""
    folder.mkdir(exist_ok=True)
    write_integers(folder, "view_0000.png", "RGB")
    write_integers(folder, "mask.png", "L")
    _floats(folder, "light.pfm")
    frame = Frame(
        label="", image=folder / "view_0000.png", mask=folder / "mask.png", to_world=np.eye(4),
        focal=(20.0, 21.0), center=(8.0, 4.0), size=(WIDTH, HEIGHT), **fields,
    )  # fmt: skip
    light = Light(path=folder / "light.pfm")
    return Source(format="", root=folder, frames=[frame] * 2, light=light)


def _transforms(folder: Path) -> None:
    write_transforms(folder / "transforms.json", _source(folder, exposure=2.0).frames)


def _distorted(folder: Path) -> None:
    lens = Lens(-0.1, 0.05, -0.01, 0.004, 1e-3, -2e-3)
    write_transforms(folder / "transforms.json", _source(folder, lens=lens).frames)


def _colmap(folder: Path, *, text: bool = False) -> None:
    write_colmap(folder, _source(folder.parent / "other"))
    if text:
        model = folder / "sparse" / "0"
        for file in model.iterdir():
            file.unlink()
        (model / "cameras.txt").write_text(f"# a line\n1 PINHOLE {WIDTH} {HEIGHT} 20 21 8 4\n")
        (model / "images.txt").write_text(
            "1 1 0 0 0 0.5 1 2 1 view_0000.png\n3.5 4.5 -1\n2 0 1 0 0 0 0 3 1 view_0001.png\n\n"
        )
        (model / "points3D.txt").write_text("1 0.5 1 2 9 9 9 0.1 1 0\n2 3 -1 2 9 9 9 0.1 1 1\n")


def _alicevision(folder: Path) -> None:
    """Two views of one camera with numbers as text, as AliceVision writes them."""
    _source(folder)
    camera = {
        "intrinsicId": "9", "width": f"{WIDTH}", "height": f"{HEIGHT}", "sensorWidth": "36",
        "focalLength": "45", "pixelRatio": "1", "principalPoint": ["0", "0"], "type": "pinhole",
        "distortionType": "radialk1", "distortionParams": ["-0.1"],
    }  # fmt: skip
    transform = {"rotation": [*"100010001"], "center": ["0", "1", "-2"]}
    view = {"viewId": "1", "poseId": "1", "intrinsicId": "9", "path": "/home/view_0000.png"}
    record = {
        "version": ["1", "2", "6"], "views": [view] * 2, "intrinsics": [camera],
        "poses": [{"poseId": "1", "pose": {"transform": transform, "locked": "0"}}],
    }  # fmt: skip
    (folder / "cameras.sfm").write_text(json.dumps(record))


def _llff(folder: Path) -> None:
    for name in ("images/view_0000.png", "images/view_0001.png", "masks/view_0000.png"):
        (folder / name).parent.mkdir(exist_ok=True)
        write_integers(folder, name, "RGB")
    matrix = np.array([[0, 1, 0, 1, HEIGHT], [-1, 0, 0, 2, WIDTH], [0, 0, 1, 3, 20]], np.float64)
    np.save(folder / "poses_bounds.npy", [[*matrix.ravel(), 1, 9]] * 2)


def _idr(folder: Path) -> None:
    for name in ("image/0.png", "image/1.png", "mask/0.png", "mask/1.png"):
        (folder / name).parent.mkdir(exist_ok=True)
        write_integers(folder, name, "RGB")
    world = np.array([[20.0, 0, 8, 1], [0, 21, 4, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
    arrays = {"world_mat": world, "scale_mat": np.diag([2.0, 2, 2, 1])}
    np.savez(folder / "cameras.npz", **{f"{n}_{k}": arrays[n] for n in arrays for k in (0, 1)})


def _owl(folder: Path) -> None:
    write_owl(folder, _source(folder.parent / "other"))


def _exposures(folder: Path) -> None:
    exif = Image.Exif()
    exif.get_ifd(0x8769).update({0x829A: 0.02, 0x8827: 100, 0x829D: 4.0})  # time, ISO, aperture
    write_integers(folder, "view_0000.jpg", "RGB", exif=exif)
    (folder / "gains.txt").write_text("# name gain\nview_0000.jpg 0.5\n\nother.jpg 2  # bright\n")


def _normalisation(folder: Path) -> None:
    record = {"transform": np.eye(4)[[1, 2, 0]].tolist(), "scale": 0.5}
    (folder / "dataparser_transforms.json").write_text(json.dumps(record))


def _response(folder: Path) -> None:
    write_integers(folder, "view_0000.png", "RGB")
    (folder / "curve.txt").write_text("# code R G B\n0 0 0 0\n128, .2, .3, .25\n\n255 2 1 1.5\n")


def _imported(folder: Path) -> None:
    _transforms(folder)
    write_mesh(folder, "mesh.glb", painted=True)


def _orb(folder: Path) -> None:
    shot = OrbPhotograph(
        image=_pixels(), mask=_pixels(1)[..., 0], to_world=np.eye(4), environment=_pixels()
    )
    capture = OrbCapture(
        name="ball_scene001", x_fov=40.0, world=np.eye(4), train=[shot] * 2, test=[shot]
    )
    write_orb(folder, ball(4, 3), [capture])


def write_scene_capture(folder: Path) -> None:
    scene = write_scene(folder, sensors=sensor_xml(2, WIDTH, HEIGHT))
    sensors = mi.load_file(str(scene)).sensors()
    for number in range(len(sensors)):
        write_exr(folder / f"view_{number:04d}.exr", {"RGB": _pixels()})
    # Written in place, beside its scene.
    draft = Draft(folder=folder, target=folder, run="0" * 16, command="import", capture="")
    capture_folder.write(draft, Description(scene=scene, exposures=[1.0, 2.0]), sensors)


def _scene(folder: Path) -> None:
    """A scene that includes another, with libraries where only a trick leads to them."""
    extra = '<default name="kind" value="diffuse"/>\n<include filename="more.xml"/>\n'
    write_scene(folder, extra=f'{extra}<path value="other"/>\n<bsdf type="$kind" id="more"/>')
    (folder / "more.xml").write_text(
        '<scene version="3.0.0">\n<shape type="merge" id="both">\n<shape type="ply">\n'
        '<string name="filename" value="ball.ply"/>\n</shape>\n</shape>\n</scene>'
    )
    for name in ("other", "plugins", "kept/plugins"):  # "../evil" needs a folder to leave
        (folder / name).mkdir(parents=True)
    for place in (".", "..", "kept", "kept/plugins", "other"):
        (folder / place / "evil.so").write_text("no library, and Mitsuba would say so")


def _shapes(folder: Path) -> None:
    """Primitives with and without ids, and the word that chooses two of them."""
    (folder / "scene.xml").write_text(
        '<scene version="3.0.0">\n<shape type="sphere" id="body"/>\n<shape type="cube"/>\n'
        '<shape type="disk">\n<transform name="to_world">\n<scale x="2" y="1" z="3"/>\n'
        '</transform>\n<bsdf type="principled" id="paint"/>\n</shape>\n</scene>'
    )
    (folder / "shape.txt").write_text("body, 1,paint")


def _all_formats() -> Iterator[Format]:
    for kind in ("NO", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24", "B44", "B44A", "DWAA", "DWAB"):
        make = partial(_exr, compression=getattr(OpenEXR, f"{kind}_COMPRESSION"))
        yield Format(name=f"exr-{kind.lower()}", make=make, read=light)
    tiles = {"type": OpenEXR.tiledimage, "tiles": OpenEXR.TileDescription()}
    yield Format(name="exr-tiled", make=partial(_exr, **tiles), read=light)
    yield Format(name="exr-parts", make=partial(_exr, parts=2), read=light)
    for suffix in ("hdr", "pfm"):
        yield Format(name=suffix, make=partial(_floats, name=f"picture.{suffix}"), read=light)
    for mode in ("RGB", "RGBA", "L", "I;16", "P"):
        make = partial(write_integers, name="picture.png", mode=mode)
        yield Format(name=f"png-{mode.lower()}", make=make, read=picture)
    for progressive in (False, True):
        make = partial(write_integers, name="picture.jpg", mode="RGB", progressive=progressive)
        yield Format(name=f"jpeg-{progressive}".lower(), make=make, read=picture)
    for suffix in ("png", "tif", "webp", "jxl", "avif", "heic", "dng"):
        make = partial(_other_image, suffix=f"picture.{suffix}")
        yield Format(name=f"profile-{suffix}", make=make, read=picture, share=2)
    for suffix in ("glb", "gltf", "obj"):
        make = partial(write_mesh, name=f"mesh.{suffix}", painted=True)
        yield Format(name=suffix, make=make, read=mesh)
    yield Format(name="mtl", make=_obj_material, read=mesh, targets="*.mtl", share=2)
    for name, suffix, options in (
        ("ply-binary", "ply", {}), ("ply-ascii", "ply", {"encoding": "ascii"}),
        ("stl-binary", "stl", {}), ("stl-ascii", "stl", {"file_type": "stl_ascii"}),
    ):  # fmt: skip
        make = partial(write_mesh, name=f"mesh.{suffix}", **options)
        yield Format(name=name, make=make, read=mesh, share=2)
    for name, make, targets, place in (
        ("transforms", _transforms, "*.json", "."),
        ("transforms-distorted", _distorted, "*.json", "."),
        ("colmap-binary", _colmap, "*.bin", "."),
        ("colmap-text", partial(_colmap, text=True), "*.txt", "."), ("owl", _owl, "*.txt", "test"),
        ("alicevision", _alicevision, "*.sfm", "."),
        ("llff", _llff, "*.npy", "."), ("idr", _idr, "*.npz", "."),
        ("orb", _orb, "*_t*.json", "blender_HDR/ball_scene001"),
    ):  # fmt: skip
        read = partial(source, place=place)
        yield Format(name=name, make=make, targets=targets, read=read)
    yield Format(name="svu import", make=_imported, read=program, share=10)
    yield Format(name="exposures", make=_exposures, read=exposures)
    yield Format(name="normalisation", make=_normalisation, read=normalisation)
    yield Format(name="response", make=_response, read=response)
    yield Format(name="capture", make=write_scene_capture, read=capture, share=4)
    yield Format(name="scene", make=_scene, read=scene, targets="*.xml", share=2)
    yield Format(name="shapes", make=_shapes, read=target, share=2)
    make = partial(_made_again, said=[])
    yield Format(name="unwrapped", make=make, read=kept_uvs, share=4)


FORMATS = tuple(_all_formats())
