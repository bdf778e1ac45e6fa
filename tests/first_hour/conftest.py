"""What new users have: a scene of ours copied out, and photographs of it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from hour import done
from PIL import Image

from svu_mi.capture.picture import quantized, srgb
from svu_mi.formats.source import frame_of
from svu_mi.formats.transforms import write_transforms


@pytest.fixture(scope="session")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder in which the README's first commands were typed, with small photographs."""
    folder = tmp_path_factory.mktemp("desk")
    assert done("scenes vase", folder).out[-1] == (
        "Next: svu render scenes/vase/vase.xml -D light=window -o capture"
    )
    line = "render scenes/vase/vase.xml -D light=window -D resolution=64 --spp 8 -o capture"
    announced, wrote = done(line, folder).out
    assert announced.startswith("Needs up to 0.") and wrote == "Wrote 24 photographs to capture"
    return folder


@pytest.fixture(scope="session")
def shots(desk: Path) -> Path:
    """The same desk, with what another program has written: poses, 8-bit pictures, a mesh, a light.

    ``blender`` has EXR photographs, ``phone`` PNG, and ``lens`` says that they are distorted.
    """
    import svu_mi as svu

    capture = svu.load_capture(desk / "capture")
    for name in ("blender", "phone"):
        frames = []
        (desk / name / "images").mkdir(parents=True)
        for number, (sensor, image) in enumerate(zip(capture.sensors, capture.images, strict=True)):
            path = desk / name / "images" / f"IMG_{number + 1}.exr"
            if name == "blender":
                shutil.copy(desk / "capture" / f"view_{number:04d}.exr", path)
            else:
                path = path.with_suffix(".png")
                pixels = srgb(np.clip(np.nan_to_num(image), 0, 1))
                Image.fromarray(quantized(pixels)).save(path)
            frames.append(frame_of(sensor, path))
        write_transforms(desk / name / "transforms.json", frames)
    poses = json.loads((desk / "blender" / "transforms.json").read_text())
    lens = poses | {"k1": 0.02, "k2": -0.01, "p1": 0.0, "p2": 0.0}
    (desk / "blender" / "lens.json").write_text(json.dumps(lens))
    shutil.copy(desk / "scenes" / "vase" / "mesh.ply", desk / "scan.ply")
    shutil.copy(desk / "scenes" / "lights" / "window.exr", desk / "probe.exr")
    return desk
