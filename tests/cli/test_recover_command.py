"""``svu recover``: files, bad input, and Ctrl-C with ``--resume``."""

from __future__ import annotations

import json
import signal
import time
from importlib.machinery import ExtensionFileLoader
from types import SimpleNamespace
from unittest.mock import MagicMock

import mitsuba as mi
import numpy as np
import pytest
from support.helpers import fails, last_line, names, run, sensor_xml, write_scene

from svu_mi import scenes
from svu_mi.cli.base_command import was_interrupted
from svu_mi.core.interrupts import between_steps, raise_after_imports
from svu_mi.core.io.exr import read_exr, write_exr
from svu_mi.core.io.folder_exchange import DRAFT, beside
from svu_mi.core.io.output_folder import CHECKPOINT
from svu_mi.errors import OutputError
from svu_mi.output.relight_page import view_file_names
from svu_mi.output.texture_files import read_textures, write_textures
from svu_mi.parameters import NAMES
from svu_mi.recovery import adam
from svu_mi.recovery.svbrdf_textures import Textures

PICTURES = ["recovery.png", "relit.png"]
NUMBERS = [
    "assets", "base_color.exr", "coverage.exr", "entropy.exr", "losses.csv", "metallic.exr",
    "recovered.xml", "roughness.exr", "run.json", "uncertainty.exr",
]  # fmt: skip
FILES = sorted([*NUMBERS, *PICTURES])
SIZE = 32
pytestmark = pytest.mark.usefixtures("variant")  # svu selects a variant


@pytest.fixture
def no_pictures(monkeypatch):
    """Skip slow outputs that other tests cover."""
    monkeypatch.setattr("svu_mi.output.write_recovery._draw", MagicMock())


def recover(shot, out, *words):
    """Run ``svu recover`` on the capture with small settings."""
    steps = () if "path" in words else ("--steps", 20)
    return run("recover", shot, "-o", out, "--resolution", SIZE, *steps, *words)


def maps(folder):
    return {name: np.array(tensor) for name, tensor in read_textures(folder).items()}


@pytest.mark.filterwarnings("default::svu_mi.errors.SvuWarning")
def test_recover_writes_textures_a_scene_and_pictures(shot, tmp_path, monkeypatch, capsys):
    assert recover(shot, tmp_path, "--seed", 5, "--tv", 0.1, "--sharing") == 0
    assert names(tmp_path) == FILES
    for name, values in maps(tmp_path).items():
        assert values.shape == (SIZE, SIZE, 3 if name == "base_color" else 1)
        assert np.ptp(values) > 0.1
    record = json.loads((tmp_path / "run.json").read_text())
    assert record["settings"]["method"] == "sh"
    assert record["settings"]["given"]["seed"] == 5
    assert record["inputs"]["views"] == 8
    assert record["timings_s"] and record["environment"]["versions"]["mitsuba"]
    lines = (tmp_path / "losses.csv").read_text().splitlines()
    assert len(lines) == record["result"]["steps"] + 1 == 21
    for name, line in (("first_loss", lines[1]), ("last_loss", lines[-1])):
        assert float(line.split(",")[1]) == pytest.approx(record["result"][name])
    scene = mi.load_file(str(tmp_path / "recovered.xml"))
    assert len(scene.sensors()) == 8
    entropy, coverage = (read_exr(tmp_path / f"{n}.exr")["Y"] for n in ("entropy", "coverage"))
    assert (entropy[coverage == 0] == 1).all()
    sd = read_exr(tmp_path / "uncertainty.exr")
    kinds = [name for name in sd if ".sd" in name]
    assert sorted(kinds) == ["base_color.sd.B", "base_color.sd.G", "base_color.sd.R",
                             "metallic.sd", "roughness.sd"]  # fmt: skip
    sure, unsure = (
        np.median(sd["roughness.sd"][coverage == views]) for views in (coverage.max(), 0)
    )
    assert sure < unsure
    page = SimpleNamespace(summary=str)
    monkeypatch.setattr("svu_mi.output.report.report.write_report", lambda *_, **__: page)
    words = ("report", shot, "--recovered", tmp_path, "-o", tmp_path / "page.html")
    assert run(*words) == 0
    said = capsys.readouterr().err
    assert "recovered with sharing; shares, maps" in said and "with other" not in said
    assert run(*words, "--known", "metallic=0") == 0
    assert "recovered with other --known; give the same here" in capsys.readouterr().err


