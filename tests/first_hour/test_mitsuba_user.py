"""The first hour of somebody who knows Mitsuba and has a scene of their own."""

from __future__ import annotations

import re
import shutil

import pytest
from hour import done, notebook, stopped, svu

SCENE = "scenes/vase/vase.xml -D light=window -D resolution=64"


@pytest.mark.slow  # without processes of its own: test_cli.py
def test_a_scene_without_photographs_is_not_rendered_unasked(desk):
    """Placeholders of the scene would be found, minutes later, instead of the object."""
    assert svu("entropy scenes/vase/vase.xml -o out/none", desk).refusal == (
        "scenes/vase/vase.xml: no photographs beside it; give their folder with --images, or "
        "--render to render the scene itself (24 sensors)."
    )


@pytest.mark.slow  # without a process of its own: test_cli.py
def test_no_gpu_is_said_so(desk):
    said = svu("entropy capture -m cuda_ad_rgb -o out/gpu", desk)
    if said.status == 0:
        pytest.skip("this machine has a GPU")
    assert said.refusal == (
        "No GPU that Dr.Jit can use was found, which cuda_ad_rgb needs; leave -m out, or run svu "
        "doctor."
    )


@pytest.mark.slow
def test_mitsuba_may_come_first(desk):
    """As in every script of theirs: mitsuba, a variant, a render; then svu_mi."""
    said = notebook("""
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
import svu_mi as svu
scene = mi.load_file("scenes/vase/vase.xml", light="window", resolution="32")
print(mi.render(scene, spp=1).shape)
capture = svu.load_capture("capture")
estimate = svu.estimate(capture, svu.texels(capture.mesh, 32))
print(estimate.image("entropy").shape)
""", desk)  # fmt: skip
    assert (said.status, said.out) == (0, ["(32, 32, 3)", "(32, 32)"]), said


@pytest.mark.slow
def test_one_core_is_enough(desk):
    """In a small container, a SLURM job, a Dask worker."""
    if shutil.which("taskset") is None:
        pytest.skip("no taskset here")
    for line in ("entropy capture --resolution 32 -o out/one", "doctor"):
        done(line, desk, "taskset", "-c", "0")
    said = notebook("""
import os
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
import svu_mi
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
print(len(mi.load_file("scenes/vase/vase.xml", resolution="32").sensors()))
""", desk)  # fmt: skip
    assert said.out == ["24"], said


@pytest.mark.slow
def test_some_photographs_are_missing(desk):
    """16 of 24 are taken so far."""
    (desk / "taken").mkdir()
    for number in range(16):
        shutil.copy(desk / "capture" / f"view_{number:04d}.exr", desk / "taken")
    line = f"entropy {SCENE} --images taken --resolution 32 -o out/taken"
    assert svu(line, desk).refusal == (
        "taken: 8 of 24 photographs are missing, first view_0016.exr; give the others, or "
        "--missing leave-out to go on without them."
    )
    assert done(f"{line} --missing leave-out", desk).out[1] == "Wrote out/taken"


@pytest.mark.slow
def test_photographs_have_their_own_names(desk):
    """IMG_2 comes before IMG_10; messages and tables say IMG_2."""
    (desk / "mine").mkdir()
    for number in range(24):
        source = desk / "capture" / f"view_{number:04d}.exr"
        shutil.copy(source, desk / "mine" / f"IMG_{number + 1}.exr")
    said = done(f"check {SCENE} --images mine -o out/mine", desk)
    assert said.warnings == [
        "mine: 24 photographs are taken in the order of their names: IMG_1.exr is sensor 0 "
        "('view_0000'), ..., IMG_24.exr is sensor 23 ('view_0023')."
    ]
    assert re.search(r"^ IMG_\d+\.exr +0\.9", "\n".join(said.out), re.M)
    assert not [line for line in said.out if "view_" in line]
    assert any(line.startswith("poses (fits): ") for line in said.out)


@pytest.mark.slow
def test_a_preset_of_another_method_is_named(desk):
    assert svu("entropy capture --method spectrum --preset fixed", desk).refusal == (
        "Unknown preset 'fixed'; method 'spectrum' has default, fast, paper. 'fixed' is one of "
        "method 'angular'."
    )
    assert svu("recover capture --method path --preset coefficients", desk).refusal == (
        "Unknown preset 'coefficients' of method 'path'; use one of default, paper, polish, "
        "paper_polish. 'coefficients' is one of method 'sh'."
    )


@pytest.mark.slow
def test_two_captures_are_compared(desk):
    """The same object, photographed twice: nothing differs."""
    line = f"render {SCENE} --spp 8 --seed 7 -o again"
    done(line, desk)
    said = done("compare capture again --resolution 64", desk)
    assert said.out[-2] == "Wrote out/compare/compare.html"
    assert said.out[-1].startswith(
        "Of the surface that both show, base colour differs certainly on 0 %, roughness differs "
        "certainly on 0 %, metallic differs certainly on 0 %, the entropy differs by "
    )
    assert svu("compare capture scenes -o out/wrong", desk).refusal == (
        "scenes: holds neither a capture (capture.json), nor entropy.exr, nor textures "
        "(base_color, roughness, metallic as EXR or PNG); give a folder that does."
    )


@pytest.mark.slow
def test_a_scene_without_cameras_is_rendered_from_all_sides(desk):
    scene = (desk / "scenes" / "vase" / "vase.xml").read_text()
    bare = scene.replace('<include filename="sensors.xml"/>', "")
    (desk / "scenes" / "vase" / "bare.xml").write_text(bare)
    line = "scenes/vase/bare.xml -D light=window"
    assert svu(f"entropy {line} -o out/bare", desk).refusal == (
        "scenes/vase/bare.xml: the scene has no sensor, so there is no view; add one <sensor> per "
        "photograph, or render some with svu render --views N."
    )
    said = done(f"render {line} --views 3 --resolution 16 --spp 1 -o bare", desk)
    assert said.out[-1] == "Wrote 3 photographs to bare"


@pytest.mark.slow
def test_a_render_that_was_stopped_goes_on(desk):
    line = "render scenes/vase/vase.xml -D light=window -D resolution=320 --spp 24 -o long"
    said = stopped(line, desk, "long/**/view_0001.exr")
    assert said.status == 130
    assert re.fullmatch(
        r"svu: interrupted; \d+ views are kept in long: continue with the same command and "
        r"--resume", said.err[-1],
    )  # fmt: skip
    assert done(f"{line} --resume", desk).out[-1] == "Wrote 24 photographs to long"


@pytest.mark.slow
def test_help_is_written_for_users(desk):
    """No {None} for what may be left out, whatever the command."""
    for command in ("import", "check", "entropy", "guide", "recover", "report", "compare"):
        text = " ".join(done(f"{command} --help", desk).out)
        assert "{None}" not in text, text
