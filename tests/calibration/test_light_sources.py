"""Sources of the light on an object, compared with view factors in closed form."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from support.helpers import ball, memory_capture

from svu_mi.calibration.checks.light_sources import light_shares, sentence
from svu_mi.calibration.checks.surface_samples import scatter_points
from svu_mi.capture.mesh import MeshArrays, make_mesh

WHITE = {"type": "constant", "radiance": 1.0}


def shares(mesh, shown, **others):
    """Return the shares of a black object in a scene of all bounces."""
    shape = make_mesh("object", mesh)
    scene = mi.load_dict(
        {"type": "scene", "integrator": {"type": "path"}, "object": shape, "sky": WHITE, **others},
        optimize=False,
    )
    sensors = [mi.load_dict({"type": "perspective", "film": {"type": "hdrfilm"}})]
    capture = memory_capture(scene, [np.zeros((1, 1, 3), np.float32)], sensors)
    points = scatter_points(capture.shape, 400)
    return light_shares(capture, points, np.full((400, 3), shown), 256)


def test_of_a_small_ball_above_a_disk_under_a_lamp():
    """A distant source of solid angle w and radiance L lights a ball by w L / 4 on average."""
    height, radius, albedo, intensity, away = 1.0, 1.5, 0.6, 20.0, 3.0
    small = ball(24, 12)
    small = MeshArrays(0.02 * small.positions, small.faces, small.normals, small.uvs)
    place = mi.ScalarTransform4f().translate([0, 0, -height]).scale(radius)
    grey = {"type": "diffuse", "reflectance": albedo}
    table = {"type": "disk", "to_world": place, "bsdf": grey}
    power = 4 * np.pi * intensity
    lamp = {"type": "point", "position": [0, 0, away], "intensity": intensity}
    found = shares(small, np.nan, table=table, lamp=lamp)
    hidden = 2 * np.pi * (1 - height / np.hypot(height, radius))
    # Radiance of the disk: sky, and the point lamp on rings of radius r.
    r = (np.arange(2000) + 0.5) / 2000 * radius
    square = r**2 + (away + height) ** 2
    shown = albedo * (1 + intensity * (away + height) / square**1.5 / np.pi)
    solid = 2 * np.pi * r * radius / 2000 * height / (r**2 + height**2) ** 1.5
    truth = {"the environment": 4 * np.pi - hidden, "shape `table`": (shown * solid).sum(),
             "lamp `lamp`": power / (4 * np.pi) / away**2}  # fmt: skip
    assert solid.sum() == pytest.approx(hidden, rel=1e-3)
    whole = sum(truth.values())
    # 10^5 rays: standard errors are below 0.005.
    assert found == pytest.approx({k: v / whole for k, v in truth.items()} | {
        "the object itself": 0.0}, abs=0.015)  # fmt: skip


def test_of_a_bowl_half_of_the_light_is_its_own():
    """The inside of a hemisphere gets 1 - A_opening / A_inside = 1/2 of its light from itself."""
    whole = ball(48, 24)
    below = (whole.positions[whole.faces][..., 2] <= 1e-6).all(axis=1)
    inside = whole.faces[below][:, ::-1]
    bowl = MeshArrays(whole.positions, inside, -whole.normals, whole.uvs)
    found = shares(bowl, 1.0)
    assert found == pytest.approx({"the environment": 0.5, "the object itself": 0.5}, abs=0.02)


def test_small_shares_are_not_listed_and_large_ones_have_an_advice():
    few = sentence({"the environment": 0.87, "shape `a`": 0.12, "the object itself": 0.01})
    assert few == "87 % from the environment, 12 % from shape `a` and 1 % from the object itself."
    assert sentence({"the environment": 0.999, "the object itself": 0.001}) == (
        "100 % from the environment."
    )
    assert "--bounces" in sentence({"the environment": 0.9, "the object itself": 0.1})
