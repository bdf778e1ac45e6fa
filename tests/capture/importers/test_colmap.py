"""COLMAP: reading and writing of models, damaged models, and undistortion.

pycolmap runs in separate processes, as in the package: its zlib conflicts with Pillow's.
"""

from __future__ import annotations

import json
import os
import signal
import struct
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.colmap import write_colmap
from support.helpers import fails, foreign_source, names, projected, run, write_ball

from svu_mi.capture.importers.colmap import project as colmap
from svu_mi.capture.importers.colmap import undistortion
from svu_mi.capture.importers.colmap.sparse_model import (
    ColmapCamera,
    Pose,
    read_model,
    read_points,
    write_model,
)
from svu_mi.capture.importers.lens_distortion import Lens
from svu_mi.capture.importers.registry import ReadOptions, read_source
from svu_mi.capture.importers.source import OPENCV, Source
from svu_mi.cli.import_ import Import
from svu_mi.core.io.output_folder import claimed
from svu_mi.core.progress import Progress
from svu_mi.errors import CaptureError, SvuEnvironmentError

POINTS = np.random.default_rng(4401).uniform(-0.4, 0.4, (6, 3))
# Projects points by a model, and writes a model with rigs, frames and points.
PYCOLMAP = """
import sys
import numpy as np
import pycolmap
pycolmap.logging.minloglevel = 3
root = sys.argv[1]
model = pycolmap.Reconstruction(f"{root}/given/sparse/0")
points = np.load(f"{root}/points.npy")
images = sorted(model.images.values(), key=lambda image: image.name)
np.save(f"{root}/pixels.npy", [[image.project_point(p) for p in points] for image in images])
options = pycolmap.SyntheticDatasetOptions()
options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 2, 2, 2
options.num_points3D = 12
made = pycolmap.synthesize_dataset(options)
made.write_binary(f"{root}/bin")
made.write_text(f"{root}/txt")
images = sorted(made.images.values(), key=lambda image: image.name)
np.save(f"{root}/poses.npy", [image.cam_from_world().matrix() for image in images])
"""


def read_colmap(path: Path, **options: Path) -> Source:
    return colmap.read(path, ReadOptions(**options))


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    return foreign_source(tmp_path_factory.mktemp("source"))


@pytest.fixture(scope="module")
def project(source, tmp_path_factory):
    """A project from ``write_colmap``, and pycolmap's projections of it."""
    root = tmp_path_factory.mktemp("colmap")
    write_colmap(root / "given", source)
    np.save(root / "points.npy", POINTS)
    for name in ("bin", "txt"):
        (root / name).mkdir()
    subprocess.run([sys.executable, "-c", PYCOLMAP, str(root)], check=True)
    return root


def test_what_is_written_is_read(source, project):
    imported = read_colmap(project / "given")
    assert imported.format == "colmap" and (imported.camera_axes == OPENCV).all()
    assert "unit" in imported.notes[0]
    for got, wanted in zip(imported.frames, source.frames, strict=True):
        np.testing.assert_allclose(got.to_world, wanted.to_world, atol=1e-12)
        assert (got.focal, got.center, got.size) == (wanted.focal, wanted.center, wanted.size)
        assert got.image.read_bytes() == wanted.image.read_bytes()
        assert (got.mask is None) == (wanted.mask is None)
        if got.mask is not None:
            assert got.mask.name == f"{got.image.name}.png"
            assert got.mask.read_bytes() == wanted.mask.read_bytes()
    assert len(read_model(project / "given/sparse/0")[0]) == 2  # two frames share a camera


def test_pycolmap_projects_as_mitsuba_does(project):
    pixels = np.load(project / "pixels.npy")
    for frame, wanted in zip(read_colmap(project / "given").frames, pixels, strict=True):
        assert (wanted.min(axis=0) > 0).all() and (wanted.max(axis=0) < frame.size).all()
        np.testing.assert_allclose(projected(frame, POINTS), wanted, atol=1e-3)


