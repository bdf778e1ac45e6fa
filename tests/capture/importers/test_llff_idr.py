"""LLFF, IDR and NeuS: files are written from camera axes, read, and compared by projection."""

from __future__ import annotations

import os
import warnings
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.colmap import write_colmap
from support.helpers import projected

from svu_mi.capture.image_io import open_image
from svu_mi.capture.importers import idr
from svu_mi.capture.importers.idr import decompose_projection
from svu_mi.capture.importers.nerf import write_transforms
from svu_mi.capture.importers.registry import ReadOptions, read_source
from svu_mi.capture.importers.resampling import with_size
from svu_mi.capture.importers.source import Source
from svu_mi.errors import CaptureError, OptionError, SvuError


def read_idr(path: Path, **options: object) -> Source:
    return idr.read(path, ReadOptions(**options))


SIZE = 40, 24  # width and height
POINTS = np.random.default_rng(6170).uniform(-0.3, 0.3, (6, 3))
SPHERE = np.array([[2.5, 0, 0, 0.3], [0, 2.5, 0, -0.2], [0, 0, 2.5, 0.1], [0, 0, 0, 1]])


@dataclass(frozen=True)
class Camera:
    """A pinhole camera, defined by its axes in the world without any convention.

    Attributes:
        eye: (3,).
        right: (3,), unit vector.
        down: (3,), unit vector.
        forward: (3,), unit vector.
        focal: (fx, fy), in pixels.
        center: (cx, cy), (0, 0) is the corner of the first pixel.
    """

    eye: np.ndarray
    right: np.ndarray
    down: np.ndarray
    forward: np.ndarray
    focal: tuple[float, float] = (50.0, 50.0)
    center: tuple[float, float] = (SIZE[0] / 2, SIZE[1] / 2)

    def pixels(self, points: np.ndarray) -> np.ndarray:
        """Project points (N, 3) to (N, 2)."""
        away = points - self.eye
        depth = away @ self.forward
        assert (depth > 0).all()
        plane = np.stack([away @ self.right, away @ self.down], axis=-1) / depth[:, None]
        return plane * self.focal + self.center

    @property
    def world_mat(self) -> np.ndarray:
        """Return K [R | t] of IDR, with the centre of the first pixel at (0, 0)."""
        K = np.array([[self.focal[0], 0, self.center[0] - 0.5],
                      [0, self.focal[1], self.center[1] - 0.5], [0, 0, 1]])  # fmt: skip
        rotation = np.stack([self.right, self.down, self.forward])
        matrix = np.eye(4)
        matrix[:3, :3] = K @ rotation
        matrix[:3, 3] = -K @ rotation @ self.eye
        return matrix

    @property
    def row(self) -> np.ndarray:
        """Return the row of LLFF: 3 x 5 matrix, near and far."""
        width, height = SIZE
        columns = [self.down, self.right, -self.forward, self.eye, [height, width, self.focal[0]]]
        return np.concatenate([np.stack(columns, axis=-1).ravel(), [2.0, 9.0]])

    @property
    def pose(self) -> np.ndarray:
        """Return the pose (4, 4) in Mitsuba's axes: +X left, +Y up, +Z forward."""
        matrix = np.eye(4)
        matrix[:3] = np.stack([-self.right, -self.down, self.forward, self.eye], axis=-1)
        return matrix


def looking(index: int, **fields: tuple[float, float]) -> Camera:
    """Return a camera towards the origin, with another position and roll for each index."""
    rng = np.random.default_rng([811, index])
    eye = rng.normal(size=3)
    eye *= 4 / np.linalg.norm(eye)
    forward = -eye / 4
    right = np.cross(forward, rng.normal(size=3))
    right /= np.linalg.norm(right)
    return Camera(eye, right, np.cross(forward, right), forward, **fields)


CENTERED = [looking(index) for index in range(3)]
SHIFTED = [
    looking(7, focal=(52.0, 47.0), center=(23.25, 9.0)), looking(8, center=(17.0, 13.75)),
    looking(9, focal=(61.0, 61.0), center=(21.5, 14.5)),
]  # fmt: skip


def shoot(folder: Path, names: list[str], size: tuple[int, int] = SIZE) -> None:
    """Write photographs with different grey values."""
    folder.mkdir(parents=True, exist_ok=True)
    for index, name in enumerate(names):
        Image.new("RGB", size, (60 + index,) * 3).save(folder / name)


def write_llff(folder: Path, rows: object = None, images: str = "images") -> Path:
    """Write poses, and photographs in the order of their names."""
    shoot(folder / images, ["b.jpg", "a.jpg", "c.png"])
    np.save(folder / "poses_bounds.npy", [c.row for c in CENTERED] if rows is None else rows)
    return folder


