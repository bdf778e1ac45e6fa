"""``svu guide``: files, a table and status 0, or one line and 2 on bad input."""

from __future__ import annotations

import contextlib
import io
import json
import re
import shutil
from unittest.mock import MagicMock

import numpy as np
import pytest
from support.helpers import fails, names, run

import svu_mi as svu
from svu_mi.capture.scene import to_world
from svu_mi.cli.guide import Guide
from svu_mi.cli.shared_options import CaptureOptions, SceneOptions
from svu_mi.core.io.exr import read_exr

MISSING = (2, 5, 6)  # missing photographs of the sensors of the scene


pytestmark = pytest.mark.usefixtures("variant")  # svu selects a variant


@pytest.fixture(scope="module")
def partial(shot, tmp_path_factory):
    """Return a capture with a subset of its photographs."""
    folder = tmp_path_factory.mktemp(
        "partial"
    )  # next to the other: the path of the scene is relative
    shutil.copytree(shot, folder, dirs_exist_ok=True)
    for view in MISSING:
        (folder / f"view_{view:04d}.exr").unlink()
    return folder


@pytest.fixture
def no_page(monkeypatch):
    """Skip slow outputs that other tests cover."""

    monkeypatch.setattr("svu_mi.output.write_guidance.write_guidance_overview", MagicMock())


def guide(shot, out, *words):
    """Run ``svu guide`` on a capture with small settings."""
    return run("guide", shot, "-o", out, "--resolution", 32, "--texels", 400, *words)


def plan(folder):
    return json.loads((folder / "guidance.json").read_text())


@pytest.fixture(scope="module")
def planned(shot, tmp_path_factory):
    """Return the folder of a run, and its printed lines."""
    folder = tmp_path_factory.mktemp("planned")
    with contextlib.redirect_stdout(io.StringIO()) as said:
        assert guide(shot, folder, "--candidates", 20, "--add", 3, "--seed", 5) == 0
    return folder, said.getvalue().splitlines()


def test_guide_writes_poses_maps_pictures_and_table(planned):
    folder, said = planned
    assert names(folder) == [
        "gain_0.exr", "gain_1.exr", "gain_2.exr", "guidance.json", "guidance.png", "run.json",
        "sensors.xml", "thumbnails", "transforms.json",
    ]  # fmt: skip
    record, guidance = json.loads((folder / "run.json").read_text()), plan(folder)
    assert record["settings"]["given"]["candidates"] == "20"
    assert record["settings"]["given"]["seed"] == record["settings"]["used"]["seed"] == 5
    assert record["settings"]["used"]["texels"] == 400
    assert "Writing the results" not in record["timings_s"] and record["kernels_compiled"]
    assert len(guidance["candidates"]) == 20
    gains = [p["gain"] for p in guidance["proposals"]]
    assert all(a > b > 0 for a, b in zip(gains, gains[1:], strict=False))
    head = next(k for k, line in enumerate(said) if line.split()[:2] == ["rank", "candidate"])
    for line, proposal in zip(said[head + 1 : head + 4], guidance["proposals"], strict=True):
        rank, candidate, gain = line.split()[:3]
        assert (int(rank), int(candidate)) == (proposal["rank"], proposal["candidate"])
        assert float(gain) == pytest.approx(proposal["gain"], abs=6e-5)
        assert proposal["file"] in line
    assert said[-2] == f"Wrote {folder}"
    pattern = r"\d+ % of the surface area seen, mean entropy 0\.\d\d\. Roughness known to"
    assert re.match(pattern, said[-1])


@pytest.mark.slow
@pytest.mark.filterwarnings("default::svu_mi.errors.SvuWarning")
def test_sensors_without_photograph_are_candidates(partial, tmp_path):
    assert guide(partial, tmp_path, "--candidates", "scene", "--add", 9) == 0
    guidance = plan(tmp_path)
    missing = sorted(f"view_{view:04d}.exr" for view in MISSING)
    assert sorted(p["file"] for p in guidance["proposals"]) == missing
    assert guidance["photographs"] == 5
    record = json.loads((tmp_path / "run.json").read_text())
    assert record["inputs"]["left_out"] == missing
    capture = svu.load_capture(partial, missing="leave-out")
    for proposal in guidance["proposals"]:
        sensor = capture.sensors[MISSING[proposal["candidate"]]]
        np.testing.assert_allclose(proposal["pose"]["to_world"], to_world(sensor), atol=1e-6)


