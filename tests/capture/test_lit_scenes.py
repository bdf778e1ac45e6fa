"""Scenes with lamps and several shapes give a map of their object, or one sentence."""

from __future__ import annotations

import numpy as np
import pytest
from support.lit_scenes import LIT_SCENES, write_files

import svu_mi as svu
from svu_mi.errors import SceneError


def test_most_scenes_give_maps():
    assert len(LIT_SCENES) == 20
    assert sum(scene.refusal is None for scene in LIT_SCENES) >= 17


@pytest.mark.few(5)
@pytest.mark.filterwarnings("ignore::svu_mi.SvuWarning")
@pytest.mark.parametrize("case", LIT_SCENES, ids=lambda case: case.name)
def test_lit_scene_gives_a_map_or_a_sentence(case, tmp_path):
    write_files(tmp_path)
    path = case.write(tmp_path)
    if case.refusal is not None:
        with pytest.raises(SceneError) as refused:
            estimate_of(path, case.choice)
        assert case.refusal in str(refused.value)
        assert str(refused.value).count(". ") == 0
        return
    if case.choice is not None:
        with pytest.raises(SceneError, match="several shapes could be the object; choose one with"):
            svu.render_capture(path)
    estimate = estimate_of(path, case.choice)
    capture = estimate.observed.capture
    # The unit ball is the object of all of them.
    box = capture.mesh.bbox()
    np.testing.assert_allclose([box.min, box.max], [[-1] * 3, [1] * 3], atol=1e-3)
    seen = np.array(estimate.coverage) >= 2
    assert seen.sum() > 20
    assert 0 < np.array(estimate.entropy)[seen].mean() < 0.95


def estimate_of(path, choice):
    """Render five views of 24 pixels, and estimate 16 x 16 texels."""
    capture = svu.render_capture(path, spp=4, shape=choice)
    return svu.estimate(capture, svu.texels(capture.mesh, 16), preset="fixed")
