"""Integrator svu_entropy: pixels equal the map at the right positions."""

from __future__ import annotations

import re
from pathlib import Path

import matplotlib
import mitsuba as mi
import numpy as np
import pytest
from support.helpers import box_film, run, sensor_xml, write_scene

import svu_mi as svu
import svu_mi.plugins  # noqa: F401 - registers
from svu_mi.capture.scene import load_scene
from svu_mi.core.io.exr import read_exr, write_exr
from svu_mi.errors import SceneError
from svu_mi.plugins import registry

SIZE = 24


def scene(integrator: dict, **shapes) -> mi.Scene:
    """Return a camera that maps texels of the rectangle [-1, 1]^2 to pixels one to one."""
    look = mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0])
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": {"type": "orthographic", "to_world": look, "film": box_film(SIZE)},
            "integrator": {"type": "svu_entropy", **integrator},
            **(shapes or {"wall": {"type": "rectangle"}}),
        },
        optimize=False,
    )


def picture(integrator: dict, **shapes) -> np.ndarray:
    """(SIZE, SIZE, 4) linear RGBA."""
    return np.array(mi.render(scene(integrator, **shapes), spp=4))


@pytest.fixture
def values(variant) -> np.ndarray:
    """An asymmetric map of the resolution of the film."""
    return np.random.default_rng(27640183).random((SIZE, SIZE)).astype(np.float32)


@pytest.fixture
def file(tmp_path, values):
    write_exr(tmp_path / "map.exr", {"Y": values})
    return str(tmp_path / "map.exr")


def seen(values: np.ndarray) -> np.ndarray:
    """Return the map as the camera sees it: v points up, row 0 is v = 0, u points right."""
    return values[::-1]


def test_svu_renders_the_map_without_a_light(file, tmp_path, values):
    """Other integrators show nothing without a light, which is an error."""
    path = write_scene(tmp_path, sensors=sensor_xml(2, 20, 12))
    dark = path.read_text().replace('<emitter type="constant" id="light"/>', "")
    path.write_text(dark)
    with pytest.raises(SceneError, match="no emitter"):
        svu.render_capture(path, 1)
    kind = f'<integrator type="svu_entropy"><string name="filename" value="{file}"/></integrator>'
    path.write_text(dark.replace('<integrator type="direct"/>', kind))
    assert run("render", path, "--spp", 1, "-o", tmp_path / "shown") == 0
    first, second = (tmp_path / "shown").glob("*.exr")
    assert read_exr(first)["R"].shape == (12, 20) and read_exr(second)["G"].max() > 0.1


def test_without_a_colormap_the_pixels_are_the_map(file, values):
    image = picture({"filename": file, "colormap": "none"})
    for channel in range(3):
        np.testing.assert_allclose(image[..., channel], seen(values), atol=1e-6)
    np.testing.assert_allclose(image[..., 3], 1, atol=1e-6)


@pytest.mark.parametrize("name", ["viridis", "inferno"])
def test_colours_saved_as_srgb_are_those_of_matplotlib(file, values, name):
    linear = picture({"map": file, "colormap": name, "range_min": 0.2, "range_max": 0.7})
    encoded = np.array(
        mi.Bitmap(linear[..., :3]).convert(
            mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, srgb_gamma=True
        )
    )
    expected = matplotlib.colormaps[name](np.clip((seen(values) - 0.2) / 0.5, 0, 1))[..., :3]
    # 0.007 for the control points, 0.01 because matplotlib does not interpolate its 256 steps.
    np.testing.assert_allclose(encoded, expected, atol=0.017)


@pytest.mark.parametrize("name", ["texture", "map"])
def test_a_nested_texture_is_a_map_under_any_name(values, name):
    bitmap = mi.Bitmap(np.ascontiguousarray(values[..., None]))
    texture = {"type": "bitmap", "bitmap": bitmap, "raw": True, "filter_type": "nearest"}
    image = picture({"colormap": "none", name: texture})
    np.testing.assert_allclose(image[..., 1], seen(values), atol=1e-6)


def test_three_channels_are_shown_as_colours(tmp_path, values):
    color = np.stack([values, values**2, 1 - values], axis=-1)
    write_exr(tmp_path / "rgb.exr", {"RGB": color})
    image = picture({"map": str(tmp_path / "rgb.exr"), "colormap": "none"})
    np.testing.assert_allclose(image[..., :3], seen(color), atol=1e-6)


def test_only_the_chosen_shape_shows_the_map(file, values):
    T = mi.ScalarTransform4f
    shapes = {
        "left": {"type": "rectangle", "to_world": T().translate([-1, 0, 0])},
        "right": {"type": "rectangle", "to_world": T().translate([1, 0, 0])},
    }
    image = picture({"map": file, "shape": "left", "background": [0.25, 0.5, 0.75]}, **shapes)
    half = SIZE // 2
    np.testing.assert_allclose(image[:, :half, 3], 1, atol=1e-6)
    np.testing.assert_allclose(image[:, half:, 3], 0, atol=1e-6)
    np.testing.assert_allclose(
        image[:, half:, :3], np.broadcast_to([0.25, 0.5, 0.75], (SIZE, half, 3)), atol=1e-6
    )


def test_lights_and_meshes_without_uvs_do_not_show_it(file):
    light = {"type": "rectangle", "emitter": {"type": "area", "radiance": 3.0}}
    assert not picture({"map": file}, light=light).any()
    bare = mi.Mesh("bare", 3, 1)
    params = mi.traverse(bare)
    params["vertex_positions"] = [-9.0, -9, 0, 9, -9, 0, 0, 20, 0]
    params["faces"] = [0, 1, 2]
    params.update()
    assert not picture({"map": file}, bare=bare).any()


