"""The first hour of somebody who knows Mitsuba and has a scene of their own."""

from __future__ import annotations

import re

import pytest
from support.journey import done, stopped


@pytest.mark.slow
def test_stopped_render_continues(desk):
    around = "-D light=window -D resolution=160 --views 8"
    line = f"render scenes/vase/vase.xml {around} --spp 24 -o long"
    said = stopped(line, desk, ".long.svu-draft/view_0001.exr")
    assert said.status == 130
    assert re.fullmatch(
        r"svu: interrupted; \d+ views are kept: continue with the same command and --resume",
        said.err[-1],
    )  # fmt: skip
    assert done(f"{line} --resume", desk).out[-1] == "Wrote 8 photographs to long"
