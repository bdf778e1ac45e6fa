"""Tests of Eq. 12 against a double precision solver, and of invariances."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from numerics.samples import placed
from oracle import frequency as oracle

import svu_mi as svu
from svu_mi.errors import OptionError, ShapeError
from svu_mi.frequency.fit_sh import fit_sh, solver_groups
from svu_mi.frequency.harmonics import power_spectrum

LAMBDA = 1e-3
METHODS = ["primal", "dual"]


def samples(
    rng: np.random.Generator, texels: int, views: int, channels: int, *,
    kind: str = "hemisphere", visible: float = 1.0,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Return directions, weights (cosine, or 0) and noisy positive values, float32."""
    d = placed(rng, kind, texels, views)
    seen = rng.random((texels, views)) < visible
    seen[:, 0] = True
    f = np.exp(rng.normal(size=(texels, views, channels)))
    return d, np.where(seen, d[..., 2], 0).astype(np.float32), f.astype(np.float32)


def spectrum_error(got: np.ndarray, truth: np.ndarray) -> float:
    """Return the largest error relative to the largest degree of the same texel and channel."""
    got, truth = oracle.power(np.asarray(got, np.float64)), oracle.power(truth)
    return float((np.abs(got - truth) / truth.max(axis=1, keepdims=True)).max())


@pytest.mark.few(3)
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("kind", ["hemisphere", "grazing", "identical", "crowded", "in a plane"])
@pytest.mark.parametrize("views, lmax", [(7, 6), (256, 6), (1, 9), (32, 6)])
def test_spectra_agree_with_a_double_precision_solve(views, lmax, kind, method):
    """The method requires 1e-3 of the largest degree; rounding of the output alone is 2e-7.

    Alternating noise is the worst case: with close views, only differences have power.
    """
    rng = np.random.default_rng(515377 + views)
    d, w, f = samples(rng, 60 if views < 100 else 8, views, 2, kind=kind, visible=0.7)
    f[..., 1] *= 1 - 2 * (np.arange(views) % 2)
    for preset, penalized in (("default", False), ("paper", True)):
        for regularizer, tolerance in ((1e-6, 2e-5), (LAMBDA, 1e-6), (100, 1e-6)):
            truth = oracle.fit(d, w, f, lmax, regularizer, penalized)
            got = fit_sh(d, w, f, lmax, regularizer, preset, method)
            assert got.shape == truth.shape
            assert spectrum_error(got, truth) < tolerance, (preset, regularizer)


@pytest.mark.parametrize("scale", [1e-20, 1e-3, 1e3])
def test_weights_of_any_size_can_be_used(scale):
    """Only w^2 / lambda matters; if it is tiny, the unpenalised constant is still the mean."""
    d, w, f = samples(np.random.default_rng(4711), 8, 20, 2)
    w = (w * scale).astype(np.float32)
    truth = oracle.fit(d, w, f, 3, 1e-2, False)
    assert spectrum_error(fit_sh(d, w, f, 3, 1e-2), truth) < 1e-5


@pytest.mark.parametrize("lmax", [0, 9])
def test_lowest_and_highest_degree_can_be_fitted(lmax):
    """Coefficients are compared, not powers, so signs of the basis are included."""
    d, w, f = samples(np.random.default_rng(96284512), 5, 60, 2)
    truth = oracle.fit(d, w, f, lmax, LAMBDA, False)
    np.testing.assert_allclose(
        np.array(fit_sh(d, w, f, lmax)), truth, atol=1e-6 * np.abs(truth).max()
    )


def test_texels_with_different_views_are_independent():
    """Lanes of a packet have different numbers of samples, including 0."""
    rng = np.random.default_rng(4404823)
    d, w, f = samples(rng, 70, 24, 2)
    w *= rng.random((70, 1)) > rng.random((70, 24))
    w[::9] = 0
    truth = oracle.fit(d, w, f, 4, LAMBDA, False)
    for method in ("auto", *METHODS):
        got = np.array(fit_sh(d, w, f, 4, method=method))
        np.testing.assert_allclose(got, truth, atol=1e-6 * np.abs(truth).max(), err_msg=method)
        assert not got[::9].any(), "unseen texels have no signal"


def test_auto_chooses_the_primal_for_many_views_and_agrees():
    d, w, f = samples(np.random.default_rng(71120935), 40, 60, 1)
    w[:20, 3:] = 0
    for counts in ((w > 0).sum(axis=1), mi.UInt32((w > 0).sum(axis=1).astype(np.uint32))):
        chosen = {g.capacity: dr.width(g.selection) for g in solver_groups(counts, 2)}
        assert chosen == {32: 20, 0: 20}  # dual and primal
    assert solver_groups(np.zeros(7), 2) == []
    truth = oracle.fit(d, w, f, 2, LAMBDA, False)
    assert spectrum_error(fit_sh(d, w, f, 2), truth) < 1e-6