def test_models_of_pycolmap_are_read_from_both_kinds_of_file(project):
    cameras, views = read_model(project / "bin")
    assert (cameras, views) == read_model(project / "txt")
    assert {camera.model for camera in cameras.values()} == {"SIMPLE_RADIAL"}
    assert len(cameras) == 4 and len(views) == 8
    images = project / "bin" / "images"
    images.mkdir()
    for view in views:
        (images / view.name).touch()
    straight = {k: replace(c, model="SIMPLE_PINHOLE", parameters=c.parameters[:3])
                for k, c in cameras.items()}  # fmt: skip
    write_model(project / "bin", straight, views)
    poses = np.load(project / "poses.npy")
    for frame, wanted in zip(read_colmap(project / "bin").frames, poses, strict=True):
        np.testing.assert_allclose(np.linalg.inv(frame.to_world @ OPENCV)[:3], wanted, atol=1e-9)


# Handwritten models.

CAMERA = ColmapCamera("PINHOLE", 8, 6, (9.0, 9.5, 4.0, 3.0))
VIEW = Pose("a.png", 1, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 4.0))
CAMERA_LINE = "1 PINHOLE 8 6 9 9.5 4 3"
VIEW_LINE = "1 1 0 0 0 0 0 4 1 a.png"


def put(
    root: Path, camera: ColmapCamera = CAMERA, view: Pose = VIEW, model: str = "sparse/0"
) -> Path:
    """Write a project of one view."""
    (root / model).mkdir(parents=True, exist_ok=True)
    write_model(root / model, {1: camera}, [view])
    (root / "images").mkdir(exist_ok=True)
    (root / "images" / "a.png").touch()
    return root


def put_text(root: Path, cameras: str = CAMERA_LINE, images: str = VIEW_LINE) -> Path:
    (root / "cameras.txt").write_text(f"# cameras\n{cameras}\n")
    (root / "images.txt").write_text(f"# images\n\n{images}\n\n")
    (root / "images").mkdir()
    (root / "images" / "a.png").touch()
    return root


@pytest.mark.parametrize("place", ["sparse/0", "sparse", "dense/sparse", "."])
def test_a_model_is_found_in_its_project(tmp_path, place):
    put(tmp_path, model=place)
    for path in (tmp_path, tmp_path / place):
        (frame,) = read_colmap(path).frames
        assert frame.image == tmp_path / "images" / "a.png"
    assert not colmap.recognises(tmp_path / "images", "")


def test_the_folder_that_has_the_model_0_will_do(tmp_path):
    """The path may be ``project/sparse``, or nerfstudio's ``data/colmap/sparse``."""
    put(tmp_path / "project")
    put(tmp_path / "data", model="colmap/sparse/0")
    for folder, parts in (("project", "sparse"), ("data", "colmap/sparse")):
        source = read_source(tmp_path / folder / parts)
        assert source.format == "colmap"
        assert source.frames[0].image == tmp_path / folder / "images" / "a.png"


def test_the_undistorted_model_and_its_images_go_first(tmp_path):
    put(tmp_path, camera=replace(CAMERA, model="OPENCV", parameters=(9.0,) * 8))
    put(tmp_path / "dense", model="sparse")
    (frame,) = read_colmap(tmp_path).frames
    assert frame.image == tmp_path / "dense" / "images" / "a.png"


@pytest.mark.parametrize("place", ["sparse/{}", "dense/{}/sparse", "colmap/sparse/{}", "{}"])
def test_largest_of_several_models_is_read(tmp_path, place):
    """Of 0, 2 and 10 with one, three and two images; 3 is damaged."""
    (tmp_path / "images").mkdir()
    for number, count in ((0, 1), (2, 3), (10, 2), (3, 0)):
        folder = tmp_path / place.format(number)
        folder.mkdir(parents=True)
        write_model(folder, {1: CAMERA}, [replace(VIEW, name=f"{k}.png") for k in range(count)])
    for k in range(3):
        (tmp_path / "images" / f"{k}.png").touch()
    images = {"images": tmp_path / "images"}
    source = read_colmap(tmp_path, **images)
    assert [frame.image.name for frame in source.frames] == ["0.png", "1.png", "2.png"]
    model = {number: tmp_path / place.format(number) for number in (0, 2, 3, 10)}
    assert source.notes[1] == (
        f"{model[2]}: the largest of 4 models of parts of the scene is used, with 3 images "
        f"({model[0]} has 1, {model[3]} has 0, {model[10]} has 2); to use another, import its "
        "folder instead."
    )
    other = read_colmap(model[10], **images)
    assert len(other.frames) == 2 and len(other.notes) == 1


