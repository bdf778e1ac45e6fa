"""Power spectra (Eq. 8)."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from oracle import frequency as oracle
from scipy.spatial.transform import Rotation

from svu_mi.errors import ShapeError
from svu_mi.frequency import fit_sh, harmonics, power_lanes, power_spectrum


def test_lanes_and_tensors_give_the_same_spectrum():
    c = np.random.default_rng(112358).normal(size=(13, 16, 2)).astype(np.float32)
    lanes = [[mi.Float(np.ascontiguousarray(c[:, i, k])) for k in range(2)] for i in range(16)]
    got = np.array([[x.numpy() for x in row] for row in power_lanes(lanes)])
    np.testing.assert_allclose(got.transpose(2, 0, 1), np.array(power_spectrum(c)), rtol=1e-6)


@pytest.mark.parametrize("preset", ["default", "paper"])
def test_spectrum_does_not_change_when_the_views_are_rotated(preset):
    """R of Eq. 12 depends on the degree only; so world space directions will do."""
    rng = np.random.default_rng(651978631)
    d = rng.normal(size=(16, 40, 3))
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    w, f = rng.random((16, 40)), np.exp(rng.normal(size=(16, 40, 2)))
    turned = d @ Rotation.random(random_state=rng).as_matrix().T
    before = np.array(power_spectrum(fit_sh(d, w, f, preset=preset)))
    after = np.array(power_spectrum(fit_sh(turned, w, f, preset=preset)))
    # Single precision directions: 1e-7, amplified by the fit's smallest singular values.
    np.testing.assert_allclose(after, before, atol=1e-4 * before.max())


def test_basis_is_scipys_up_to_the_highest_degree():
    d = np.random.default_rng(9431).normal(size=(50, 3))
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    got = harmonics.basis(mi.Vector3d(*[mi.Float64(x.copy()) for x in d.T]), 9)
    got = np.stack([np.broadcast_to(y.numpy(), 50) for y in got], axis=-1)
    np.testing.assert_allclose(got, oracle.basis(d, 9), atol=1e-12)


@pytest.mark.parametrize("free", [False, True])
def test_zonal_kernel_is_the_addition_theorem(free):
    d = np.random.default_rng(53).normal(size=(2, 50, 3))
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    a, b = oracle.basis(d[0], 6), oracle.basis(d[1], 6)
    inverse = np.exp(-oracle.degrees(6).astype(float))
    inverse[0] = 0 if free else 1
    t = mi.Float64((d[0] * d[1]).sum(axis=-1))
    got = harmonics.zonal_kernel(t, harmonics.zonal_polynomial(6, not free))
    np.testing.assert_allclose(got.numpy(), (a * inverse * b).sum(axis=-1), atol=1e-13)


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