def matrices(cameras: list[Camera], sphere: np.ndarray | None = SPHERE) -> dict[str, np.ndarray]:
    """Return the arrays of IDR, and others that must be ignored."""
    arrays = {f"world_mat_{k}": camera.world_mat for k, camera in enumerate(cameras)}
    arrays |= {f"world_mat_inv_{k}": np.full((4, 4), np.nan) for k in range(len(cameras))}
    if sphere is not None:
        arrays |= {f"scale_mat_{k}": sphere for k in range(len(cameras))}
    return arrays


def write_idr(
    folder: Path, arrays: dict[str, np.ndarray] | None = None, file: str = "cameras_sphere.npz"
) -> Path:
    """Write three cameras and photographs."""
    shoot(folder / "image", [f"{k:06d}.png" for k in range(3)])
    np.savez(folder / file, **(matrices(SHIFTED) if arrays is None else arrays))
    return folder


def same(source: Source, cameras: list[Camera], atol: float = 1e-9) -> None:
    """Compare poses, intrinsics, and projections of world points."""
    for frame, camera in zip(source.frames, cameras, strict=True):
        np.testing.assert_allclose(frame.to_world, camera.pose, atol=atol)
        np.testing.assert_allclose(frame.focal, camera.focal, rtol=atol)
        np.testing.assert_allclose(frame.center, camera.center, rtol=atol)
        assert frame.size == SIZE
        wanted = camera.pixels(POINTS)
        assert np.ptp(wanted, axis=0).min() > 1  # detects any exchanged axis
        np.testing.assert_allclose(projected(frame, POINTS), wanted, atol=2e-3)


# --- round trips ----------------------------------------------------------


@pytest.mark.parametrize("kind", [np.float64, np.float32])
def test_poses_of_llff_are_read(tmp_path, kind):
    rows = np.array([camera.row for camera in CENTERED], kind)
    folder = write_llff(tmp_path / "fern", rows)
    for path in (folder, folder / "poses_bounds.npy"):
        source = read_source(path)
        assert (source.format, source.root) == ("llff", folder)
        assert [f.image.name for f in source.frames] == ["a.jpg", "b.jpg", "c.png"]
        assert all(frame.mask is None for frame in source.frames)
        same(source, CENTERED, 1e-9 if kind is np.float64 else 1e-6)
    (note,) = source.notes
    assert note.startswith(f"{folder / 'poses_bounds.npy'}: ") and "lens" in note


def test_smaller_copies_of_llffs_photographs_are_chosen(tmp_path):
    folder = write_llff(tmp_path)
    shoot(folder / "images_4", ["0.png", "1.png", "2.png"], (10, 6))
    assert {f.image.parent.name for f in read_source(folder).frames} == {"images"}
    small = read_source(folder, ReadOptions(images=folder / "images_4"))
    for frame, camera in zip(small.frames, CENTERED, strict=True):
        frame = with_size(frame, open_image(frame.image).size)
        assert (frame.size, frame.focal, frame.center) == ((10, 6), (12.5, 12.5), (5.0, 3.0))
        wanted = camera.pixels(POINTS) / 4
        np.testing.assert_allclose(projected(frame, POINTS), wanted, atol=2e-3)


@pytest.mark.parametrize("file", ["cameras_sphere.npz", "cameras.npz"])
def test_cameras_of_idr_are_read(tmp_path, file):
    folder = write_idr(tmp_path / "scan24", file=file)
    for path in (folder, folder / file):
        source = read_source(path)
        assert (source.format, source.root) == ("idr", folder)
        assert [f.image.name for f in source.frames] == ["000000.png", "000001.png", "000002.png"]
        same(source, SHIFTED)
    assert source.notes == [
        f"{folder / file}: poses are in the world of world_mat; a mesh in the unit sphere of "
        "scale_mat (scale 2.5 and centre 0.3, -0.2, 0.1), as meshes of NeuS are, needs "
        "--normalized."
    ]


def test_cameras_sphere_is_preferred_to_cameras(tmp_path):
    write_idr(tmp_path, matrices(CENTERED, None), "cameras.npz")
    same(read_source(write_idr(tmp_path)), SHIFTED)


