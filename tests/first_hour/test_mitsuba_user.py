"""The first hour of somebody who knows Mitsuba and has a scene of their own."""

from __future__ import annotations

import re
import shutil

import pytest
from hour import done, notebook, stopped, svu

SCENE = "scenes/vase/vase.xml -D light=window -D resolution=64"


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
def test_a_render_that_was_stopped_goes_on(desk):
    line = "render scenes/vase/vase.xml -D light=window -D resolution=320 --spp 24 -o long"
    said = stopped(line, desk, ".long.svu-draft/view_0001.exr")
    assert said.status == 130
    assert re.fullmatch(
        r"svu: interrupted; \d+ views are kept: continue with the same command and --resume",
        said.err[-1],
    )  # fmt: skip
    assert done(f"{line} --resume", desk).out[-1] == "Wrote 24 photographs to long"
