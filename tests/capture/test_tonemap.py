"""Textures as pictures of the object alone: only what may show it is traced."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from svu_mi.capture import tonemap as module
from svu_mi.capture.mesh import positions
from svu_mi.capture.quantization import Saturation
from svu_mi.capture.sensors import film_size, make_sensor, projected
from svu_mi.capture.tonemap import ObjectView, object_only_scene, tone_mapped, with_bounds
from svu_mi.core.arrays import to_drjit


def sensor(distance: float, *, aside: float = 0.0, **changes: Any) -> Any:
    """A camera on the +Z axis that looks at a point beside the origin."""
    pose = mi.ScalarTransform4f().look_at([0, 0.2, distance], [aside, 0.2, 0], [0.1, 1, 0])
    return make_sensor({
        "to_world": np.array(pose.matrix, np.float64), "x_fov": 40.0,
        "principal_point_offset": [0.1, -0.05], "clip": [1e-3, 1e3], "film": [70, 50],
        "crop_offset": [6, 4], "crop_size": [60, 40], **changes,
    }, "look")  # fmt: skip


@pytest.mark.parametrize("many", [2**17, 0])
@pytest.mark.parametrize(("distance", "aside", "covers"), [
    (4.0, 0.0, True), (0.7, 0.0, True), (3.0, 1.2, True), (9.0, 8.0, False), (0.05, 0.0, True),
])  # fmt: skip
def test_nothing_of_the_object_lies_beyond_the_window(
    vase: SimpleNamespace, monkeypatch: pytest.MonkeyPatch, distance: float, aside: float,
    covers: bool, many: int,
) -> None:  # fmt: skip
    """From afar, near, at the edge, beside it, and from within; of many vertices their box."""
    monkeypatch.setattr(module, "MANY", many)
    place = sensor(distance, aside=aside)
    scene, texture = object_only_scene(vase.capture), np.random.default_rng(5).random((9, 7, 3))
    view = ObjectView.of(scene, place)
    width, height = film_size(place)
    monkeypatch.setattr(module, "_window", lambda *_: (slice(0, height), slice(0, width)))
    whole = ObjectView.of(scene, place)
    np.testing.assert_array_equal(view.covered, whole.covered)
    np.testing.assert_array_equal(view.painted(texture), whole.painted(texture))
    np.testing.assert_array_equal(view.values(texture), whole.values(texture))
    assert bool(view.covered.any()) == covers
    if distance > 2:
        assert view.shade.numpy().size < whole.shade.numpy().size


@pytest.mark.parametrize("offset", [(3.0, 0.0), (-3.0, 0.0), (0.0, 3.0), (0.0, -3.0)])
def test_object_beside_the_film_has_a_window_at_its_edge(
    vase: SimpleNamespace, offset: tuple[float, float]
) -> None:
    place = sensor(4.0, principal_point_offset=offset)
    view = ObjectView.of(object_only_scene(vase.capture), place)
    assert min(part.stop - part.start for part in view.window) == 1
    assert not view.covered.any() and view.covered.shape == (40, 60)


def test_points_are_where_mitsuba_shows_them(vase: SimpleNamespace) -> None:
    points = positions(vase.capture.mesh)
    for place in (sensor(4.0), sensor(2.5, aside=0.4), sensor(4.0, x_fov=70.0)):
        interaction = mi.Interaction3f()
        interaction.p = to_drjit(mi.Point3f, points.T.astype(np.float32))
        sample, _ = place.sample_direction(interaction, mi.Point2f(0.5))
        pixels, depth = projected(place, points)
        shown = np.array(sample.pdf) > 0
        assert shown.any() and (depth > 0).all()
        np.testing.assert_allclose(pixels[shown], np.array(sample.uv).T[shown], atol=2e-3)


def test_points_behind_a_camera_have_negative_depth(vase: SimpleNamespace) -> None:
    place = sensor(4.0)
    pixels, depth = projected(place, np.array([[0, 0.2, 9.0], [0, 0.2, 4.0], [0, 0.2, 1.0]]))
    assert np.isfinite(pixels).all()
    np.testing.assert_allclose(depth, [-5, 0, 3], atol=1e-5)


def test_saturated_channels_are_shown_as_bright() -> None:
    """Saturated pixels look white, also with one saturated channel; other NaN are grey."""
    nan = np.nan
    pixels = [[1, nan, 0.9], [0.25, 0.25, 0.25], [nan, nan, nan], [nan, nan, nan], [1, 1, 1]]
    over = np.array([[2, 0, 7, 0, 0]], np.uint8)  # bits of channels
    photograph = SimpleNamespace(
        images=(np.array([pixels], np.float32),) * 2,
        clipped=(None, Saturation(over, np.full(3, 1.0, np.float32))),
    )
    quarter, most = 1.055 * 0.25 ** (1 / 2.4) - 0.055, 1.055 * 0.9 ** (1 / 2.4) - 0.055
    for view, bright in enumerate((0.5, 1.0)):
        shown = tone_mapped(with_bounds(photograph, view), white=1.0)
        expected = [[1, bright, most], [quarter] * 3, [bright] * 3, [0.5] * 3, [1] * 3]
        np.testing.assert_allclose(shown[0], expected, atol=1e-5)
