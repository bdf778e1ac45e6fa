"""Estimated gains of photographs: normal equations, division, outliers."""

from __future__ import annotations

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from support.helpers import Said, made_up_light, names, run, write_dark
from support.made_up_samples import SWITCHES, photographed

import svu_mi as svu
from svu_mi import scenes
from svu_mi.calibration.exposure import equalized, estimate_gains, step_gains, without_gains
from svu_mi.calibration.light import estimate_light, resolve_light
from svu_mi.calibration.light.estimate_light import LightProblem
from svu_mi.calibration.light.gauss_newton import (
    BALANCE,
    COLOR_SD,
    EXPOSURE,
    MATERIAL_SD,
    LightPriors,
    _linearized,
    normal_equations,
)
from svu_mi.calibration.light.light_estimate import FoundGains
from svu_mi.calibration.light.light_prior import prior_of
from svu_mi.calibration.light.light_summary import gain_sentences
from svu_mi.calibration.light.light_transport import (
    SampleMoments,
    Transport,
    columns_of,
    materials_of,
)
from svu_mi.calibration.light.resolve_light import with_resolved_light
from svu_mi.core.io.npz import read_arrays, write_arrays
from svu_mi.errors import CaptureError, OptionError
from svu_mi.posterior.empirical_bayes import with_empirical_prior
from svu_mi.posterior.observations import observe

ODD = (3, 11, 17)


def random_gains(views: int, seed: int = 4) -> np.ndarray:
    """Return (V, 3) log gains: exposure 30 %, white balance 15 %, zero mean."""
    rng = np.random.default_rng(seed)
    result = rng.uniform(-0.3, 0.3, (views, 1)) + rng.uniform(-0.15, 0.15, (views, 3))
    return result - result.mean(axis=0)


def multiplied(capture: svu.Capture, gains: np.ndarray) -> svu.Capture:
    factors = np.exp(gains).astype(np.float32)
    images = [image * factor for image, factor in zip(capture.images, factors, strict=True)]
    return replace(capture, images=tuple(images))


# --- the equations ----------------------------------------------------------------------------


def test_gains_and_light_equal_full_normal_equations():
    samples, x = photographed(8, 6, 64, noise=0.05)
    transport, tau = Transport.of(samples, 64), SWITCHES.overdispersion
    posterior = SampleMoments.of(samples, columns_of(transport, np.exp(x), SWITCHES)).posterior(
        SWITCHES
    )
    gains = random_gains(6)
    system = normal_equations(transport, np.exp(x), posterior, tau, gains=gains)

    materials = materials_of(with_empirical_prior(posterior))
    slopes, r = _linearized(transport, np.exp(x), materials)
    w = samples.weight / (posterior.kernel.noise[samples.owner] ** 2 * tau)
    count, n = samples.count, 3 * 6
    J = np.zeros((count, 3, n + 5 * samples.texels))
    for s in range(count):
        for c in range(3):
            J[s, c, c * 6 + samples.view[s]] = r[s, c]
        own = n + 5 * samples.owner[s]
        J[s, :, own : own + 5] = slopes[s]
    H = np.einsum("s,sci,scj->ij", w, J, J)
    g = -np.einsum("s,sci,sc->i", w, J, samples.radiance - r)
    covariance = np.full((3, 3), EXPOSURE**2) + BALANCE**2 * np.eye(3)
    H[:n, :n] += np.kron(np.linalg.inv(covariance), np.eye(6))
    g[:n] += (gains @ np.linalg.inv(covariance)).T.ravel()
    H[n:, n:] += np.diag(np.tile(1 / np.square([*MATERIAL_SD, *[COLOR_SD] * 3]), samples.texels))
    color = materials.color
    g[n:].reshape(-1, 5)[:, 2:] += (color - color.mean(axis=0)) / COLOR_SD**2
    taken = np.linalg.solve(H[n:, n:], np.column_stack([H[n:, :n], g[n:]]))
    matrix, gradient = H[:n, :n] - H[:n, n:] @ taken[:, :-1], g[:n] - H[:n, n:] @ taken[:, -1]
    np.testing.assert_allclose(system.matrix, matrix, atol=2e-4 * np.abs(matrix).max())
    np.testing.assert_allclose(system.gradient, gradient, atol=2e-4 * np.abs(gradient).max())

    # With cells of the light, whose own block is the same as without gains.
    both = normal_equations(transport, np.exp(x), posterior, tau, LightPriors(prior_of(64)), gains)
    alone = normal_equations(transport, np.exp(x), posterior, tau, LightPriors(prior_of(64)))
    of_light = np.concatenate([np.arange(64) + c * 70 for c in range(3)])
    of_gains = np.concatenate([np.arange(64, 70) + c * 70 for c in range(3)])
    atol = 1e-5 * np.abs(alone.matrix).max()
    np.testing.assert_allclose(both.matrix[np.ix_(of_light, of_light)], alone.matrix, atol=atol)
    np.testing.assert_allclose(both.gradient[of_light], alone.gradient, rtol=1e-4, atol=1e-2)
    np.testing.assert_allclose(both.matrix[np.ix_(of_gains, of_gains)], system.matrix,
                               rtol=1e-3, atol=2e-3 * np.abs(matrix).max())  # fmt: skip