@pytest.mark.slow
def test_the_poses_of_a_run_are_candidates_of_the_next(shot, planned, tmp_path, no_page):
    words = ("--candidates", planned[0] / "transforms.json", "--add", 1, "--seed", 5)
    assert guide(shot, tmp_path, *words) == 0
    (first,) = plan(tmp_path)["proposals"]
    assert first["candidate"] == 0  # the best proposal is unchanged
    gain = plan(planned[0])["proposals"][0]["gain"]
    assert first["gain"] == pytest.approx(gain, abs=1e-4)  # border pixels may differ


@pytest.mark.filterwarnings("default::svu_mi.errors.SvuWarning")
def test_what_cannot_be_reached_is_not_proposed(shot, tmp_path, no_page, capsys):
    (tmp_path / "some.json").write_text("[0, 3, 6, 9]")
    words = ("--candidates", 12, "--add", 9, "--reachable", tmp_path / "some.json")
    assert guide(shot, tmp_path / "out", *words, "--unreachable", 3, 4) == 0
    assert "Only 3 of 9 views are proposed" in capsys.readouterr().err
    guidance = plan(tmp_path / "out")
    assert sorted(p["candidate"] for p in guidance["proposals"]) == [0, 6, 9]
    assert sum(c["reachable"] for c in guidance["candidates"]) == 3
    assert all(c["gain"] is None for c in guidance["candidates"] if not c["reachable"])


@pytest.mark.parametrize("text", ["0 3\n6\t9\n", "[0, 3, 6, 9]", "[9, 0, 3, 6, 6]",
                                  json.dumps([k % 3 == 0 for k in range(12)])])  # fmt: skip
def test_what_can_be_reached_is_said_in_any_of_three_ways(tmp_path, text):
    path = tmp_path / "file"
    path.write_text(text)
    capture = CaptureOptions(source=SceneOptions(scene=tmp_path))
    flags = Guide(capture=capture, reachable=path, unreachable=(3, 4))._reachable_flags(12)
    assert np.flatnonzero(flags).tolist() == [0, 6, 9]


@pytest.mark.slow
def test_the_sphere_of_candidates_is_where_it_is_asked_to_be(shot, tmp_path, no_page):
    words = ("--candidates", 9, "--add", 9, "--lowest", 30, "--up", 0, 0, -2, "--distance", 5)
    assert guide(shot, tmp_path, *words, "--strategy", "random") == 0
    poses = np.array([p["pose"]["to_world"] for p in plan(tmp_path)["proposals"]])
    box = svu.load_capture(shot).shape.bbox()
    offsets = poses[:, :3, 3] - np.array(box.center())
    np.testing.assert_allclose(np.linalg.norm(offsets, axis=1), 5, rtol=1e-5)
    assert (-offsets[:, 2] / 5).min() == pytest.approx(0.5 + 0.5 / 18)  # the ninth and last ring
    assert len(list((tmp_path / "thumbnails").iterdir())) == 9


@pytest.mark.few(1)
@pytest.mark.parametrize(
    "words",
    [
        ("--strategy", "error"),
        ("--preset", "fixed", "--known", "metallic=0", "--no-lazy", "--hypotheses", "4"),
        ("--method", "spectrum", "--preset", "paper", "--band-limit", "growing"),
    ],
    ids=" ".join,
)  # fmt: skip
def test_other_ways_to_judge(shot, tmp_path, no_page, words):
    assert guide(shot, tmp_path, "--candidates", 8, "--add", 2, *words) == 0
    assert len(plan(tmp_path)["proposals"]) == 2
    assert read_exr(tmp_path / "gain_1.exr")["Y"].shape == (32, 32)


