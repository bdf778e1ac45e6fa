"""Recovery from statistics, against float64 and finite differences."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from oracle.levels import levels
from oracle.levels import place as place_of
from support.helpers import as_tensor, as_values

from svu_mi.core.arrays import to_drjit
from svu_mi.recovery.sh.likelihood import Likelihood
from svu_mi.recovery.sh.quadratic_error import energy
from svu_mi.reflection.lobes import dielectric_fresnel, split_sum
from svu_mi.statistics.cholesky_factors import PAIRS, Factors
from svu_mi.statistics.gather_statistics import flatten_values
from svu_mi.statistics.statistics import Statistics

LEVELS, TEXELS, VIEWS = 6, 7, 9


def columns(seed: int = 48211) -> np.ndarray:
    """(R, C, 4, V, T) random columns e, p, q - d, d - b, smooth in roughness."""
    rng = np.random.default_rng(seed)
    r = levels(LEVELS)[:, None, None, None, None]
    a, b = rng.uniform(0.2, 1, (2, 3, 4, VIEWS, TEXELS))
    return a + b * r * np.array([0.3, -0.8, -0.1, 0.5])[None, None, :, None, None]


def upper(samples: np.ndarray) -> np.ndarray:
    """(R, C, 10, T) entries of U, by NumPy's QR factorisation."""
    entries = np.empty((LEVELS, 3, len(PAIRS), TEXELS))
    for r, c, t in np.ndindex(LEVELS, 3, TEXELS):
        R = np.linalg.qr(samples[r, c, :, :, t].T / np.sqrt(VIEWS))[1]
        R *= np.sign(np.diag(R))[:, None]
        entries[r, c, :, t] = [R[pair] for pair in PAIRS]
    return entries


def factors_of(samples: np.ndarray) -> Factors:
    """``Factors`` of columns, by way of their sums."""
    table = np.stack([(samples[:, :, i] * samples[:, :, j]).sum(axis=2) for i, j in PAIRS], axis=2)
    views = np.full(TEXELS, VIEWS)
    return Statistics.of(table, views, views, levels(LEVELS)).factor()


def spline(entries: np.ndarray, roughness: np.ndarray) -> np.ndarray:
    """(C, 10, T): Catmull-Rom as Hermite's cubic, with one-sided differences at the end."""
    place = place_of(np.clip(roughness, 0, 1), LEVELS)
    first = np.minimum(np.floor(place), LEVELS - 2).astype(int)
    t = place - first
    at = [entries[np.clip(first + k, 0, LEVELS - 1), ..., np.arange(TEXELS)] for k in (-1, 0, 1, 2)]
    m0, m1 = (at[2] - at[0]) / 2, (at[3] - at[1]) / 2
    ends = (first == LEVELS - 2)[:, None, None]
    m1 = np.where(ends, (at[0] - 4 * at[1] + 3 * at[2]) / 2, m1)
    t = t[:, None, None]
    h = (2 * t**3 - 3 * t**2 + 1, t**3 - 2 * t**2 + t, -2 * t**3 + 3 * t**2, t**3 - t**2)
    return np.moveaxis(h[0] * at[1] + h[1] * m0 + h[2] * at[2] + h[3] * m1, 0, -1)


