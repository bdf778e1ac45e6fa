"""Packing: which pixels may be used, where they lie, and what it costs."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.helpers import ball_scene, memory_capture, write_scene

from svu_mi import scenes
from svu_mi.capture.loading import load_capture
from svu_mi.capture.pixel_buffer import PixelBuffer
from svu_mi.capture.rendering import render_capture
from svu_mi.capture.scene import load_scene
from svu_mi.capture.sensors import describe, film_size, make_sensor, sphere_sensors
from svu_mi.errors import CaptureError
from svu_mi.geometry.packed_views import pack_sensors, pack_views
from svu_mi.geometry.pixel_footprint import as_channels
from svu_mi.geometry.sample_view import TexelLanes, sample_view
from svu_mi.geometry.silhouettes import MIN_COSINE, SLOPE_MARGIN
from svu_mi.geometry.texels import texels

WHITE = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 1.0}}


def interior(scene, target, sensor):
    """The same, one view at a time, with Mitsuba's own rays through the whole film."""
    width, height = film_size(sensor)
    index = dr.arange(mi.UInt32, (width + 1) * (height + 1))
    x = mi.Float(index % (width + 1)) / dr.opaque(mi.Float, width)
    y = mi.Float(index // (width + 1)) / dr.opaque(mi.Float, height)
    ray, _ = sensor.sample_ray(0, 0.5, mi.Point2f(x, y), mi.Point2f(0.5))
    si = scene.ray_intersect(ray, mi.RayFlags.Minimal, coherent=True)
    on_target = si.is_valid() & (si.shape == mi.ShapePtr(target))
    cosine = dr.maximum(dr.abs(dr.dot(si.n, ray.d)), MIN_COSINE)
    slope = dr.sqrt(1 - dr.square(cosine)) / cosine
    shape = (height + 1, width + 1)
    distance = dr.select(on_target, si.t, dr.inf).numpy().reshape(shape)
    slope = slope.numpy().reshape(shape)

    def extremes(grid):
        four = [grid[:-1, :-1], grid[:-1, 1:], grid[1:, :-1], grid[1:, 1:]]
        return np.min(four, axis=0), np.max(four, axis=0)

    near, far = extremes(distance)
    shallowest, _ = extremes(slope)
    projection = np.array(sensor.projection_transform().matrix).reshape(4, 4)
    angle = np.float32(SLOPE_MARGIN * float(1 / abs(np.float64(projection[0, 0]) * width)))
    with np.errstate(invalid="ignore"):
        level = far - near <= angle * far * (np.float32(0.5) + shallowest)
    return (np.isfinite(far) & level).ravel()


def expected_usable(capture):
    """Flags of all pixels of the used views, one view after the other."""
    flags = []
    for view in np.flatnonzero(capture.used):
        good = interior(capture.scene, capture.shape, capture.sensors[view])
        good &= np.isfinite(capture.images[view]).all(axis=-1).ravel()
        mask = capture.masks[view]
        flags.append(good if mask is None else good & mask.ravel())
    return np.concatenate(flags)


def odd_sensors(target):
    """Films of several sizes and shapes, crop windows, principal points, a camera close by."""
    changes = [
        {"film": [97, 61], "crop_size": [97, 61]},
        {"film": [40, 90], "crop_size": [40, 90], "principal_point_offset": [0.11, -0.07]},
        {"film": [120, 80], "crop_offset": [31, 17], "crop_size": [53, 33]},
        {"film": [64, 64], "crop_size": [64, 64]},
        {"film": [1, 1], "crop_size": [1, 1]},
    ]
    sensors = sphere_sensors(target, len(changes), (64, 64))
    records = [{**describe(s), **c} for s, c in zip(sensors, changes, strict=True)]
    inside = np.array(records[3]["to_world"])
    inside[:3, 3] *= 0.25  # its film shows the object only, whose box reaches behind it
    records[3] = {**records[3], "to_world": inside.tolist(), "x_fov": 70.0}
    return [make_sensor(record, "odd") for record in records]


def capture_of(scene, sensors, seed=91, **changes):
    """A capture of random radiance."""
    rng = np.random.default_rng(seed)
    sizes = [film_size(sensor) for sensor in sensors]
    images = [rng.uniform(0.1, 1, (h, w, 3)).astype(np.float32) for w, h in sizes]
    return memory_capture(scene, images, sensors, **changes)


# --- the same flags as one view at a time ---------------------------------------------------


@pytest.mark.parametrize("name", ["vase", "knot"])
def test_silhouettes_equal_those_of_single_views(name):
    scene = load_scene(scenes.FOLDER / name / f"{name}.xml")
    target = scene.shapes()[0]
    sensors = [*sphere_sensors(target, 5, (130, 101)), *odd_sensors(target)]
    capture = capture_of(scene, sensors)
    usable = pack_views(capture).usable.numpy()
    assert 0.1 < usable.mean() < 0.6
    np.testing.assert_array_equal(usable, expected_usable(capture))


def test_masks_and_unusable_pixels_and_views_left_out(tmp_path):
    scene = ball_scene(tmp_path, {"type": "constant"}, WHITE)
    sensors = [*sphere_sensors(scene.shapes()[0], 3, (70, 50)), *odd_sensors(scene.shapes()[0])]
    rng = np.random.default_rng(417)
    capture = capture_of(scene, sensors)
    for image in capture.images:
        image[rng.random(image.shape) < 0.05] = np.nan
        image[rng.random(image.shape) < 0.01] = np.inf
    masks = [rng.random(image.shape[:2]) < 0.7 for image in capture.images]
    masks[0], masks[1] = None, np.zeros((50, 70), bool)
    masks[2][:, :60] = False  # most tiles of this view have nothing to do
    used = tuple(view != 5 for view in range(len(sensors)))
    capture = replace(capture, masks=tuple(masks), used=used)
    usable = pack_views(capture).usable.numpy()
    assert usable.any()
    np.testing.assert_array_equal(usable, expected_usable(capture))


def test_an_occluder_and_another_shape_are_not_the_object(tmp_path):
    wall = (
        '<shape type="rectangle" id="wall"><transform name="to_world">'
        '<scale value="0.6"/><translate x="-1" z="2"/></transform></shape>'
    )
    scene = load_scene(write_scene(tmp_path, extra=wall))
    target = next(shape for shape in scene.shapes() if shape.id() == "ball")
    capture = capture_of(scene, sphere_sensors(target, 6, (64, 64)), shape=target, mesh=target)
    usable = pack_views(capture).usable.numpy()
    np.testing.assert_array_equal(usable, expected_usable(capture))


def test_a_camera_that_looks_away_has_no_pixels(tmp_path):
    scene = ball_scene(tmp_path, {"type": "constant"}, WHITE)
    record = describe(sphere_sensors(scene.shapes()[0], 1, (32, 32))[0])
    record["to_world"] = (np.array(record["to_world"]) @ np.diag([1, -1, -1, 1])).tolist()
    views = pack_views(capture_of(scene, [make_sensor(record, "away")]))
    assert not views.usable.numpy().any()
    assert views.grey  # nothing says otherwise


# --- colour ---------------------------------------------------------------------------------


def test_lazy_silhouettes_equal_those_of_whole_films():
    scene = load_scene(scenes.path("vase"))
    target = next(shape for shape in scene.shapes() if shape.is_mesh())
    sensors = sphere_sensors(target, 6, (96, 80))
    surface = TexelLanes.of(texels(target, resolution=128))
    at_once, later = (pack_sensors(scene, target, sensors, later=value) for value in (False, True))
    assert later.usable is None
    for view in range(6):
        seen = [sample_view(v, surface, dr.opaque(mi.UInt32, view)).seen.numpy()
                for v in (at_once, later)]  # fmt: skip
        assert 0.05 < seen[0].mean() < 0.6
        assert (seen[0] == seen[1]).mean() > 0.9999  # a kernel may round a ray differently


def test_photographs_are_packed_in_colour(tmp_path):
    """Whoever needs one channel averages three; where a pixel is usable, it is finite."""
    scene = ball_scene(tmp_path, {"type": "constant"}, WHITE)
    capture = capture_of(scene, sphere_sensors(scene.shapes()[0], 3, (40, 30)))
    views = pack_views(capture)
    exact = np.concatenate([image.reshape(-1, 3) for image in capture.images])
    np.testing.assert_array_equal(views.pixels.numpy().reshape(-1, 3), exact)
    assert np.isfinite(exact[views.usable.numpy()]).all()
    surface = TexelLanes.of(texels(capture.mesh, 16))
    seen = sample_view(views, surface, mi.UInt32(1))
    (mean,) = as_channels(seen.radiance, 1)
    assert seen.seen.numpy().any()
    three = seen.radiance.numpy().mean(axis=0, dtype=np.float64)
    np.testing.assert_allclose(mean.numpy(), three, rtol=3e-7)
    assert all(x is y for x, y in zip(as_channels(seen.radiance, 3), seen.radiance, strict=True))


@pytest.mark.parametrize(("change", "grey"), [(0.0, True), (5e-7, True), (3e-6, False)])
def test_grey_photographs_are_recognised(tmp_path, change, grey):
    scene = ball_scene(tmp_path, {"type": "constant"}, WHITE)
    capture = capture_of(scene, sphere_sensors(scene.shapes()[0], 2, (32, 32)))
    for image in capture.images:
        image[:] = image[..., :1]
    capture.images[0][0, 0] = (1, 2, 3)  # off the object: does not matter
    capture.images[1][16, 16, 1] *= 1 + change
    assert pack_views(capture).grey is grey


# --- memory and kernels ---------------------------------------------------------------------


def test_photographs_that_were_read_are_not_copied(tmp_path):
    if mi.variant().startswith("cuda"):
        pytest.skip("a GPU has memory of its own")
    render_capture(write_scene(tmp_path), spp=1, folder=tmp_path / "shot", views=3,
                   resolution=(40, 24))  # fmt: skip
    capture = load_capture(tmp_path / "shot")
    views = pack_views(capture)
    assert views.offset.numpy().tolist() == [0, 960, 1920]
    assert np.shares_memory(views.pixels.numpy(), capture.images[0])
    later = pack_views(replace(capture, used=(False, True, True)))
    assert later.offset.numpy().tolist() == [960, 1920]
    assert np.shares_memory(later.pixels.numpy(), capture.images[1])
    np.testing.assert_array_equal(later.usable.numpy()[960:], views.usable.numpy()[960:])
    masks = capture.buffer.masks_at([0, 1, 2], capture.masks)
    assert masks is capture.buffer.masked
    some = capture.buffer.masks_at([0, 1, 2], (None, *capture.masks[1:]))
    assert some[:960].all() and (some[960:] == masks[960:]).all()


def test_reordered_photographs_are_found_and_shared_ones_copied():
    buffer = PixelBuffer.allocate([(4, 2), (3, 5), (2, 2)])
    a, b, c = buffer.images
    assert buffer.offsets.tolist() == [0, 8, 23]
    assert buffer.places([c, a, b]) == [2, 0, 1]
    for images in ([a, b, a], [a[:, ::-1], b], [a, np.ones((2, 2, 3), np.float32)], [a[0:1], b]):
        assert buffer.places(images) is None
        copied = PixelBuffer.of(images)
        for image, own in zip(images, copied.images, strict=True):
            np.testing.assert_array_equal(own, image)
    assert PixelBuffer.of([]).pixels.size == 0


def test_photograph_of_two_cameras_has_two_silhouettes(tmp_path):
    scene = ball_scene(tmp_path, {"type": "constant"}, WHITE)
    sensors = sphere_sensors(scene.shapes()[0], 2, (32, 32))
    buffer = PixelBuffer.allocate([(32, 32)])
    (image,) = buffer.images
    image[:] = 0.5
    left_out = np.zeros((32, 32), bool)
    capture = memory_capture(scene, [image, image], sensors, masks=(left_out, None), buffer=buffer)
    np.testing.assert_array_equal(pack_views(capture).usable.numpy(), expected_usable(capture))


@pytest.mark.parametrize("wrong", ["larger", "turned", "alpha", "mask"])
def test_photograph_of_another_size_than_film_is_refused(tmp_path, wrong):
    scene = ball_scene(tmp_path, {"type": "constant"}, WHITE)
    sensors = sphere_sensors(scene.shapes()[0], 2, (24, 16))
    sizes = {"larger": (32, 48, 3), "turned": (24, 16, 3), "alpha": (16, 24, 4)}
    images = [np.ones((16, 24, 3)), np.ones(sizes.get(wrong, (16, 24, 3)))]
    masks = (None, np.ones((9, 9), bool) if wrong == "mask" else None)
    capture = memory_capture(scene, images, sensors, masks=masks)
    with pytest.raises(CaptureError, match=r"view_0001.exr: .*\(16, 24, 3\) and \(16, 24\)"):
        pack_views(capture)


@pytest.mark.parametrize("kind", [bool, np.int64, np.float32])
def test_masks_of_any_type(tmp_path, kind):
    scene = ball_scene(tmp_path, {"type": "constant"}, WHITE)
    sensors = sphere_sensors(scene.shapes()[0], 2, (64, 48))
    mask = np.zeros((48, 64), kind)
    mask[:, 20:] = 1
    capture = memory_capture(scene, [np.ones((48, 64, 3))] * 2, sensors, masks=(mask,) * 2)
    expected = expected_usable(replace(capture, masks=(mask.astype(bool),) * 2))
    np.testing.assert_array_equal(pack_views(capture).usable.numpy(), expected)