def test_what_gains_have_in_common_is_the_lights():
    gains = FoundGains(np.zeros((4, 3)), np.zeros(4), np.array([False, False, True, False]))
    change = np.arange(12.0).reshape(4, 3)
    stepped, common = step_gains(gains, None, None, change, None)
    np.testing.assert_allclose(common, change[[0, 1, 3]].mean(axis=0))
    np.testing.assert_allclose(stepped.logarithm[[0, 1, 3]].mean(axis=0), 0, atol=1e-12)
    np.testing.assert_allclose(stepped.logarithm[2], -common)  # skipped by the step
    np.testing.assert_allclose(stepped.factor, np.exp(stepped.logarithm))


def test_readmitted_photograph_keeps_its_gain():
    """Steps skip outliers; a readmitted photograph gets the gain of its samples."""
    samples, _ = photographed(40, 6, 64, noise=0)
    gains = FoundGains(np.zeros((6, 3)), np.zeros(6), np.arange(6) == 1)
    bright = np.where(samples.view == 1, 2.0, 1.0)[:, None].astype(np.float32)
    shown = replace(samples, radiance=samples.radiance * bright)
    off = 1 + 0.02 * np.random.default_rng(1).normal(size=samples.radiance.shape)
    system = SimpleNamespace(predicted=samples.radiance * off)
    change = np.full((6, 3), -0.8)  # the second has only its prior
    after, _ = step_gains(gains, shown, system, change, np.full(40, 0.1))
    assert not after.odd.any()
    np.testing.assert_allclose(after.logarithm[1] - after.logarithm[0], np.log(2) + 0.8, atol=0.02)


@pytest.mark.slow
def test_light_and_gains_are_found_together():
    samples, x = photographed(100, 20, 64, noise=0.03)
    true = random_gains(20)
    shown = replace(
        samples, radiance=(samples.radiance * np.exp(true)[samples.view]).astype(np.float32)
    )
    fit = LightProblem(shown, SWITCHES, gains=True).solve(((64, 9),))
    alone = LightProblem(shown, SWITCHES).solve(((64, 9),))
    assert fit.gains is not None and alone.gains is None and not fit.gains.odd.any()
    assert np.sqrt(np.mean((fit.gains.logarithm - true) ** 2)) < 0.03
    np.testing.assert_allclose(fit.gains.logarithm.mean(axis=0), 0, atol=1e-9)
    assert fit.misfit < 0.6 * alone.misfit
    correlation = [np.corrcoef(one.x.mean(axis=1), x.mean(axis=1))[0, 1] for one in (fit, alone)]
    assert correlation[0] > 0.95 and correlation[0] > correlation[1]
    again = without_gains(Transport.of(shown, 64), fit.gains)
    np.testing.assert_array_equal(again.samples.radiance, fit.transport.samples.radiance)


def test_outliers_are_flagged_once_new_cells_are_fitted(monkeypatch):
    """An excluded photograph would stay one: no other shows the light that it mirrors."""
    samples, _ = photographed(40, 6, 64, noise=0.03)
    problem, odd = LightProblem(samples, SWITCHES, gains=True), np.arange(6) == 1
    start = problem.solve(((64, 1),))
    start = replace(start, gains=replace(start.gains, odd=odd))
    rounds = []

    def step(gains, *rest):
        rounds.append((gains.odd.any(), rest[-1] is not None))
        return step_gains(gains, *rest)

    monkeypatch.setattr(estimate_light, "step_gains", step)
    problem.solve(((64, 3),), start)
    assert rounds == [(False, False), (False, False), (False, True)]


