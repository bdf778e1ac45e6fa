"""Scenes as people write them give a map of the right object, or ask in words that work."""

from __future__ import annotations

import json
import shlex

import numpy as np
import pytest
from support.helpers import last_line, run
from support.mitsuba_scenes import SCENES

import svu_mi as svu

SILHOUETTE = 1e-3  # of the box of a sphere that is made of triangles


@pytest.mark.few(6)
@pytest.mark.filterwarnings("ignore::svu_mi.SvuWarning")
@pytest.mark.parametrize("case", SCENES, ids=lambda case: case.name)
def test_map_of_the_right_object(case, tmp_path, capsys):
    path, out = case.write(tmp_path), tmp_path / "out"
    words = ["render", path, "--spp", 1, "-o", out]
    if case.choice is not None:
        assert run(*words) == 2
        line = last_line(capsys)
        assert "several shapes could be the object; choose one with --shape" in line
        assert all(f"--shape {shlex.quote(name)} (" in line for name in case.choice.split(","))
        assert not out.exists()
        words += ["--shape", case.choice]
    assert run(*words) == 0
    capture = svu.load_capture(out)
    box = capture.mesh.bbox()
    np.testing.assert_allclose([box.min, box.max], case.box, atol=SILHOUETTE)
    remembered = json.loads((out / "capture.json").read_text())["shape"]
    assert case.choice in (None, remembered)
    estimate = svu.estimate(capture, svu.texels(capture.mesh, 16), preset="fast")
    seen = np.array(estimate.coverage) == 2
    assert seen.any() and np.array(estimate.entropy)[seen].min() < 1
