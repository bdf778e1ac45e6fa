"""Tests of figures 2, 4 and 7 of the paper: order of entropies.

Our scenes differ from the paper's, so only the order of entropies is compared, for the preset
``paper`` and for our presets, by power spectra and by the SH model. Figure 7 is interpreted as:
entropy decreases with the number of views and with sharper light.
"""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import mitsuba as mi
import numpy as np
import pytest
from support.helpers import ball_scene, memory_capture, render_ball

import svu_mi as svu
from svu_mi import scenes
from svu_mi.capture.scene import load_scene
from svu_mi.capture.sensors import sphere_sensors
from svu_mi.presets import preset

pytestmark = pytest.mark.slow

METHODS = pytest.mark.parametrize("method", ["angular", "spectrum"])
AXIS = np.array([0.36, 0.8, 0.48])  # direction of the lamp
NEAR = np.cos(np.radians(35))
# Total flux of each light. It matters because the paper's sigma is in squared radiance: with twice
# the flux, low-frequency light determines roughness as well as a lamp.
FLUX = 6.0
ROUGHNESS, NODE = 0.447, 3  # alpha 0.2, as in the figure; NODE is the nearest of 8 nodes


# --- Figure 2: which plane is glossy? -------------------------------------------------------


@pytest.fixture(scope="module")
def planes():
    """Observe a matte plane (left) and a glossy one under a given light."""

    @cache
    def observed(light):
        scene = load_scene(scenes.path("planes"), {"light": light, "resolution": "64"})
        capture = svu.render_capture(scene, spp=32)
        return svu.estimate(capture, svu.texels(capture.mesh, 32), "spectrum", "paper")

    return observed


def plane_entropies(planes, light, method, switches):
    """Return mean entropies of the matte and the glossy plane."""
    result = svu.estimate(planes(light), method=method, preset=switches)
    entropy, seen = np.array(result.entropy), np.array(result.coverage) > 3
    left = result.texels.uv.x.numpy() < 0.5
    return entropy[seen & left].mean(), entropy[seen & ~left].mean()


@pytest.mark.parametrize(
    "method, name",
    [("angular", "paper"), ("spectrum", "paper"), ("angular", "fixed"), ("spectrum", "default")],
)
def test_figure_2_clear_light_helps_the_glossy_plane(planes, method, name):
    """Overcast light determines neither plane; clear light determines the glossy one.

    Over (roughness, Ks), as in the figure; the SH model as printed uses all three parameters.
    """
    free = {} if name == "paper" else {"parameters": "specular"}
    switches = preset(name, method=method, **free)
    overcast_matte, overcast_glossy = plane_entropies(planes, "overcast", method, switches)
    clear_matte, clear_glossy = plane_entropies(planes, "clear", method, switches)
    assert overcast_matte > 0.5
    assert overcast_glossy > 0.5
    assert clear_glossy < 0.4  # 24 views exclude roughness above 0.45, a third remains
    assert clear_glossy < clear_matte
    assert clear_glossy < 0.6 * overcast_glossy
    assert clear_matte - clear_glossy > 1.2 * abs(overcast_matte - overcast_glossy)


def test_clear_light_helps_glossy_plane_with_estimated_noise(planes):
    """Without camera noise, the model explains renders well, also under overcast light."""
    switches = preset(method="angular")
    overcast_matte, overcast_glossy = plane_entropies(planes, "overcast", "angular", switches)
    clear_matte, clear_glossy = plane_entropies(planes, "clear", "angular", switches)
    assert clear_glossy < 0.5 * clear_matte
    assert clear_glossy < 0.6 * overcast_glossy
    assert overcast_glossy < overcast_matte < 0.5


# --- Figures 4 and 7: a metal ball in the light of one lamp ---------------------------------


def lamp(width):
    """Return light with harmonics proportional to exp(-(width l)^2), of constant flux."""
    rows = 64
    theta, phi = (np.pi * (np.arange(n) + 0.5) / rows for n in (rows, 2 * rows))
    across, up = np.sin(theta)[:, None], np.cos(theta)[:, None]
    towards = AXIS[0] * across * np.sin(phi) + AXIS[1] * up + AXIS[2] * across * np.cos(phi)
    light = np.exp(-(np.arccos(np.clip(towards, -1, 1)) ** 2) / (4 * width**2))
    light *= FLUX / (light * across * (np.pi / rows) ** 2).sum()
    pixels = np.repeat(light[..., None], 3, axis=2).astype(np.float32)
    return {"type": "envmap", "bitmap": mi.Bitmap(pixels)}


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    """Observe a metal ball from the lamp's side; metals have no diffuse term."""
    folder = tmp_path_factory.mktemp("figures")

    @cache
    def observed(width=0.25, Ks=0.8, views=24):
        metal = {"type": "principled", "metallic": 1.0, "roughness": ROUGHNESS,
                 "base_color": {"type": "rgb", "value": [Ks] * 3}}  # fmt: skip
        scene = ball_scene(folder, lamp(width), metal)
        sensors = sphere_sensors(scene.shapes()[0], views, (40, 40), up=tuple(AXIS), lowest=0.0)
        images = [np.array(mi.render(scene, sensor=sensor, spp=32)) for sensor in sensors]
        capture = memory_capture(scene, images, sensors)
        return svu.estimate(capture, svu.texels(capture.mesh, 20), "spectrum", "paper")

    return observed