# --- captures ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def vase(tmp_path_factory):
    """Capture of the vase from 24 sides. Read only."""
    folder = tmp_path_factory.mktemp("vase")
    words = ("render", scenes.path("vase"), "-D", "light=window", "--views", 24)
    assert run(*words, "--resolution", 64, "--spp", 32, "-o", folder) == 0
    return folder


@pytest.fixture(scope="module")
def observed(vase):
    capture = svu.load_capture(vase)
    return observe(capture, svu.texels(capture.mesh, 64))


OPTIONS = svu.LightOptions(texels=300)


@pytest.mark.slow
def test_gains_are_found_under_a_known_light(observed):
    true = random_gains(24)
    estimated = estimate_gains(multiplied(observed.capture, true), observed.texels, OPTIONS)
    off = estimated.logarithm - true
    assert np.sqrt(np.mean(off**2)) < 0.05 and not estimated.odd.any()
    bright = multiplied(observed.capture, true + np.log(3))  # light in different units
    units = estimate_gains(bright, observed.texels, OPTIONS)
    assert np.sqrt(np.mean((units.logarithm - true) ** 2)) < 0.06 and not units.odd.any()
    without = estimate_gains(observed, options=OPTIONS)
    assert np.sqrt(np.mean(without.logarithm**2)) < 0.05 and not without.odd.any()


@pytest.mark.slow
def test_photographs_that_do_not_fit_are_named_and_left_out(observed):
    capture = observed.capture
    images = list(capture.images)
    images[ODD[0]] = images[ODD[0]] * np.float32(4)
    images[ODD[1]] = gaussian_filter(np.nan_to_num(images[ODD[1]]), (4, 4, 0))
    images[ODD[2]] = np.ascontiguousarray(images[ODD[2]][::-1])  # of a different object
    changed = replace(capture, images=tuple(images))
    estimated = estimate_gains(changed, observed.texels, OPTIONS)
    assert np.flatnonzero(estimated.odd).tolist() == list(ODD)
    assert estimated.factor[ODD[0]].mean() == pytest.approx(4, rel=0.2)
    said = list(gain_sentences(estimated, changed))
    assert "Exposure gains range from" in said[0]
    for view, sentence in zip(ODD, said[-len(ODD) :], strict=True):
        assert sentence.startswith(f"{capture.names[view]} is an outlier (gain ")
    even = equalized(changed, estimated)
    assert np.flatnonzero(~np.array(even.used)).tolist() == list(ODD)
    right, result, spoilt = (
        np.array(svu.estimate(one, observed.texels).posterior.mean("roughness"))
        for one in (replace(capture, used=even.used), even, changed)
    )
    off = [np.abs(one - right)[observed.coverage >= 5].mean() for one in (result, spoilt)]
    assert off[0] < 0.03 and off[0] < 0.4 * off[1]


@pytest.mark.slow
def test_equalized_divides_a_copy_of_photographs(observed):
    capture = replace(
        observed.capture, used=tuple(view != 1 for view in range(observed.capture.count))
    )
    gains = FoundGains(random_gains(23), np.ones(23), np.arange(23) == 4)
    before = [image.copy() for image in capture.images]
    even = equalized(capture, gains)
    for image, kept in zip(capture.images, before, strict=True):
        np.testing.assert_array_equal(image, kept)
    of_view = np.delete(np.arange(24), 1)
    for place, view in enumerate(of_view):
        expected = before[view] / gains.factor[place].astype(np.float32)
        np.testing.assert_array_equal(even.images[view], expected)
    assert even.used == tuple(view not in (1, of_view[4]) for view in range(24))
    with pytest.raises(CaptureError, match="^23 gains for 24 used photographs; estimate th"):
        equalized(observed.capture, gains)
    with pytest.raises(
        CaptureError, match="All photographs are outliers; check the capture with svu"
    ):
        equalized(capture, replace(gains, odd=np.ones(23, bool)))


