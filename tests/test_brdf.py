"""Principled parameters and back (method, Sec. 1)."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from svu_mi.reflection import principled


def test_conversion_to_specular_and_back_is_the_identity():
    rng = np.random.default_rng(811)
    color, metallic = rng.uniform(0.05, 1, (2, 1000))
    Ks = principled.specular_from_principled(color, metallic)
    Kd = principled.diffuse_from_principled(color, metallic)
    back = principled.principled_from_specular(Ks, Kd)
    np.testing.assert_allclose(back, (color, metallic), atol=1e-12)


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
    np.testing.assert_allclose(principled.roughness_from_alpha(0.25), 0.5)


def test_numbers_numpy_and_drjit_give_the_same():
    values = np.array([0.0, 0.3, 0.9], np.float32)
    for function in (principled.alpha_from_roughness, principled.unbounded_alpha):
        lanes = function(mi.Float(values)).numpy()
        np.testing.assert_allclose(lanes, function(values), rtol=1e-6)
        np.testing.assert_allclose([function(float(v)) for v in values], lanes, rtol=1e-6)
