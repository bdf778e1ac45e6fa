"""Tests of saturated samples as lower bounds, from the file to the statistics."""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image
from scipy.stats import norm
from support.helpers import render_ball, sensor_xml, write_scene
from support.photographs import in_integers

import svu_mi as svu
from svu_mi.calibration.exposure import equalized
from svu_mi.calibration.light.light_estimate import FoundGains
from svu_mi.capture.content_hash import capture_key, photographs_key
from svu_mi.capture.image_io import decoded
from svu_mi.capture.photographs import SATURATED
from svu_mi.capture.quantization import Saturation
from svu_mi.errors import CaptureError
from svu_mi.posterior.observations import observe
from svu_mi.presets import preset
from svu_mi.reflection.principled import mixture
from svu_mi.statistics.censored import BestModels, find_best_models, parabola
from svu_mi.statistics.cholesky_factors import PAIRS
from svu_mi.statistics.gather_statistics import Weighting
from svu_mi.statistics.statistics import Statistics

SWITCHES = preset("default", method="angular")
LIMIT = float(decoded(np.array(SATURATED[8], np.float32)))


# --- the parabola -----------------------------------------------------------------------------


def test_parabola_has_slope_and_curvature_of_likelihood():
    z = np.concatenate([np.linspace(-30, 4.5, 300), [-3.001, -2.999, 0]])
    least, noise = 2.0, 0.4
    r = least + noise * z
    t, h = (x.numpy().astype(np.float64) for x in parabola(
        mi.Float(r.astype(np.float32)), mi.Float(least), mi.Float(noise)))  # fmt: skip
    ratio = np.exp(norm.logpdf(z) - norm.logcdf(z))
    slope, curvature = -ratio / noise, ratio * (ratio + z) / noise**2  # derivatives of -log Phi
    np.testing.assert_allclose(h / noise**2, curvature, rtol=0.02, atol=1e-4)
    np.testing.assert_allclose(h * (r - t) / noise**2, slope, rtol=0.02, atol=2e-3)


def test_weight_is_1_far_below_bound_and_0_far_above():
    t, h = parabola(mi.Float([0.0, 100.0]), mi.Float(2.0), mi.Float(0.01))
    np.testing.assert_allclose([t[0], h[0]], [2, 1], rtol=1e-3)
    assert h[1] < 1e-5 and np.isfinite(t[1])


def test_best_models_match_a_search():
    rng = np.random.default_rng(3)
    columns = rng.uniform(0.1, 1, (3, 5, 12, 2, 4))  # levels, texels, views, channels, columns
    truth = rng.uniform(0.2, 0.8, (5, 2))
    x = np.stack([np.array(mixture(0.5).at(c)) for c in truth.ravel()]).reshape(5, 2, 4)
    last = -np.einsum("lsvck,sck->lsvc", columns[..., :3], x[..., :3])
    columns[..., 3] = (last + 0.01 * rng.normal(size=last.shape)) / x[..., 3][None, :, None]
    table = np.stack(
        [(columns[..., i] * columns[..., j]).sum(axis=2) for i, j in PAIRS], axis=-1
    ).transpose(0, 2, 3, 1)
    models = find_best_models(Statistics.of(
        table, np.full(5, 12.0), np.full(5, 12), np.linspace(0, 1, 3), 1.0))  # fmt: skip
    assert isinstance(models, BestModels)
    values, sigma = models.values.numpy().reshape(5, 3, 3), models.sigma.numpy()
    for level in range(3):
        np.testing.assert_allclose(values[:, level, 0], 0.5, atol=1e-6)
        np.testing.assert_allclose(values[:, level, 1:], truth, atol=0.02)
    assert (sigma < 0.03).all() and (sigma >= 0.01).all()


# --- photographs ------------------------------------------------------------------------------