@pytest.mark.slow
def test_they_are_kept_with_the_light_and_read_back(observed, tmp_path):
    gains = FoundGains(random_gains(5), np.linspace(0, 2, 5), np.arange(5) == 2)
    svu.save_light(replace(made_up_light(), gains=gains), tmp_path / "light")
    estimated = svu.load_light(tmp_path / "light").gains
    for name in ("logarithm", "noise", "odd"):
        np.testing.assert_array_equal(getattr(estimated, name), getattr(gains, name))
    arrays = read_arrays(tmp_path / "light" / "light.npz")
    for changes, message in (
        (
            {"gains": np.full((5, 3), np.inf)},
            r"gains must be numbers for 5 photographs x 3 .*, got inf",
        ),
        (
            {"gains_odd": np.zeros(4, bool)},
            r"gains_odd .* 5 photographs .*, got bool of shape \(4,\)",
        ),
        ({"gains_noise": None}, "gains_noise is missing"),
    ):
        changed = {k: v for k, v in {**arrays, **changes}.items() if v is not None}
        write_arrays(tmp_path / "light" / "light.npz", changed)
        with pytest.raises(CaptureError, match=message):
            svu.load_light(tmp_path / "light")


def test_they_exclude_looks_at_the_background():
    with pytest.raises(OptionError, match="background 'distant' needs the recorded exposures an"):
        svu.LightOptions(gains=True, background="distant")


@pytest.mark.slow
def test_light_with_gains_has_its_own_cache(vase, tmp_path, monkeypatch):
    few = svu.LightOptions(texels=300, depths=((64, 8),), draws=2, moves=False)
    monkeypatch.setattr(resolve_light, "OPTIONS", few)
    monkeypatch.setattr(resolve_light, "RESOLUTION", 48)
    dark = write_dark(vase, tmp_path / "dark")
    capture = multiplied(svu.load_capture(dark, light="optional"), random_gains(24))
    plain, first, second = Said(), Said(), Said()
    assert with_resolved_light(capture, progress=plain).images[0] is capture.images[0]
    lit = with_resolved_light(capture, gains=True, progress=first)
    assert any("estimating it from the photographs" in line for line in first.lines)
    assert svu.load_light(dark / "light").gains is None
    again = with_resolved_light(capture, gains=True, progress=second)
    assert any("Using the estimated light" in line for line in second.lines)
    true = np.exp(random_gains(24))
    for view in range(24):
        np.testing.assert_array_equal(again.images[view], lit.images[view])
    ratio = np.log([
        np.nanmean(lit.images[v], axis=(0, 1)) / np.nanmean(capture.images[v], axis=(0, 1))
        for v in range(24)
    ])  # fmt: skip
    assert np.sqrt(np.mean((-ratio - np.log(true)) ** 2)) < 0.06
    folder = with_resolved_light(
        capture, svu.Light(path=dark / "light-gains"), progress=Said()
    )
    np.testing.assert_array_equal(
        folder.images[5], lit.images[5]
    )  # gains are cached with their light


@pytest.mark.slow
def test_svu_finds_them_under_the_light_of_the_scene(vase, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(resolve_light, "OPTIONS", replace(OPTIONS, texels=100))
    out, small = tmp_path / "out", ("--resolution", 48, "--no-pictures")
    assert run("entropy", vase, "--gains", "estimate", *small, "-o", out) == 0
    assert "Exposure gains range from" in " ".join(capsys.readouterr().out.split())
    assert "entropy.exr" in names(out)


def test_significant_white_balance_and_drift_are_reported():
    rng = np.random.default_rng(0)
    even = rng.normal(0, 0.02, (24, 3))
    capture = SimpleNamespace(names=[f"{k}.jpg" for k in range(24)], used=[True] * 24)
    none = np.zeros(24, bool)

    def said(logarithm: np.ndarray) -> str:
        return " ".join(gain_sentences(FoundGains(logarithm, np.ones(24), none), capture))

    assert "White balance" not in said(even) and "drift" not in said(even)
    told = sum("drift" in said(rng.normal(0, 0.2, (24, 3))) for _ in range(200))
    assert told <= 10  # random differences are not a drift
    bluer = even + np.linspace(-0.2, 0.2, 24)[:, None] * [0, 0, 1]
    assert re.search(r"White balance .* B 0\.8\d to 1\.1\d\.", said(bluer))
    assert re.search(r"drift: .* by R [01]\.\d\d, G [01]\.\d\d, B 1\.[34]\d\.", said(bluer))
