"""The program: files and exit status 0 on good input, one clear line and 2 on bad input."""

from __future__ import annotations

import json
import re
import subprocess
import sys

import numpy as np
import pytest
from helpers import ball, fails, names, run, sensor_xml, write_scene

from svu_mi import scenes
from svu_mi.errors import SvuError
from svu_mi.exr import read_exr, write_exr

FILES = ["coverage.exr", "entropy.exr", "overview.png", "run.json"]


pytestmark = pytest.mark.usefixtures("variant")  # svu chooses one


def test_render_writes_a_capture_folder(shot):
    assert names(shot) == ["capture.json"] + [f"view_{i:04d}.exr" for i in range(8)]
    record = json.loads((shot / "capture.json").read_text())
    assert record["define"] == {"light": "window"}
    assert record["shape"] == "vase"
    image = read_exr(shot / "view_0003.exr")
    assert set(image) == set("RGBA")
    assert image["R"].shape == (32, 40)


def test_entropy_writes_four_files(shot, tmp_path, capsys):
    assert run("entropy", shot, "-o", tmp_path, "--resolution", 64, 32, "-t", 2) == 0
    told = capsys.readouterr().out.splitlines()[-1]
    assert names(tmp_path) == FILES
    entropy = read_exr(tmp_path / "entropy.exr")
    coverage = read_exr(tmp_path / "coverage.exr")
    assert list(entropy) == list(coverage) == ["Y"]
    assert entropy["Y"].shape == (32, 64)
    assert (entropy["Y"] >= 0).all()
    assert (entropy["Y"] <= 1).all()
    assert (entropy["Y"][coverage["Y"] == 0] == 1).all()
    assert coverage["Y"].max() <= 8
    record = json.loads((tmp_path / "run.json").read_text())
    assert record["settings"]["preset"]["name"] == "default"
    assert record["environment"]["variant"].endswith("_ad_rgb")
    assert record["timings_s"]
    assert record["skipped"]["views left out"] == 0
    known = record["result"]["intervals"]["known_part"]
    words = [f"{name} {part}" for name, part in zip(
        ("Roughness known to ±0.05 on", "of the surface seen, metallic on", "base colour on"),
        ("under 1 %" if 0 < part <= 0.005 else f"{100 * part:.0f} %" for part in known.values()),
        strict=True,
    )]  # fmt: skip
    assert told == f"{words[0]} {words[1]}, {words[2]} (90 % intervals)."


def test_a_scene_and_a_folder_of_images_are_an_input_too(shot, tmp_path):
    status = run("entropy", scenes.path("vase"), "--images", shot, "-D", "light=window", "-t", 1,
                 "--resolution", 48, "-o", tmp_path, "--preset", "paper")  # fmt: skip
    assert status == 0
    assert names(tmp_path) == FILES


def test_without_photographs_the_scene_is_rendered(tmp_path, capsys):
    path = write_scene(tmp_path, sensors=sensor_xml(4, 32, 32))
    assert run("entropy", path, "-o", tmp_path / "out", "--resolution", 24, "--spp", 2) == 0
    assert "the scene was rendered" in capsys.readouterr().err
    assert (tmp_path / "out" / "capture" / "view_0003.exr").exists()
    assert (tmp_path / "out" / "entropy.exr").exists()


@pytest.mark.filterwarnings("default::svu_mi.errors.SvuWarning")
def test_overlapping_uvs_are_unwrapped_when_asked_rendered_scenes_too(tmp_path, capsys):
    flat = ball()
    doubled = {
        "positions": np.concatenate([flat.positions, 0.2 * flat.positions + [2, 0, 0]]),
        "faces": np.concatenate([flat.faces, flat.faces + len(flat.positions)]),
        "normals": np.concatenate([flat.normals] * 2),
        "uvs": np.concatenate([flat.uvs] * 2),
    }
    path = write_scene(tmp_path, sensors=sensor_xml(3, 32, 32), **doubled)
    words = ["entropy", path, "-o", tmp_path / "out", "--resolution", 32, "--spp", 1]
    assert "--unwrap" in fails(capsys, *words, warnings=1)
    assert run(*words, "--unwrap") == 0


def test_python_scripts_find_every_name():
    import svu_mi as svu

    for name in svu.__all__:
        assert getattr(svu, name) is not None


def test_bad_input_is_one_line_and_status_2(shot, tmp_path, capsys):
    out = tmp_path / "out"
    assert "no such file" in fails(capsys, "entropy", tmp_path / "no.xml", "-o", out)
    line = fails(capsys, "entropy", scenes.path("vase"), "--images", tmp_path / "x", "-o", out)
    assert "no such folder" in line
    assert "KEY=VALUE" in fails(capsys, "render", scenes.path("vase"), "-D", "light", "-o", out)
    line = fails(capsys, "render", scenes.path("vase"), "-D", "light=moon", "-o", out)
    assert "vase.xml" in line
    line = fails(capsys, "entropy", shot, "--shape", "jug", "-o", out)
    assert re.search("no shape 'jug'.*'vase'", line)
    line = fails(capsys, "entropy", shot, "--resolution", 0, "-o", out)
    assert "--resolution" in line
    assert "-1" in fails(capsys, "entropy", shot, "-t", -1, "-o", out)
    assert "at most" in fails(capsys, "entropy", shot, "-t", 100000, "-o", out)
    assert "$parallel" in fails(capsys, "entropy", shot, "-D", "parallel=0", "-o", out)
    assert "seed" in fails(capsys, "render", scenes.path("vase"), "--seed", -1, "-o", out)


@pytest.mark.parametrize("name", ["scalar_rgb", "llvm_ad_spectral", "nonsense_rgb"])
def test_a_variant_that_cannot_run_is_named(shot, tmp_path, capsys, name):
    assert name in fails(capsys, "entropy", shot, "-m", name, "-o", tmp_path)


def test_an_output_folder_that_cannot_be_written(shot, tmp_path, capsys):
    blocker = tmp_path / "file"
    blocker.write_text("")
    assert "is a file" in fails(capsys, "entropy", shot, "-o", blocker)
    assert str(blocker) in fails(capsys, "entropy", shot, "-o", blocker / "below")


def test_a_failed_run_leaves_no_half_written_result(shot, tmp_path, capsys):
    bad = tmp_path / "images"
    bad.mkdir()
    for path in shot.iterdir():
        (bad / path.name).write_bytes(path.read_bytes())
    write_exr(bad / "view_0005.exr", {"RGB": np.ones((3, 3, 3))})
    line = fails(capsys, "entropy", scenes.path("vase"), "--images", bad, "-o", tmp_path / "out")
    assert "view_0005.exr" in line
    assert list((tmp_path / "out").iterdir()) == []


def test_verbose_shows_the_traceback(tmp_path):
    with pytest.raises(SvuError):
        run("entropy", tmp_path / "no.xml", "-v", "-o", tmp_path / "out")


def test_the_module_is_the_program(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "svu_mi", "entropy", str(tmp_path / "no.xml"), "-o", str(tmp_path)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    assert done.stderr.strip().count("\n") == 0


def test_demo_leaves_four_files(tmp_path, capsys):
    assert run("demo", "-o", tmp_path, "--spp", 1, "--resolution", 32) == 0
    told = capsys.readouterr().out.splitlines()[-1]
    assert re.match(r"Roughness known to ±0\.05 on .* of the surface seen, .* intervals\)\.$", told)
    assert names(tmp_path) == FILES