def exact(entries: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(T,) mean over channels of |U (c (1 - m), c m, m, 1)|^2, float64."""
    m, total = values[4], np.zeros(TEXELS)
    for c, entry in enumerate(spline(entries, values[3])):
        U = np.zeros((4, 4, TEXELS))
        for (i, j), row in zip(PAIRS, entry, strict=True):
            U[i, j] = row
        x = np.stack([values[c] * (1 - m), values[c] * m, m, np.ones_like(m)])
        total += (np.einsum("ijt,jt->it", U, x) ** 2).sum(axis=0)
    return total / 3


def parameters(seed: int = 9022) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.03, 0.97, (5, TEXELS))


def test_factors_are_those_of_a_qr_factorisation() -> None:
    samples = columns()
    np.testing.assert_allclose(factors_of(samples).table(), upper(samples), rtol=2e-4, atol=1e-5)


def test_energy_is_the_mean_squared_error_at_a_level() -> None:
    samples, values = columns(), parameters()
    values[3] = levels(LEVELS)[3]
    e, p, more, rest = np.moveaxis(samples[3], 1, 0)  # (C, V, T) each: q - d, and d - b
    m, c = values[4], values[:3, None]
    residual = c * ((1 - m) * e + m * p) + m * more + rest
    value, _ = energy(factors_of(samples), as_values(values))
    np.testing.assert_allclose(value.numpy(), (residual**2).mean(axis=(0, 1)), rtol=1e-5)


def test_energy_and_its_derivatives_between_levels() -> None:
    samples, values = columns(), parameters()
    entries = upper(samples)
    value, slopes = energy(factors_of(samples), as_values(values))
    np.testing.assert_allclose(value.numpy(), exact(entries, values), rtol=2e-5)
    step = 1e-6
    for k, slope in enumerate(flatten_values(slopes)):
        ends = []
        for sign in (1, -1):
            moved = values.copy()
            moved[k] += sign * step
            ends.append(exact(entries, moved))
        np.testing.assert_allclose(slope.numpy(), (ends[0] - ends[1]) / (2 * step), rtol=1e-3,
                                   atol=1e-5)  # fmt: skip


def test_loss_is_differentiable_in_textures() -> None:
    samples, values = columns(), parameters()
    factors, entries = factors_of(samples), upper(samples)
    place = np.random.default_rng(5).permutation(12)[:TEXELS]  # of 3 x 4 texels
    variance = np.linspace(0.5, 2, TEXELS)
    weight = to_drjit(mi.Float, 1 / (2 * variance))
    loss = Likelihood(factors, to_drjit(mi.UInt32, place), weight)
    images = {name: np.full((3 * 4, n), 0.5, np.float32)
              for name, n in (("base_color", 3), ("roughness", 1), ("metallic", 1))}  # fmt: skip
    images["base_color"][place] = values[:3].T
    images["roughness"][place, 0], images["metallic"][place, 0] = values[3], values[4]
    textures: dict[str, Any] = {
        name: as_tensor(image.reshape(3, 4, -1)) for name, image in images.items()
    }
    dr.enable_grad(textures)
    result = loss(textures)
    expected = (exact(entries, values) / (2 * variance)).mean()
    assert float(result.array[0] if hasattr(result, "array") else result[0]) == pytest.approx(
        expected, rel=1e-5
    )
    dr.backward(result)
    _, slopes = energy(factors, as_values(values))
    wanted = np.zeros((12, 3))
    wanted[place] = (np.array(slopes["base_color"]) / (2 * variance) / TEXELS).T
    grad = np.array(dr.grad(textures["base_color"])).reshape(12, 3)
    np.testing.assert_allclose(grad, wanted, rtol=1e-5, atol=1e-9)


def test_dielectric_reflectance() -> None:
    cosine = np.linspace(0.02, 1, 50)
    # Snell and Fresnel with complex refraction, the textbook's other form.
    angle = np.arccos(cosine)
    inner = np.arcsin(np.sin(angle) / 1.5)
    with np.errstate(invalid="ignore", divide="ignore"):
        s = (np.sin(angle - inner) / np.sin(angle + inner)) ** 2
        p = (np.tan(angle - inner) / np.tan(angle + inner)) ** 2
    np.testing.assert_allclose(dielectric_fresnel(cosine)[:-1], ((s + p) / 2)[:-1], rtol=1e-9)
    assert dielectric_fresnel(np.array([1.0]))[0] == pytest.approx(0.04)
    assert dielectric_fresnel(np.array([0.0]))[0] == pytest.approx(1.0)


def test_dielectric_albedo_is_that_of_schlick_up_to_a_quarter() -> None:
    alpha = np.array([0.05, 0.3, 0.9])
    A, B, D = np.moveaxis(split_sum(alpha), -1, 0)
    ratio = D / (0.04 * A + B)
    assert ratio.min() > 0.9
    assert 1.1 < ratio.max() < 1.35
