"""Tests of skipped work: results are equal with and without it."""

from __future__ import annotations

import functools
import logging
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from support.helpers import ball_scene, memory_capture

import svu_mi as svu
from svu_mi.capture.replace_material import constant_parameters
from svu_mi.capture.sensors import sphere_sensors
from svu_mi.errors import OptionError
from svu_mi.pipeline import estimate
from svu_mi.presets import NOTHING, Skip, preset

RULES = pytest.mark.parametrize(
    "method, rule", [("angular", "default"), ("angular", "fixed"), ("spectrum", "default")]
)
COLOURED = {"angular": "joint", "spectrum": "sum"}
TOLERANCE = 1e-5
RNG = np.random.default_rng(5)
TEXTURE = {
    "type": "bitmap", "raw": True, "filter_type": "nearest",
    "data": RNG.uniform(0.1, 0.9, (8, 8, 1)).astype(np.float32),
}  # fmt: skip


def material(**changes):
    """Return a grey material with textures for all parameters except metallic."""

    def texture():
        return {**TEXTURE, "data": mi.TensorXf(TEXTURE["data"])}

    return {"type": "principled", "base_color": texture(), "roughness": texture(),
            "metallic": 0.0, **changes}  # fmt: skip


def lamps(color=(1, 1, 1)):
    """Return a sky with two lamps."""
    sky = np.full((16, 32, 3), 0.2) * color
    sky[4:6, 5:8] += 12 * np.array(color)
    sky[9:11, 20:24] += 5 * np.array(color)
    return {"type": "envmap", "bitmap": mi.Bitmap(sky.astype(np.float32)), "scale": 1.0}


def one_sided(tmp_path, emitter=None, bsdf=None):
    """Return photographs of one side of a ball; the last camera looks away from it."""
    scene = ball_scene(tmp_path, emitter or lamps(), bsdf or material())
    sensors = [s for s in sphere_sensors(scene.shapes()[0], 40, (48, 40)) if place(s)[2] > 0.5]
    images = [np.array(mi.render(scene, sensor=s, spp=8, seed=i)) for i, s in enumerate(sensors)]
    away = mi.load_dict({
        "type": "perspective", "fov": 20.0,
        "to_world": mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 9], [0, 1, 0]),
        "film": {"type": "hdrfilm", "width": 48, "height": 40},
    })  # fmt: skip
    return memory_capture(scene, [*images, np.ones((40, 48, 3))], [*sensors, away])


def place(sensor):
    return np.array(sensor.world_transform().matrix).reshape(4, 4)[:3, 3]


@pytest.fixture(scope="module")
def grey(tmp_path_factory):
    """Return a grey capture with unseen texels and a blind view, and its texels."""
    capture = one_sided(tmp_path_factory.mktemp("grey"))
    return capture, svu.texels(capture.mesh, 40)


AXES = {"roughness": 0, "metallic": 1, "base_color": 2}


def entropy(result):
    return np.array(result.entropy)


PRIOR = np.array([0, 0, 1, 1, 2, 1, 1, 0.0])  # per roughness node


@pytest.fixture(scope="module")
def estimates(grey):
    """Return a function that estimates with a noise rule and options to skip."""

    @functools.cache
    def estimated(method, rule, skip):
        switches = preset(rule, method=method, channels=COLOURED[method])
        return estimate(*grey, method, switches, prior=PRIOR, skip=skip)

    return estimated


@pytest.mark.few(2)
@pytest.mark.parametrize(("method", "rule", "name"), [
    ("angular", "fixed", None), ("spectrum", "default", None),
    *(("angular", "default", name) for name in (None, *vars(NOTHING))),
])  # fmt: skip
def test_every_switch_leaves_the_result(estimates, method, rule, name):
    ours = estimates(method, rule, Skip())
    other = estimates(method, rule, replace(NOTHING, **{name: True}) if name else NOTHING)
    np.testing.assert_allclose(entropy(ours), entropy(other), atol=TOLERANCE)
    chosen = np.flatnonzero(np.array(ours.coverage) > 0)[::97]
    np.testing.assert_allclose(
        *(np.array(each.posterior.probabilities_of(chosen)) for each in (ours, other)), atol=2e-5
    )
    cells = np.prod(ours.posterior.grid.shape[1:])
    p = np.repeat(PRIOR / PRIOR.sum() / cells, cells)
    usual = -(p[p > 0] * np.log(p[p > 0])).sum() / np.log(8 * cells)
    unseen = entropy(ours)[np.array(ours.coverage) == 0]
    estimated = ours.preset.noise == "estimated"
    np.testing.assert_allclose(unseen, 1.0 if estimated else usual, rtol=1e-6)
    assert (unseen == unseen[0]).all()


