"""Tests of lobes and albedos against quadrature, and of the diffuse model against direct sums."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from oracle import angular as oracle
from support.helpers import unit_vectors

from svu_mi.reflection.lobes import (
    ALBEDO_NODES,
    dielectric_fresnel,
    disk_ggx,
    dominance,
    ggx,
    smith_g1,
    split_sum,
    zonal_profile,
)
from svu_mi.reflection.mix_columns import diffuse_shading

WIDTHS = [1e-3, 0.02, 0.1, 0.3, 0.6, 1.0]
COSINES = (np.arange(ALBEDO_NODES) + 0.5) / ALBEDO_NODES


@pytest.mark.parametrize("alpha", WIDTHS)
def test_masking_is_smith(alpha):
    cosine = np.linspace(0.01, 1, 50)
    np.testing.assert_allclose(smith_g1(cosine, alpha), oracle.g1(cosine, alpha), rtol=1e-12)
    on_device = smith_g1(mi.Float(cosine.astype(np.float32)), alpha).numpy()
    np.testing.assert_allclose(on_device, oracle.g1(cosine, alpha), rtol=1e-5)
    assert smith_g1(1.0, alpha) == 1


@pytest.mark.parametrize("alpha", [0.02, 0.1, 0.3, 0.6, 1.0])
@pytest.mark.parametrize("kind", ["ggx", "gaussian"])
def test_profile_is_the_lobe_up_to_a_factor(kind, alpha):
    angle = np.linspace(0, np.pi, 181)
    ours = zonal_profile(kind, alpha, np.cos(angle))
    truth = oracle.lobe(kind, alpha, angle)
    assert (ours >= 0).all() or kind == "gaussian"  # its series can be negative
    # A narrow Gaussian equals a Gaussian on a plane.
    atol = 1e-4 if kind == "gaussian" else 3e-6
    np.testing.assert_allclose(ours / ours[0], truth / truth[0], rtol=1e-6, atol=atol)


@pytest.mark.few(1)
@pytest.mark.parametrize("alpha", [pytest.param(0.015, marks=pytest.mark.slow), 0.1, 0.49, 1.0])
def test_gaussian_degrees_fall_off_as_in_equation_6(alpha):
    x, weight = np.polynomial.legendre.leggauss(1200)
    profile = zonal_profile("gaussian", alpha, x)
    for l in range(1, 13):
        legendre = np.polynomial.legendre.Legendre.basis(l)(x)
        part = (weight * profile * legendre).sum() / (weight * profile).sum()
        assert part == pytest.approx(np.exp(-((alpha * l) ** 2)), abs=5e-4)


def test_lobes_lean_from_the_mirror_to_the_normal_as_they_widen():
    part = dominance(np.linspace(0, 1, 101))
    assert part[0] == 1
    assert part[-1] == 0
    assert ((part >= 0) & (part <= 1 + 0.06)).all()
    assert (np.diff(part[20:]) < 0).all()


@pytest.mark.few(2)
@pytest.mark.parametrize("alpha", WIDTHS)
def test_split_sum_is_the_directional_albedo(alpha):
    table = split_sum(np.array([alpha]))[0, :, :2]
    for node in range(0, ALBEDO_NODES, 5):
        truth = oracle.albedo(alpha, COSINES[node], nodes=150)  # within 1e-5 of 500 nodes
        np.testing.assert_allclose(table[node], truth, atol=5e-3)


def shading(lights, flux, n, o, roughness, model="disney"):
    """Return ``diffuse_shading`` with moments from direct sums."""
    cosine = np.maximum(lights @ n, 0)
    grazing = (1 - cosine) ** 5
    moments = []
    for part in (flux * cosine, flux * cosine * grazing):
        moments += [part.sum(), *(part @ lights)]
    a, b = diffuse_shading(model, [mi.Float(float(m)) for m in moments],
                           [mi.Float(float(x)) for x in o], mi.Float(float(o @ n)))  # fmt: skip
    return float((a + roughness * b)[0])


@pytest.mark.parametrize("roughness", [0.0, 0.5, 1.0])
def test_moments_hold_disneys_diffuse_model(roughness):
    """Exact except for the product of both grazing weights; compared where it is small."""
    rng = np.random.default_rng(30113)
    lights, flux = unit_vectors(rng, 40), rng.exponential(size=40)
    for n, o in zip(unit_vectors(rng, 12), unit_vectors(rng, 12), strict=True):
        o = o if o @ n > 0 else o - 2 * (o @ n) * n
        ours = shading(lights, flux, n, o, roughness)
        exact = oracle.diffuse_radiance(lights, flux, o, n, roughness, product=False)
        assert ours == pytest.approx(exact, rel=1e-5)
        if o @ n > 0.4:
            whole = oracle.diffuse_radiance(lights, flux, o, n, roughness)
            assert ours == pytest.approx(whole, rel=0.02)


@pytest.mark.parametrize("roughness", [0.2, 0.9])
def test_diffuse_model_matches_mitsuba(roughness):
    """Specular lobes of dielectrics do not depend on base colour: white minus black is diffuse."""
    rng = np.random.default_rng(8)
    up = np.array([0, 0, 1.0])
    lights, o = unit_vectors(rng, 30), np.array([0.48, -0.6, 0.64])
    lights[:, 2] = np.abs(lights[:, 2])
    values = []
    for shade in (1.0, 0.0):
        bsdf = mi.load_dict({"type": "principled", "roughness": roughness, "metallic": 0.0,
                             "base_color": {"type": "rgb", "value": [shade] * 3}})  # fmt: skip
        si = mi.SurfaceInteraction3f()
        si.wi = mi.Vector3f(*(float(x) for x in o))
        to_light = mi.Vector3f(np.ascontiguousarray(lights.T, np.float32))
        values.append(bsdf.eval(mi.BSDFContext(), si, to_light).numpy()[0])
    truth = oracle.disney_diffuse(lights, o, up, roughness) * lights[:, 2]
    np.testing.assert_allclose(values[0] - values[1], truth, rtol=1e-4, atol=1e-6)


# --- light from a disk ----------------------------------------------------------------------


@pytest.mark.parametrize("alpha", WIDTHS)
def test_light_from_one_direction_is_not_blurred(alpha):
    up, incident = np.linspace(0.05, 1, 40)[:, None], np.linspace(0.01, 1, 40)
    exact = oracle.ggx(up, alpha) * oracle.g1(incident, alpha)
    angles = (float_array(x) for x in np.broadcast_arrays(up, incident))
    ours = disk_ggx(*angles, [alpha], 0.0)[0]
    # sin^2 of the half vector in single precision, for narrow lobes.
    keep = np.broadcast_to(1 - up**2 + alpha**2 * up**2 > 1e-3, exact.shape)
    np.testing.assert_allclose(ours.numpy()[keep.ravel()], exact[keep], rtol=1e-3)
    known = ggx(up, alpha) * smith_g1(incident, alpha)
    np.testing.assert_allclose(known, exact, rtol=1e-9)


@pytest.mark.parametrize("alpha", [0.05, 0.3, 1.0])
@pytest.mark.parametrize("rho", [0.02, 0.1, 1.0])
def test_light_from_a_disk_is_the_mean_over_its_rings(alpha, rho):
    """Also for disks larger than the lobe."""
    up, incident = np.linspace(0.3, 0.99, 30), np.linspace(0.05, 1, 30)
    ours = disk_ggx(float_array(up), float_array(incident), [alpha], rho**2)[0].numpy()
    exact = oracle.disk_mean(up, alpha, rho**2) * oracle.g1(incident, alpha)
    np.testing.assert_allclose(ours, exact, rtol=2e-4)


@pytest.mark.parametrize("alpha", [0.02, 0.05])  # widths at which the sphere is flat
@pytest.mark.parametrize("spot", [0.0, 0.3, 0.6, 1.0, 2.0, 4.0])
def test_a_blurred_lobe_is_the_average_over_a_small_disk(alpha, spot):
    """To first order of rho^2 / s: the error is a small part of the change.

    If the change is 0 (2 s = 3 alpha^2), the error is relative to the change at the peak.
    """
    tilt = spot * alpha  # angle of the half vector
    s = np.sin(tilt) ** 2 + (alpha * np.cos(tilt)) ** 2
    rho = 0.3 * float(np.sqrt(s))
    average, center = averages(alpha, tilt, rho)
    up = float_array(np.array([np.cos(tilt)]))
    ours = float(disk_ggx(up, mi.Float(1), [alpha], rho**2)[0][0])
    plain = float(disk_ggx(up, mi.Float(1), [alpha], 0.0)[0][0])  # also in single precision
    assert ours / plain - 1 == pytest.approx(average / center - 1, rel=0.06, abs=1.5e-3)


def averages(alpha, tilt, rho):
    """Return the mean of D over half vectors within rho / 2, and D at the centre."""
    radius = rho / 2 * np.sqrt((np.arange(200) + 0.5) / 200)
    turn = 2 * np.pi * (np.arange(64) + 0.5) / 64
    x = np.tan(radius)[:, None] * np.cos(turn)
    y = np.tan(radius)[:, None] * np.sin(turn)
    middle = np.array([np.sin(tilt), 0, np.cos(tilt)])
    across, over = np.array([np.cos(tilt), 0, -np.sin(tilt)]), np.array([0.0, 1, 0])
    half = middle + x[..., None] * across + y[..., None] * over
    cosine = half[..., 2] / np.linalg.norm(half, axis=-1)
    return oracle.ggx(cosine, alpha).mean(), oracle.ggx(np.cos(tilt), alpha)


def test_fresnel_matches_snells_law():
    cosine = np.linspace(1e-3, 1, 200)
    exact = oracle.fresnel(cosine)
    np.testing.assert_allclose(dielectric_fresnel(cosine), exact, rtol=1e-12)
    np.testing.assert_allclose(dielectric_fresnel(float_array(cosine)).numpy(), exact, rtol=1e-5)
    assert exact[-1] == pytest.approx(0.04)


def float_array(values):
    return mi.Float(np.ascontiguousarray(values.ravel(), np.float32))


def test_no_surface_reflects_more_than_it_receives():
    A, B, D = np.moveaxis(split_sum(np.array(WIDTHS)), -1, 0)
    assert (A >= 0).all()
    assert (B >= 0).all()
    assert (A + B <= 1 + 1e-12).all()
    assert ((D >= 0) & (D < A + B)).all()
    # With R0 = 1 under a white sky, only masking reduces the albedo, more for wider lobes.
    assert (np.diff((A + B)[:, 4:], axis=0) < 1e-3).all()
    assert (A + B)[0].min() > 0.99
