"""Scenes: they load under every light, show their object, and equal the output of the script."""

from __future__ import annotations

import errno
import os
import shutil

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from PIL import Image
from support.helpers import fails, run

from svu_mi import scenes
from svu_mi.capture.mesh import arrays
from svu_mi.capture.rendering import object_mask
from svu_mi.capture.scene import find_environment, find_sensors, load_scene
from svu_mi.capture.target import find_target
from svu_mi.core.io.exr import read_exr
from svu_mi.errors import OptionError, OutputError
from svu_mi.geometry.texels import texels
from svu_mi.scenes import make_assets

SMALL = {"resolution": "16", "spp": "4"}


@pytest.mark.few(2)
@pytest.mark.parametrize("light", scenes.LIGHTS)
@pytest.mark.parametrize("name", scenes.NAMES)
def test_every_scene_renders_under_every_light(name, light):
    scene = load_scene(scenes.path(name), {**SMALL, "light": light})
    assert find_environment(scene, name).id() == "light"
    image = np.array(mi.render(scene, sensor=3, spp=4))
    assert image.shape == (16, 16, 3)
    assert np.isfinite(image).all()
    assert image.max() > 0.01


def test_a_scene_loads_from_any_working_directory(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    scene = load_scene(scenes.path("vase"), {**SMALL, "integrator": "prb", "max_depth": "3"})
    assert type(scene.integrator()).__name__ == "PRBIntegrator"
    assert [s.id() for s in scene.sensors()] == [f"view_{k:04d}" for k in range(24)]


@pytest.mark.slow
def test_the_object_scene_takes_a_folder_an_image_and_a_scale(tmp_path):
    """Substitute files of a user; twice the light gives twice the image."""
    (tmp_path / "mesh.ply").write_bytes((scenes.FOLDER / "vase" / "mesh.ply").read_bytes())
    Image.new("RGB", (4, 4), (200, 120, 60)).save(tmp_path / "base_color.png")
    for name in ("roughness", "metallic"):
        Image.new("L", (4, 4), 128).save(tmp_path / f"{name}.png")
    light = scenes.FOLDER / "lights" / "studio.exr"
    given = {**SMALL, "object": str(tmp_path), "environment": str(light)}
    once, twice = (
        np.array(mi.render(load_scene(scenes.path("object"), {**given, **more}), sensor=3, seed=7))
        for more in ({}, {"environment_scale": "2"})
    )
    assert once.max() > 0.01
    np.testing.assert_allclose(twice, 2 * once, rtol=1e-3)


@pytest.mark.parametrize("name", scenes.NAMES)
def test_every_sensor_sees_the_object(name):
    scene = load_scene(scenes.path(name), SMALL)
    shape = find_target(scene, None, name).mesh
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


def test_an_unknown_scene_is_named():
    with pytest.raises(OptionError, match="Unknown scene 'teapot'; use one of planes, spheres"):
        scenes.path("teapot")


def test_the_command_lists_them(capsys):
    assert run("scenes") == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[:-1]] == [*scenes.NAMES, "object"]
    assert lines[2] == (
        "vase     a vase of clay with glaze, painted bands and golden rim, open at the top"
    )
    assert lines[-1] == "Copy one with: svu scenes NAME"


def test_the_command_copies_one_that_loads_from_there(tmp_path, monkeypatch, capsys):
    """With its lights, twice, and next to other scenes."""
    monkeypatch.chdir(tmp_path)
    for name in ("vase", "vase", "planes"):
        assert run("scenes", name) == 0
    assert capsys.readouterr().out.splitlines()[:2] == [
        "Wrote scenes/vase/vase.xml",
        "Next: svu render scenes/vase/vase.xml -D light=window -o capture",
    ]
    assert run("scenes", "object", "-o", "mine") == 0
    assert capsys.readouterr().out.splitlines()[-1] == (
        "Next: svu render mine/object/object.xml -D object=FOLDER -D environment=FILE -o capture"
    )
    assert not (tmp_path / "mine" / "lights").exists()
    for light in scenes.LIGHTS:
        scene = load_scene(tmp_path / "scenes" / "vase" / "vase.xml", {**SMALL, "light": light})
        assert find_environment(scene, "vase").id() == "light"
        assert len(find_sensors(scene, "vase")) == 24
    assert not list(tmp_path.rglob("*.py"))


def test_a_copy_replaces_nothing(tmp_path, capsys):
    copy = scenes.copy("vase", tmp_path)
    copy.write_text("mine")
    with pytest.raises(
        OutputError, match=r"vase\.xml: exists with other contents; choose another fol"
    ):
        scenes.copy("vase", tmp_path)
    assert copy.read_text() == "mine"
    assert fails(capsys, "scenes", "teapot", "-o", tmp_path) == (
        "svu: Unknown scene 'teapot'; use one of planes, spheres, vase, knot or object."
    )


def _volume(corners):
    """Signed volume inside (F, 3, 3) triangles; positive if they face outwards."""
    return (corners[:, 0] * np.cross(corners[:, 1], corners[:, 2])).sum() / 6


@pytest.mark.parametrize("name", scenes.NAMES)
def test_winding_agrees_with_the_normals_and_points_outwards(name):
    mesh = arrays(load_scene(scenes.path(name), SMALL).shapes()[0])
    corners = mesh.positions[mesh.faces]
    face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert ((face * mesh.normals[mesh.faces].sum(axis=1)).sum(axis=1) > 0).mean() > 0.999
    assert name == "planes" or _volume(corners) > 0.05


def test_a_copy_is_whole_or_absent(tmp_path, monkeypatch):
    copyfile, count = shutil.copyfile, 0

    def full(source, target):
        nonlocal count
        count += 1
        if count == 9:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(target))
        return copyfile(source, target)

    monkeypatch.setattr(shutil, "copyfile", full)
    with pytest.raises((OSError, OutputError), match="No space left"):
        scenes.copy("vase", tmp_path)
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]
    monkeypatch.undo()
    assert scenes.copy("vase", tmp_path).is_file()