EARLY = {  # fails before loading
    "add": (["--add", "0"], "--add must be at least 1"),
    "no candidate": (["--candidates", "0"], "--candidates must be at least 1"),
    "no file": (["--candidates", "{tmp}/none.json"], "must be a number, a file or"),
    "lowest": (["--lowest", "95"], "--lowest must be an elevation in [-90, 90)"),
    "lowest nan": (["--lowest", "nan"], "--lowest"),
    "distance": (["--distance", "0"], "--distance must be positive"),
    "up": (["--up", "0", "0", "0"], "--up must be a direction"),
    "a sphere for a file": (["--candidates", "{tmp}", "--lowest", "0"], "--lowest has no effect"),
    "a sphere for scene": (["--candidates", "scene", "--distance", "2"], "--distance has no"),
    "all unreachable": (["--candidates", "3", "--unreachable", "0", "1", "2"], "are unreachable"),
    "no such number": (["--candidates", "3", "--unreachable", "3"], "numbered from 0 to 2"),
    "a negative number": (["--candidates", "3", "--unreachable", "-1"], "no candidate -1"),
    "no list": (["--reachable", "{tmp}/none.txt"], "No such file or directory"),
    "words": (["--reachable", "{words}"], "words.txt: invalid literal for int"),
    "mixed": (["--reachable", "{mixed}"], "mixed.json: not a list of candidates; give"),
    "flags": (["--reachable", "{flags}"], "flags.json: 2 flags for 100 candidates"),
    "spectrum": (["--method", "spectrum"], "--preset paper"),
    "fixed": (["--method", "spectrum", "--preset", "fixed"], "Unknown preset"),
    "error": (
        ["--method", "spectrum", "--preset", "paper", "--strategy", "error"], "--strategy",
    ),
    "SH model": (["--preset", "paper", "--strategy", "coverage"], "--preset paper is the SH model"),
    "growing": (["--band-limit", "growing"], "--band-limit growing needs --method spectrum"),
    "texels": (["--texels", "0"], "texels"),
    "hypotheses": (["--hypotheses", "0"], "hypotheses"),
    "seed": (["--seed", "-1"], "seed"),
    "known": (["--known", "metallic"], "--known takes"),
    "unknown": (["--known", "gloss=1"], "gloss"),
}  # fmt: skip
LATE = {
    "no photograph": (["--images", "{tmp}"], "are missing"),
    "incomplete": ([], "3 of 8 photographs are missing"),
    "no pose": (["--candidates", "{words}"], "words.txt: not a readable JSON"),
    "no transforms": (["--candidates", "{flags}"], "no poses"),
    "no sensor": (["--candidates", "{empty}"], "no sensor"),
    "scene": (
        ["--candidates", "scene", "--unreachable", "0", "1", "2"],
        "3 candidates are unreachable",
    ),
    "scene number": (["--candidates", "scene", "--unreachable", "3"], "numbered from 0 to 2"),
}


@pytest.fixture(scope="module")
def bad(tmp_path_factory):
    """Return invalid files."""
    folder = tmp_path_factory.mktemp("bad")
    texts = {"words.txt": "0 one 2", "mixed.json": "[0, true]", "flags.json": "[true, false]",
             "empty.xml": '<scene version="3.0.0"><emitter type="constant"/></scene>'}  # fmt: skip
    for name, text in texts.items():
        (folder / name).write_text(text)
    return {name.partition(".")[0]: folder / name for name in texts}


@pytest.mark.parametrize("case", [*EARLY, *LATE])
def test_bad_input_is_one_line_and_nothing_is_half_written(partial, tmp_path, capsys, bad, case):
    words, sentence = (EARLY | LATE)[case]
    words = [word.format(tmp=tmp_path, **bad) for word in words]
    # The scene does not exist: the error must come before loading.
    place = (partial, "--resolution", 16) if case in LATE else (tmp_path / "no.xml",)
    line = fails(capsys, "guide", *place, *words, "-o", tmp_path / "out")
    assert sentence in line
    assert not (tmp_path / "out").exists()


def test_every_sensor_has_its_photograph(shot, tmp_path, capsys):
    words = ("guide", shot, "-o", tmp_path / "out", "--candidates", "scene", "--resolution", 16)
    assert "Every sensor of the capture has a photograph" in fails(capsys, *words)
