"""A flash: closed forms, photographs with a lamp at each camera, and what does not support it."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from light.test_lamps import scene_of
from light.test_near_light import texel_facing
from support.helpers import memory_capture, require_equal_columns, unit, write_ball

import svu_mi as svu
from svu_mi.capture.capture import Flash
from svu_mi.capture.content_hash import capture_key
from svu_mi.capture.replace_material import make_scene
from svu_mi.capture.sensors import sphere_sensors
from svu_mi.core.arrays import to_drjit
from svu_mi.errors import CaptureError, OptionError, SceneError
from svu_mi.light.flash_light import FlashCell, FlashLight
from svu_mi.posterior.observations import observe
from svu_mi.presets import preset
from svu_mi.reflection.lobes import Normals
from svu_mi.reflection.wide_lobes import LobeSums

FLASH = Flash((-0.6, 0.2, 0.1), (60.0, 40.0, 50.0))
COLOR = np.array([0.5, 0.3, 0.2])


def lamp_of(sensor):
    """A point lamp at the place of ``FLASH`` in the frame of a camera."""
    to_world = np.array(sensor.world_transform().matrix).reshape(4, 4)
    place = to_world[:3, 3] - 0.6 * to_world[:3, 0] + 0.2 * to_world[:3, 1] + 0.1 * to_world[:3, 2]
    power = {"type": "rgb", "value": list(FLASH.intensity)}
    return mi.load_dict({"type": "point", "position": place.tolist(), "intensity": power})


def seen_by_flash(scene, sensors, spp, emitters=()):
    """Photographs in which each camera has its lamp; others of direct light."""
    path, images = mi.load_dict({"type": "path", "max_depth": 2}), []
    for seed, sensor in enumerate(sensors):
        lit = make_scene([*scene.shapes(), *emitters, lamp_of(sensor)])
        image = mi.render(lit, sensor=sensor, integrator=path, spp=spp, seed=seed)
        images.append(np.array(image)[..., :3])
    return images


@pytest.fixture(scope="module")
def flashed(tmp_path_factory):
    """A ball in the shadow of a plate for some views, photographed with a flash only."""
    paint = {"type": "principled", "base_color": {"type": "rgb", "value": COLOR.tolist()},
             "roughness": 0.75}  # fmt: skip
    mesh = str(write_ball(tmp_path_factory.mktemp("flash")))
    plate = mi.ScalarTransform4f().translate([0.6, 1.3, 0.3]).rotate([1, 0, 0], 90).scale(0.4)
    dark = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": 0.0}}
    scene = scene_of(
        integrator={"type": "path", "max_depth": 2},
        ball={"type": "ply", "filename": mesh, "bsdf": paint},
        plate={"type": "rectangle", "to_world": plate, "bsdf": dark},
    )
    ball = next(shape for shape in scene.shapes() if shape.id() == "ball")
    sensors = sphere_sensors(ball, 20, (64, 64))
    images = seen_by_flash(scene, sensors, 16)
    return memory_capture(scene, images, sensors, shape=ball, mesh=ball, flash=FLASH)


def test_a_flash_has_its_place_in_the_frame_of_each_camera(flashed):
    """Direction and irradiance I / r^2, and no light from behind."""
    observed = observe(flashed, svu.texels(flashed.mesh, 8))
    surface = texel_facing([[0, 0, 1], [0, 0, -1]])
    light = FlashLight.of(FLASH, [flashed.sensors[k] for k in observed.visibility.order.numpy()])
    for slot, view in list(enumerate(observed.visibility.order.numpy()))[:5]:
        place = np.array(mi.traverse(lamp_of(flashed.sensors[view]))["position"]).ravel()
        cell = light.seen_from(surface, mi.UInt32(slot))
        np.testing.assert_allclose(cell.direction.numpy()[:, 0], unit(place), atol=1e-5)
        lit = np.array([place[2] > 0, place[2] < 0])
        for value, found in zip(FLASH.intensity, cell.light(0, 3), strict=True):
            np.testing.assert_allclose(found.numpy(), lit * value / (place @ place), rtol=1e-5)


@pytest.mark.parametrize("alpha", [0.05, 0.3, 0.8])
def test_lobes_are_ggx_towards_the_flash(alpha):
    """D G1 G1 / (4 cos_o) times the irradiance of the lamp, and diffuse moments with it."""
    n, v, w = np.array([0, 0, 1.0]), unit(np.array([0.3, 0.1, 1.0])), unit(np.array([-0.2, 0, 1]))
    h = unit(v + w)
    d = (alpha / (h[2] ** 2 * (alpha**2 - 1) + 1)) ** 2 / np.pi
    g_v, g_w = (2 * c / (c + np.sqrt(c * c * (1 - alpha**2) + alpha**2)) for c in (v[2], w[2]))
    cell = FlashCell(mi.Vector3f(*map(float, w)), [mi.Float(x) for x in (1.0, 2.0, 3.0)])
    surface, direction = texel_facing(n), mi.Vector3f(*map(float, v))
    sums = LobeSums(np.array([alpha, 1.0]), 3, Normals.of(surface.normal), direction)
    cosine = dr.dot(surface.normal, direction)
    found = sums.of_cells(cell, dr.opaque(mi.UInt32, 1), mi.Bool(True), cosine)
    for k, (p, q, _) in enumerate(found[0]):
        assert (p + q).numpy() == pytest.approx((k + 1) * d * g_v * g_w / (4 * v[2]), rel=1e-3)
    for k, (c0, *m0, c1) in enumerate(x[:5] for x in cell.moments(surface.normal, 3)):
        assert c0.numpy() == pytest.approx((k + 1) * w[2], rel=1e-5)
        np.testing.assert_allclose([x.numpy()[0] for x in m0], (k + 1) * w[2] * w, rtol=1e-4)
        assert c1.numpy() == pytest.approx((k + 1) * w[2] * (1 - w[2]) ** 5, rel=1e-3, abs=1e-9)


def test_diffuse_reflection_is_disneys(flashed):
    """With its retroreflection, which is large where the lamp is near the camera and both graze."""
    observed, roughness = observe(flashed, svu.texels(flashed.mesh, 16)), np.array([0.3, 1.0])
    model = observed.model(roughness, preset("default", method="angular"), 3)
    surface, normal = model.surface, model.surface.normal.numpy().T
    sensor = flashed.sensors[observed.visibility.order.numpy()[0]]
    eye = np.array(sensor.world_transform().matrix).reshape(4, 4)[:3, 3]
    place = np.array(mi.traverse(lamp_of(sensor))["position"]).ravel()
    v, way = unit(eye - surface.position.numpy().T), place - surface.position.numpy().T
    w = unit(way)
    c_v, c_w = ((normal * x).sum(axis=1) for x in (v, w))
    cosine = to_drjit(mi.Float, np.maximum(c_v, 1e-3).astype(np.float32))
    towards = to_drjit(mi.Vector3f, v.T.astype(np.float32))
    levels = model.columns(towards, cosine, mi.Bool(True), mi.UInt32(0))
    light = model.flash.seen_from(surface, mi.UInt32(0)).light(0, 3)[0].numpy()
    lit = (light > 0) & (c_v > 0.1) & (c_w > 0.1)
    f_v, f_w = (1 - c_v) ** 5, (1 - c_w) ** 5
    for r, level in zip(roughness, levels, strict=True):
        R = r * (1 + (v * w).sum(axis=1))
        shape = (1 - f_v / 2) * (1 - f_w / 2) + R * (f_v + f_w + f_v * f_w * (R - 1))
        expected = FLASH.intensity[0] / (way**2).sum(axis=1) * c_w * shape / np.pi
        np.testing.assert_allclose(level[0][0].numpy()[lit], expected[lit], rtol=1e-3)
    assert lit.sum() > 10 and (f_v * f_w)[lit].max() > 0.02


def test_the_plate_hides_the_flash(flashed):
    """Where the way to the lamp crosses the plate: y = 1.3, .4 around (.6, .3)."""
    observed = observe(flashed, svu.texels(flashed.mesh, 32))
    surface, hidden = observed.surface, 0
    points, normals = surface.position.numpy().T, surface.normal.numpy().T
    for slot, view in enumerate(observed.visibility.order.numpy()):
        place = np.array(mi.traverse(lamp_of(flashed.sensors[view]))["position"]).ravel()
        way = place - points
        t = (1.3 - points[:, 1]) / way[:, 1]
        x, z = (points[:, k] + t * way[:, k] for k in (0, 2))
        outside = np.maximum(np.abs(x - 0.6), np.abs(z - 0.3)) / 0.4
        crosses = (t > 0) & (t < 1) & (outside < 1)
        bits = observed.visibility.bits.test(mi.UInt32(view), surface.index)
        judged = bits.numpy() & ((unit(way) * normals).sum(axis=1) > 0.3)
        judged &= np.abs(outside - 1) > 0.1
        lit = observed.flash.seen_from(surface, mi.UInt32(slot)).light(0, 1)[0].numpy() > 0
        np.testing.assert_array_equal(lit[judged], ~crosses[judged])
        hidden += (judged & crosses).sum()
    assert hidden > 5


def test_an_object_is_measured_by_flash_only(flashed):
    chosen = preset("default", method="angular", folds=0)
    texels = svu.texels(flashed.mesh, 48)
    estimate = svu.estimate(flashed, texels, preset=chosen, known={"metallic": 0.0})
    seen = estimate.posterior.observed
    assert seen.mean() > 0.9
    color = np.array(estimate.posterior.mean("base_color"))[seen]
    np.testing.assert_allclose(np.median(color, axis=0), COLOR, rtol=0.05)
    assert np.quantile(np.abs(color / COLOR - 1), 0.9) < 0.1
    roughness = np.array(estimate.posterior.mean("roughness"))[seen]
    assert np.median(roughness) == pytest.approx(0.75, abs=0.03)


def test_a_flash_moves_with_the_candidates(flashed):
    require_equal_columns(flashed)


def test_what_supports_no_flash_says_so(flashed):
    texels = svu.texels(flashed.mesh, 8)
    for call in (
        lambda: svu.estimate(flashed, texels, preset="fast"),
        lambda: svu.estimate(flashed, texels, method="spectrum"),
        lambda: svu.estimate_light(flashed, texels),
    ):
        with pytest.raises(SceneError, match="a flash is not supported here; the light must be"):
            call()
    with pytest.raises(OptionError, match="omit --bounces"):
        svu.estimate(flashed, texels, preset=preset("default", method="angular", bounces=True))
    with pytest.raises(OptionError, match="supports no flash; use the method sh"):
        svu.recover(svu.estimate(flashed, texels), method="path")


def test_results_are_of_one_flash(flashed):
    brighter = replace(flashed, flash=replace(FLASH, intensity=(60.0, 40.0, 51.0)))
    keys = {capture_key(each) for each in (flashed, brighter, replace(flashed, flash=None))}
    assert len(keys) == 3


@pytest.fixture
def folder(shot, tmp_path):
    """A capture folder, and a function that writes a flash to its capture.json."""
    copy = shutil.copytree(shot, tmp_path / "shot")
    file = copy / "capture.json"
    record = json.loads(file.read_text())

    def write(flash):
        scene = str((shot / record["scene"]).resolve())
        file.write_text(json.dumps({**record, "scene": scene, "flash": flash}))
        return copy

    return write


def test_capture_json_holds_the_flash(folder):
    values = {"position": [-0.6, 0.2, 0.1], "intensity": [60, 40, 50]}
    capture = svu.load_capture(folder(values))
    assert capture.flash == FLASH
    assert "flash" in repr(capture)
    assert svu.load_capture(folder(None)).flash is None


@pytest.mark.parametrize(("flash", "problem"), [
    ({"position": [0, 0], "intensity": [1, 1, 1]}, "flash: position must be"),
    ({"position": [0, 0, 0]}, "flash: intensity is missing"),
    ({"position": [0, 0, 0], "intensity": [1, -1, 1]}, "flash: intensity must be"),
    ({"position": [0, 0, "x"], "intensity": [1, 1, 1]}, "flash: position must be"),
    ([0, 0, 0], "flash: expected an object with position, intensity"),
])  # fmt: skip
def test_a_wrong_flash_is_refused(folder, flash, problem):
    with pytest.raises(CaptureError, match=problem):
        svu.load_capture(folder(flash))