def photograph(path, over=((3, 4), (5, 6))) -> np.ndarray:
    """Return an 8-bit photograph with saturated pixels; in the second one only red is saturated."""
    pixels = np.full((24, 24, 3), 120, np.uint8)
    pixels[over[0]] = 255
    pixels[over[1]] = (255, 90, 80)
    Image.fromarray(pixels).save(path)
    return pixels


@pytest.fixture(scope="module")
def shiny(tmp_path_factory):
    """Return HDR photographs of a glossy ball under a bright lamp from 16 sides."""
    light = np.full((32, 64, 3), 0.3, np.float32)
    light[6:12, 20:28] = 12
    emitter = {"type": "envmap", "bitmap": mi.Bitmap(light)}
    paint = {"type": "principled", "roughness": 0.3, "metallic": 0.0,
             "base_color": {"type": "rgb", "value": [0.5, 0.3, 0.2]}}  # fmt: skip
    return render_ball(tmp_path_factory.mktemp("shiny"), emitter, paint, views=16,
                       resolution=(64, 64), spp=16)  # fmt: skip


@pytest.mark.filterwarnings("ignore::svu_mi.errors.SvuWarning")
def test_channels_that_are_clipped_are_known_to_be_bright(tmp_path):
    scene = write_scene(tmp_path, sensors=sensor_xml(1))
    (tmp_path / "images").mkdir()
    photograph(tmp_path / "images" / "view_0000.png")
    capture = svu.load_capture(scene)
    image, saturation = capture.images[0], capture.clipped[0]
    assert saturation.flags[3, 4].all() and saturation.flags[5, 6].tolist() == [True, False, False]
    assert saturation.flags.sum() == 4 and capture.unusable == (2,)
    np.testing.assert_allclose(saturation.least, LIMIT, rtol=1e-6)
    assert np.isnan(image[3, 4]).all() and np.isnan(image[5, 6]).tolist() == [True, False, False]
    assert image[5, 6, 1] == pytest.approx(float(decoded(np.array(90 / 255, np.float32))))
    other = replace(capture, clipped=())
    assert capture_key(capture) != capture_key(other)
    assert photographs_key(capture) != photographs_key(other)


@pytest.mark.slow
def test_saturation_levels_are_divided_by_gains(shiny):
    observed = observe(shiny, svu.texels(shiny.mesh, 32))
    stored, _ = in_integers(shiny, observed, 0.03)
    gains = FoundGains(np.log(np.full((16, 3), [2.0, 1.0, 0.5])), np.ones(16), np.zeros(16, bool))
    even = equalized(stored, gains)
    for one, other in zip(stored.clipped, even.clipped, strict=True):
        np.testing.assert_allclose(other.least, one.least / [2, 1, 0.5], rtol=1e-6)


def test_unsaturated_texels_are_unchanged(shiny):
    observed = observe(shiny, svu.texels(shiny.mesh, 32))
    none = tuple(Saturation.of(np.zeros((64, 64, 3), bool), 1.0) for _ in range(16))
    same = observe(replace(shiny, clipped=none), observed.texels)
    assert same.views.clipped is None and same.visibility.clipped is None


@pytest.mark.slow
def test_texels_saturated_in_all_views_are_bright(vase):
    """Saturated texels are seen; their radiance has a lower bound."""
    before = vase.estimate
    stored, _ = in_integers(vase.capture, before.observed, 0.3)
    estimate = svu.estimate(stored, vase.texels)
    always = (estimate.observed.coverage == 0) & (estimate.observed.shown > 0)
    assert always.sum() > 50
    assert (
        estimate.posterior.observed[always].all() and np.array(estimate.coverage)[always].min() > 0
    )
    assert np.median(np.array(estimate.entropy)[always]) < 0.9
    dropped = svu.estimate(replace(stored, clipped=()), vase.texels)
    assert not dropped.posterior.observed[always].any()
    right = np.array(before.posterior.mean("base_color"))[always]
    errors = [np.square(np.array(x.posterior.mean("base_color"))[always] - right).mean()
              for x in (estimate, dropped)]  # fmt: skip
    assert errors[0] < 0.7 * errors[1]


