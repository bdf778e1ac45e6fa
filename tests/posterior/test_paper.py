"""Tests of the preset ``paper``: one test per equation, against ``oracle/paper.py``.

Values and derivatives agree to 1e-5 unless a comment explains another tolerance. Both sides get
float32 arrays, the input type of the package.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from oracle import paper
from support.helpers import STUDIO, as_tensor, as_values, ball, render_ball, unit, unit_vectors

import svu_mi as svu
from svu_mi.capture.mesh import make_mesh
from svu_mi.core.arrays import to_drjit
from svu_mi.frequency.spectra import Coefficients
from svu_mi.geometry.neighbors import neighbors
from svu_mi.geometry.sample_view import TexelLanes
from svu_mi.guidance.strategy_inputs import StrategyInputs
from svu_mi.light.band_limited import lat_long_texture, look_up
from svu_mi.light.environment import synthesize
from svu_mi.light.latlong import directions, quadrature
from svu_mi.posterior.estimate import Estimate
from svu_mi.posterior.grid import ParameterGrid, PrincipledGrid
from svu_mi.posterior.spectrum import spectrum_grid
from svu_mi.posterior.tabulated import tabulated_posterior
from svu_mi.presets import Fit, preset
from svu_mi.recovery.path.pixel_loss import l1
from svu_mi.recovery.recovery_options import PATH_PRESETS, SH_PRESETS
from svu_mi.recovery.sh.angular_l1_loss import angular_objective
from svu_mi.recovery.sh.spectral_loss import SpectralObjective
from svu_mi.statistics.gather_statistics import flatten_values

L = 6  # l*
SH = preset("paper", method="angular")
EXACT = 1e-5
GRID = ParameterGrid(5, 4)
ROUGHNESS, KS = np.linspace(0, 1, 5), np.linspace(0, 1, 4)
ALPHAS = ROUGHNESS**2


def test_settings_match_the_paper():
    """Numbers in the text: 8 x 8 bins, lambda, l*, Adam's rate and steps, weights, 32 paths."""
    spectra = preset("paper", method="spectrum")
    sh, path = SH_PRESETS["paper"], PATH_PRESETS["paper"]
    grid = spectrum_grid(None, spectra)
    np.testing.assert_allclose(grid.roughness_nodes, np.linspace(0, 1, 8))
    np.testing.assert_allclose(grid.specular_nodes, np.linspace(0, 1, 8))
    assert (spectra.degree, spectra.regularizer, spectra.penalize_constant) == (6, 1e-3, True)
    assert SH.fit == Fit(degree=6, regularizer=1e-3, penalize_constant=True, undo_prefilter=False)
    assert (sh.loss, sh.tv, sh.closed_form, sh.common_prior) == ("angular", 1e-2, False, False)
    assert (sh.descent.learning_rate, sh.descent.final_rate, sh.descent.steps) == (0.01, 1, 200)
    assert (path.loss, path.tv, path.spp) == ("l1", 1e-2, 32)
    assert (path.descent.learning_rate, path.descent.final_rate) == (0.02, 1)


# --- material -------------------------------------------------------------------------------


def light_coefficients(rng: np.random.Generator, texels: int, channels: int = 3) -> np.ndarray:
    """Return coefficients, (T, (L + 1)^2, C), that decrease with degree as in natural light."""
    l = np.array([l for l in range(L + 1) for _ in range(2 * l + 1)])
    c = rng.normal(size=(texels, (L + 1) ** 2, channels)) * np.exp(-0.35 * l)[:, None]
    c[:, 0] = np.abs(c[:, 0]) + 1  # radiance is positive
    return c


def spectra(rng: np.random.Generator, texels: int) -> tuple[np.ndarray, np.ndarray]:
    """Return S_L and noisy S_B, (T, L + 1, 3) float32."""
    incoming = np.array([paper.power(c) for c in light_coefficients(rng, texels)])
    Ks, roughness = rng.uniform(0.1, 0.9, texels), rng.uniform(0, 0.9, texels)
    shown = np.array([
        paper.reflected_power(S, k, r**2) for S, k, r in zip(incoming, Ks, roughness, strict=True)
    ])  # fmt: skip
    shown *= rng.uniform(0.8, 1.2, shown.shape)
    return incoming.astype(np.float32), shown.astype(np.float32)


