"""Principled parameters, and how they mix what is reflected (method, Sec. 1)."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from svu_mi.reflection import principled


def test_columns_are_mixed_to_the_radiance_of_the_model_and_its_slopes():
    """r - b = (1 - m) (c e + d) + m (c p + q) - b, and Kd e + Ks p + q - b in the paper's way."""
    rng = np.random.default_rng(811)
    c, m, e, p, q, d, b = rng.random((7, 1000))
    columns = principled.columns(e, p, q, d, b)

    def total(x):
        return sum(a * column for a, column in zip(x, columns, strict=True))

    how = principled.mixture(m)
    exact = (1 - m) * (c * e + d) + m * (c * p + q) - b
    np.testing.assert_allclose(total(how.at(c)), exact, atol=1e-12)
    np.testing.assert_allclose(total(how.scaled), (1 - m) * e + m * p, atol=1e-12)
    slope = principled.slope([m], 0).at(c)
    np.testing.assert_allclose(total(slope), c * p + q - c * e - d, atol=1e-12)
    paper = principled.lobe_mixture(m).at(c)
    np.testing.assert_allclose(total(paper), c * e + m * p + q - b, atol=1e-12)
    np.testing.assert_array_equal(how.at(c)[-1], 1)


def test_dielectrics_and_metals_have_the_reflectance_of_the_principled_bsdf():
    assert principled.specular_from_principled(0.7, 0.0) == pytest.approx(0.04)
    assert principled.specular_from_principled(0.7, 1.0) == pytest.approx(0.7)
    assert principled.diffuse_from_principled(0.7, 1.0) == 0


def test_alpha_has_mitsubas_lower_bound_only_where_asked_for():
    roughness = np.array([0.0, 0.01, 0.5, 1.0])
    np.testing.assert_allclose(
        principled.alpha_from_roughness(roughness), [1e-3, 1e-3, 0.25, 1], rtol=1e-12
    )
    np.testing.assert_array_equal(principled.unbounded_alpha(roughness), roughness**2)


def test_numbers_numpy_and_drjit_give_the_same():
    values = np.array([0.0, 0.3, 0.9], np.float32)
    for function in (principled.alpha_from_roughness, principled.unbounded_alpha):
        lanes = function(mi.Float(values)).numpy()
        np.testing.assert_allclose(lanes, function(values), rtol=1e-6)
        np.testing.assert_allclose([function(float(v)) for v in values], lanes, rtol=1e-6)
