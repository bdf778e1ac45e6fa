"""Pixels as texels see them: the mean over the parallelogram that a texel is in a view."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.ndimage import map_coordinates
from support.helpers import ball_scene, memory_capture

from svu_mi.capture.mesh import MeshArrays, make_mesh
from svu_mi.capture.sensors import sphere_sensors
from svu_mi.geometry.packed_views import pack_views
from svu_mi.geometry.pixel_footprint import SPACING
from svu_mi.geometry.sample_view import TexelLanes, sample_visible
from svu_mi.geometry.texels import texels
from svu_mi.geometry.visibility import trace_visibility

WHITE = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 1.0}}
FILM = 200


def seen_by(tmp_path, image, resolution, mask=None):
    """What one view shows of a ball's texels: the observation, texels, and the sensor."""
    scene = ball_scene(tmp_path, {"type": "constant"}, WHITE)
    sensor = sphere_sensors(mi.load_dict({"type": "sphere"}), 5, (FILM, FILM))[2]
    capture = memory_capture(scene, [image], [sensor], masks=(mask,))
    layout = texels(capture.mesh, resolution)
    views, surface = pack_views(capture), TexelLanes.of(layout)
    bits = trace_visibility(views, surface).bits
    seen = bits.test(mi.UInt32(0), surface.index)
    sample = sample_visible(views, surface, mi.UInt32(0), seen)
    dr.eval(sample.radiance, sample.contrast, seen)
    return sample, layout, sensor, seen.numpy()


def corners(layout, sensor, u, v):
    """Pixel coordinates (T, 2), 0 at a pixel's centre, of points at (u, v) of every texel."""
    it = dr.zeros(mi.SurfaceInteraction3f, layout.count)
    u, v = (dr.opaque(mi.Float, x) for x in (u, v))  # as literals, each would be a kernel
    it.p = layout.position + u * layout.sides[0] + v * layout.sides[1]
    exact, _ = sensor.sample_direction(it, mi.Point2f(0.5))
    return exact.uv.numpy().T - 0.5


@pytest.fixture
def noise():
    return np.random.default_rng(0).uniform(0, 1, (FILM, FILM, 3))


def test_sides_are_those_of_the_texels(tmp_path):
    """Steps of one texel along u and v lead to the neighbours' positions."""
    scene = ball_scene(tmp_path, {"type": "constant"}, WHITE)
    capture = memory_capture(
        scene, [np.ones((8, 8, 3), np.float32)],
        sphere_sensors(mi.load_dict({"type": "sphere"}), 1, (8, 8)),
    )  # fmt: skip
    layout = texels(capture.mesh, (96, 64))
    position, index = layout.position.numpy().T, layout.index.numpy().astype(int)
    place = np.full(96 * 64, -1)
    place[index] = np.arange(layout.count)
    for side, step in zip(layout.sides, (1, 96), strict=True):
        other = place[np.minimum(index + step, 96 * 64 - 1)]
        same = (other >= 0) & (layout.face.numpy()[other] == layout.face.numpy())
        assert same.sum() > 500
        along = position[other[same]] - position[same]
        assert np.abs(along - side.numpy().T[same]).max() < 1e-5


def test_a_large_texel_is_the_mean_of_its_pixels(tmp_path, noise):
    sample, layout, sensor, seen = seen_by(tmp_path, noise, 24)
    facing = seen & (np.array(sample.cosine) > 0.5)
    assert facing.sum() > 20
    # The photograph, interpolated, at 40 x 40 points all over each texel.
    steps = (np.arange(40) + 0.5) / 40 - 0.5
    values = []
    for u in steps:
        for v in steps:
            x, y = corners(layout, sensor, float(u), float(v))[facing].T
            values.append([map_coordinates(noise[..., c], [y, x], order=1) for c in range(3)])
    exact, plain = np.mean(values, axis=0), np.std(noise)
    error = np.array(sample.radiance)[:, facing] - exact
    spans = [np.linalg.norm(corners(layout, sensor, *p) - corners(layout, sensor, 0.0, 0.0), axis=1)
             for p in ((1.0, 0.0), (0.0, 1.0))]  # fmt: skip
    number = np.median(spans[0][facing] * spans[1][facing])
    assert number > 30
    # Look-ups 1.5 pixels apart see nearly all pixels: the error is small beside the noise of
    # one of them, and the mean is about as quiet as that of so many pixels.
    assert error.std() < 0.12 * plain
    assert np.array(sample.radiance)[:, facing].std() < 2 * plain / np.sqrt(number)
    # The pixels differ by as much as they do.
    grey = noise.mean(axis=-1)
    assert np.median(np.array(sample.contrast)[facing]) == pytest.approx(grey.var(), rel=0.1)


def test_a_small_texel_is_one_look_up(tmp_path, noise):
    sample, layout, sensor, seen = seen_by(tmp_path, noise, 256)
    spans = [np.linalg.norm(corners(layout, sensor, *p) - corners(layout, sensor, 0.0, 0.0), axis=1)
             for p in ((1.0, 0.0), (0.0, 1.0))]  # fmt: skip
    small = seen & (np.maximum(*spans) < 0.98 * SPACING)
    assert small.sum() > 1000
    x, y = corners(layout, sensor, 0.0, 0.0)[small].T
    exact = [map_coordinates(noise[..., c], [y, x], order=1) for c in range(3)]
    assert np.abs(np.array(sample.radiance)[:, small] - exact).max() < 5e-3