def test_only_model_may_have_another_number(tmp_path):
    source = read_colmap(put(tmp_path, model="sparse/1"))
    assert len(source.frames) == 1 and len(source.notes) == 1


@pytest.mark.parametrize("name", ["a.png.png", "a.png", "a.jpg", "a_mask.png", "mask_a.jpg"])
def test_masks_are_found_by_any_of_their_names(tmp_path, name):
    put(tmp_path)
    (tmp_path / "shapes").mkdir()
    (tmp_path / "shapes" / name).touch()
    assert read_colmap(tmp_path).frames[0].mask is None
    (frame,) = read_colmap(tmp_path, masks=tmp_path / "shapes").frames
    assert frame.mask == tmp_path / "shapes" / name


def test_folders_that_are_not_there(tmp_path):
    put(tmp_path)
    with pytest.raises(CaptureError, match="none: not a COLMAP model"):
        read_colmap(tmp_path / "none")
    with pytest.raises(CaptureError, match="none: no such folder; .* masks with --masks"):
        read_colmap(tmp_path, masks=tmp_path / "none")
    with pytest.raises(CaptureError, match="none: no such folder; .* --images"):
        read_colmap(tmp_path, images=tmp_path / "none")
    with pytest.raises(CaptureError, match="sparse: has no mask of a.png or any other photograph"):
        read_colmap(tmp_path, masks=tmp_path / "sparse")
    with pytest.raises(CaptureError, match="1 of 1 photographs is missing, first a.png"):
        read_colmap(tmp_path, images=tmp_path / "sparse")


STRAIGHT = {"SIMPLE_DIVISION": (9.0, 4.0, 3.0, 0.0),
            "FULL_OPENCV": (9.0, 9.5, 4.0, 3.0, *[0] * 8)}  # fmt: skip
BENT = {"SIMPLE_RADIAL": {"k1": 1e-3}, "RADIAL": {"k1": 1e-3, "k2": 2e-3},
        "OPENCV": {"k1": 1e-3, "k2": 2e-3, "p1": 3e-3, "p2": 4e-3},
        "FULL_OPENCV": {"k1": 1e-3, "k2": 2e-3, "p1": 3e-3, "p2": 4e-3, "k3": 5e-3}}  # fmt: skip


@pytest.mark.parametrize("model", BENT)
def test_lenses_of_opencvs_model_are_straightened_by_the_import(tmp_path, model):
    """It needs no pycolmap and supports floating-point photographs."""
    focal = (9.0, 9.5) if "OPENCV" in model else (9.0,)
    rest = [0.0] * (3 if model == "FULL_OPENCV" else 0)
    parameters = (*focal, 4.0, 3.0, *BENT[model].values(), *rest)
    camera = replace(CAMERA, model=model, parameters=parameters)
    (frame,) = read_colmap(put(tmp_path, camera=camera)).frames
    assert frame.lens == Lens(**BENT[model]) and frame.center == (4.0, 3.0)
    assert frame.focal == (focal[0], focal[-1])


@pytest.mark.parametrize("model", STRAIGHT)
def test_other_lenses_that_bend_lines_are_refused(tmp_path, model):
    camera = replace(CAMERA, model=model, parameters=STRAIGHT[model])
    (frame,) = read_colmap(put(tmp_path / "straight", camera=camera)).frames
    assert frame.focal[0] == 9.0 and frame.center == (4.0, 3.0) and frame.lens is None
    bent = replace(camera, parameters=(*camera.parameters[:-1], 1e-3))
    with pytest.raises(CaptureError, match=rf"camera 1: .*\({model}\).*--undistort"):
        read_colmap(put(tmp_path / "bent", camera=bent))


def test_a_text_model_of_two_lines_per_image(tmp_path):
    lines = f"{VIEW_LINE}\n1.5 2.5 -1 3 4 7\n2 1 0 0 0 0 0 4 1 a name.png"
    put_text(tmp_path, images=lines)
    cameras, views = read_model(tmp_path)
    assert cameras == {1: CAMERA} and views[1] == VIEW and views[0].name == "a name.png"


def test_a_quaternion_that_was_rounded_is_a_rotation(tmp_path):
    for name in "ab":
        (tmp_path / name).mkdir()
    put_text(tmp_path / "a", images=VIEW_LINE.replace("1 1 0", "1 0.996 0"))
    assert read_colmap(tmp_path / "a").frames
    put_text(tmp_path / "b", images=VIEW_LINE.replace("1 1 0", "1 0.98 0"))
    with pytest.raises(CaptureError, match="a unit quaternion"):
        read_colmap(tmp_path / "b")