@pytest.mark.slow
def test_the_path_tracer_recovers_too(shot, tmp_path, no_pictures):
    assert recover(shot, tmp_path, "--method", "path", "--epochs", 0.5) == 0
    assert names(tmp_path) == NUMBERS
    assert json.loads((tmp_path / "run.json").read_text())["settings"]["method"] == "path"


def test_textures_that_are_not_asked_for_stay(shot, tmp_path, no_pictures):
    rng = np.random.default_rng(1462719035)
    given = {name: np.full((SIZE, SIZE, 3 if name == "base_color" else 1), rng.random(), "f4")
             for name in NAMES}  # fmt: skip
    (tmp_path / "given").mkdir()
    write_textures(Textures(**{k: mi.TensorXf(v) for k, v in given.items()}), tmp_path / "given")
    words = ("--start", tmp_path / "given", "--parameters", "roughness", "base_color")
    assert recover(shot, tmp_path / "out", *words) == 0
    textures = maps(tmp_path / "out")
    np.testing.assert_array_equal(textures["metallic"], given["metallic"])
    assert np.ptp(textures["roughness"]) > 0 and np.ptp(textures["base_color"]) > 0


@pytest.mark.slow
def test_a_scene_that_recover_renders_is_rendered_once(tmp_path, capsys, monkeypatch, no_pictures):
    path = write_scene(tmp_path, sensors=sensor_xml(4, 32, 32))
    words = ("recover", path, "-o", tmp_path / "out", "--resolution", 24, "--render", "--spp", 2,
             "--steps", 20)  # fmt: skip
    with monkeypatch.context() as patch:
        interrupt_after(patch, 12)
        assert run(*words) == 130
    photograph = tmp_path / "out" / "capture" / "view_0003.exr"
    before = photograph.stat().st_mtime_ns
    assert run(*words, "--resume", "--spp", 3) == 2
    assert "was rendered with --spp 2; restore that, or" in capsys.readouterr().err
    text = path.read_text()
    path.write_text(text.replace('value="35"', 'value="36"', 1))
    assert run(*words, "--resume") == 2
    assert "rendered with other sensors than the scene has now" in capsys.readouterr().err
    path.write_text(text)
    assert run(*words, "--resume") == 0
    assert photograph.stat().st_mtime_ns == before


def interrupt_after(monkeypatch, steps):
    """Interrupt a step of the last descent."""
    advance = adam._DescentRun.advance

    def interrupted(self):
        advance(self)
        if self._options.steps == 20 and self.step >= steps:
            raise KeyboardInterrupt

    monkeypatch.setattr(adam._DescentRun, "advance", interrupted)


def brighter(shot, folder):
    """Return the capture with one photograph twice as bright."""
    for path in shot.iterdir():
        if path.is_file():
            (folder / path.name).write_bytes(path.read_bytes())
    image = read_exr(folder / "view_0002.exr")
    write_exr(folder / "view_0002.exr", {c: (1 if c == "A" else 2) * image[c] for c in "RGBA"})
    return folder


@pytest.mark.slow
def test_resumed_run_gives_the_same_textures(
    shot, tmp_path, tmp_path_factory, capsys, monkeypatch, no_pictures
):
    assert "no checkpoint" in fails(capsys, "recover", shot, "-o", tmp_path / "out", "--resume")
    assert recover(shot, tmp_path / "whole") == 0
    capsys.readouterr()
    with monkeypatch.context() as patch:
        interrupt_after(patch, 11)
        assert recover(shot, tmp_path / "out") == 130
    line = last_line(capsys)
    assert "a checkpoint is kept" in line and "--resume" in line
    other = brighter(shot, tmp_path_factory.mktemp("other"))
    for capture, words, said in (
        (shot, ("--resume", "--tv", 0.5), "another run"), (shot, (), "--resume"),
        (other, ("--resume",), "changed since: photographs"),
    ):  # fmt: skip
        assert recover(capture, tmp_path / "out", *words) == 2
        assert said in last_line(capsys)
    assert names(beside(tmp_path / "out", DRAFT)) == [CHECKPOINT]
    assert recover(shot, tmp_path / "out", "--resume") == 0
    assert names(tmp_path / "out") == NUMBERS
    whole, resumed = maps(tmp_path / "whole"), maps(tmp_path / "out")
    for name in NAMES:
        np.testing.assert_array_equal(resumed[name], whole[name])
    losses = [(tmp_path / f / "losses.csv").read_text() for f in ("whole", "out")]
    assert losses[0] == losses[1]


