"""Tests of the plane on which an object stands."""

from __future__ import annotations

from dataclasses import replace
from itertools import repeat

import mitsuba as mi
import numpy as np
import pytest
from support.helpers import render_ball

import svu_mi as svu
from svu_mi.bench.spoiled_captures import on_table, other_light, photographed
from svu_mi.capture.scene import find_environment
from svu_mi.light.above_plane import above_plane
from svu_mi.light.environment import Environment
from svu_mi.light.latlong import directions

GLOSSY = {"type": "principled", "roughness": 0.3, "metallic": 0.0,
          "base_color": {"type": "rgb", "value": [0.1, 0.2, 0.3]}}  # fmt: skip
WITHOUT_FOLDS = svu.preset("default", method="angular", folds=0)


def test_the_plane_reflects_the_light_above():
    """It has the radiance rho (L + E / pi) under a uniform light L and a sun of irradiance E."""
    up = np.array([0.6, 0.0, 0.8])
    turned = np.array([[0, 0, 1.0], [0, 1, 0], [-1, 0, 0]])  # world to local
    sun = np.stack([up, -up]) @ turned.T
    light = Environment(
        np.full((65, 128, 3), [2.0, 3.0, 0.5]), sun, np.array([0.01, 0.02]),
        np.full((2, 3), [100.0, 0.0, 10.0]), turned,
    )  # fmt: skip
    found = above_plane(light, up, 0.25)
    height = directions(128, 65) @ turned @ up
    expected = 0.25 * (np.array([2.0, 3.0, 0.5]) + np.array([1.0, 0.0, 0.1]) / np.pi)
    below, above = height < -0.05, height > 0.05
    assert np.abs(found.radiance[below] / expected - 1).max() < 0.01
    np.testing.assert_array_equal(found.radiance[above], light.radiance[above])
    np.testing.assert_array_equal(found.disk_radiance, [[100.0, 0.0, 10.0], [0, 0, 0]])
    assert found.disk_weights is light.disk_weights


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    """Photographs of a glossy ball in a room with a window and a striped floor."""
    room = np.full((16, 32, 3), 0.3, np.float32)
    room[2:6, 4:9], room[9:, ::8] = 8.0, 3.0
    light = {"type": "envmap", "bitmap": mi.Bitmap(room)}
    return render_ball(tmp_path_factory.mktemp("ball"), light, GLOSSY, 24, (32, 32), 16)


def missed(estimate: svu.Estimate) -> float:
    """Return the rms error of roughness."""
    means = np.array(estimate.posterior.mean("roughness"))[estimate.posterior.observed]
    return float(np.sqrt(np.square(means - 0.3).mean()))


@pytest.mark.filterwarnings("ignore::svu_mi.SvuWarning")
def test_a_missing_table_is_found_and_taken_into_account(ball):
    """Reflections in the table, not in the floor, tell how glossy the ball is."""
    capture, layout = on_table(ball, (0.5, 0.5, 0.5), 64), svu.texels(ball.mesh, 24)
    untested = svu.estimate(capture, layout, preset=WITHOUT_FOLDS)
    found = svu.estimate(untested)
    assert untested.observed.plane is None
    assert found.observed.plane in (0.3, 0.5)
    assert found.prediction.cause == "surroundings"
    assert "--table-albedo 0." in found.prediction_sentence
    assert missed(found) < 0.7 * missed(untested)
    low, high = found.posterior.interval("roughness")
    held = (np.array(low) <= 0.3) & (np.array(high) >= 0.3)
    assert held[found.posterior.observed].mean() > 0.8
    assert svu.estimate(found, preset=WITHOUT_FOLDS).observed.plane == found.observed.plane


def test_no_table_is_found_under_an_object_in_space(ball):
    """Seen from above, with the floor as the light says; and from all sides."""
    table = on_table(ball, (0.0, 0.0, 0.0), 1)
    bare = photographed(table, repeat(ball.scene), 64, depth=2)
    layout = svu.texels(ball.mesh, 24)
    for capture in (bare, ball):
        found = svu.estimate(capture, layout)
        assert found.observed.plane is None and found.prediction.cause != "surroundings"


@pytest.mark.filterwarnings("ignore::svu_mi.SvuWarning")
def test_a_wrong_light_is_named_and_few_photographs_test_nothing(ball):
    """Another light from below improves a wrong light, too, but predicts photographs badly."""
    table = on_table(ball, (0.0, 0.0, 0.0), 1)
    bare = photographed(table, repeat(ball.scene), 64, depth=2)
    layout = svu.texels(ball.mesh, 24)
    turned = other_light(bare, find_environment(ball.scene, "scene"), 45)
    found = svu.estimate(turned, layout)
    assert found.prediction.r2 < 0.6 and found.prediction.cause == "light"
    assert "--table" not in found.prediction_sentence
    few = replace(turned, used=tuple(k < 11 for k in range(turned.count)))
    assert svu.estimate(few, layout).observed.plane is None