def printed(ball, method):
    """Return preset ``paper`` over (roughness, Ks), with the same noise for all balls."""
    if method == "spectrum":
        return preset("paper", method="spectrum")
    known = preset("paper", method="angular")
    sigma = known.sigma * ball().observed.unit
    return preset(known, method="angular", parameters="specular", noise="fixed", sigma=sigma)


def towards_the_lamp(estimate):
    """Return cosines (T,) between the texels' normals and the direction of the lamp."""
    return AXIS @ np.array(estimate.texels.position).reshape(3, -1)


def near_entropy(ball, method, **changes):
    """Return the mean entropy of texels that face the lamp; 1 for unseen texels."""
    result = svu.estimate(ball(**changes), method=method, preset=printed(ball, method))
    return np.array(result.entropy)[towards_the_lamp(result) > NEAR].mean()


@METHODS
def test_figure_4_the_posterior_of_a_texel_is_narrow_or_wide(ball, method):
    """A lamp determines roughness; low-frequency light and weak reflection do not.

    The figure has three pictures, all with alpha 0.2: Ks 0.8 under a point light (H 0.25), Ks 0.8
    under low frequencies, which many values of roughness explain (0.69), and Ks 0.1 under a point
    light (0.87).
    """
    cases = {"sharp": {}, "low frequencies": {"width": 0.566}, "low Ks": {"Ks": 0.1}}
    entropy, cells, roughness = {}, {}, {}
    for name, changes in cases.items():
        result = svu.estimate(ball(**changes), method=method, preset=printed(ball, method))
        texel = int(np.argmax(towards_the_lamp(result)))
        p = np.array(result.posterior.probabilities_of([texel])).reshape(8, 8)
        entropy[name] = float(np.array(result.entropy)[texel])
        cells[name] = 1 + int((np.cumsum(np.sort(p.ravel())[::-1]) < 0.9).sum())
        roughness[name] = p.sum(axis=1)
    assert entropy["sharp"] < 0.45
    assert entropy["sharp"] + 0.15 < entropy["low frequencies"] < entropy["low Ks"] - 0.1
    assert 2 * cells["sharp"] < cells["low frequencies"] < cells["low Ks"]
    assert (roughness["low frequencies"] > 0.05).sum() > (roughness["sharp"] > 0.05).sum()
    # Not at the true roughness: as printed, light is band-limited for 24 views and photographs are
    # not, so the estimated roughness is too low.
    assert np.argmax(roughness["sharp"]) <= NODE


@pytest.fixture(scope="module")
def scene_ball(tmp_path_factory):
    """Observe a ball, of coloured metal or of a dielectric, under a light of our scenes."""

    @cache
    def observed(light, metallic):
        material = {"type": "principled", "metallic": metallic, "roughness": 0.25,
                    "base_color": {"type": "rgb", "value": [0.9, 0.7, 0.4]}}  # fmt: skip
        emitter = {"type": "envmap", "filename": str(scenes.FOLDER / "lights" / f"{light}.exr")}
        folder = tmp_path_factory.mktemp(light)
        capture = render_ball(folder, emitter, material, views=24, resolution=(48, 48), spp=32)
        return svu.estimate(capture, svu.texels(capture.mesh, 24), "spectrum", "paper")

    return observed


@METHODS
def test_figure_4_ordering(scene_ball, method):
    """Check the order of mean entropies of whole objects by our own presets."""

    def mean(light, metallic):
        result = svu.estimate(scene_ball(light, metallic), method=method)
        return float(np.array(result.entropy)[np.array(result.coverage) > 5].mean())

    sharp = mean("studio", 1.0)
    assert sharp < mean("overcast", 1.0)
    assert sharp < mean("studio", 0.0)


@METHODS
def test_figure_7_more_views_leave_less_entropy(ball, method):
    entropies = [near_entropy(ball, method, views=views) for views in (6, 12, 24)]
    assert all(few > 1.2 * many for few, many in pairwise(entropies))


@METHODS
def test_figure_7_sharper_light_leaves_less_entropy(ball, method):
    entropies = [near_entropy(ball, method, width=width) for width in (0.8, 0.566, 0.25)]
    assert all(soft > 1.2 * sharp for soft, sharp in pairwise(entropies))