def test_normalized_poses_see_a_normalized_mesh(tmp_path):
    """World = scale_mat times unit sphere: projections of both must be equal."""
    (note,) = read_source(write_idr(tmp_path), ReadOptions(normalized=True)).notes
    assert "unit sphere" in note and "without --normalized" in note
    inside = (POINTS - SPHERE[:3, 3]) / 2.5
    for frame, camera in zip(read_idr(tmp_path, normalized=True).frames, SHIFTED, strict=True):
        np.testing.assert_allclose(projected(frame, inside), camera.pixels(POINTS), atol=2e-3)
        np.testing.assert_allclose(frame.focal, camera.focal, rtol=1e-9)
        np.testing.assert_allclose(frame.to_world[:3, :3], camera.pose[:3, :3], atol=1e-9)
        np.testing.assert_allclose(2.5 * frame.to_world[:3, 3] + SPHERE[:3, 3], camera.eye)
    with pytest.raises(OptionError, match="has no scale_mat_0; omit --normalized"):
        read_idr(write_idr(tmp_path, matrices(SHIFTED, None)), normalized=True)
    assert read_idr(tmp_path).notes == []


def test_packed_and_single_precision_cameras_are_read(tmp_path):
    folder = write_idr(tmp_path)
    single = {name: array.astype(np.float32) for name, array in matrices(SHIFTED).items()}
    np.savez_compressed(folder / "cameras_sphere.npz", **single)
    same(read_idr(folder), SHIFTED, 1e-5)


def test_a_projection_is_taken_apart_whatever_its_factor():
    camera = SHIFTED[0]
    for factor in (1e-3, 1.0, 700.0):
        K, pose = decompose_projection(factor * camera.world_mat[:3], "P")
        assert K[2, 2] == 1 and K[1, 0] == K[2, 0] == K[2, 1] == 0
        np.testing.assert_allclose([K[0, 0], K[1, 1]], camera.focal, rtol=1e-12)
        assert np.linalg.det(pose[:3, :3]) == pytest.approx(1, abs=1e-12)
        axes = np.stack([camera.right, camera.down, camera.forward], axis=-1)
        np.testing.assert_allclose(pose[:3, :3], axes, atol=1e-12)
        np.testing.assert_allclose(pose[:3, 3], camera.eye, atol=1e-12)


# --- masks ----------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["masks", "mask", "elsewhere"])
def test_masks_of_llff_go_by_name(tmp_path, name):
    folder = write_llff(tmp_path)
    shoot(folder / name, ["a.png", "c.png.png"])  # for a.jpg and c.png
    asked = folder / name if name == "elsewhere" else None
    masks = [frame.mask for frame in read_source(folder, ReadOptions(masks=asked)).frames]
    assert masks == [folder / name / "a.png", None, folder / name / "c.png.png"]


@pytest.mark.parametrize("name", ["mask", "masks", "elsewhere"])
def test_masks_of_idr_go_by_their_order(tmp_path, name):
    folder = write_idr(tmp_path)
    shoot(folder / name, ["002.png", "001.png", "000.png", "._000.png"])
    (folder / name / "readme.txt").write_text("masks")
    asked = folder / name if name == "elsewhere" else None
    masks = [frame.mask for frame in read_source(folder, ReadOptions(masks=asked)).frames]
    assert masks == [folder / name / f"00{k}.png" for k in range(3)]
    (folder / name / "001.png").unlink()
    with pytest.raises(CaptureError, match=f"{name}: has 2 masks for 3 photographs; add"):
        read_idr(folder, masks=asked)


# --- detection of the format ---------------------------------------------------------------


def test_folders_with_several_formats_are_read_as_before(tmp_path):
    """Detection prefers transforms and COLMAP, and a note names the other formats."""
    lines, cameras = write_llff(tmp_path / "llff"), write_idr(tmp_path / "idr")
    frames = read_source(lines).frames
    model = tmp_path / "model"
    write_colmap(model, Source(format="test", root=lines, frames=frames))
    assert read_source(model).format == "colmap" and len(read_source(model).notes) == 1
    for folder, name in ((lines, "llff"), (cameras, "idr")):
        (model / "sparse").rename(folder / "sparse")
        (folder / "images").mkdir(exist_ok=True)
        for k in range(3):
            (folder / "images" / f"view_000{k}.png").touch()
            (folder / "images" / f"view_000{k}.jpg").touch()
        both = read_source(folder)
        assert both.format == "colmap"
        assert both.notes[-1] == (
            f"{folder}: is read as colmap, but also contains poses of {name}; --format {name} "
            "reads them."
        )
        assert len(read_source(folder, ReadOptions(format="colmap")).notes) == 1
        (folder / "sparse").rename(model / "sparse")
        write_transforms(folder / "transforms.json", frames)
        assert read_source(folder).format == "transforms"
    (tmp_path / "nothing").mkdir()
    with pytest.raises(CaptureError, match=r"contains transforms.json, .*poses_bounds.npy, cam"):
        read_source(tmp_path / "nothing")