@pytest.mark.parametrize("method", METHODS)
def test_unseen_views_do_not_change_the_fit(method):
    """Weight 0 excludes samples with any values, including NaN."""
    rng = np.random.default_rng(30331)
    d, w, f = samples(rng, 20, 12, 3)
    nan = np.full((20, 5, 3), np.nan, np.float32)
    before = np.array(fit_sh(d, w, f, method=method))
    after = np.array(
        fit_sh(
            np.concatenate([nan, d], axis=1),
            np.concatenate([np.zeros((20, 5), np.float32), w], axis=1),
            np.concatenate([nan, f], axis=1),
            method=method,
        )
    )
    np.testing.assert_array_equal(after, before)


def test_a_diffuse_texel_has_no_power_above_degree_0_by_default():
    d, w, _ = samples(np.random.default_rng(771029), 8, 30, 1)
    c = np.array(fit_sh(d, w, np.ones((8, 30, 1), np.float32)))
    np.testing.assert_allclose(c[:, 0], np.sqrt(4 * np.pi), rtol=1e-6)
    assert np.abs(c[:, 1:]).max() < 1e-5  # small relative to a dielectric's 0.04


def test_any_precision_memory_order_and_tensors_are_taken():
    d, w, f = samples(np.random.default_rng(90213), 6, 11, 3)
    expected = np.array(fit_sh(d, w, f))
    double = [np.asfortranarray(x.astype(np.float64)) for x in (d, w, f)]
    padded = np.repeat(f, 2, axis=2)[:, :, ::2]
    np.testing.assert_array_equal(np.array(fit_sh(*double)), expected)
    np.testing.assert_array_equal(np.array(fit_sh(d, w, padded)), expected)
    tensors = [mi.TensorXf(x) for x in (d, w, f)]
    np.testing.assert_array_equal(np.array(fit_sh(*tensors)), expected)


@pytest.mark.parametrize("texels, views", [(0, 4), (4, 0), (1, 1)])
def test_empty_and_single_inputs_work(texels, views):
    d = np.tile([0.0, 0.0, 1.0], (texels, views, 1))
    c = fit_sh(d, np.ones((texels, views)), np.ones((texels, views, 2)), 3)
    assert c.shape == (texels, 16, 2)
    assert power_spectrum(c).shape == (texels, 4, 2)


def good() -> dict[str, np.ndarray]:
    d, w, f = samples(np.random.default_rng(27720), 4, 5, 2)
    return {"directions": d, "weights": w, "values": f}


@pytest.mark.parametrize(
    "change, message",
    [
        ({"directions": np.zeros((4, 5))}, r"directions must have shape \(4, 5, 3\)"),
        ({"values": np.zeros((4, 6, 2))}, r"values must have shape \(4, 5, C\)"),
        ({"weights": np.zeros(4)}, r"weights must have shape \(T, V\)"),
        ({"weights": [["a"]]}, "not an array of numbers"),
    ],
)
def test_wrong_shapes_are_named(change, message):
    with pytest.raises(ShapeError, match=message):
        fit_sh(**(good() | change))


@pytest.mark.parametrize(
    "name, bad",
    [("weights", np.nan), ("weights", -1), ("values", np.inf), ("values", np.nan),
     ("directions", np.nan), ("directions", 2)],
)  # fmt: skip
def test_an_unusable_sample_is_named(name, bad):
    inputs = good()
    inputs[name][2, 3] = bad
    with pytest.raises(OptionError, match="texel 2, view 3"):
        fit_sh(**inputs)


@pytest.mark.parametrize(
    "options",
    [{"lmax": 10}, {"lmax": -1}, {"lmax": 2.5}, {"regularizer": 0}, {"method": "qr"},
     {"preset": "papre"}, {"regularizer": float("nan")}],
)  # fmt: skip
def test_options_outside_their_range_are_refused(options):
    with pytest.raises(OptionError):
        svu.fit_sh(**good(), **options)


def test_too_many_views_for_the_dual_are_refused():
    d, w, f = samples(np.random.default_rng(6022), 2, 300, 1)
    with pytest.raises(OptionError, match='has 300 views.*method="auto"'):
        fit_sh(d, w, f, method="dual")
    assert spectrum_error(fit_sh(d, w, f), oracle.fit(d, w, f, 6, LAMBDA, False)) < 1e-6


@pytest.mark.parametrize(
    "shape, message",
    [
        ((3, 5, 1), "got 5.* 4 and 9"),
        ((3, 49), r"shape \(T, \(lmax\+1\)\^2, C\)"),
        ((3, 0, 1), "got 0"),
    ],
)
def test_a_wrong_number_of_coefficients_is_named(shape, message):
    with pytest.raises(ShapeError, match=message):
        power_spectrum(np.zeros(shape))