def test_an_interrupt_that_was_wrapped_is_one():
    try:
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt as stop:
            raise RuntimeError("drjit.while_loop(): an error in the body") from stop
    except RuntimeError as error:
        assert was_interrupted(error)
    assert not was_interrupted(RuntimeError("another"))


@pytest.fixture
def ctrl_c():
    """Ctrl-C may be ignored without a terminal."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_ctrl_c_waits_for_the_end_of_a_step(ctrl_c):
    done = []
    with pytest.raises(KeyboardInterrupt), between_steps() as answer:
        for step in range(5):
            if step == 2:
                signal.raise_signal(signal.SIGINT)
            done.append(step)
            answer()
    assert done == [0, 1, 2]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    with pytest.raises(KeyboardInterrupt), between_steps():
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        raise AssertionError("the second one was held back, too")


def test_ctrl_c_waits_for_the_end_of_an_import(ctrl_c):
    class Loader(ExtensionFileLoader):
        def exec_module(self, module):
            signal.raise_signal(signal.SIGINT)
            time.sleep(0.1)
            ended.append(module)

    ended = []
    signal.signal(signal.SIGINT, raise_after_imports)
    with pytest.raises(KeyboardInterrupt):
        Loader("name", "path").exec_module("module")
        for _ in range(1000):
            time.sleep(0.01)
    assert ended == ["module"]
    with pytest.raises(KeyboardInterrupt), between_steps() as answer:
        signal.raise_signal(signal.SIGINT)
        answer()
    assert signal.getsignal(signal.SIGINT) is raise_after_imports
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)


BAD = {
    "no start": (["--start", "{tmp}/none"], "no such folder"),
    "seed": (["--seed", "-1"], "seed"),
    "preset": (["--method", "path", "--preset", "spectrum"], "use one of default, paper"),
    "preset of both": (["--method", "sh+path", "--preset", "polish"], "'sh+path'; use"),
    "preset of sh": (["--preset", "paper_polish"], "Unknown preset"),
    "tv": (["--tv", "-1"], "tv"),
    "steps": (["--steps", "-3"], "steps"),
    "epochs": (["--method", "path", "--epochs", "0"], "epochs"),
    "seconds": (["--checkpoint-seconds", "-1"], "seconds"),
}  # common options are tested in test_main.py


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_line_and_status_2(shot, tmp_path, capsys, case):
    words, sentence = BAD[case]
    words = ["--resolution", "16", *(word.format(tmp=tmp_path) for word in words)]
    assert sentence in fails(capsys, "recover", shot, *words, "-o", tmp_path / "out")
    out = tmp_path / "out"
    assert not out.exists() or names(out) == []


def test_textures_of_another_size_name_the_option(shot, tmp_path, capsys):
    for name in NAMES:
        channels = {"RGB": np.ones((8, 9, 3))} if name == "base_color" else {"Y": np.ones((8, 9))}
        write_exr(tmp_path / f"{name}.exr", channels)
    words = ("recover", shot, "-o", tmp_path / "out", "--start", tmp_path, "--resolution", 16)
    assert "--resolution 9 8" in fails(capsys, *words)


@pytest.mark.slow
def test_draws_are_written_and_a_picture_says_how_sure_it_is(shot, tmp_path, capsys):
    textures, out = tmp_path / "textures", tmp_path / "relit"
    assert recover(shot, textures, "--draws", 3) == 0
    assert names(textures / "draws") == [f"draw_{k:03d}.exr" for k in range(3)]
    assert (textures / "draws.png").is_file()
    channels = read_exr(textures / "uncertainty.exr")
    assert set(channels) == {
        f"{name}.{kind}{letter}" for kind in ("sd", "low", "high")
        for name, letters in (("base_color", (".R", ".G", ".B")), ("roughness", ("",)),
                              ("metallic", ("",)))
        for letter in letters
    }  # fmt: skip
    assert (channels["roughness.low"] <= channels["roughness.high"]).all()
    capsys.readouterr()
    words = ("relight", shot, "--recovered", textures, "--views", 2, "--spp", 4)
    assert run(*words, "-o", out) == 0
    assert "Relative standard deviation of pixels, median:" in capsys.readouterr().out
    views = [name for name in names(out) if name.startswith("view_")]
    assert len(views) == 4 and "relight.png" in names(out)
    picture = read_exr(out / next(name for name in views if name.endswith(".exr")))
    assert set(picture) == {
        *"RGB", *(f"{kind}.{c}" for kind in ("mean", "sd") for c in "RGB")
    }  # fmt: skip
    assert picture["sd.R"].max() > 0 and picture["R"].max() > 0
    record = json.loads((out / "run.json").read_text())
    assert record["settings"]["draws"] == 3
    light = scenes.FOLDER / "lights" / "studio.exr"
    constant = ("--known", "metallic=0", "roughness=0.5", "base_color=0.25")
    words = (*words, *constant, "--environment", light, "--no-pictures")
    assert run(*words, "-o", tmp_path / "other") == 0
    assert "relight.png" not in names(tmp_path / "other")
    shown = read_exr(tmp_path / "other" / next(name for name in views if name.endswith(".exr")))
    assert shown["sd.R"].max() == 0 and shown["R"].max() > 0  # the draws differ in nothing else


@pytest.mark.parametrize(
    "given",
    [["../../escaped"], ["capture.json: sensor 0"], ["a", "A"], ["relight"], ["run", "b"], ["/a"],
     [".hidden"], ["a\nb"], [""]],
)  # fmt: skip
def test_no_view_is_written_elsewhere_or_over_another(given):
    assert view_file_names(given) == [f"view_{number:04d}" for number in range(len(given))]


def test_views_keep_names_that_can_be_files():
    assert view_file_names(["left", "view_0007", "IMG 12-b"]) == ["left", "view_0007", "IMG 12-b"]


@pytest.mark.usefixtures("no_pictures")
def test_what_relight_cannot_do_is_said(shot, tmp_path, capsys):
    assert recover(shot, tmp_path / "plain") == 0
    words = ("relight", shot, "--recovered", tmp_path / "plain", "-o", tmp_path / "out")
    assert "has no draws of the textures; svu recover --draws 16" in fails(capsys, *words)
    assert "--views must be at least 1" in fails(capsys, *words, "--views", 0)
    assert "no such file; --environment takes a lat-long map" in fails(
        capsys, *words, "--environment", tmp_path / "none.exr"
    )
    assert "--draws must be in [0, 1000]" in fails(
        capsys, "recover", shot, "--draws", -1, "-o", tmp_path / "a"
    )
    assert "--draws needs the noise of the photographs" in fails(
        capsys, "recover", shot, "--draws", 2, "--preset", "paper", "-o", tmp_path / "a"
    )


@pytest.mark.slow
def test_failed_page_is_an_error_and_leaves_no_result(shot, tmp_path, monkeypatch, capsys):
    def refuse(*_, **__):
        raise OutputError("relit.png: the disk is full.")

    monkeypatch.setattr("svu_mi.output.write_recovery.write_relit", refuse)
    assert recover(shot, tmp_path) == 2
    assert last_line(capsys) == "svu: relit.png: the disk is full."
    assert not set(FILES) & set(names(tmp_path))


@pytest.mark.slow
def test_known_parameters_are_textures_of_their_value(shot, tmp_path):
    out = tmp_path / "out"
    words = ("--known", "metallic=0.25", "roughness=0.5", "--resolution", 16, "--steps", 3)
    assert run("recover", *words, shot, "--no-pictures", "-o", out) == 0
    assert (read_exr(out / "metallic.exr")["Y"] == 0.25).all()
    assert (read_exr(out / "roughness.exr")["Y"] == 0.5).all()
    assert np.ptp(read_exr(out / "base_color.exr")["G"]) > 0.1
    record = json.loads((out / "run.json").read_text())
    assert record["settings"]["used"]["estimate"]["known"] == {"metallic": 0.25, "roughness": 0.5}