def test_texels_are_unseen_if_preset_ignores_saturated_samples(vase):
    stored, _ = in_integers(vase.capture, vase.estimate.observed, 0.3)
    observed = observe(stored, vase.texels)
    always = (observed.coverage == 0) & (observed.shown > 0)
    for name in ("fixed", "paper"):
        estimate = svu.estimate(observed, preset=name)
        assert not estimate.posterior.observed[always].any(), name
        assert not np.array(estimate.coverage)[always].any(), name


def test_completely_saturated_object_is_refused(vase):
    stored, _ = in_integers(vase.capture, vase.estimate.observed, 1.0)
    with pytest.raises(CaptureError, match="are saturated in all .* use shorter exposures"):
        observe(stored, vase.texels)


def statistics_of(capture, texels, **options):
    observed = observe(capture, texels)
    weighting = Weighting(SWITCHES.kappa(observed.unit), SWITCHES.edges)
    return observed, observed.statistics(
        np.linspace(0, 1, 5), SWITCHES, 3, weighting=weighting, **options
    )


def test_saturated_highlight_still_determines_roughness(shiny):
    """Without its saturated pixels, roughness at the highlight is unknown; bounds determine it."""
    texels = svu.texels(shiny.mesh, 48)
    observed = observe(shiny, texels)
    stored, part = in_integers(shiny, observed, 0.05)
    assert 0.03 < part < 0.06
    left_out = replace(stored, clipped=())
    seen = observed.coverage >= 4
    entropy = {
        name: np.array(svu.estimate(one, texels).entropy)[seen]
        for name, one in (("hdr", shiny), ("bound", stored), ("left out", left_out))
    }
    correlation = {
        name: np.corrcoef(entropy["hdr"], entropy[name])[0, 1] for name in ("bound", "left out")
    }
    assert correlation["bound"] > correlation["left out"]
    assert all(np.isfinite(values).all() for values in entropy.values())


@pytest.mark.slow
def test_bounds_add_weight_to_saturated_texels_only(shiny):
    texels = svu.texels(shiny.mesh, 32)
    hdr = observe(shiny, texels)
    stored, _ = in_integers(shiny, hdr, 0.05)
    seen, statistics = statistics_of(stored, texels)
    _, without = statistics_of(replace(stored, clipped=()), texels)
    both = np.intersect1d(statistics.texel.numpy(), without.texel.numpy())
    one, other = (x.subset(np.searchsorted(x.texel.numpy(), both)) for x in (statistics, without))
    touched = seen.visibility.clipped.count()[both] > 0
    assert 0.05 < touched.mean() < 0.9
    assert np.median((one.weight / other.weight)[touched]) > 1
    assert (one.views.numpy()[touched] >= other.views.numpy()[touched]).mean() > 0.9
    pure = ~touched & (one.views.numpy() == other.views.numpy())  # without saturated pixels
    assert pure.mean() > 0.1
    scale = other.table().max(axis=(0, 1, 2))
    off = np.abs(one.table() - other.table()).max(axis=(0, 1, 2)) / scale
    assert np.median(off[pure]) < 0.02 and np.median(off[touched]) > np.median(off[pure])


def test_mirror_directions_of_clipped_views_are_traced_too(shiny):
    """A ball does not occlude its mirror directions, so all samples are unoccluded."""
    texels = svu.texels(shiny.mesh, 32)
    stored, _ = in_integers(shiny, observe(shiny, texels), 0.05)
    seen = observe(stored, texels)
    asked = seen.visibility.bits.count() + seen.visibility.clipped.count()
    free = np.zeros(texels.count, int)
    free[seen.seen] = seen.mirrors.bits.count()
    assert seen.visibility.clipped.count()[seen.seen].sum() > 100
    np.testing.assert_array_equal(free[seen.seen], asked[seen.seen])


# --- import -----------------------------------------------------------------------------------
