"""What new users have: a scene of ours copied out, and photographs of it."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from support.journey import done

from svu_mi.capture.importers.nerf import write_transforms
from svu_mi.capture.importers.source import frame_of


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
    """The same desk, with what another program has written: poses, photographs, a mesh, a light."""
    import svu_mi as svu

    frames = []
    (desk / "blender" / "images").mkdir(parents=True)
    for number, sensor in enumerate(svu.load_capture(desk / "capture").sensors):
        path = desk / "blender" / "images" / f"IMG_{number + 1}.exr"
        shutil.copy(desk / "capture" / f"view_{number:04d}.exr", path)
        frames.append(frame_of(sensor, path))
    write_transforms(desk / "blender" / "transforms.json", frames)
    shutil.copy(desk / "scenes" / "vase" / "mesh.ply", desk / "scan.ply")
    shutil.copy(desk / "scenes" / "lights" / "window.exr", desk / "probe.exr")
    return desk