def test_record_lists_skipped_work(grey, caplog):
    capture, texels = grey
    with caplog.at_level(logging.INFO, logger="svu_mi.posterior.work_plan"):
        result = estimate(capture, texels, prior=PRIOR, known={"metallic": 0.0})
    assert result.skipped["texels never seen"] == (np.array(result.coverage) == 0).sum() > 100
    assert result.skipped["views that show no texel"] == 1
    assert result.skipped["channels of the light equal to another"] == 2
    assert result.skipped["channels of the photographs equal to another"] == 2
    assert result.skipped["roughness levels that the prior excludes"] == 3
    assert result.skipped["parameters known"] == 1
    for reason, count in result.skipped.items():
        assert (f"Skipped: {count} {reason}." in caplog.text) == (count > 0)


@pytest.mark.parametrize("name", ["default", "fixed"])
def test_work_is_really_left_out(grey, name):
    """Statistics have one channel and two levels; interpolated levels have two bins' nodes."""
    capture, texels = grey
    switches = preset(name, method="angular", channels="joint")
    prior = np.array([0, 0, 1, 1, 0, 0, 0, 0.0])
    few, all_of_it = (
        estimate(capture, texels, "angular", switches, prior=prior, skip=skip).posterior
        for skip in (Skip(), NOTHING)
    )
    few, all_of_it = few.kernel.problem, all_of_it.kernel.problem
    assert (few.factors.channels, all_of_it.factors.channels) == (1, 3)
    if name == "fixed":
        assert (few.factors.levels, all_of_it.factors.levels) == (2, 8)
        assert few.total == all_of_it.total == 512
    else:
        assert few.factors.levels == all_of_it.factors.levels == 12
        assert few.roughness.count == all_of_it.roughness.count == 2 * 42 / 7
        assert set(few.roughness.bin) == {2, 3}


def test_one_grey_channel_replaces_three(grey):
    one, three = (estimate(*grey, "spectrum", "paper", skip=skip) for skip in (Skip(), NOTHING))
    assert one.skipped["channels of the photographs equal to another"] == 2
    np.testing.assert_allclose(entropy(one), entropy(three), atol=TOLERANCE)


@pytest.fixture(scope="module", params=["light", "object"])
def colored(request, tmp_path_factory):
    """Return a capture with coloured light or material, and its texels."""
    emitter = lamps((1.0, 0.7, 0.4) if request.param == "light" else (1, 1, 1))
    paint = {"base_color": {"type": "rgb", "value": [0.7, 0.3, 0.2]}}
    bsdf = material(**(paint if request.param == "object" else {}))
    capture = one_sided(tmp_path_factory.mktemp("colored"), emitter, bsdf)
    return request.param, capture, svu.texels(capture.mesh, 24)


@pytest.mark.slow
@RULES
def test_of_coloured_photographs_only_grey_light_is_skipped(colored, method, rule):
    what, *subject = colored
    switches = preset(rule, method=method, channels=COLOURED[method])
    result = estimate(*subject, method, switches)
    assert result.skipped["channels of the photographs equal to another"] == 0
    expected = 2 if what == "object" else 0
    assert result.skipped["channels of the light equal to another"] == expected
    without = estimate(*subject, method, switches, skip=NOTHING)
    np.testing.assert_allclose(entropy(result), entropy(without), atol=TOLERANCE)


@pytest.mark.slow
def test_a_bright_grey_sun_does_not_make_a_coloured_sky_grey(tmp_path):
    sky = np.full((16, 32, 3), [0.03, 0.06, 0.1], np.float32)
    sky[4, 7] = 2e5
    capture = one_sided(tmp_path, {"type": "envmap", "bitmap": mi.Bitmap(sky)})
    texels = svu.texels(capture.mesh, 24)
    switches = preset("default", method="angular", channels="joint")
    result = estimate(capture, texels, "angular", switches)
    assert result.skipped["channels of the light equal to another"] == 0


# --- known parameters -----------------------------------------------------------------------


@pytest.mark.few(2)
@pytest.mark.parametrize("method, rule", [("angular", "fixed"), ("spectrum", "default")])
@pytest.mark.parametrize("name, node", [("metallic", 0), ("metallic", 7), ("roughness", 3),
                                        ("base_color", 5)])  # fmt: skip
def test_known_value_equals_prior_on_its_node(grey, method, rule, name, node):
    """H log n equals the whole grid's under a prior that allows only that node."""
    capture, texels = grey
    prior = np.zeros((8, 8, 8))
    prior[(slice(None),) * AXES[name] + (node,)] = 1
    whole = estimate(capture, texels, method, rule, prior=prior, skip=NOTHING)
    known = estimate(capture, texels, method, rule, known={name: node / 7})
    seen = np.array(known.coverage) > 0
    nats = entropy(known)[seen] * np.log(64), entropy(whole)[seen] * np.log(512)
    np.testing.assert_allclose(*nats, atol=TOLERANCE * np.log(512))
    assert known.posterior.axes[name].tolist() == [node / 7]
    assert 1 in np.array(known.posterior.probabilities_of([0])).shape


