"""The scenes: they load under every light, show their object, and are what the script makes."""

from __future__ import annotations

import re

import mitsuba as mi
import numpy as np
import pytest
import trimesh

from svu_mi import scenes
from svu_mi.capture.mesh import arrays
from svu_mi.capture.rendering import object_mask
from svu_mi.capture.scene import find_environment, find_sensors, find_shape, load_scene
from svu_mi.errors import OptionError
from svu_mi.exr import read_exr
from svu_mi.scenes import make_assets
from svu_mi.surface import texels

SMALL = {"resolution": "16", "spp": "4"}


@pytest.mark.parametrize("light", scenes.LIGHTS)
@pytest.mark.parametrize("name", scenes.NAMES)
def test_every_scene_renders_under_every_light(name, light):
    scene = load_scene(scenes.path(name), {**SMALL, "light": light})
    assert find_environment(scene, name).id() == "light"
    image = np.array(mi.render(scene, sensor=3, spp=4))
    assert image.shape == (16, 16, 3)
    assert np.isfinite(image).all()
    assert image.max() > 0.01


@pytest.mark.parametrize("name", scenes.NAMES)
def test_every_sensor_sees_the_object(name):
    scene = load_scene(scenes.path(name), SMALL)
    shape = find_shape(scene, None, name)
    assert shape.id() == name
    covered = [object_mask(scene, shape, s).mean() for s in find_sensors(scene, name)]
    assert len(covered) == 24
    assert min(covered) > 0.03
    assert max(covered) < 0.7


@pytest.mark.parametrize("name", scenes.NAMES)
def test_charts_do_not_overlap_and_keep_a_gutter(name):
    shape = load_scene(scenes.path(name), SMALL).shapes()[0]
    found = texels(shape, 256)
    assert found.overlapping == 0
    assert found.count > 0.7 * 256**2
    uvs = arrays(shape).uvs
    assert uvs.min() >= 2 / 256
    assert uvs.max() <= 1 - 2 / 256


@pytest.mark.parametrize("name", scenes.NAMES)
def test_winding_agrees_with_the_normals_and_points_outwards(name):
    mesh = arrays(load_scene(scenes.path(name), SMALL).shapes()[0])
    corners = mesh.positions[mesh.faces]
    face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert ((face * mesh.normals[mesh.faces].sum(axis=1)).sum(axis=1) > 0).mean() > 0.999
    volume = (corners[:, 0] * np.cross(corners[:, 1], corners[:, 2])).sum() / 6
    assert volume >= -1e-6


def test_the_script_makes_the_committed_assets(tmp_path):
    make_assets.make(tmp_path)
    made = sorted(p.relative_to(tmp_path) for p in tmp_path.rglob("*") if p.is_file())
    assert len(made) == 3 + 5 * len(scenes.NAMES) + 1
    for path in made:
        ours, theirs = tmp_path / path, scenes.FOLDER / path
        if path.suffix == ".exr":
            a, b = read_exr(ours), read_exr(theirs)
            assert a.keys() == b.keys()
            for name in a:
                np.testing.assert_allclose(a[name], b[name], rtol=1e-3)  # one half-float step
        elif path.suffix == ".ply":
            a, b = (trimesh.load(p, process=False) for p in (ours, theirs))
            np.testing.assert_array_equal(a.faces, b.faces)
            np.testing.assert_allclose(a.vertices, b.vertices, atol=1e-6)
        else:
            assert ours.read_text() == theirs.read_text()


def test_scenes_are_small_and_their_paths_relative():
    for name in scenes.NAMES:
        folder = scenes.FOLDER / name
        assert sum(p.stat().st_size for p in folder.iterdir()) < 2e6
    for path in scenes.FOLDER.rglob("*.xml"):
        for value in re.findall(r'name="filename" value="([^"]*)"', path.read_text()):
            assert not value.startswith("/")


def test_an_unknown_scene_is_named():
    with pytest.raises(OptionError, match="no scene 'teapot'; there are planes, spheres"):
        scenes.path("teapot")