# --- errors ------------------------------------------------------------------


def changed(index: int | list[int], value: float, factor: float = 0) -> np.ndarray:
    rows = np.array([camera.row for camera in CENTERED])
    rows[1, index] = value + factor * rows[1, index]
    return rows


BAD_ROWS = {
    "16 columns": (changed(3, 1)[:, :16], r"3 photographs x 17 in .*, got .* shape \(3, 16\)"),
    "flat": (changed(3, 1).ravel(), r"photographs x 17 in .*, got .* shape \(51,\); export"),
    "one number": (np.float64(3), "10000 photographs x 17 in .*, got 3.0; export them again"),
    "none": (np.zeros((0, 17)), r"10000 photographs x 17 in .* shape \(0, 17\)"),
    "NaN": (changed(6, np.nan), "3 photographs x 17 .*, got nan; export"),
    "infinite": (changed(14, np.inf), "3 photographs x 17 .*, got inf; export"),
    "objects": (np.array([[print] * 17] * 3, object), "declares pickled objects; export"),
    "words": (np.full((3, 17), "a"), "the array has type <U1; expected real numbers"),
    "complex": (changed(3, 1).astype(complex), "the array has type complex128; expected real"),
    "mirrored": (changed([0, 5, 10], 0, -1), r"pose 1: the pose is mirrored \(determinant < 0\)"),
    "parts of pixels": (changed(4, 23.5), "pose 1: size must be 2 whole num.* got 23.5"),
    "no height": (changed(4, 0), r"pose 1: size must be 2 .* in \[1, 65536\] pixels, got 0"),
    "no focal length": (changed(14, 0), r"pose 1: focal length must .* \[0.001, 1e\+06\] times"),
    "too few": (changed(3, 1)[:2], "has 3 photographs, but .*poses_bounds.npy has 2 poses; give"),
}


def sentence(error: SvuError, folder: Path) -> str:
    """Return the message: one line that begins with a file and ends with a remedy."""
    text = str(error)
    assert text.startswith(str(folder)) and "\n" not in text
    assert text.endswith(".") and ("; " in text or ": " in text.replace(str(folder), ""))
    return text


def but(**changes: object) -> dict[str, np.ndarray]:
    """Return arrays of IDR with some changed, or removed if None."""
    arrays = {**matrices(SHIFTED), **changes}
    return {name: value for name, value in arrays.items() if value is not None}


def intrinsics(matrix: np.ndarray) -> np.ndarray:
    """Put another K before the rotation of the second camera."""
    c = SHIFTED[1]
    rotation = np.stack([c.right, c.down, c.forward])
    made = np.eye(4)
    made[:3] = matrix @ np.concatenate([rotation, (-rotation @ c.eye)[:, None]], axis=1)
    return made


SKEWED = np.array([[50.0, 0.2, 16], [0, 50, 13], [0, 0, 1]])
FLAT = np.array([[50.0, 0, 16], [0, 0, 13], [0, 0, 1]])
BAD_ARRAYS = {
    "no world_mat": (but(world_mat_1=None), "world_mat_1 is missing; write the cameras again"),
    "nothing": ({"other": np.eye(4)}, "world_mat_0 is missing; write the cameras again, with"),
    "no scale_mat": (but(scale_mat_2=None), "scale_mat_2 is missing; .* none of scale_mat_0,"),
    "NaN": (but(world_mat_1=np.full((4, 4), np.nan)), "world_mat_1 must be 4 x 4 .*, got nan"),
    "3 x 4": (but(world_mat_1=SHIFTED[1].world_mat[:3]), r"4 x 4 .*, got .* shape \(3, 4\)"),
    "transposed": (but(world_mat_1=SHIFTED[1].world_mat.T), "last row of world_mat_1 must be"),
    "objects": (but(world_mat_1=np.array([print] * 16, object)), "declares pickled objects; write"),
    "mirrored": (
        but(world_mat_1=SHIFTED[1].world_mat @ np.diag([1.0, 1, -1, 1])),
        r"world_mat_1: is mirrored \(determinant < 0\)",
    ),
    "negative": (
        but(world_mat_1=np.diag([-1.0, -1, -1, 1]) @ SHIFTED[1].world_mat),
        r"world_mat_1: is mirrored .*, or negate it\.",
    ),
    "degenerate": (but(world_mat_1=intrinsics(FLAT)), "world_mat_1: is singular"),
    "zero": (but(world_mat_1=np.diag([0.0, 0, 0, 1])), "world_mat_1: is singular"),
    "skew": (
        but(world_mat_1=intrinsics(SKEWED)),
        "world_mat_1: the camera has a skew of 0.2 for a focal",
    ),
    "another sphere": (but(scale_mat_1=np.eye(4)), "scale_mat_1 differs from scale_mat_0"),
    "a flat sphere": (
        matrices(SHIFTED, np.diag([1.0, 1, 0, 1])),
        "scale_mat_0 must be a positive uniform",
    ),
    "an ellipsoid": (
        matrices(SHIFTED, np.diag([1.0, 1, 2, 1])),
        "scale_mat_0 must be a positive uniform",
    ),
    "too many": (matrices([*SHIFTED, CENTERED[0]]), "has 3 photographs, but .* has 4 poses; give"),
}


