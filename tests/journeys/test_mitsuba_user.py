"""The first hour of somebody who knows Mitsuba and has a scene of their own."""

from __future__ import annotations

import pytest
from support.journey import stopped


@pytest.mark.slow
def test_stopped_render_leaves_nothing(desk):
    line = "render scenes/vase/vase.xml -D light=window --resolution 224 --views 8 --spp 24 -o long"
    said = stopped(line, desk, ".long.svu-draft/view_0001.exr")
    assert said.status == 130 and said.err[-1] == "svu: interrupted"
    assert not [path for path in desk.iterdir() if "long" in path.name]
