"""Tests of quantised photographs: step sizes, from files to the noise of texels."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from PIL import Image
from support.helpers import run

import svu_mi as svu
from svu_mi import scenes
from svu_mi.calibration.exposure import equalized
from svu_mi.calibration.light.light_estimate import FoundGains
from svu_mi.capture.content_hash import capture_key, photographs_key
from svu_mi.capture.image_io import decoded, quantized, srgb
from svu_mi.capture.importers.nerf import write_transforms
from svu_mi.capture.importers.source import frame_of
from svu_mi.capture.quantization import Rounding, quantization_steps, variance
from svu_mi.capture.tone_curve import SampledCurve
from svu_mi.core.arrays import to_drjit
from svu_mi.geometry.sample_view import TexelLanes, sample_view, sample_visible
from svu_mi.posterior.observations import observe
from svu_mi.statistics.gather_statistics import Weighting
from svu_mi.statistics.statistics import noise_weight

DARK = 0.004  # exposure at which the vase covers a few of 255 steps


def in_steps(capture: svu.Capture, exposure: float) -> svu.Capture:
    """Return photographs quantised as 8-bit sRGB at an exposure."""
    images = [
        decoded(quantized(srgb(np.clip(np.nan_to_num(image) * exposure, 0, 1))) / 255) / exposure
        for image in capture.images
    ]
    rounding = (Rounding.of(8).divided(exposure),) * capture.count
    return replace(
        capture,
        images=tuple(np.ascontiguousarray(x, np.float32) for x in images),
        rounding=rounding,
    )


@pytest.mark.parametrize("transfer", ["srgb", "gamma 2.2", "linear"])
@pytest.mark.parametrize("bits", [8, 16])
def test_steps_match_differences_of_codes(bits, transfer):
    codes = np.arange(2**bits, dtype=np.float64)
    values = decoded(codes / codes[-1], transfer).astype(np.float64)
    steps, middle = np.diff(values), (values[1:] + values[:-1]) / 2
    rounding = Rounding.of(bits, transfer)
    steps_of = variance(owned_floats(middle), float(rounding.first[0]), float(rounding.slope[0]))
    said = np.sqrt(12 * steps_of.numpy())
    lit = middle > 4e-3  # in single precision, 16-bit steps have rounding errors, too
    if transfer == "linear":
        assert np.all(said >= 0.98 * steps)
    else:
        np.testing.assert_allclose(said[lit], steps[lit], rtol=0.25)


def owned_floats(values):
    return to_drjit(mi.Float, values.astype(np.float32))


def test_a_gain_makes_radiance_and_steps_smaller():
    gain = np.array([0.5, 1.0, 4.0])
    rounding, divided = Rounding.of(8), Rounding.of(8).divided(gain)
    shown = np.array([1e-4, 0.1, 0.7])  # as stored
    for c in range(3):
        whole = variance(owned_floats(shown), float(rounding.first[c]), float(rounding.slope[c]))
        of_light = variance(
            owned_floats(shown / gain[c]), float(divided.first[c]), float(divided.slope[c])
        )
        np.testing.assert_allclose(of_light.numpy() * gain[c] ** 2, whole.numpy(), rtol=1e-4)


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    """Return a folder of 8-bit photographs, and the capture imported from it."""
    folder = tmp_path_factory.mktemp("stored")
    capture = svu.render_capture(
        scenes.path("vase"), spp=4, views=3, resolution=(32, 32), defines={"light": "window"}
    )
    frames = []
    for view, sensor in enumerate(capture.sensors):
        path = folder / f"shot_{view}.png"
        pixels = quantized(srgb(np.clip(np.nan_to_num(capture.images[view]), 0, 1)))
        Image.fromarray(pixels).save(path)
        frames.append(frame_of(sensor, path, exposure=2.0 if view else 1.0))
    write_transforms(folder / "transforms.json", frames)
    mesh = scenes.path("vase").parent / "mesh.ply"
    assert run("import", folder, "--mesh", mesh, "-o", folder / "mine") == 0
    return capture, svu.load_capture(folder / "mine", light="optional")


def test_an_import_keeps_the_steps_and_hdr_has_none(stored):
    rendered, imported = stored
    assert rendered.rounding == () and len(imported.rounding) == 3
    for view, rounding in enumerate(imported.rounding):
        expected = Rounding.of(8).divided(2.0 if view else 1.0)
        np.testing.assert_allclose(rounding.first, expected.first, rtol=1e-5)
        np.testing.assert_allclose(rounding.slope, expected.slope, rtol=1e-5)


def test_capture_key_depends_on_quantisation_steps(stored):
    _, imported = stored
    other = replace(imported, rounding=())
    assert capture_key(imported) != capture_key(other)
    assert photographs_key(imported) == photographs_key(other)  # light does not depend on steps


def test_steps_of_a_measured_curve_match_its_codes():
    codes = np.arange(256, dtype=np.float32) / 255
    curve = np.minimum(decoded(codes) / decoded(codes)[250], 1).astype(np.float64)
    curve[:3] = 0  # black up to code 2, white from code 250
    response = SampledCurve(name="curve", codes=codes, values=np.repeat(curve[:, None], 3, axis=1))
    first, slope = quantization_steps(response, 8)
    assert first == pytest.approx(curve[3], rel=1e-3)
    usual = Rounding.of(8)
    assert slope == pytest.approx(float(usual.slope[0]), rel=0.3)
    assert quantization_steps("srgb", 8) == pytest.approx(
        (float(usual.first[0]), float(usual.slope[0]))
    )


def test_gains_divide_steps(stored):
    _, imported = stored
    logarithm = np.log([[0.5, 1, 2]] * 3)
    gains = FoundGains(logarithm, np.ones(3), np.zeros(3, bool))
    divided = equalized(imported, gains)
    for before, after in zip(imported.rounding, divided.rounding, strict=True):
        np.testing.assert_allclose(after.first * [0.5, 1, 2], before.first, rtol=1e-5)
    assert equalized(replace(imported, rounding=()), gains).rounding == ()


def test_sample_variance_matches_quantisation_steps(vase):
    dark = in_steps(vase.capture, 0.05)
    seen = observe(dark, vase.texels)
    kappa, eta = 0.4 * seen.unit, 2.0
    variances = seen.rounding(Weighting(kappa, eta))
    surface = TexelLanes.of(seen.texels, to_drjit(mi.UInt32, seen.seen.astype(np.uint32)))
    total, count = np.zeros(len(seen.seen)), np.zeros(len(seen.seen))
    for view in range(dark.count):
        which = dr.opaque(mi.UInt32, view)
        shows = sample_view(seen.views, surface, which).seen
        shown = sample_visible(seen.views, surface, which, shows)
        b, v = shown.radiance.numpy().T.astype(np.float64), shown.contrast.numpy()
        rounding = dark.rounding[view]
        step = np.maximum(rounding.first, rounding.slope * np.maximum(b, 1e-20) ** (1.4 / 2.4))
        weight = noise_weight(b.mean(axis=1), kappa, v, eta)
        total += np.where(shows.numpy(), weight * (step**2 / 12).mean(axis=1), 0)
        count += shows.numpy()
    np.testing.assert_allclose(variances, total / np.maximum(count, 1), rtol=1e-4)
    assert observe(vase.capture, vase.texels).rounding(Weighting(kappa, eta)) is None


def test_photographs_that_round_alike_are_not_sure(vase):
    """Noise is at least a quantisation step, also if samples agree, so entropy increases."""
    dark = in_steps(vase.capture, DARK)
    untested = svu.preset("default", method="angular", folds=0)
    said = svu.estimate(dark, vase.texels, preset=untested)
    unsaid = svu.estimate(replace(dark, rounding=()), vase.texels, preset=untested)
    least = said.observed.rounding(
        Weighting(said.switches.kappa(said.observed.unit), said.switches.edges)
    )
    assert np.all(said.posterior.kernel.noise >= 0.999 * np.sqrt(least))
    seen = said.posterior.observed
    assert np.array(said.entropy)[seen].mean() > np.array(unsaid.entropy)[seen].mean() + 0.05


def test_fine_quantisation_does_not_change_results(vase):
    bright = in_steps(vase.capture, 0.5)
    said = svu.estimate(bright, vase.texels)
    unsaid = svu.estimate(replace(bright, rounding=()), vase.texels)
    close = np.abs(np.array(said.entropy) - np.array(unsaid.entropy))
    assert np.quantile(close, 0.95) < 0.02