@pytest.mark.slow
def test_known_value_equals_prior_on_a_narrow_bin(grey):
    """With the default prior of other parameters; narrower bins approach the known value."""
    capture, texels = grey
    untested = preset("default", method="angular", folds=0)  # which would widen only a narrow bin
    off = []
    for steps in (8, 64):
        grid, node = svu.PrincipledGrid(roughness=steps), round(0.6 * (steps - 1))
        known = estimate(capture, texels, preset=untested, known={"roughness": node / (steps - 1)})
        prior = np.zeros(grid.shape)
        prior[node] = known.posterior.prior[0]
        whole = estimate(capture, texels, preset=untested, prior=prior, grid=grid)
        off.append(np.abs(entropy(known) - entropy(whole))[np.array(known.coverage) > 0].mean())
    assert off[1] < 0.005 < off[0]


def test_a_known_value_need_not_be_a_node(grey):
    """Between two nodes, entropy is a continuous function of the known value."""
    capture, texels = grey
    values = [0.3, 0.3 + 1e-4]
    a, b = (entropy(estimate(capture, texels, known={"metallic": value})) for value in values)
    assert 0 < np.abs(a - b).max() < 1e-2


@pytest.mark.few(1)
@RULES
def test_another_prior_needs_no_other_kernel(grey, method, rule):
    """Neither the entropy nor other results compile a new kernel for another prior."""
    from drjit import detail

    capture, texels = grey
    rng = np.random.default_rng(90001)
    for run in range(3):
        compiled = sum(detail.launch_stats()[1:])
        posterior = estimate(capture, texels, method, rule, prior=rng.random((8, 8, 8))).posterior
        for name in posterior.axes:
            (
                posterior.mean(name),
                posterior.sd(name),
                posterior.interval(name, rng.uniform(0.5, 0.9)),
            )
        posterior.draw(2, seed=run)
        if run > 1:
            assert sum(detail.launch_stats()[1:]) == compiled


def test_constants_of_a_material(grey, tmp_path):
    capture, texels = grey
    assert constant_parameters(capture.shape) == {"metallic": 0.0}
    result = estimate(capture, texels, known="scene")
    assert result.posterior.grid.known == {"metallic": 0.0}
    assert estimate(capture, texels).posterior.grid.known == {}
    plain = {"type": "principled", "metallic": 0.3}
    for bsdf in (plain, {"type": "diffuse"}, {"type": "twosided", "inside": plain}):
        shape = ball_scene(tmp_path, {"type": "constant"}, bsdf).shapes()[0]
        assert constant_parameters(shape) == {}
    both = {"type": "twosided", "inside": material(metallic=0.3)}
    shape = ball_scene(tmp_path, {"type": "constant"}, both).shapes()[0]
    assert constant_parameters(shape) == pytest.approx({"metallic": 0.3})


@pytest.mark.parametrize(
    "known, words",
    [
        ({"metalness": 0.0}, "metalness"),
        ({"metallic": 1.5}, r"in \[0, 1\]"),
        ({"metallic": float("nan")}, r"in \[0, 1\]"),
        ({"roughness": 0.1, "metallic": 0.0, "base_color": 0.5}, "leave at least one unknown"),
        ({"metallic": True}, r"known\['metallic'\] must be a number, got True"),
        ("bsdf", "known must be a dict or 'scene', got 'bsdf'"),
        (0.5, "known must be a dict or 'scene', got 0.5"),
    ],
)
def test_known_values_that_are_refused(grey, known, words):
    capture, texels = grey
    with pytest.raises(OptionError, match=words):
        svu.estimate(capture, texels, known=known)


@pytest.mark.slow
def test_pictures_and_record_with_a_known_parameter(grey, tmp_path):
    """Overview, figures and run.json with an axis of one node, whose marginal is constant."""
    import json

    from matplotlib import pyplot as plt

    from svu_mi.output import panels
    from svu_mi.output.write_entropy import write_outputs

    capture, texels = grey
    result = estimate(capture, texels, known={"metallic": 0.25})
    write_outputs(capture, result, tmp_path)
    assert json.loads((tmp_path / "run.json").read_text())["settings"]["grid"]["known"] == {
        "metallic": 0.25
    }
    assert (np.array(result.posterior.marginal_entropy("metallic")) == 0).all()
    assert (np.array(result.posterior.map()["metallic"]) == 0.25).all()
    figure, (left, right) = plt.subplots(1, 2)
    panels.draw_posterior(left, result.posterior, 700)
    assert {left.get_xlabel(), left.get_ylabel()} == {"roughness", "base colour"}
    panels.draw_marginal(right, result.posterior, 700, "metallic")
    plt.close(figure)
