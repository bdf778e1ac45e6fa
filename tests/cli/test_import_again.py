"""``svu import`` records its options; ``svu check`` prints them as a command."""

from __future__ import annotations

import json
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

import svu_mi as svu
from svu_mi.capture.importers.import_options import ENVIRONMENT_AXES, Light
from svu_mi.capture.importers.nerf import write_transforms
from svu_mi.capture.importers.registry import ReadOptions
from svu_mi.capture.importers.source import Frame
from svu_mi.capture.sensors import affine
from svu_mi.cli.import_ import Conversion, Import, _parse_arguments, reimport_command
from svu_mi.cli.main import main
from svu_mi.core.io.exr import write_exr


@pytest.fixture
def given(tmp_path, monkeypatch):
    """NeRF folder with a photograph, a mesh and a light, as working directory."""
    folder = tmp_path / "my nerf"
    folder.mkdir()
    trimesh.creation.icosphere(subdivisions=2).export(folder / "scan.ply")
    write_exr(folder / "probe.exr", {"RGB": np.ones((8, 16, 3))})
    write_exr(folder / "0.exr", {"RGB": np.full((6, 8, 3), 0.5)})
    pose = affine(np.diag([-1.0, 1, -1]), [0, 0, 4])
    frame = Frame(
        label="0", image=folder / "0.exr", to_world=pose, focal=(9.0, 9.0), center=(4.0, 3.0),
        size=(8, 6),
    )  # fmt: skip
    write_transforms(folder / "transforms.json", [frame])
    monkeypatch.chdir(tmp_path)
    return folder


NEEDED = ["my nerf", "--mesh", "my nerf/scan.ply"]
OPTIONS = {
    "nothing else": [],
    "a light": ["--environment", "my nerf/probe.exr", "--environment-axes", "blender",
                "--environment-scale", "2.5"],
    "axes and units": ["--mesh-up", "y", "--world-up", "z", "--mesh-scale", "0.5"],
    "a format": ["--format", "transforms", "--original-world"],
    "fixes": ["--geometry-only", "--fix", "camera-z180", "--fix", "mesh-mirror"],
}  # fmt: skip


@pytest.mark.parametrize("kind", OPTIONS)
def test_the_whole_command_is_printed_again(given, capsys, kind):
    words = [*NEEDED, *OPTIONS[kind]]
    assert main(["import", *words, "-o", "the capture"]) == 0
    record = json.loads((given.parent / "the capture/capture.json").read_text())["import"]
    assert sorted(record["options"]) == sorted(words)
    capture = svu.load_capture("the capture", light="optional")
    line = reimport_command(capture, ["camera-y180", "light-flip"])
    assert line.startswith("svu import 'my nerf' ")
    assert line.endswith(" --fix camera-y180 --fix light-flip -o 'the capture'")
    program, *again = shlex.split(line)
    assert program == "svu" and main(again) == 0  # as pasted into a shell
    after = json.loads((given.parent / "the capture/capture.json").read_text())["import"]
    assert after["fixes"] == [*record["fixes"], "camera-y180", "light-flip"]
    assert after["options"] == again[1:-2]


@pytest.mark.parametrize(("given_before", "said", "left"), [
    (["camera-z180"], ["camera-z180"], []),
    (["camera-x180", "mesh-x90"], ["mesh-x90"], ["camera-x180", "mesh-x90", "mesh-x90"]),
    (["light-mirror", "camera-inverse"], ["camera-inverse", "light-mirror"], []),
    (["light-flip"], ["light-turn-90"], ["light-flip", "light-turn-90"]),
])  # fmt: skip
def test_a_correction_that_was_wrong_is_left_out(given, given_before, said, left):
    """Applying a correction twice cancels it, except for quarter turns."""
    words = [word for name in given_before for word in ("--fix", name)]
    assert main(["import", *NEEDED, *words, "-o", "capture"]) == 0
    line = reimport_command(svu.load_capture("capture", light="optional"), said)
    words = [word for name in left for word in ("--fix", name)]
    assert line == shlex.join(["svu", "import", *NEEDED, *words, "-o", "capture"])