TEXT = {
    "too few numbers": ({"cameras": "1 PINHOLE 8 6 9 9 4"}, "PINHOLE has 4 parameters, not 3"),
    "an unknown model": ({"cameras": "1 GLASS 8 6 9 9 4 3"}, "camera model 'GLASS' is unknown"),
    "half a camera": ({"cameras": "1 PINHOLE"}, "CAMERA_ID MODEL"),
    "words": ({"cameras": "1 PINHOLE 8 six 9 9 4 3"}, "'six'"),
    "nan": ({"cameras": "1 PINHOLE 8 6 nan 9 4 3"}, "NaN"),
    "no size": (
        {"cameras": "1 PINHOLE 0 6 9 9 4 3"},
        r"size must be 2 whole numbers in \[1, 65536\]",
    ),
    "a huge size": (
        {"cameras": "1 PINHOLE 99999999999 6 9 9 4 3"},
        r"size must be 2 whole numbers in \[1, 65536\]",
    ),
    "a huge centre": ({"cameras": "1 PINHOLE 8 6 9 9 4e300 3"}, "principal point"),
    "a negative camera": ({"cameras": f"-{CAMERA_LINE}"}, "-1 is not a valid id"),
    "no image": ({"images": ""}, "has no images"),
    "half an image": ({"images": "1 1 0 0 0 0 0 4"}, "IMAGE_ID QW"),
    "no line of points": ({"images": f"{VIEW_LINE}\n2{VIEW_LINE}"}, "a line of points"),
    "another camera": ({"images": VIEW_LINE.replace("1 a.", "2 a.")}, "no camera 2"),
    "no rotation": ({"images": VIEW_LINE.replace("1 1 0", "1 0 0")}, "a unit quaternion"),
    "far away": ({"images": VIEW_LINE.replace("4", "1e12")}, "1e.12 units .* than 1e.09"),
    "twice": ({"images": f"{VIEW_LINE}\n\n{VIEW_LINE}"}, "occurs twice"),
    "a name above": ({"images": VIEW_LINE.replace("a.png", "../b.png")}, "lies outside"),
    "a name elsewhere": ({"images": VIEW_LINE.replace("a.png", "/b.png")}, "lies outside"),
    "an endless name": ({"images": VIEW_LINE.replace("a.png", "a" * 600)}, "too long"),
}


@pytest.mark.parametrize("case", TEXT)
def test_a_broken_text_model_is_named(tmp_path, case):
    changes, sentence = TEXT[case]
    with pytest.raises(CaptureError, match=sentence) as error:
        read_colmap(put_text(tmp_path, **changes))
    assert str(tmp_path) in str(error.value) and "\n" not in str(error.value)


BINARY = {
    "empty": ("cameras.bin", lambda b: b[:0], "empty"),
    "short": ("cameras.bin", lambda b: b[:-1], "ends too early"),
    "long": ("cameras.bin", lambda b: b + b"\0", "1 bytes too many"),
    "many cameras": ("cameras.bin", lambda b: b"\xff" * 8 + b[8:], "at most 10000 are"),
    "a model of none": ("cameras.bin", lambda b: b[:12] + b"\x63" + b[13:], "model 99 is unknown"),
    "nan": ("cameras.bin", lambda b: b[:-8] + struct.pack("<d", np.nan), "NaN"),
    "a huge width": (
        "cameras.bin",
        lambda b: b[:16] + b"\xff" * 8 + b[24:],
        r"size must be 2 whole numbers in \[1, 65536\]",
    ),
    "half an image": ("images.bin", lambda b: b[:40], "ends too early"),
    "many images": ("images.bin", lambda b: b"\xff" * 8 + b[8:], "at most 10000 are"),
    "many points": ("images.bin", lambda b: b[:-8] + b"\xff" * 8, "ends too early"),
    "a name that goes on": (
        "images.bin",
        lambda b: b.replace(b"\0" * 9, b"x" * 9),
        "not terminated",
    ),
    "a name in no alphabet": ("images.bin", lambda b: b.replace(b"a.png", b"a.\xff\xfeg"), "utf-8"),
    "a name above": ("images.bin", lambda b: b.replace(b"a.png", b"../.."), "lies outside"),
}


