"""8-bit textures are float32 in scenes for Python, and bytes in those of commands."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from support.png_scene import srgb_to_linear, write_png_scene

import svu_mi as svu
from svu_mi.capture.content_hash import capture_key, scene_key
from svu_mi.capture.float_textures import as_stored
from svu_mi.capture.rendering import plan_render
from svu_mi.capture.scene import load_scene

CODES = np.arange(256).reshape(16, 16, 1)


def data(scene, name):
    return mi.traverse(scene)[f"ball.bsdf.{name}.data"]


@pytest.mark.parametrize("channels", [1, 3])
def test_float_textures_have_the_values_of_the_files(tmp_path, channels):
    """All 256 codes: sRGB and raw, grey and RGB; 16 bits are half precision, as Mitsuba does."""
    color = np.concatenate([CODES, CODES[::-1], CODES.T.reshape(16, 16, 1)], axis=2)[..., :channels]
    codes = {"base_color": color.astype(np.uint8), "roughness": CODES.astype(np.uint8),
             "metallic": (CODES * 257).astype(np.uint16)}  # fmt: skip
    path = write_png_scene(tmp_path, codes)
    plain, floats = load_scene(path), load_scene(path, float_textures=True)
    kinds = {name: type(data(floats, name)).__name__ for name in codes}
    assert kinds == {"base_color": "TensorXf", "roughness": "TensorXf", "metallic": "TensorXf16"}
    wanted = {"base_color": srgb_to_linear(color), "roughness": CODES / 255,
              "metallic": CODES / 255}  # fmt: skip
    for name, values in wanted.items():
        tolerance = 3e-4 if name == "metallic" else 5e-7
        np.testing.assert_allclose(np.array(data(floats, name)), values, atol=tolerance)
    assert type(data(plain, "base_color")).__name__ == "TensorXu8"
    shown = [np.array(mi.render(scene, spp=4)) for scene in (plain, floats)]
    np.testing.assert_allclose(*shown, rtol=1e-5, atol=1e-6)
    # The digest of a scene does not depend on how textures are stored, and it sees each code.
    keys = [scene_key(scene, scene.shapes()[0]) for scene in (plain, floats)]
    assert keys[0] == keys[1]
    codes["base_color"][3, 5, 0] += 1
    write_png_scene(tmp_path, codes)
    other = load_scene(path, float_textures=True)
    assert scene_key(other, other.shapes()[0]) != keys[0]


def test_textures_that_are_no_codes_are_kept():
    for values in ([0.2, 0.3001], [0.5, np.nan], [0.0, 1.2], [-0.1, 0.0]):
        texture = np.array(values, np.float32).reshape(1, 2, 1)
        assert as_stored(texture) is texture


def test_a_format_in_the_scene_is_respected(tmp_path):
    path = write_png_scene(tmp_path, {"roughness": CODES.astype(np.uint8)})
    own = '<string name="format" value="fp16"/><boolean name="raw"'
    path.write_text(path.read_text().replace('<boolean name="raw"', own))
    assert type(data(load_scene(path, float_textures=True), "roughness")).__name__ == "TensorXf16"


def test_a_missing_texture_is_named_by_its_line(tmp_path):
    path = write_png_scene(tmp_path, {"roughness": CODES.astype(np.uint8)})
    (tmp_path / "roughness.png").unlink()
    with pytest.raises(svu.SvuError, match=r"roughness\.png"):
        load_scene(path, float_textures=True)


def test_python_has_float_textures_and_commands_have_not(tmp_path):
    path = write_png_scene(tmp_path / "scene", {"base_color": CODES.astype(np.uint8)})
    made = svu.render_capture(path, spp=1, folder=tmp_path / "capture")
    read = svu.load_capture(tmp_path / "capture")
    assert {type(data(each.scene, "base_color")) for each in (made, read)} == {mi.TensorXf}
    assert capture_key(made) == capture_key(read)
    assert type(data(plan_render(path).scene, "base_color")).__name__ == "TensorXu8"