def hemisphere(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Return directions (..., 3) float32 above the horizon."""
    d = rng.normal(size=(*shape, 3))
    d[..., 2] = 0.03 + np.abs(d[..., 2])
    return (d / np.linalg.norm(d, axis=-1, keepdims=True)).astype(np.float32)


def close(values: Any, exact: np.ndarray, tolerance: float = EXACT) -> None:
    """Check the difference relative to the largest value."""
    exact = np.asarray(exact, np.float64)
    error = np.abs(np.asarray(values, np.float64) - exact).max()
    assert error <= tolerance * np.abs(exact).max(), error / np.abs(exact).max()


def backward(loss: Any, values: np.ndarray) -> tuple[float, np.ndarray]:
    """Return value and derivatives of a function of a TensorXf, by Dr.Jit's AD."""
    live = as_tensor(values)
    dr.enable_grad(live)
    result = loss(live)
    value = np.array(dr.detach(result), np.float64)
    dr.backward(result)
    return float(value.ravel()[0]), np.array(live.grad, np.float64)


# --- Eq. 1 to 5 -----------------------------------------------------------------------------


def of_paper(S_L: np.ndarray, S_B: np.ndarray, sigma: float, prior: Any = None) -> Any:
    return svu.spectrum_posterior(S_L, S_B, GRID, sigma, preset="paper", prior=prior)


def exact_distances(S_L: np.ndarray, S_B: np.ndarray) -> np.ndarray:
    """Return distances, (T, 5, 4), by Eq. 11."""
    pairs = zip(S_B.astype(np.float64), S_L.astype(np.float64), strict=True)
    return np.array([paper.distances(B, light, KS, ALPHAS) for B, light in pairs])


@pytest.mark.parametrize("uniform", [True, False])
def test_eq01_02_04_posterior_is_likelihood_times_prior(uniform):
    rng = np.random.default_rng(50311)
    S_L, S_B = spectra(rng, 20)
    prior = None if uniform else rng.uniform(0.2, 1, GRID.shape)
    p = np.array(of_paper(S_L, S_B, 2.0, prior).probabilities)
    for table, d in zip(p, exact_distances(S_L, S_B), strict=True):
        close(table, paper.posterior(paper.likelihood(d, 2.0), 1.0 if uniform else prior))


@pytest.mark.parametrize("sigma", [0.5, 2.0])
def test_eq03_log_likelihood_is_distance_over_2_sigma_squared(sigma):
    """Ratios of two bins do not depend on the normalisation."""
    S_L, S_B = spectra(np.random.default_rng(911382), 20)
    p = np.array(of_paper(S_L, S_B, sigma).probabilities, np.float64)
    for table, d in zip(p, exact_distances(S_L, S_B), strict=True):
        exact = paper.likelihood(d, sigma)
        likely = exact > 1e-8  # smaller values are lost in single precision
        close(np.log(table[likely] / table.max()), np.log(exact[likely]))


@pytest.mark.parametrize("sigma", [0.02, None, 1.0])
def test_eq05_entropy(sigma):
    S_L, S_B = spectra(np.random.default_rng(77241), 40)
    used = 0.1 if sigma is None else sigma  # the preset's
    exact = [
        paper.entropy(paper.posterior(paper.likelihood(d, used))) for d in exact_distances(S_L, S_B)
    ]
    assert max(exact) - min(exact) > 0.3
    np.testing.assert_allclose(
        np.array(svu.spectrum_posterior(S_L, S_B, GRID, sigma, preset="paper").entropy()), exact,
        rtol=EXACT, atol=1e-7,
    )  # fmt: skip


def test_eq05_entropy_is_1_without_information_or_unseen():
    flat = np.ones((2, L + 1, 3), np.float32) * np.r_[1, np.zeros(L)][:, None].astype(np.float32)
    posterior = svu.spectrum_posterior(flat, flat, GRID, preset="paper", observed=[True, False])
    np.testing.assert_allclose(np.array(posterior.entropy()), 1, atol=1e-6)


# --- Eq. 6 ----------------------------------------------------------------------------------


PAINT = {"type": "principled", "base_color": {"type": "rgb", "value": [0.7, 0.4, 0.2]},
         "roughness": 0.4, "metallic": 0.7}  # fmt: skip
LEVELS = 9
NODES = np.linspace(0, 1, LEVELS)


@pytest.fixture(scope="module")
def observed(tmp_path_factory):
    """Return the observations of a ball in a studio, with 14 photographs."""
    capture = render_ball(
        tmp_path_factory.mktemp("paper"), STUDIO, PAINT, views=14, resolution=(32, 32), spp=16
    )
    return svu.estimate(capture, svu.texels(capture.mesh, 8), preset="paper").observed


@dataclass(frozen=True)
class Samples:
    """Samples of S seen texels, float64; directions in world space."""

    seen: np.ndarray  # (V, S)
    direction: np.ndarray  # (V, S, 3)
    cosine: np.ndarray  # (V, S)
    shown: np.ndarray  # (V, S, 3)
    mirrored: np.ndarray  # (V, S, 3) band-limited light from the mirror direction
    irradiance: np.ndarray  # (S, 3)
    texel: np.ndarray  # (S,)

    def of(self, s: int) -> tuple[Any, ...]:
        """Return samples of one texel, in the order of ``sh_model``, and its radiance."""
        on = self.seen[:, s]
        wo, cosine = self.direction[on, s], self.cosine[on, s]
        light = wo, cosine, self.mirrored[on, s]
        return light, wo, cosine, self.irradiance[s], self.shown[on, s]


@pytest.fixture(scope="module")
def samples(observed) -> Samples:
    """Read samples from the capture; they are the input of both sides."""
    surface = TexelLanes.of(observed.texels, to_drjit(mi.UInt32, observed.seen.astype(np.uint32)))
    normal = unit(surface.normal.numpy().T)
    rows = []
    for slot in range(int(observed.visibility.count[0])):
        look = observed.visibility.sample(observed.views, surface, dr.opaque(mi.UInt32, slot))
        direction = np.array(look.direction).T
        o = unit(direction)
        i = 2 * (o * normal).sum(axis=1, keepdims=True) * normal - o
        light = observed.lighting.radiance(to_drjit(mi.Vector3f, i.T.astype(np.float32)))
        rows.append([np.array(look.seen), o, (o * normal).sum(axis=1),
                     np.array(look.radiance).T, np.array(light).T])  # fmt: skip
    E = np.array(observed.lighting.irradiance(surface.normal)).T
    seen, direction, cosine, shown, mirrored = (
        np.array([np.broadcast_to(row[k], rows[0][k].shape) for row in rows]) for k in range(5)
    )
    return Samples(seen, direction, cosine, shown.astype(np.float64),
                   mirrored.astype(np.float64), E.astype(np.float64), observed.seen)  # fmt: skip


def test_sec_332_band_limit_follows_number_of_photographs(observed):
    lighting = observed.lighting
    assert lighting.prefilter == pytest.approx(14**-0.5, rel=1e-12)
    limited = paper.band_limited(lighting.coefficients, 14)
    grid = synthesize(limited, lighting.filtered.shape[1], lighting.filtered.shape[0])
    close(np.array(lighting.filtered.tensor()), grid)


def test_eq06_the_sh_model(observed, samples):
    """Compare the radiance of random materials in all photographs, at roughness nodes."""
    model = observed.model(NODES, SH, 3)
    rng = np.random.default_rng(30033)
    color, metallic = rng.random((LEVELS, 3)), rng.random(LEVELS)
    radiance = np.zeros((LEVELS, *samples.shown.shape))
    for view, (direction, cosine) in enumerate(zip(samples.direction, samples.cosine, strict=True)):
        columns = model.columns(
            to_drjit(mi.Vector3f, direction.T.astype(np.float32)),
            to_drjit(mi.Float, np.maximum(cosine, 1e-3).astype(np.float32)), mi.Bool(True),
        )  # fmt: skip
        for k, level in enumerate(columns):
            for c in range(3):
                e, p, q, d = (np.array(x, np.float64) for x in level[c])
                m, base = metallic[k], color[k, c]
                radiance[k, view, :, c] = (1 - m) * (base * e + d) + m * (base * p + q)
    exact = radiance.copy()
    for s in range(len(samples.texel)):
        *sample, _ = samples.of(s)
        for k, roughness in enumerate(NODES):
            exact[k, samples.seen[:, s], s] = paper.sh_model(
                *sample, color[k], roughness, metallic[k], L, 1e-3
            )
    for k in range(LEVELS):
        close(radiance[k], exact[k])


def test_eq06_irradiance_is_the_integral_over_the_light(observed, samples):
    """The diffuse term is Kd / pi E; 1 % tolerance, because E is expanded in harmonics."""
    environment = observed.lighting.environment
    rows, columns = environment.radiance.shape[:2]
    local = directions(columns, rows).reshape(-1, 3)
    solid = np.repeat(quadrature(rows) * 2 * np.pi / columns, columns)
    flux = environment.radiance.reshape(-1, 3) * solid[:, None]
    normal = unit(observed.texels.normal.numpy().T[samples.texel]) @ environment.to_local.T
    exact = np.maximum(normal @ local.T, 0) @ flux
    np.testing.assert_allclose(samples.irradiance, exact, rtol=0.01)
    model = observed.model(NODES[:1], SH, 3)
    columns = model.columns(mi.Vector3f(model.surface.normal), mi.Float(1), mi.Bool(True))
    for c in range(3):
        np.testing.assert_allclose(np.array(columns[0][c][0]), exact[:, c] / np.pi, rtol=0.01)


@pytest.mark.slow
def test_eq06_the_posterior_of_the_sh_model(observed, samples):
    """Eq. 1 to 6 together, as in ``svu.estimate(preset="paper")``: grey, all views.

    sigma is relative to the capture's mean radiance, because the paper does not define its unit.
    """
    grid = PrincipledGrid(3, 4, 4)
    estimate = svu.estimate(observed.capture, observed.texels, preset="paper", grid=grid)
    sigma = SH.sigma * observed.unit
    p = np.array(estimate.posterior.probabilities, np.float64)
    H = np.array(estimate.entropy, np.float64)
    for s, texel in list(enumerate(samples.texel))[::3]:
        light, wo, cosine, E, shown = samples.of(s)
        grey = *light[:2], light[2].mean(axis=1, keepdims=True)
        d = np.zeros(grid.shape)
        for index in np.ndindex(*grid.shape):
            r, m, c = (nodes[i] for nodes, i in zip(grid.axes.values(), index, strict=True))
            B = paper.sh_model(
                grey, wo, cosine, E.mean(keepdims=True), np.array([c]), r, m, L, 1e-3
            )
            d[index] = ((shown.mean(axis=1, keepdims=True) - B) ** 2).sum()
        exact = paper.posterior(paper.likelihood(d, sigma))
        close(p[texel], exact)
        assert H[texel] == pytest.approx(paper.entropy(exact), abs=EXACT)


def textures_of(observed: Any, rows: np.ndarray) -> dict[str, Any]:
    """Return textures of (S, 5) parameters of the seen texels; 0.5 elsewhere."""
    width, height = observed.texels.resolution
    flat = np.full((width * height, 5), 0.5, np.float32)
    flat[observed.texels.index.numpy()[observed.seen]] = rows
    parts = {"base_color": flat[:, :3], "roughness": flat[:, 3:4], "metallic": flat[:, 4:]}
    return {name: as_tensor(x.reshape(height, width, -1)) for name, x in parts.items()}


def gradient_of(objective: Any, textures: dict[str, Any], place: np.ndarray) -> tuple[float, Any]:
    """Return the loss, and its derivatives with respect to the parameters of texels, (S, 5)."""
    dr.enable_grad(textures)
    loss = objective(textures)
    dr.backward(loss)
    gradients = [
        np.array(textures[name].grad, np.float64).reshape(-1, n)[place]
        for name, n in (("base_color", 3), ("roughness", 1), ("metallic", 1))
    ]
    return float(dr.detach(loss)[0]), np.concatenate(gradients, axis=1)


def exact_loss(samples: Samples, rows: np.ndarray, scale: float) -> tuple[float, np.ndarray]:
    """Return mean |B - model| / scale over all samples and channels, and its derivatives (S, 5)."""
    total, slopes, count = 0.0, np.zeros_like(rows), 3 * int(samples.seen.sum()) * scale
    for s, x in enumerate(rows):
        *sample, shown = samples.of(s)

        def modelled(y, sample=sample):
            return paper.sh_model(*sample, y[:3], y[3], y[4], L, 1e-3)

        away, by_model = paper.absolute_error(modelled(x), shown)
        total += away * shown.size / count
        change = paper.differences(modelled, x)
        slopes[s] = (change * by_model).sum(axis=(1, 2)) * shown.size / count
    return total, slopes


@pytest.mark.slow
def test_eq06_the_loss_of_recovery_by_the_sh_model(observed, samples):
    """The fit changes with roughness, because G1(theta_i) is a factor of the fitted light."""
    rng = np.random.default_rng(66311)
    rows = rng.uniform(0.05, 0.95, (len(samples.texel), 5)).astype(np.float32)
    objective = angular_objective(observed, SH)
    place = observed.texels.index.numpy()[samples.texel]
    loss, slopes = gradient_of(objective, textures_of(observed, rows), place)
    exact, rise = exact_loss(samples, rows.astype(np.float64), observed.visibility.scale)
    assert loss == pytest.approx(exact, rel=EXACT)
    for k in range(5):
        close(slopes[:, k], rise[:, k], EXACT)


# --- Eq. 7 to 11 ----------------------------------------------------------------------------


def spectral_loss(
    domain: str, outgoing: np.ndarray, incoming: np.ndarray, E: np.ndarray
) -> SpectralObjective:
    """Return the recovery's loss on given coefficients (T, n, 3) and irradiance (T, 3), unit 1."""
    count, n, _ = outgoing.shape
    table = np.concatenate([outgoing, incoming], axis=2).transpose(1, 2, 0)
    power = np.stack([np.array(svu.power_spectrum(c)) for c in (outgoing, incoming)])
    rows = power.transpose(2, 3, 0, 1)  # axes: degree, channel, B and L, texel
    return SpectralObjective(
        domain=domain,
        coefficients=Coefficients(
            to_drjit(mi.Float, table.ravel().astype(np.float32)), math.isqrt(n) - 1, 3, 3, count
        ),
        power=to_drjit(mi.Float, np.ascontiguousarray(rows).ravel().astype(np.float32)),
        irradiance=[to_drjit(mi.Float, np.ascontiguousarray(x, np.float32)) for x in E.T],
        texel=dr.arange(mi.UInt32, count), place=dr.arange(mi.UInt32, count),
        prefilter=dr.opaque(mi.Float, 0.0), albedo=dr.full(mi.Float, 1, 33),
        factor=dr.opaque(mi.Float, 1.0),
    )  # fmt: skip


def materials(rng: np.random.Generator, count: int) -> np.ndarray:
    """Return base colour, roughness and metallic, (T, 5) float32."""
    return rng.uniform(0.1, 0.9, (count, 5)).astype(np.float32)


def summed_errors(objective: Any, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the error of each texel, and its derivatives with respect to the parameters (T, 5)."""
    values = as_values(rows.T)
    dr.enable_grad(values)
    errors = objective.errors(values)
    result = np.array(dr.detach(errors), np.float64)
    dr.backward(dr.sum(errors))
    slopes = [np.array(dr.grad(column), np.float64) for column in flatten_values(values)]
    return result, np.stack(slopes, axis=1)


def exact_coefficients(x: np.ndarray, light: np.ndarray, E: np.ndarray) -> np.ndarray:
    """Return B_lm of Eq. 7 for a material, (5,) float64."""
    Kd, Ks = paper.reflectances(x[:3], x[4])
    return paper.reflected(light, Kd, Ks, float(paper.alpha_of(x[3])), E)


def check_spectral_loss(domain: str, seed: int) -> None:
    """Compare value and derivatives of sum |model - observed| over coefficients, or degrees."""
    rng, count = np.random.default_rng(seed), 30
    light = light_coefficients(rng, count).astype(np.float32)
    E, rows = rng.uniform(0.5, 3, (count, 3)).astype(np.float32), materials(rng, count)
    shown = light_coefficients(rng, count).astype(np.float32)
    errors, slopes = summed_errors(spectral_loss(domain, shown, light, E), rows)
    exact, rise = [], []
    for x, l, B, e in zip(
        rows.astype(np.float64), light.astype(np.float64), shown.astype(np.float64),
        E.astype(np.float64), strict=True,
    ):  # fmt: skip
        measure = paper.power if domain == "spectrum" else (lambda c: c)

        def modelled(y, l=l, e=e, measure=measure):
            return measure(exact_coefficients(y, l, e))

        away, by_model = paper.absolute_error(modelled(x), measure(B))
        exact.append(away * by_model.size)  # sum = mean times number
        change = paper.differences(modelled, x)
        rise.append((change * by_model * by_model.size).sum(axis=(1, 2)))
    np.testing.assert_allclose(errors, exact, rtol=EXACT)
    close(slopes, np.array(rise))


def test_eq07_coefficients_of_the_reflected_light():
    """By the recovery's loss on coefficients B_lm, and the constant of the diffuse term."""
    check_spectral_loss("coefficients", 40087)


def test_eq07_a_constant_has_one_coefficient():
    """The fit of a constant radiance Kd E / pi is 2 Kd E / sqrt(pi) Y_00."""
    rng = np.random.default_rng(3307)
    d = unit_vectors(rng, 1, 4000).astype(np.float32)
    value = np.full((1, 4000, 1), 0.7 / np.pi, np.float32)
    coefficients = np.array(svu.fit_sh(d, np.ones((1, 4000)), value, preset="paper"))[0]
    # lambda = 1e-3 relative to 4000 samples over 4 pi: 3e-6
    close(coefficients, paper.constant(np.array([0.7 / np.pi]), L))


def test_eq08_power_spectrum():
    c = light_coefficients(np.random.default_rng(616), 25).astype(np.float32)
    exact = [paper.power(x) for x in c.astype(np.float64)]
    np.testing.assert_allclose(np.array(svu.power_spectrum(c)), exact, rtol=EXACT)


def test_eq09_10_power_of_the_reflected_light():
    """Degrees l > 0 use the coefficients of Eq. 7; degree 0 is the square of a sum."""
    rng = np.random.default_rng(8675)
    light = light_coefficients(rng, 12).astype(np.float32)
    Ks, alpha = rng.uniform(0, 1, 12), rng.uniform(0, 1, 12)
    shown = [
        paper.reflected(c, np.full(3, 0.4), np.full(3, k), a, np.full(3, 2.0))
        for c, k, a in zip(light.astype(np.float64), Ks, alpha, strict=True)
    ]
    S_L, S_B = (np.array(svu.power_spectrum(np.array(c, np.float32))) for c in (light, shown))
    exact = [
        paper.reflected_power(S, k, a) for S, k, a in zip(S_L.astype(np.float64), Ks, alpha,
                                                          strict=True)
    ]  # fmt: skip
    np.testing.assert_allclose(S_B[:, 1:], np.array(exact)[:, 1:], rtol=EXACT, atol=1e-12)
    check_spectral_loss("spectrum", 70657)


def test_eq11_distance():
    """Compare posteriors, so that constant offsets of the distances cancel."""
    S_L, S_B = spectra(np.random.default_rng(52163), 20)
    exact = exact_distances(S_L, S_B)
    # Large, so that the probabilities of all bins have significant digits.
    sigma = float(np.sqrt(np.ptp(exact, axis=(1, 2)).max() / 20))
    p = np.array(of_paper(S_L, S_B, sigma).probabilities, np.float64)
    for table, d in zip(p, exact, strict=True):
        log = np.log(table)
        close(2 * sigma**2 * (log.max() - log), d - d.min(), 2 * EXACT)


# --- Eq. 12 ---------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["primal", "dual"])
@pytest.mark.parametrize("views, regularizer", [(4, 1e-3), (25, 1e-3), (60, 1e-2)])
def test_eq12_fit(views, regularizer, method):
    rng, texels = np.random.default_rng(views), 7
    d = hemisphere(rng, (texels, views))
    w = np.abs(d[..., 2]) * (rng.random((texels, views)) < 0.8)
    f = rng.gamma(1.0, 1.0, (texels, views, 2)).astype(np.float32)
    entropies = np.array(
        svu.fit_sh(d, w, f, lmax=L, regularizer=regularizer, preset="paper", method=method)
    )
    for t in range(texels):
        exact = paper.fit(
            unit(d[t]), w[t].astype(np.float64), f[t].astype(np.float64), L, regularizer
        )
        close(entropies[t], exact)


# --- Eq. 13 ---------------------------------------------------------------------------------


def test_eq13_expected_entropy(observed, samples):
    """For all texels and three candidates, fit again with light band-limited for v' = 15 views."""
    capture, sigma = observed.capture, 0.3
    switches = preset("paper", method="spectrum", sigma=sigma)
    estimate = svu.estimate(capture, observed.texels, "spectrum", switches, grid=GRID)
    candidates = svu.Candidates.around(capture, 3)
    options = svu.GuidanceOptions(band_limit="growing")
    known = StrategyInputs(estimate, estimate.observed, candidates, samples.texel, options)
    views, asked = np.arange(14), 14 + np.arange(3)
    expected = known.forecast.expected(views, asked, np.arange(len(samples.texel)))
    responses, prefilter = known.forecast.relight(15)  # w, direction and light of each view
    assert prefilter == pytest.approx(15**-0.5, rel=1e-12)
    table = responses.table().astype(np.float64)
    checked, low, high = 0, 1.0, 0.0
    for s in range(len(samples.texel)):
        _, wo, cosine, _, shown = samples.of(s)
        S_B = paper.power(paper.fit(wo, cosine, shown, L, 1e-3))
        for a, candidate in enumerate(asked):
            if table[candidate, s, 0] == 0:
                assert np.isnan(expected[a, s])
                continue
            rows = table[[v for v in (*views, candidate) if table[v, s, 0] > 0], s]
            S_L = paper.power(paper.fit(unit(rows[:, 1:4]), rows[:, 0], rows[:, 4:], L, 1e-3))
            exact = paper.expected_entropy(S_B, S_L, KS, ALPHAS, sigma)
            assert expected[a, s] == pytest.approx(exact, rel=EXACT)
            checked, low, high = checked + 1, min(low, exact), max(high, exact)
    assert checked > 40 and high - low > 0.2


def test_eq13_band_limit_follows_new_number_of_views(observed, samples):
    """The light of a candidate is band-limited light from its mirror direction."""
    candidates = svu.Candidates.around(observed.capture, 2)
    estimate = svu.estimate(observed.capture, observed.texels, "spectrum", "paper", grid=GRID)
    options = svu.GuidanceOptions(band_limit="growing")
    known = StrategyInputs(estimate, estimate.observed, candidates, samples.texel, options)
    table = known.forecast.relight(15)[0].table()
    normal = unit(observed.texels.normal.numpy().T[samples.texel])
    coefficients = paper.band_limited(observed.lighting.coefficients, 15)
    rows = observed.lighting.filtered.shape[0]
    grid = synthesize(coefficients, 2 * (rows - 1), rows)
    texture = lat_long_texture(grid)
    view, texel = np.nonzero(table[..., 0])
    d = unit(table[view, texel, 1:4])
    mirrored = 2 * (d * normal[texel]).sum(axis=1, keepdims=True) * normal[texel] - d
    local = mirrored @ observed.lighting.environment.to_local.T
    light = look_up(texture, to_drjit(mi.Vector3f, local.T.astype(np.float32)))
    close(table[view, texel, 4:], np.stack([x.numpy() for x in light], axis=1))


# --- Eq. 14 and 15 --------------------------------------------------------------------------


RESOLUTION = (16, 10)


@pytest.fixture(scope="module")
def sphere() -> SimpleNamespace:
    """Return texels of a ball, their neighbours, and random posteriors."""
    mesh = make_mesh("ball", ball())
    where = svu.texels(mesh, RESOLUTION)
    rng = np.random.default_rng(104)
    energies = rng.gamma(1.0, 2.0, (where.count, 4, 3))
    posterior = tabulated_posterior(energies, ParameterGrid(4, 3), np.ones(where.count, bool))
    estimate = Estimate(
        method="angular", preset=preset("paper", method="angular"), texels=where,
        posterior=posterior, coverage=dr.full(mi.UInt32, 1, where.count),
        seen_per_view=np.array([where.count]), skipped={},
    )  # fmt: skip
    p = np.exp(-energies)
    return SimpleNamespace(
        mesh=mesh, where=where, estimate=estimate, p=p / p.sum(axis=(1, 2), keepdims=True)
    )


def texture(seed: int) -> np.ndarray:
    width, height = RESOLUTION
    return np.random.default_rng(seed).random((height, width, 3)).astype(np.float32)


def at_texels(where: Any, values: np.ndarray) -> np.ndarray:
    """Return textures as (T, C) float64."""
    return values.astype(np.float64).reshape(-1, values.shape[-1])[where.index.numpy()]


def test_eq14_sharing(sphere):
    """Seeds have gradients, too, as in the derivative of the printed sum."""
    where, seeds = sphere.where, np.array([7, 61, 90, 118])
    sharing = svu.GlobalSharing.printed(sphere.estimate, sphere.mesh, seeds=seeds)
    w = paper.sharing_weights(sphere.p, seeds)
    values = texture(3301)
    value, gradient = backward(sharing, values)
    exact, slope = paper.sharing(at_texels(where, values), seeds, w)
    assert value == pytest.approx(exact, rel=EXACT)
    close(at_texels(where, gradient), slope)
    assert np.abs(gradient).sum() == pytest.approx(
        np.abs(at_texels(where, gradient)).sum()
    )  # texels outside the charts have no gradient


def test_eq15_weights(sphere):
    seeds = np.array([7, 61, 90, 118])
    sharing = svu.GlobalSharing.printed(sphere.estimate, sphere.mesh, seeds=seeds)
    w = np.array(sharing.weights, np.float64).reshape(len(seeds), -1).T
    exact = paper.sharing_weights(sphere.p, seeds)
    assert np.ptp(exact) > 0.9
    close(w, exact)


def test_eq15_seeds_are_the_least_local_minima(sphere):
    pairs = np.stack([column.numpy() for column in neighbors(sphere.where, sphere.mesh).pairs], 1)
    entropy = np.array([paper.entropy(p) for p in sphere.p])
    for count in (3, 20):
        chosen = svu.GlobalSharing.printed(sphere.estimate, sphere.mesh, seeds=count).seeds
        np.testing.assert_array_equal(chosen, paper.least_minima(entropy, pairs, count))


# --- losses ---------------------------------------------------------------------------------


def test_total_variation(sphere):
    """In texture space: pairs of each texel with its right and lower neighbours."""
    width, height = RESOLUTION
    number = np.full((height, width), -1)
    number.ravel()[sphere.where.index.numpy()] = np.arange(sphere.where.count)
    both = [(number[:, :-1], number[:, 1:]), (number[:-1], number[1:])]
    pairs = np.concatenate([np.stack([a.ravel(), b.ravel()], 1) for a, b in both])
    pairs = pairs[(pairs >= 0).all(axis=1)]
    values = texture(559)
    value, gradient = backward(svu.TotalVariation(sphere.where, epsilon=0.0), values)
    exact, slope = paper.total_variation(at_texels(sphere.where, values), pairs)
    assert value == pytest.approx(exact, rel=EXACT)
    close(at_texels(sphere.where, gradient), slope)


def test_l1_of_rendered_pixels():
    rng = np.random.default_rng(4021)
    render, target = (rng.gamma(1.0, 1.0, (9, 7, 3)).astype(np.float32) for _ in range(2))
    value, gradient = backward(lambda x: l1(x, as_tensor(target)), render)
    exact, slope = paper.absolute_error(render.astype(np.float64), target.astype(np.float64))
    assert value == pytest.approx(exact, rel=EXACT)
    close(gradient, slope)