@pytest.mark.parametrize("case", BINARY)
def test_a_broken_binary_model_is_named(tmp_path, case):
    name, change, sentence = BINARY[case]
    path = put(tmp_path) / "sparse/0" / name
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(CaptureError, match=sentence) as error:
        read_colmap(tmp_path)
    assert str(path.parent) in str(error.value)


# Undistortion.

LENS = ColmapCamera("SIMPLE_RADIAL", 90, 60, (75.0, 46.0, 28.0, -0.15))


def put_lens(root: Path, directions: list[tuple[float, float]], lens: ColmapCamera = LENS) -> Path:
    """Write photographs of spots in directions (x/z, y/z) through a lens, with masks."""
    f, cx, cy, k = lens.parameters
    y, x = np.mgrid[: lens.height, : lens.width] + 0.5
    views = []
    for index, (u, v) in enumerate(directions):
        bent = 1 + k * (u * u + v * v)
        spot = np.exp(-((x - f * u * bent - cx) ** 2 + (y - f * v * bent - cy) ** 2) / 8)
        views.append(replace(VIEW, name=f"a place/{index}.png"))
        for name, values in (("images", spot), ("masks", spot > 0.1)):
            path = root / name / views[-1].name
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(np.uint8(255 * values)).save(path)
    (root / "sparse").mkdir()
    write_model(root / "sparse", {1: lens, 2: CAMERA}, views)
    return root


def test_a_bent_lens_is_straightened_with_its_masks(tmp_path):
    directions = [(0.3, 0.1), (-0.4, -0.25)]
    put_lens(tmp_path / "bent", directions)
    (tmp_path / "scratch").mkdir()
    straight = undistortion.undistort(tmp_path / "bent", tmp_path / "scratch")
    assert sorted(p.name for p in straight.iterdir()) == ["images", "masks", "sparse"]
    for frame, (u, v) in zip(read_colmap(straight).frames, directions, strict=True):
        wanted = frame.focal[0] * u + frame.center[0], frame.focal[1] * v + frame.center[1]
        for path in (frame.image, frame.mask):
            values = np.array(Image.open(path).convert("L"), np.float64)
            assert values.shape == frame.size[::-1]
            y, x = np.mgrid[: values.shape[0], : values.shape[1]] + 0.5
            center = (values * x).sum() / values.sum(), (values * y).sum() / values.sum()
            np.testing.assert_allclose(center, wanted, atol=0.2)  # the lens moves the second by 1.2


def test_exposures_of_undistorted_photographs_are_those_of_the_originals(tmp_path, capsys):
    """Copies by pycolmap have no EXIF data; times of 1/60 s and 1/30 s differ by 2."""
    bent, out = put_lens(tmp_path / "bent", [(0, 0), (0.1, 0)]), tmp_path / "out"
    words = ("import", bent, "--undistort", "--mesh", write_ball(tmp_path), "-o", out)
    missing = f"{bent / 'images/a place/0.png'}: no exposure time in its EXIF data"
    assert missing in fails(capsys, *words, "--exposures", "exif")
    for index, time in enumerate((1 / 60, 1 / 30)):
        file, exif = bent / f"images/a place/{index}.png", Image.Exif()
        exif[0x010F] = "maker"  # Pillow drops EXIF data without a tag of the image
        exif.get_ifd(0x8769)[0x829A] = time
        Image.open(file).save(file, exif=exif)
    assert run(*words) == 0
    assert "EXIF: exposures differ by 2 x" in capsys.readouterr().out
    record = json.loads((out / "capture.json").read_text())
    np.testing.assert_allclose(record["exposure"], [2 / 3, 4 / 3], rtol=1e-5)
    assert record["import"]["photographs"] == ["images/a place/0.png", "images/a place/1.png"]
    listed = tmp_path / "gains.txt"
    listed.write_text("0.png 1\n1.png 3\n")
    assert run(*words, "--exposures", listed, "--overwrite") == 0
    assert f"{listed}: exposures differ by 3 x; pixels are divided" in capsys.readouterr().out


KILL = "import os, signal; os.kill(os.getppid(), signal.SIGKILL)"