@pytest.mark.parametrize("resolution", [48, 256])
def test_normals_deviate_as_on_the_pixels_of_a_texel(tmp_path, resolution):
    """On a sphere, at random points of the pixels that bilinear look-ups of a texel read."""
    sample, layout, sensor, seen = seen_by(tmp_path, np.ones((FILM, FILM, 3)), resolution)
    facing = np.flatnonzero(seen & (np.array(sample.cosine) > 0.4))[::29]
    a, b = (np.array(x)[:, facing].T for x in sample.bend)
    middle = corners(layout, sensor, 0.0, 0.0)[facing]
    sides = [corners(layout, sensor, *p)[facing] - middle for p in ((1.0, 0.0), (0.0, 1.0))]
    random = np.random.default_rng(1)
    film = np.repeat(middle[None], 4000, axis=0)
    for side in sides:
        steps = np.clip(np.ceil(np.linalg.norm(side, axis=1) / SPACING), 1, 8)
        step = np.floor(random.random((4000, len(facing))) * steps)
        film += ((step + 0.5) / steps - 0.5)[..., None] * side
    film += (random.random((3, *film.shape)) - 0.5).sum(axis=0)  # a pixel, and bilinear weights
    point = mi.Point2f(np.ascontiguousarray((film.reshape(-1, 2).T + 0.5) / FILM, np.float32))
    ray, _ = sensor.sample_ray(0.0, 0.0, point, mi.Point2f(0.5))
    along = -dr.dot(ray.d, mi.Vector3f(ray.o))
    short = dr.sqrt(dr.square(along) - dr.squared_norm(mi.Vector3f(ray.o)) + 1)
    normal = (ray.o + (along - short) * ray.d).numpy().T.reshape(4000, -1, 3)
    found = np.einsum("ti,tj->tij", a, a) + np.einsum("ti,tj->tij", b, b)
    off = normal - normal.mean(axis=0)
    exact = np.einsum("nti,ntj->tij", off, off) / len(off)
    assert len(facing) > 5 and np.trace(found, axis1=1, axis2=2).max() < 0.06**2
    error = np.linalg.norm(found - exact, axis=(1, 2)) / np.linalg.norm(exact, axis=(1, 2))
    assert np.median(error) < 0.1 and np.quantile(error, 0.95) < 0.25


def test_flat_faces_do_not_bend(tmp_path):
    """Texels of a mesh without vertex normals, and points."""
    flat = texels(make_mesh("quad", MeshArrays(
        np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]]), np.array([[0, 1, 2], [0, 2, 3]]),
        None, np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]]),
    )), 4)  # fmt: skip
    assert all(np.abs(np.array(turn)).max() < 1e-6 for turn in flat.turns)


@pytest.mark.parametrize("resolution", [16, 256])
def test_ramps_are_read_at_the_centre(tmp_path, resolution):
    """Constant: itself, without contrast; linear: the value in the middle."""
    y, x = np.mgrid[:FILM, :FILM] / FILM
    sample, layout, sensor, seen = seen_by(tmp_path, np.stack([x, y, 0 * x + 0.7], -1), resolution)
    facing = seen & (np.array(sample.cosine) > 0.5)
    at = corners(layout, sensor, 0.0, 0.0)[facing].T / FILM
    radiance = np.array(sample.radiance)[:, facing]
    assert np.abs(radiance[:2] - at).max() < 0.01
    assert np.abs(radiance[2] - 0.7).max() < 1e-5
    flat, *_ = seen_by(tmp_path, np.full((FILM, FILM, 3), 0.7), resolution)
    assert np.array(flat.contrast).max() < 1e-6


def test_unusable_pixels_are_ignored(tmp_path, noise):
    """Masked or NaN, inside of large texels: the mean is that of the others."""
    holes = np.zeros((FILM, FILM), bool)
    holes[::4, ::4] = True
    bad = np.where(holes[..., None], np.nan, 0.5 + 0 * noise)
    sample, _, _, seen = seen_by(tmp_path, bad, 24)
    assert seen.any()
    assert np.abs(np.array(sample.radiance)[:, seen] - 0.5).max() < 1e-5
    hot = np.where(holes[..., None], 1e6, 0.5 + 0 * noise)
    sample, _, _, seen = seen_by(tmp_path, hot, 24, mask=~holes)
    assert seen.any()
    assert np.abs(np.array(sample.radiance)[:, seen] - 0.5).max() < 1e-5


def test_pixels_beyond_the_film_are_ignored(tmp_path):
    """A border of 10 around 1: texels that reach over the edge must not be made of border."""
    image = np.ones((FILM, FILM, 3))
    image[:2], image[-2:], image[:, :2], image[:, -2:] = 10, 10, 10, 10
    scene = ball_scene(tmp_path, {"type": "constant"}, WHITE)
    near = mi.load_dict({
        "type": "perspective", "fov": 20,
        "film": {"type": "hdrfilm", "width": FILM, "height": FILM},
        "to_world": mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0]),
    })  # fmt: skip
    capture = memory_capture(scene, [image], [near])
    layout = texels(capture.mesh, 24)
    views, surface = pack_views(capture), TexelLanes.of(layout)
    seen = trace_visibility(views, surface).bits.test(mi.UInt32(0), surface.index)
    sample = sample_visible(views, surface, mi.UInt32(0), seen)
    value = np.array(sample.radiance)[0][seen.numpy()]
    assert len(value) > 20
    # Two rows of pixels of at least thirty: not more than a part of any texel.
    assert value.max() < 4
