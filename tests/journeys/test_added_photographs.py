"""Photographs that svu guide proposes are added to a capture, as the page on guiding describes."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from support.helpers import run, sensor_xml, write_scene

import svu_mi as svu
from svu_mi.capture.importers.nerf import write_transforms
from svu_mi.capture.importers.source import frame_of
from svu_mi.capture.scene import to_world
from svu_mi.core.io.exr import write_exr

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("variant")]
GUIDE = ("--candidates", 6, "--add", 2, "--resolution", 32, "--no-pictures", "-o", "out/next")


@pytest.fixture
def made(tmp_path, monkeypatch):
    """A scene, and three photographs in a folder without ``capture.json``."""
    monkeypatch.chdir(tmp_path)
    scene = write_scene(tmp_path, sensors=sensor_xml(3))
    capture = svu.render_capture(scene, 4, folder="shot")
    shutil.copytree("shot", "photographs", ignore=shutil.ignore_patterns("*.json"))
    return capture


def proposed(capture, count):
    """Check that ``capture`` ends with the proposed poses."""
    poses = [
        one["pose"]["to_world"]
        for one in json.loads(Path("out/next/guidance.json").read_text())["proposals"]
    ]
    assert capture.count == count + 2 and all(capture.used)
    for pose, sensor in zip(poses, capture.sensors[count:], strict=True):
        np.testing.assert_allclose(to_world(sensor), pose, atol=1e-5)


def test_sensors_are_included_in_a_scene(made, root, tmp_path):
    assert run("guide", "scene.xml", "--images", "photographs", *GUIDE) == 0
    page = (root / "notebooks" / "guiding.md").read_text()
    include = re.search("<include .*/>", page)[0]
    for name in ("view_0003.exr", "view_0004.exr"):
        shutil.copyfile("photographs/view_0000.exr", f"photographs/{name}")
    scene = tmp_path / "scene.xml"
    scene.write_text(scene.read_text().replace("<shape", f"{include}<shape", 1))
    proposed(svu.load_capture(scene, "photographs"), 3)


def test_frames_are_appended_to_transforms(made):
    frames = [frame_of(s, Path(n)) for s, n in zip(made.sensors, made.files, strict=True)]
    write_transforms("photographs/transforms.json", frames)
    write_exr("probe.exr", {"RGB": np.ones((8, 16, 3), np.float32)})
    line = "import", "photographs", "--mesh", "ball.ply", "--environment", "probe.exr", "-o", "mine"
    assert run(*line) == 0
    assert run("guide", "mine", *GUIDE) == 0
    known, new = (json.loads(Path(f"{folder}/transforms.json").read_text())
                  for folder in ("photographs", "out/next"))  # fmt: skip
    for frame in new["frames"]:
        shutil.copyfile("photographs/view_0000.exr", f"photographs/{frame['file_path']}")
    known["frames"] += new["frames"]
    Path("photographs/transforms.json").write_text(json.dumps(known))
    assert run(*line) == 0
    proposed(svu.load_capture("mine"), 3)
