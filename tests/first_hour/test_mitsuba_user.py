"""The first hour of somebody who knows Mitsuba and has a scene of their own."""

from __future__ import annotations

import re

import pytest
from hour import done, stopped, svu

SCENE = "scenes/vase/vase.xml -D light=window -D resolution=64"


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