def test_nan_texels_show_the_background(values):
    holes = values.copy()
    holes[3:6, 8:] = np.nan
    bitmap = mi.Bitmap(np.ascontiguousarray(holes[..., None]))
    texture = {"type": "bitmap", "bitmap": bitmap, "raw": True, "filter_type": "nearest"}
    for colormap in ("none", "viridis"):
        image = picture({"texture": texture, "colormap": colormap})
        np.testing.assert_array_equal(image[..., 3] == 0, seen(np.isnan(holes)))
        assert np.isfinite(image).all()


def test_shading_darkens_grazing_angles(file):
    T = mi.ScalarTransform4f
    tilted = {"type": "rectangle", "to_world": T().rotate([1, 0, 0], 60).scale(4)}
    flat, shaded = (
        picture({"map": file, "shading": on}, wall=tilted)[10, 10, :3] for on in (False, True)
    )
    np.testing.assert_allclose(shaded / flat, 0.35 + 0.65 * np.cos(np.radians(60)), rtol=1e-5)


def test_xml_finds_the_map_beside_the_scene(tmp_path, file, values):
    path = tmp_path / "scene.xml"
    path.write_text(
        '<scene version="3.0.0"><integrator type="svu_entropy">'
        '<string name="filename" value="map.exr"/>'
        '<string name="colormap" value="none"/></integrator>'
        '<shape type="rectangle" id="wall"/><sensor type="orthographic"><transform '
        'name="to_world"><lookat origin="0,0,5" target="0,0,0" up="0,1,0"/></transform>'
        f'<film type="hdrfilm"><integer name="width" value="{SIZE}"/>'
        f'<integer name="height" value="{SIZE}"/><rfilter type="box"/></film></sensor></scene>'
    )
    for parallel in (True, False):
        loaded = mi.load_file(str(path), optimize=False, parallel=parallel)
        image = np.array(mi.render(loaded, spp=1))
        np.testing.assert_allclose(image[..., 0], seen(values), atol=1e-6)


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ({}, r"needs exactly one map, as a filename or a nested texture, got 0\.$"),
        ({"file": "map.exr"}, r"got 0; there is no property 'file'\.$"),
        ({"map": "a.exr", "filename": "b.exr"}, r"got 2\.$"),
        ({"map": "missing.exr"}, "missing.exr: No such file"),
        ({"colormap": "jet"}, "unknown colormap 'jet'; use grey, viridis, inferno or none"),
        ({"range_min": 1.0, "range_max": 1.0}, "range_min must be below"),
        ({"filter_type": "cubic"}, "nearest or bilinear"),
        ({"colour_map": "viridis"}, "colour_map"),
        ({"range_max": "2"}, r"svu_entropy: range_max must be a number, got '2'\.$"),
        ({"shading": 1}, r"svu_entropy: shading must be True or False, got 1\.$"),
        ({"shape": 2}, r"svu_entropy: shape must be a str, got 2\.$"),
        ({"background": "white"}, r"background must be an <rgb> or a number, got 'white'\.$"),
    ],
)
def test_wrong_properties_are_named(file, wrong, sentence):
    given = wrong if not wrong or {"map", "file"} & wrong.keys() else {"map": file, **wrong}
    with pytest.raises(Exception, match=sentence):
        mi.load_dict({"type": "svu_entropy", **given})


def test_a_wrong_name_is_one_sentence_for_commands(tmp_path):
    """Mitsuba's own message contains a traceback of the plugin."""
    path = write_scene(tmp_path)
    own = '<integrator type="svu_entropy"><string name="mapp" value="a.exr"/></integrator>'
    path.write_text(path.read_text().replace('<integrator type="direct"/>', own))
    with pytest.raises(SceneError) as caught:
        load_scene(path)
    assert str(caught.value) == (
        f'{path}: line 2: failed to instantiate integrator plugin of type "svu_entropy": '
        "svu_entropy: needs exactly one map, as a filename or a nested texture, got 0; there is no "
        "property 'mapp'."
    )


def test_an_unknown_shape_is_named_with_those_there_are(file):
    with pytest.raises(RuntimeError) as caught:  # Mitsuba's error, caused by the plugin's
        picture({"map": file, "shape": "vase"})
    assert "no shape 'vase'; it has 'wall'" in str(caught.value.__cause__)


def test_it_survives_a_change_of_variant(file, values):
    others = [v for v in mi.variants() if v.startswith("llvm") and v.endswith("spectral")]
    with pytest.raises(Exception, match="needs a variant such as"):
        mi.set_variant(others[0])
        mi.load_dict({"type": "svu_entropy", "map": file})
    mi.set_variant("llvm_ad_rgb")
    image = picture({"map": file, "colormap": "none"})
    np.testing.assert_allclose(image[..., 0], seen(values), atol=1e-6)


def test_the_xml_on_the_page_of_plugins_loads(tmp_path, file):
    page = (Path(__file__).parents[2] / "notebooks" / "plugins.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```xml\n(.*?)```", page, re.S)
    assert [re.search(r'type="(\w+)"', block)[1] for block in blocks] == list(registry.MODULES)
    for block in blocks:
        text = block.replace("out/entropy.exr", file).replace('"vase"', '"ball"')
        path = write_scene(tmp_path)
        path.write_text(path.read_text().replace('<integrator type="direct"/>', text))
        kind = re.search(r"value=\"(viridis|default)\"", block)[1]
        assert f"= {kind}," in str(load_scene(path).integrator())