@pytest.mark.forks
def test_next_import_clears_what_a_killed_undistortion_has_left(tmp_path, monkeypatch):
    (tmp_path / "tmp").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "tmp"))
    bent, out = put_lens(tmp_path / "bent", [(0, 0)]), tmp_path / "shelf" / "out"
    if (pid := os.fork()) == 0:  # pycolmap is replaced by a script that kills the import
        monkeypatch.setattr(undistortion, "SCRIPT", KILL)
        try:
            with claimed(out, "import") as place:
                Import(source=bent, output=out, undistort=True)._import(Progress(), place)
        finally:
            os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == -signal.SIGKILL
    assert list(out.parent.glob(".out*/.svu-undistorted*/masks/a place/0.png.png"))
    assert run("import", bent, "--undistort", "--mesh", write_ball(tmp_path), "-o", out) == 0
    assert names(tmp_path / "tmp") == [] and names(out.parent) == ["out"]
    assert names(out) == ["capture.json", "mesh.ply", "scene.xml", "view_0000.exr"]


def test_what_cannot_be_straightened_is_named(tmp_path, monkeypatch):
    def undistort(project: Path) -> None:
        undistortion.undistort(project, Path(tempfile.mkdtemp(dir=tmp_path)))

    small = put_lens(tmp_path / "small", [(0, 0)])
    write_model(small / "sparse", {1: replace(LENS, width=91)}, read_model(small / "sparse")[1])
    with pytest.raises(CaptureError, match="0.png: has 90 x 60 pixels, but its camera has 91 x 60"):
        undistort(small)
    globe = put_lens(tmp_path / "globe", [(0, 0)])
    sphere = replace(LENS, model="EQUIRECTANGULAR", parameters=(90.0, 60.0))
    write_model(globe / "sparse", {1: sphere}, read_model(globe / "sparse")[1])
    with pytest.raises(CaptureError, match="images: COLMAP cannot undistort .* EQUIRECTANGULAR"):
        undistort(globe)
    ring = put_lens(tmp_path / "ring", [(0, 0)])
    folded = replace(LENS, parameters=(*LENS.parameters[:3], -2.0))
    write_model(ring / "sparse", {1: folded}, read_model(ring / "sparse")[1])
    with pytest.raises(CaptureError, match=r"sparse: camera 1: the lens \(k1 -2\) folds over"):
        undistort(ring)
    with monkeypatch.context() as patch:
        patch.setattr(undistortion, "SCRIPT", "import sys; sys.exit('lost')")
        with pytest.raises(CaptureError, match=r"images: COLMAP cannot undistort them \(lost\)"):
            undistort(globe)
    radiance = put(tmp_path / "radiance", view=replace(VIEW, name="a.exr"))
    (radiance / "images" / "a.exr").touch()
    with pytest.raises(CaptureError, match="a.exr: COLMAP undistorts"):
        undistort(radiance)
    monkeypatch.setattr(undistortion.importlib.util, "find_spec", lambda _: None)
    with pytest.raises(SvuEnvironmentError, match=r"svu_mi\[colmap\]"):
        undistort(small)


POINTS3D = """# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]
7 0.5 -1 2 1 2 3 0.1 1 4 2 5
9 -3 4e-1 6 1 2 3 0.1
"""


def test_points_of_the_reconstruction(tmp_path):
    """For units; they are optional, and damaged ones do not matter."""
    assert read_points(tmp_path) is None
    (tmp_path / "points3D.txt").write_text(POINTS3D)
    wanted = [[0.5, -1, 2], [-3, 0.4, 6]]
    np.testing.assert_array_equal(read_points(tmp_path), wanted)
    records = (struct.pack("<Q3d3BdQ", 7, *wanted[0], 1, 2, 3, 0.1, 2) + bytes(16)
               + struct.pack("<Q3d3BdQ", 9, *wanted[1], 1, 2, 3, 0.1, 0))  # fmt: skip
    (tmp_path / "points3D.bin").write_bytes(struct.pack("<Q", 2) + records)
    np.testing.assert_array_equal(read_points(tmp_path), wanted)
    (tmp_path / "points3D.bin").write_bytes(struct.pack("<Q", 2**60) + records)
    assert read_points(tmp_path) is None
    (tmp_path / "points3D.bin").unlink()
    for text in ("", "1 2\n", "1 nan 0 0 0\n", "1 a b c d\n", "\xff"):
        (tmp_path / "points3D.txt").write_text(text)
        assert read_points(tmp_path) is None
