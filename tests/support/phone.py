"""What somebody with a phone has: JPEGs with EXIF, COLMAP's model of them, and a scan in mm."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import trimesh
from PIL import Image
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

import svu_mi as svu
from support.helpers import render_views
from svu_mi import scenes
from svu_mi.capture.image_io import srgb
from svu_mi.capture.mesh import arrays
from svu_mi.capture.scene import load_scene, to_world
from svu_mi.capture.sensors import sphere_sensors
from svu_mi.parameters import CHANNELS

OBJECT, LIGHT = scenes.path("vase"), "window"
VIEWS, WIDTH, HEIGHT = 30, 256, 192
FAR = 3.9  # distance of the cameras
MARGIN = 24  # pixels around a photograph that its lens bends into it
RADIAL = (-0.06, 0.015)  # of COLMAP: x' = x (1 + k1 r^2 + k2 r^4)
RATIO = 1.6  # of the longest and the shortest exposure
MILLIMETRES = 1000.0  # per unit of the poses
NOISE = 2e-4  # of the scan's vertices, relative to its size
WHITE = 0.98  # of the pixels that the longest exposure does not clip
TIME = 0x829A  # tag of EXIF


def write_phone_capture(folder: Path, spp: int = 16) -> float:
    """Write ``my_colmap_project`` and ``scan.obj``.

    Returns:
        Radiance of a pixel of the median photograph, relative to the light of the scene.
    """
    scene = load_scene(OBJECT, {"light": LIGHT})
    shape = scene.shapes()[0]
    size = WIDTH + 2 * MARGIN, HEIGHT + 2 * MARGIN
    sensors = sphere_sensors(shape, VIEWS, size, 40.0, distance=FAR, lowest=-0.3)
    focal = size[1] / 2 / np.tan(np.radians(20.0))  # of the shorter side
    project = folder / "my_colmap_project"
    (project / "images").mkdir(parents=True)
    photographs = [_bent(image, focal) for image in render_views(scene, sensors, spp)]
    exposures = RATIO ** np.random.default_rng(70129).permutation(np.linspace(-0.5, 0.5, VIEWS))
    white = np.quantile(photographs, WHITE) * exposures.max() / RATIO**0.5
    for k, (pixels, gain) in enumerate(zip(photographs, exposures, strict=True)):
        exif = Image.Exif()
        exif.get_ifd(0x8769).update({TIME: float(gain) / 60, 0x829D: 1.8, 0x8827: 64})
        code = np.uint8(np.round(255 * srgb(np.clip(pixels * gain / white, 0, 1))))
        Image.fromarray(code).save(project / f"images/IMG_{k:04d}.jpg", quality=97, exif=exif)
    _write_model(project / "sparse" / "0", sensors, focal, shape)
    mesh = arrays(shape)
    rng = np.random.default_rng(1127)
    scan = trimesh.Trimesh(mesh.positions, mesh.faces)  # joins vertices at seams
    shake = rng.normal(0, NOISE * np.ptp(mesh.positions, axis=0).max(), scan.vertices.shape)
    scan.vertices = MILLIMETRES * (scan.vertices + shake)
    scan.export(folder / "scan.obj", include_normals=False, include_texture=False)
    return float(np.median(exposures) / white)


def true_textures(mesh: Any, resolution: int) -> dict[str, np.ndarray]:
    """Return the true parameters (T, C) at the texels of an imported scan, by the nearest point."""
    shape = load_scene(OBJECT, {"light": LIGHT}).shapes()[0]
    dense = svu.texels(shape, 512)
    nearest = cKDTree(_places(dense)).query(_places(svu.texels(mesh, resolution)))[1]
    index = dense.index.numpy()[nearest]
    truth = {}
    for name, count in CHANNELS.items():
        bitmap = mi.Bitmap(str(OBJECT.parent / f"{name}.exr")).resample((512, 512))
        truth[name] = np.array(bitmap, np.float32).reshape(512 * 512, -1)[index, :count]
    return truth


def _places(grid: svu.Texels) -> np.ndarray:
    return np.array(grid.position.numpy()).T


def _bent(image: np.ndarray, focal: float) -> np.ndarray:
    """Return what the lens shows of a larger photograph without distortion."""
    row, column = np.indices((HEIGHT, WIDTH)) + 0.5
    seen = np.stack([column - WIDTH / 2, row - HEIGHT / 2]) / focal
    straight = seen
    for _ in range(30):
        square = (straight**2).sum(axis=0)
        straight = seen / (1 + RADIAL[0] * square + RADIAL[1] * square**2)
    x, y = straight * focal + np.array([WIDTH, HEIGHT])[:, None, None] / 2 + MARGIN - 0.5
    return np.stack([map_coordinates(c, [y, x], order=1) for c in np.moveaxis(image, 2, 0)], axis=2)


def _write_model(folder: Path, sensors: Any, focal: float, shape: Any) -> None:
    """Write COLMAP's text files; rows of a rotation are the axes +X right, +Y down, +Z forward."""
    folder.mkdir(parents=True)
    camera = ["1 RADIAL", WIDTH, HEIGHT, focal, WIDTH / 2, HEIGHT / 2, *RADIAL]
    (folder / "cameras.txt").write_text(" ".join(map(str, camera)) + "\n")
    images = []
    for k, sensor in enumerate(sensors):
        pose = to_world(sensor)
        rotation = (pose[:3, :3] * [-1, -1, 1]).T
        x, y, z, w = Rotation.from_matrix(rotation).as_quat()
        offset = -rotation @ pose[:3, 3]
        images.append(" ".join(map(str, [k + 1, w, x, y, z, *offset, 1, f"IMG_{k:04d}.jpg"])))
    (folder / "images.txt").write_text("\n\n".join(images) + "\n\n")
    points = arrays(shape).positions[::7]
    lines = (f"{k} {x} {y} {z} 0 0 0 1" for k, (x, y, z) in enumerate(points))
    (folder / "points3D.txt").write_text("\n".join(lines) + "\n")
