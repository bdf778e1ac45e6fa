"""Samples of a view: a texel's pixel shows that texel, and nothing else does."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.helpers import ball, ball_scene, memory_capture, sensor_xml, write_scene

from svu_mi.capture.scene import load_scene
from svu_mi.capture.sensors import describe, make_sensor, sphere_sensors
from svu_mi.geometry.packed_views import pack_views
from svu_mi.geometry.sample_view import TexelLanes, over_views, sample_view
from svu_mi.geometry.texels import texels
from svu_mi.geometry.visibility import trace_visibility

WHITE = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 1.0}}


def position_images(scene, sensors, spp=64):
    """Render the visible surface's position: the photograph that says where it looks."""
    integrator = mi.load_dict({"type": "aov", "aovs": "p:position"})
    return [
        np.array(mi.render(scene, sensor=sensor, integrator=integrator, spp=spp))[..., :3] + 10
        for sensor in sensors
    ]


def seen_error(capture, resolution=64, min_cosine=0.3):
    """Per texel: the largest distance between it and what its pixels show, and the coverage."""
    layout = texels(capture.mesh, resolution)
    views, surface = pack_views(capture), TexelLanes.of(layout)

    def worst(seen, view, error, count):
        del view
        distance = dr.norm(mi.Vector3f(seen.radiance) - 10 - mi.Vector3f(surface.position))
        valid = seen.seen & (seen.cosine > min_cosine)
        error = dr.maximum(error, dr.select(valid, distance, 0))
        return error, count + dr.select(seen.seen, mi.UInt32(1), mi.UInt32(0))

    zero = dr.zeros(mi.Float, surface.count)
    error, count = over_views(views, surface, worst, (zero, dr.zeros(mi.UInt32, surface.count)))
    return error.numpy(), count.numpy(), layout


def odd_sensor(changes):
    """A sensor with an off-centre principal point, a crop window, and so on."""
    target = mi.load_dict({"type": "sphere"})
    record = {**describe(sphere_sensors(target, 5, (80, 60))[2]), **changes}
    return make_sensor(record, "odd")


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"principal_point_offset": [0.1, -0.07]},
        {"crop_offset": [21, 13], "crop_size": [40, 30]},
        {"film": [50, 90], "crop_size": [50, 90]},
        {"crop_offset": [21, 13], "crop_size": [40, 30], "principal_point_offset": [0.1, 0.05]},
    ],
)
def test_a_texels_pixel_shows_that_texel(tmp_path, changes):
    scene = ball_scene(tmp_path, {"type": "constant"}, WHITE)
    sensors = [odd_sensor(changes)]
    capture = memory_capture(scene, position_images(scene, sensors), sensors)
    error, count, _ = seen_error(capture)
    assert (count > 0).mean() > 0.08
    # Half a pixel at a cosine of 0.3, film filter included: about 0.05 on this coarse film.
    assert error.max() < 0.07
    assert np.median(error[count > 0]) < 0.01


def test_projection_is_that_of_the_sensor(tmp_path):
    """Mitsuba's own sample_direction tells on which pixel a point lands."""
    scene = ball_scene(tmp_path, {"type": "constant"}, WHITE)
    sensor = odd_sensor({"principal_point_offset": [0.2, -0.1], "crop_offset": [10, 5],
                         "crop_size": [60, 50]})  # fmt: skip
    ramp = np.stack(
        [*np.meshgrid(np.arange(60) + 0.5, np.arange(50) + 0.5), np.zeros((50, 60))], axis=-1
    )
    capture = memory_capture(scene, [ramp], [sensor])
    layout = texels(capture.mesh, 96)
    views, surface = pack_views(capture), TexelLanes.of(layout)
    seen = sample_view(views, surface, mi.UInt32(0))
    it = dr.zeros(mi.SurfaceInteraction3f, layout.count)
    it.p = layout.position
    exact, _ = sensor.sample_direction(it, mi.Point2f(0.5))
    valid = seen.seen.numpy()
    assert valid.sum() > 200
    np.testing.assert_allclose(seen.radiance.x.numpy()[valid], exact.uv.x.numpy()[valid], atol=2e-3)
    np.testing.assert_allclose(seen.radiance.y.numpy()[valid], exact.uv.y.numpy()[valid], atol=2e-3)


