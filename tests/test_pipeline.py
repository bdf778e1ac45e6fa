"""The pipeline as a whole: against the oracle, and against invariances."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from oracle import frequency as oracle_frequency
from oracle import posterior as oracle_posterior
from support.helpers import STUDIO, ball_scene, memory_capture, render_ball

import svu_mi as svu
from svu_mi.capture.sensors import describe, make_sensor, sphere_sensors
from svu_mi.errors import CaptureError, OptionError, ShapeError
from svu_mi.frequency.fit_samples import FitSamples
from svu_mi.frequency.spectra import fit_spectra
from svu_mi.geometry.sample_view import TexelLanes
from svu_mi.pipeline import estimate
from svu_mi.posterior.observations import observe
from svu_mi.presets import preset

DIFFUSE = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.6, 0.5, 0.3]}}
GLOSSY = {"type": "principled", "base_color": {"type": "rgb", "value": [0.9, 0.7, 0.4]},
          "metallic": 1.0, "roughness": 0.25}  # fmt: skip

METHODS = pytest.mark.parametrize("method", ["angular", "spectrum"])


@pytest.fixture(scope="module")
def glossy(tmp_path_factory):
    """A metal ball in a studio, seen from all sides, and its texels."""
    capture = render_ball(tmp_path_factory.mktemp("glossy"), STUDIO, GLOSSY, views=30, spp=16)
    return capture, svu.texels(capture.mesh, 40)


def stored_samples(capture, texels, switches):
    """What the kernels see, as arrays: directions (T,V,3), weights (T,V), values (T,V,2C)."""
    seen, surface = observe(capture, texels), TexelLanes.of(texels)
    columns, visibility = [], seen.visibility
    colors = switches.colors
    samples = FitSamples(seen, surface, switches.occluded, colors, colors)
    for place in range(int(visibility.count[0])):
        direction, weight, values = samples.at(mi.UInt32(place))
        dr.eval(direction, weight, values)
        columns.append((direction.numpy().T, weight.numpy(), np.stack([v.numpy() for v in values])))
    d, w, f = zip(*columns, strict=True)
    return np.stack(d, 1), np.stack(w, 1), np.stack(f, 2).transpose(1, 2, 0)


def spectra_of(seen, switches):
    return fit_spectra(seen, switches)


def exact_spectra(d, w, f, switches):
    """(T, l* + 1, 6) float64 spectra of stored samples."""
    c = oracle_frequency.fit(
        d, w, f, switches.degree, switches.regularizer, switches.penalize_constant
    )
    return oracle_frequency.power(c)


@pytest.mark.few(2)
@pytest.mark.parametrize("name", ["default", "paper", "fast"])
def test_the_fused_kernels_agree_with_the_oracle(glossy, name):
    """Samples stored, fitted and compared in float64, straight from the equations."""
    capture, texels = glossy
    switches = preset(name, method="spectrum")
    d, w, f = stored_samples(capture, texels, switches)
    spectra = spectra_of(observe(capture, texels), switches)
    exact = exact_spectra(d, w, f, switches)
    ours = np.concatenate([np.array(spectra.outgoing), np.array(spectra.incoming)], axis=2)
    largest = np.maximum(exact.max(axis=1, keepdims=True), 1e-6)
    assert (np.abs(ours - exact) / largest).max() < 1e-3


@METHODS
def test_every_result_is_in_range_and_nothing_is_nan(glossy, method):
    capture, texels = glossy
    for name in ("default", "paper", "fast", *(["fixed"] if method == "angular" else [])):
        result = estimate(capture, texels, method, name)
        entropy = np.array(result.entropy)
        assert np.isfinite(entropy).all()
        assert (entropy >= 0).all()
        assert (entropy <= 1).all()
        assert result.image("entropy").shape == (40, 40)
        assert (result.image("entropy")[~texels.inside()] == 1).all()
    with pytest.raises(OptionError, match="unknown map 'roughness'"):
        result.image("roughness")


@METHODS
def test_the_order_of_the_views_does_not_matter(glossy, method):
    capture, texels = glossy
    order = np.random.default_rng(66107).permutation(capture.count)
    shuffled = replace(
        capture,
        sensors=tuple(capture.sensors[i] for i in order),
        images=tuple(capture.images[i] for i in order),
    )
    a, b = (np.array(estimate(c, texels, method).entropy) for c in (capture, shuffled))
    np.testing.assert_allclose(a, b, atol=1e-4)


@pytest.mark.few(1)
@METHODS
def test_unseen_texel_has_entropy_1(tmp_path, method):
    """Cameras on one side only: the other side has entropy 1 and coverage 0, exactly."""
    scene = ball_scene(tmp_path, STUDIO, GLOSSY)
    sensors = [s for s in sphere_sensors(scene.shapes()[0], 40, (48, 48))
               if np.array(s.world_transform().matrix).reshape(4, 4)[2, 3] > 1.5]  # fmt: skip
    images = [np.array(mi.render(scene, sensor=s, spp=16)) for s in sensors]
    capture = memory_capture(scene, images, sensors)
    texels = svu.texels(capture.mesh, 40)
    result = estimate(capture, texels, method)
    z = texels.position.z.numpy()
    seen = np.array(result.coverage)
    entropy = np.array(result.entropy)
    assert (seen[z < -0.5] == 0).all()
    assert (entropy[seen == 0] == 1).all()
    assert (entropy[seen > 5] < 1).all()
    assert result.skipped["texels never seen"] == (seen == 0).sum()


@pytest.mark.few(1)
@METHODS
def test_one_view_is_an_answer_too(tmp_path, method):
    capture = render_ball(tmp_path, STUDIO, GLOSSY, views=1)
    result = estimate(capture, svu.texels(capture.mesh, 24), method)
    entropy = np.array(result.entropy)
    assert np.isfinite(entropy).all()
    assert set(np.array(result.coverage)) == {0, 1}


def test_capture_without_seen_texels_is_refused(tmp_path):
    scene = ball_scene(tmp_path, STUDIO, GLOSSY)
    record = describe(sphere_sensors(scene.shapes()[0], 1, (16, 16))[0])
    pose = np.array(record["to_world"])
    pose[:3, 0] *= -1
    pose[:3, 2] *= -1  # looks the other way
    capture = memory_capture(scene, [np.ones((16, 16, 3))], [
        make_sensor({**record, "to_world": pose}, "away")
    ])  # fmt: skip
    with pytest.raises(CaptureError, match="No texel of 'ball' is seen in any of 1 photographs"):
        estimate(capture, svu.texels(capture.mesh, 16))


@pytest.mark.few(1)
@METHODS
def test_a_second_capture_compiles_nothing(tmp_path, glossy, method):
    """Other photographs, another number of views, other texels: the same kernels."""
    capture, texels = glossy
    for _ in range(2):
        estimate(capture, texels, method)
    compiled = []
    for views, resolution in ((24, 28), (17, 23)):
        other = render_ball(tmp_path, STUDIO, DIFFUSE, views=views, spp=4)
        there = svu.texels(other.mesh, resolution)
        dr.sync_thread()
        before = sum(dr.detail.launch_stats()[1:])
        estimate(other, there, method)
        compiled.append(sum(dr.detail.launch_stats()[1:]) - before)
    # One kernel has two forms, and now and then the same estimate takes the other: once, then it
    # is known. What depends on the capture would be compiled for both.
    assert min(compiled) == 0 and max(compiled) <= 1


@pytest.mark.parametrize(
    ("method", "side", "many"),
    [pytest.param("angular", 128, 256, marks=pytest.mark.slow), ("spectrum", 256, 96)],
)
def test_memory_does_not_grow_with_texels_times_views(tmp_path, method, side, many):
    """More views of the same texels add their pixels, nothing per texel.

    So many more that it does not matter that Dr.Jit rounds sizes up to powers of two, but not so
    many that rays through the films take more than the texels.
    """
    scene = ball_scene(tmp_path, STUDIO, GLOSSY)
    texels = svu.texels(scene.shapes()[0], side)
    film, peak = side // 16, []
    for number in (8, many):
        sensors = sphere_sensors(scene.shapes()[0], number, (film, film))
        capture = memory_capture(scene, [np.ones((film, film, 3))] * number, sensors)
        dr.sync_thread()
        dr.flush_malloc_cache()
        dr.detail.malloc_clear_statistics()
        estimate(capture, texels, method)
        dr.sync_thread()
        peak.append(dr.detail.malloc_watermark(dr.JitBackend.LLVM))
    per_view = (peak[1] - peak[0]) / (many - 8)
    assert per_view < 0.4 * texels.count  # one byte per texel and view would be 1


@pytest.mark.slow
def test_oracle_and_posterior_agree_on_a_rendered_object(glossy):
    capture, texels = glossy
    switches = preset("paper", method="spectrum", sigma=0.05)
    d, w, f = stored_samples(capture, texels, switches)
    S = exact_spectra(d, w, f, switches)
    seen = (w > 0).any(axis=1)
    roughness, Ks = oracle_posterior.nodes(8, 8, "uniform")
    exact = np.array([
        oracle_posterior.entropy(oracle_posterior.normalize(sum(
            oracle_posterior.distances(S[t, :, 3 + c], S[t, :, c], roughness**2, Ks)
            for c in range(3)
        ) / (2 * 0.05**2)))
        for t in range(len(S))
    ])  # fmt: skip
    ours = np.array(estimate(capture, texels, "spectrum", switches).entropy)
    np.testing.assert_allclose(ours[seen], exact[seen], atol=2e-3)  # spectra differ by 1e-6


# --- what is refused, and what must not be mistaken -------------------------------------------


@pytest.mark.parametrize(
    "method, options, sentence",
    [
        ("angular", {"grid": svu.ParameterGrid()}, "need a PrincipledGrid, got ParameterGrid"),
        ("angular", {"grid": (8, 8, 8)}, r"a ParameterGrid or a PrincipledGrid, got \(8, 8, 8\)"),
        ("angular", {"prior": np.ones(3)}, r"the prior must be \(8, 8, 8\) or \(8,\)"),
        ("spectrum", {"grid": (8, 8)}, "grid must be a ParameterGrid or a PrincipledGrid"),
        ("spectrum", {"prior": -np.ones(8)}, "the prior must be finite, non-negative"),
        ("spectrum", {"preset": "fixed"}, "Unknown preset 'fixed'"),
        ("angular", {"preset": "best"}, "Unknown preset 'best'"),
        ("magic", {}, "method must be one of angular, spectrum, got 'magic'"),
    ],
)
def test_wrong_arguments_are_refused_before_any_work(glossy, method, options, sentence):
    capture, texels = glossy
    blind = replace(capture, scene=None, sensors=())  # any work on it would fail otherwise
    with pytest.raises((OptionError, ShapeError), match=sentence):
        svu.estimate(blind, texels, method, **options)


def test_a_grid_of_ks_without_a_spacing_resolves_dielectrics(glossy):
    capture, texels = glossy
    switches = preset("fixed", method="angular", parameters="specular")
    result = estimate(capture, texels, "angular", switches, grid=svu.ParameterGrid())
    assert result.posterior.axes["specular"][0] == pytest.approx(0.04)
