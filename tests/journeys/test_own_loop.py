"""The script of the page "Your own loop", on a scene whose textures are PNG files."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from support.png_scene import srgb_to_linear, write_png_scene

import svu_mi as svu
from svu_mi.capture.scene import load_scene
from svu_mi.errors import OptionError, SceneError

PAGE = Path(__file__).parents[2] / "notebooks" / "own_loop.md"
SIZE = 32
CODES = np.array([[200, 60, 40], [60, 160, 90], [230, 210, 90]], np.uint8)


def checks() -> dict[str, np.ndarray]:
    """A chessboard of three materials, one of them metal."""
    row, column = np.indices((SIZE, SIZE)) // 8
    cell = (row + column) % 3
    roughness, metallic = np.array([80, 120, 160], np.uint8), np.array([0, 0, 255], np.uint8)
    return {"base_color": CODES[cell], "roughness": roughness[cell][..., None],
            "metallic": metallic[cell][..., None]}  # fmt: skip


@pytest.mark.slow
def test_the_loop_recovers_png_textures(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    truth = checks()
    svu.render_capture(write_png_scene(tmp_path, truth, 12, 48), spp=32, folder="capture")
    grey = {name: np.full_like(codes, 128) for name, codes in truth.items()}
    write_png_scene(tmp_path, grey, 12, 48)  # the scene that the loop starts from
    script = re.search(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.S)[1]
    names: dict[str, Any] = {}
    starts = re.findall(r"`params=(.*?)`", PAGE.read_text(encoding="utf-8"))
    exec(compile(script, PAGE.name, "exec"), names)
    assert len(starts) == 2
    for start in starts:
        assert set(mi.ad.Adam(0.03, eval(start, names)).keys()) == set(names["textures"])
    seen = names["texels"].to_image(np.array(names["estimate"].coverage)) >= 3
    found = np.array(names["optimizer"][names["keys"]["base_color"]])[seen]
    assert seen.mean() > 0.4 and found.min() >= 0 and found.max() <= 1
    wanted = srgb_to_linear(truth["base_color"])[seen]
    assert np.corrcoef(found.ravel(), wanted.ravel())[0, 1] > 0.9


def test_textures_without_gradient_are_refused(tmp_path):
    path = write_png_scene(tmp_path, checks())
    params = mi.traverse(mi.load_file(str(path), optimize=False))
    keys = [f"ball.bsdf.{name}.data" for name in checks()]
    with pytest.raises(SceneError) as caught:
        svu.texture_parameters(params, keys)
    assert str(caught.value) == (
        "texture_parameters(): ball.bsdf.base_color.data is stored as TensorXu8, through which no "
        'gradient passes; add <string name="format" value="variant"/> to this bitmap, or load the '
        "scene with svu.load_capture."
    )
    # Each remedy works.
    text = path.read_text().replace("<boolean", '<string name="format" value="variant"/><boolean')
    path.with_name("other.xml").write_text(text)
    for scene in (mi.load_file(str(path.with_name("other.xml")), optimize=False),
                  load_scene(path, float_textures=True)):  # fmt: skip
        textures = svu.texture_parameters(mi.traverse(scene), keys)
        assert {key: type(t) for key, t in textures.items()} == dict.fromkeys(keys, mi.TensorXf)
        wanted = srgb_to_linear(checks()["base_color"])
        np.testing.assert_allclose(np.array(textures[keys[0]]), wanted, atol=1e-6)
    with pytest.raises(OptionError, match=r"no texture 'ball\.data'; its textures are .*bsdf"):
        svu.texture_parameters(params, ["ball.data"])
    with pytest.raises(OptionError, match="no texture 'ball.bsdf.specular'"):
        svu.texture_parameters(params, ["ball.bsdf.specular"])