@pytest.mark.filterwarnings("default::svu_mi.SvuWarning")
def test_a_unit_is_corrected_by_the_printed_command(given, capsys):
    """A scan in mm that was taken for cm: --mesh-scale 0.01 becomes 0.001."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=1000.0)
    ball.export(given / "scan.ply")
    assert main(["import", *NEEDED, "--mesh-scale", "0.01", "-o", "capture"]) == 0
    said = capsys.readouterr().out
    assert "import with --mesh-scale 0.001." in said and "svu check" not in said
    first = said.splitlines()[-1].partition("import it again with: ")[2]
    assert main(["check", "capture", "-o", "checked"]) == 0
    said = capsys.readouterr()
    assert said.err.endswith("import with --mesh-scale 0.001.\n")
    line = said.out.partition("Import it again with: ")[2].splitlines()[0]
    right = ["svu", "import", *NEEDED, "--mesh-scale", "0.001", "-o", "capture"]
    assert line == first == shlex.join(right)
    assert main(shlex.split(line)[1:]) == 0
    assert "--mesh-scale" not in capsys.readouterr().out
    assert svu.load_capture("capture", light="optional").mesh.bbox().max.x == pytest.approx(1)


@pytest.fixture
def imported_with(given):
    """Return the capture with different recorded import options."""
    main(["import", *NEEDED, "-o", "capture"])
    path = given.parent / "capture/capture.json"
    record = json.loads(path.read_text())
    capture = svu.load_capture("capture", light="optional")

    def imported(options):
        record["import"]["options"] = options
        path.write_text(json.dumps(record))
        return capture

    return imported


def test_a_capture_of_unknown_words(imported_with):
    """Imported from Python or by an earlier version, or modified later."""
    for options in (None, "words", [1, 2], {}):
        again = reimport_command(imported_with(options), ["mesh-x90"])
        assert again == "svu import ... --fix mesh-x90"
    assert reimport_command(replace(imported_with({}), source=None), []) == "svu import ..."


@pytest.mark.parametrize("more", [
    ["another source"], ["--resume"], ["--mesh"], ["--fix", "-o"], ["--fix", "unknown"],
    ["--split", "test\n"], ["--split", "--", "x"], ["--split", "\x1b[2J"], ["--mesh=-o"], ["-h"],
])  # fmt: skip
def test_invalid_recorded_options_are_not_printed(imported_with, more, capsys):
    """An untrusted capture must not inject arguments into the command."""
    capsys.readouterr()
    for options in ([*NEEDED, *more], ["-o", *NEEDED]):
        again = reimport_command(imported_with(options), ["mesh-x90"])
        assert again == "svu import ... --fix mesh-x90"
    written = [*NEEDED, "-o", "elsewhere", "--trust", "--overwrite"]
    line = reimport_command(imported_with(written), [])
    assert line == shlex.join(["svu", "import", *NEEDED, "-o", "capture"])
    assert capsys.readouterr() == ("", "")


def test_every_option_is_known():
    """The command is printed completely for all options."""
    options = Conversion(
        mesh="m.ply", mesh_up="y", world_up="z", mesh_scale=2.0, geometry_only=True,
        environment=Light(path=Path("l.exr"), to_world=ENVIRONMENT_AXES["blender"], scale=2.0),
        exposures="exif", response=Path("r"), shrink=2.0, every=2, missing="leave-out",
        fixes=("mesh-x90", "camera-inverse"),
    )  # fmt: skip
    reading = ReadOptions(
        format="colmap", images=Path("i"), masks=Path("m"), split="test", environment_view="v",
        original_world=True, normalized=True,
    )  # fmt: skip
    asked = Import(source=Path("s"), undistort=True, reading=reading, conversion=options)
    again = _parse_arguments(asked.words)
    assert again.words == asked.words and again.conversion.fixes == ("mesh-x90", "camera-inverse")