def test_occluded_texels_are_not_visible(tmp_path):
    """A wall between camera and ball hides half of it; positions would differ by the gap."""
    wall = (
        '<shape type="rectangle" id="wall"><transform name="to_world">'
        '<translate x="-1" z="2"/></transform></shape>'
    )
    pose = '<lookat origin="0, 0, 6" target="0, 0, 0" up="0, 1, 0"/>'
    sensors = sensor_xml(1, 96, 96, pose)
    free = load_scene(write_scene(tmp_path, sensors=sensors))
    (tmp_path / "b").mkdir()
    walled = load_scene(write_scene(tmp_path / "b", sensors=sensors, extra=wall))
    seen = {}
    for name, scene in (("free", free), ("walled", walled)):
        shape = [s for s in scene.shapes() if s.id() == "ball"][0]
        images = position_images(scene, scene.sensors())
        capture = memory_capture(scene, images, scene.sensors(), shape=shape, mesh=shape)
        error, seen[name], layout = seen_error(capture)
        assert error.max() < 0.15  # on the wall it would be 1.7 at least
    x = layout.position.x.numpy()
    assert (seen["walled"] <= seen["free"]).all()
    assert seen["walled"][x < -0.1].sum() == 0
    right = (seen["free"] > 0) & (x > 0.25)
    assert (seen["walled"][right] > 0).all()


def test_facing_away_is_never_seen(tmp_path):
    scene = ball_scene(tmp_path, {"type": "constant"}, WHITE)
    sensors = sphere_sensors(scene.shapes()[0], 1, (64, 64))
    capture = memory_capture(scene, [np.ones((64, 64, 3))], sensors)
    layout = texels(capture.mesh, 48)
    seen = sample_view(pack_views(capture), TexelLanes.of(layout), mi.UInt32(0))
    camera = np.array(sensors[0].world_transform().matrix).reshape(4, 4)[:3, 3]
    p = layout.position.numpy().T
    facing = ((camera - p) * p).sum(axis=1) > 0
    assert not (seen.seen.numpy() & ~facing).any()
    assert (seen.cosine.numpy()[~seen.seen.numpy()] == 0).all()


def test_silhouette_pixels_do_not_mix_in_the_background(tmp_path):
    """A white ball on black: any sample below white has seen the background."""
    scene = ball_scene(tmp_path, {"type": "constant"}, WHITE)
    sensors = sphere_sensors(scene.shapes()[0], 6, (40, 40))
    integrator = mi.load_dict({"type": "aov", "aovs": "i:shape_index"})
    images = []
    for sensor in sensors:
        hit = np.array(mi.render(scene, sensor=sensor, integrator=integrator, spp=256))
        images.append(np.repeat(hit[..., :1], 3, axis=2))
    top = max(image.max() for image in images)
    assert top > 0
    capture = memory_capture(scene, [image / top for image in images], sensors)
    layout = texels(capture.mesh, 64)
    views, surface = pack_views(capture), TexelLanes.of(layout)
    low = dr.full(mi.Float, 1, surface.count)
    (low,) = over_views(
        views,
        surface,
        lambda seen, _, low: (dr.select(seen.seen, dr.minimum(low, seen.radiance.x), low),),
        (low,),
    )
    assert float(dr.min(low)[0]) > 0.99


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_visibility_does_not_depend_on_the_scale_of_the_scene(tmp_path, scale):
    flat = ball()
    path = write_scene(tmp_path, positions=flat.positions * scale, sensors=sensor_xml(1))
    scene = load_scene(path)
    shape = scene.shapes()[0]
    sensors = sphere_sensors(shape, 6, (64, 64))
    capture = memory_capture(scene, [np.ones((64, 64, 3))] * 6, sensors)
    layout = texels(shape, 48)
    seen = trace_visibility(pack_views(capture), TexelLanes.of(layout))
    count, per_view = seen.coverage, seen.per_view
    assert int(count.numpy().sum()) == int(per_view.sum())
    # A camera 3.5 radii away sees 36 % of a sphere, and grazing pixels are not used.
    assert 0.2 < count.numpy().mean() / 6 < 0.36
    assert (count.numpy() > 0).mean() > 0.97