@pytest.mark.parametrize(("write", "written", "words"), [
    *((write_llff, *case) for case in BAD_ROWS.values()),
    *((write_idr, *case) for case in BAD_ARRAYS.values()),
], ids=[*BAD_ROWS, *BAD_ARRAYS])  # fmt: skip
def test_poses_that_are_none(tmp_path, write, written, words):
    folder = write(tmp_path, written)
    with pytest.raises(CaptureError, match=words) as error:
        read_source(folder)
    sentence(error.value, folder)


def test_a_skew_that_does_not_matter_is_left_out(tmp_path):
    nearly = SKEWED * [[1, 0.2, 1], [1, 1, 1], [1, 1, 1]]
    frame = read_idr(write_idr(tmp_path, but(world_mat_1=intrinsics(nearly)))).frames[1]
    np.testing.assert_allclose(frame.to_world, SHIFTED[1].pose, atol=1e-9)


def test_folders_that_are_not_there(tmp_path):
    llff, idr = write_llff(tmp_path / "llff"), write_idr(tmp_path / "idr")
    gone = tmp_path / "gone"
    for folder in (llff, idr):
        with pytest.raises(CaptureError, match="gone: no such folder; .*--images"):
            read_source(folder, ReadOptions(images=gone))
        with pytest.raises(CaptureError, match="gone: no such folder; .*--masks"):
            read_source(folder, ReadOptions(masks=gone))
    (llff / "images").rename(llff / "images_8")
    with pytest.raises(
        CaptureError, match="images: no such folder; give the folder of the photographs"
    ):
        read_source(llff)
    shoot(llff / "masks", ["z.png"])
    with pytest.raises(CaptureError, match="masks: has no mask of a.jpg or any other photograph;"):
        read_source(llff, ReadOptions(images=llff / "images_8"))
    for form, name in (("llff", "poses_bounds.npy"), ("idr", "cameras_sphere.npz")):
        with pytest.raises(CaptureError, match=f"{name}: the path is not a file; "):
            read_source(tmp_path, ReadOptions(format=form))


def test_files_that_promise_more_than_they_hold_are_not_read(tmp_path):
    folder = write_llff(tmp_path / "llff")
    file = folder / "poses_bounds.npy"
    whole = file.read_bytes()
    for data in (
        b"", b"text", whole[:-8], whole.replace(b"(3, 17)", b"(9**9)"),
        whole.replace(b"(3, 17), }", b"(10**11,)}"), whole.replace(b"<f8", b"|O8"),
    ):  # fmt: skip
        file.write_bytes(data)
        with pytest.raises(CaptureError, match="poses_bounds.npy: .*; export them again") as e:
            read_source(folder)
        sentence(e.value, folder)
    os.truncate(file, 2**24 + 1)
    with pytest.raises(CaptureError, match="the file has more than 16777216 bytes"):
        read_source(folder)


def test_archives_that_hold_more_than_they_should(tmp_path):
    folder = write_idr(tmp_path)
    file = folder / "cameras_sphere.npz"
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("world_mat_0.npy", bytes(2**26 + 1))
    with pytest.raises(CaptureError, match="the arrays have more than 67108864 bytes"):
        read_source(folder)
    with zipfile.ZipFile(file, "w", zipfile.ZIP_LZMA) as archive:
        archive.writestr("world_mat_0.npy", b"any")
    with pytest.raises(CaptureError, match="unknown compression"):
        read_source(folder)
    with warnings.catch_warnings(), zipfile.ZipFile(file, "w") as archive:
        warnings.simplefilter("ignore")
        for name in ("world_mat_0.npy", "world_mat_0"):
            archive.writestr(name, b"any")
    with pytest.raises(CaptureError, match="two arrays have the same name"):
        read_source(folder)
    file.write_bytes(b"no archive")
    with pytest.raises(CaptureError, match="not a zip file; write the cameras again"):
        read_source(folder)


# --- the command ----------------------------------------------------------------------
