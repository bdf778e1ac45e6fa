"""Ray-traced photographs through a distorted lens match their object after the import."""

from __future__ import annotations

import json
from pathlib import Path

import mitsuba as mi
import numpy as np
from oracle import lens as oracle
from scipy.ndimage import binary_dilation, binary_erosion

import svu_mi as svu
from svu_mi import scenes
from svu_mi.calibration.checks.thumbnails import Thumbnails, silhouettes
from svu_mi.capture.scene import to_world
from svu_mi.cli.main import main
from svu_mi.core.io.exr import write_exr

LENS = {"k1": -0.42, "k2": 0.06, "k3": 0.0, "k4": 0.0, "p1": 0.004, "p2": -0.003}
WIDTH, HEIGHT, FOCAL, CENTER = 200, 150, 270.0, (108.0, 70.5)
VIEWS = 4


def bent_photographs(folder: Path) -> Path:
    """Trace the knot through a lens; write photographs and poses like a phone."""
    scene = mi.load_file(str(scenes.path("knot")), optimize=False)
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    u, v = oracle.straight((x - CENTER[0]) / FOCAL, (y - CENTER[1]) / FOCAL, LENS)
    frames = []
    for k, sensor in enumerate(scene.sensors()[::6][:VIEWS]):
        pose = to_world(sensor)
        # Camera space has +X left and +Y up, pictures have +X right and +Y down.
        direction = np.stack([-u, -v, np.ones_like(u)], axis=-1).reshape(-1, 3) @ pose[:3, :3].T
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        ray = mi.Ray3f(mi.Point3f(pose[:3, 3]), mi.Vector3f(direction.T.astype(np.float32)))
        hit = scene.ray_intersect(ray)
        seen = np.array(hit.is_valid(), bool)
        color = np.where(seen[:, None], 0.5 + 0.5 * np.array(hit.n).T, 0.02)
        planes = np.concatenate([color, seen[:, None]], axis=1).reshape(HEIGHT, WIDTH, 4)
        channels = dict(zip("RGBA", np.moveaxis(planes, 2, 0), strict=True))
        write_exr(folder / f"IMG_{k}.exr", channels)
        matrix = pose @ np.diag([-1.0, 1, -1, 1])
        frames.append({"file_path": f"IMG_{k}.exr", "transform_matrix": matrix.tolist()})
    record = {"w": WIDTH, "h": HEIGHT, "fl_x": FOCAL, "fl_y": FOCAL, "cx": CENTER[0],
              "cy": CENTER[1], "frames": frames}  # fmt: skip
    (folder / "transforms.json").write_text(json.dumps({**record, **LENS}))
    return folder / "transforms.json"


def misplaced(folder: Path) -> float:
    """Return the share of wrong mask pixels of the object, except at its silhouette."""
    frames = Thumbnails.of(svu.load_capture(folder, light="optional"))
    wrong = whole = 0
    for seen, mask in zip(silhouettes(frames), frames.masks, strict=True):
        wrong += (mask & ~binary_dilation(seen)).sum()
        wrong += (binary_erosion(seen, iterations=2) & ~mask).sum()
        whole += seen.sum()
    return wrong / whole


def test_a_phones_photographs_lie_on_their_object(tmp_path, capsys):
    path = bent_photographs(tmp_path)
    words = ["--mesh", str(scenes.path("knot").parent / "mesh.ply"), "-o"]
    assert main(["import", str(path), *words, str(tmp_path / "capture")]) == 0
    said = (
        f"{VIEWS} of {VIEWS} photographs, IMG_0.exr first: undistorted; the focal length is "
        "kept, and empty borders are cropped."
    )
    assert said in capsys.readouterr().out
    record = json.loads(path.read_text())
    path.write_text(json.dumps({key: v for key, v in record.items() if key not in LENS}))
    assert main(["import", str(path), *words, str(tmp_path / "ignored")]) == 0
    right, wrong = (misplaced(tmp_path / name) for name in ("capture", "ignored"))
    assert right == 0 and wrong > 0.004, (right, wrong)
