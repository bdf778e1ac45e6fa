"""Tests of Eq. 3, 5 and 11 against brute force, and properties of posteriors."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from numerics.samples import DEGREE as L
from numerics.samples import metals as spectra
from oracle import posterior as oracle
from support.unseen import assert_unseen_have_the_prior

from svu_mi.errors import OptionError, ShapeError
from svu_mi.posterior.grid import ParameterGrid, PrincipledGrid
from svu_mi.posterior.spectrum import spectrum_posterior
from svu_mi.presets import preset
from svu_mi.reflection.lobes import split_sum

GRID = ParameterGrid(roughness=5, specular=4)
RULES = [
    preset("paper", method="spectrum"),
    preset("paper", method="spectrum", channels="grey"),  # Ks per channel
    preset("default", method="spectrum"),
    preset("default", method="spectrum", channels="sum"),
]


def mean_power(S_B: np.ndarray) -> float:
    """Return the power of all degrees, mean over texels and channels."""
    return S_B.astype(np.float64).sum(axis=1).mean()


def brute_force(S_L, S_B, switches, grid, scale, prior=1.0, prefilter=0.0):
    """Return probabilities of one texel, (L + 1, C); ``scale`` is the unit of a relative sigma."""
    S_L, S_B = S_L.astype(np.float64), S_B.astype(np.float64)
    paper, channels = switches.name == "paper", S_L.shape[1]
    rough, Ks = oracle.nodes(grid.roughness, grid.specular, grid.spacing or switches.spacing)
    alphas = rough**2 if paper else np.maximum(rough**2, 1e-3)
    prefilter = prefilter if switches.undo_prefilter else 0.0
    d = [oracle.distances(S_L[:, c], S_B[:, c], alphas, Ks, prefilter) for c in range(channels)]

    def energy(distance):
        sigma = switches.sigma if switches.noise == "fixed" else switches.sigma * scale
        return distance / (2 * sigma**2)

    if switches.channels == "sum":
        return oracle.normalize(energy(sum(d)), prior)
    single = [energy(d[c]) for c in range(channels)]
    joint = np.zeros((len(rough), *(len(Ks),) * channels))
    weight = np.ones_like(joint)
    prior = np.broadcast_to(prior, (len(rough), len(Ks)))
    rows = prior.sum(axis=1)
    for cell in itertools.product(*(range(n) for n in joint.shape)):
        r, columns = cell[0], cell[1:]
        joint[cell] = sum(single[c][r, s] for c, s in enumerate(columns))
        # Multiply the prior of a row by the prior of each channel's Ks given the row.
        given_row = [prior[r, s] / rows[r] if rows[r] else 0 for s in columns]
        weight[cell] = rows[r] * np.prod(given_row)
    p = oracle.normalize(joint, weight)
    # Probabilities over (roughness, Ks) of each channel, with the other channels marginalised.
    others = ([1 + k for k in range(channels) if k != c] for c in range(channels))
    return np.stack([p.sum(axis=tuple(axes)) for axes in others], axis=-1)


def entropy_of(p):
    """Return the entropy (Eq. 5) of (R, S), or the mean over channels of (R, S, C)."""
    if p.ndim == 2:
        return oracle.entropy(p)
    return np.mean([oracle.entropy(p[..., c]) for c in range(p.shape[2])])


@pytest.mark.few(6)
@pytest.mark.parametrize("with_prior", [False, True])
@pytest.mark.parametrize("switches", RULES, ids=lambda s: f"{s.name}-{s.channels}")
def test_every_rule_agrees_with_brute_force(switches, with_prior):
    rng = np.random.default_rng(20250)
    S_L, S_B = spectra(rng, 12)
    prior = rng.random((5, 4)) * (rng.random((5, 4)) > 0.3) if with_prior else None
    posterior = spectrum_posterior(S_L, S_B, GRID, preset=switches, prior=prior, prefilter=0.3)
    p, H = np.array(posterior.probabilities), np.array(posterior.entropy())
    for t in range(12):
        truth = brute_force(
            S_L[t], S_B[t], switches, GRID, mean_power(S_B), 1.0 if prior is None else prior, 0.3,
        )  # fmt: skip
        np.testing.assert_allclose(p[t], truth, atol=2e-6)  # rounding of float32 exponentials
        assert abs(H[t] - entropy_of(truth)) < 1e-6


def test_exposure_matters_in_paper():
    """With a fixed sigma in squared radiance, brighter photographs reduce entropy."""
    S_L, S_B = spectra(np.random.default_rng(1729), 200)
    before = np.array(spectrum_posterior(S_L, S_B, preset="paper").entropy())
    after = np.array(spectrum_posterior(16 * S_L, 16 * S_B, preset="paper").entropy())
    assert (before - after).mean() > 0.1


def test_entropy_is_1_without_information_and_near_0_if_sharp():
    S_L, S_B = spectra(np.random.default_rng(28), 30)
    flat = np.array(spectrum_posterior(S_L, S_B, None, 1e9, "paper").entropy())
    sharp = np.array(spectrum_posterior(S_L, S_B, None, 1e-5, "paper").entropy())
    dark = np.array(spectrum_posterior(0 * S_L, 0 * S_B).entropy())
    np.testing.assert_allclose(flat, 1, atol=1e-6)
    np.testing.assert_array_equal(dark, 1)
    # If the best bin has Ks = 0, roughness is unknown: entropy is at most log 8 / log 64.
    assert np.median(sharp) < 1e-3
    assert sharp.max() < 0.5 + 1e-6


def one_row(shape):
    """Return prior weights that allow only one roughness."""
    return np.eye(shape[0])[1] * 3.0


def uneven(shape):
    """Return weights with zeros, also for a whole roughness, and one dominant bin."""
    rng = np.random.default_rng(577215)
    weights = rng.random(shape) * (rng.random(shape) > 0.4)
    weights[2] = 0
    weights.flat[1] = 2
    return weights


@pytest.mark.few(4)
@pytest.mark.parametrize("prior", [None, one_row, uneven], ids=lambda f: f and f.__name__)
@pytest.mark.parametrize("switches", [*RULES, None], ids=lambda s: s and f"{s.name}-{s.channels}")
def test_unseen_texels_have_the_prior_for_their_posterior(switches, prior):
    """For all noise rules, and on the principled grid."""
    S_L, S_B = spectra(np.random.default_rng(6), 9)
    grid, more = GRID, {"preset": switches}
    if switches is None:
        grid, more = PrincipledGrid(4, 3, 5), {"preset": "default", "irradiance": S_L[:, 0]}
    weights = np.ones(grid.shape[0]) if prior is None else prior(grid.shape)
    posterior = spectrum_posterior(
        S_L, S_B, grid, observed=np.arange(9) % 2 == 0, prior=None if prior is None else weights,
        **more,
    )  # fmt: skip
    assert_unseen_have_the_prior(posterior, weights)


def test_black_under_light_is_an_observation():
    """A black texel has low Ks; an unseen texel has the prior."""
    S_L, _ = spectra(np.random.default_rng(137), 20)
    H = np.array(spectrum_posterior(S_L, 0 * S_L).entropy())
    assert H.max() < 0.6


def test_prior_moves_the_posterior_and_excludes_cells():
    S_L, S_B = spectra(np.random.default_rng(2718281), 20)
    prior = np.zeros(8)
    prior[3] = 5.0
    for sigma in (1e-5, 0.1, 1e3):  # from a sharp to a flat likelihood
        posterior = spectrum_posterior(S_L, S_B, None, sigma, "paper", prior=prior)
        rough = np.array(posterior.marginal("roughness"))
        np.testing.assert_allclose(rough, np.tile(np.eye(8)[3], (20, 1)), atol=1e-7)
    flat = spectrum_posterior(S_L, S_B, preset="paper", prior=np.full((8, 8), 7.0))
    plain = spectrum_posterior(S_L, S_B, preset="paper")
    np.testing.assert_allclose(np.array(flat.entropy()), np.array(plain.entropy()), atol=1e-6)


@pytest.mark.parametrize("switches", RULES, ids=lambda s: f"{s.name}-{s.channels}")
def test_marginals_are_sums_of_the_probabilities(switches):
    S_L, S_B = spectra(np.random.default_rng(65537), 15)
    posterior = spectrum_posterior(S_L, S_B, GRID, preset=switches)
    p = np.array(posterior.probabilities, np.float64)
    rough, specular = (np.array(posterior.marginal(n)) for n in ("roughness", "specular"))
    np.testing.assert_allclose(rough.sum(axis=1), 1, rtol=1e-5)
    np.testing.assert_allclose(specular.sum(axis=1), 1, rtol=1e-5)
    p, specular = np.atleast_3d(p.reshape(15, 5, 4, -1)), specular.reshape(15, 4, -1)
    for c in range(p.shape[3]):
        np.testing.assert_allclose(rough, p[..., c].sum(axis=2), atol=2e-6)
        np.testing.assert_allclose(specular[..., c], p[..., c].sum(axis=1), atol=2e-6)
    H = np.array(posterior.marginal_entropy("roughness"))
    truth = [oracle.entropy(q) for q in rough.astype(np.float64)]
    np.testing.assert_allclose(H, truth, atol=1e-6)


@pytest.mark.parametrize("channels", ["sum", "grey"])
def test_map_recovers_the_truth(channels):
    """All nodes except spectra without power, which contain no information."""
    switches = preset("default", method="spectrum", channels=channels, sigma=1e-3)
    rough, Ks = oracle.nodes(8, 8, switches.spacing)
    l = np.arange(L + 1)
    S_L = np.tile((5 * np.exp(-0.3 * l)).astype(np.float32)[:, None], (1, 3))
    cells = list(itertools.product(range(1, 7), range(1, 8)))
    S_B = np.stack([S_L * oracle.model(np.ones(L + 1), Ks[s], rough[r] ** 2)[:, None]
                    for r, s in cells])  # fmt: skip
    best = spectrum_posterior(np.tile(S_L, (len(cells), 1, 1)), S_B, preset=switches).map()
    truth = np.array([(rough[r], Ks[s]) for r, s in cells])
    np.testing.assert_allclose(np.array(best["roughness"]), truth[:, 0], atol=1e-6)
    got = np.array(best["specular"]).reshape(len(cells), -1)
    np.testing.assert_allclose(got, np.broadcast_to(truth[:, 1:], got.shape), atol=1e-6)


def test_undo_prefilter_corrects_band_limited_light():
    """Only light is band-limited, so the exponent is alpha^2 - alpha'^2."""
    rough, Ks = oracle.nodes(8, 8, "dielectric")
    l = np.arange(L + 1)
    S_L = 5 * np.exp(-0.3 * l)
    S_B = oracle.model(S_L, Ks[5], rough[5] ** 2)
    softened = S_L * np.exp(-2 * (0.4 * l) ** 2)
    arguments = [x[None, :, None].astype(np.float32) for x in (softened, S_B)]
    undone = preset("default", method="spectrum", undo_prefilter=True)
    best = spectrum_posterior(*arguments, sigma=1e-3, preset=undone, prefilter=0.4).map()
    assert np.array(best["roughness"])[0] == pytest.approx(rough[5])
    ignored = preset("default", method="spectrum", undo_prefilter=False)
    best = spectrum_posterior(*arguments, sigma=1e-3, preset=ignored, prefilter=0.4).map()
    assert np.array(best["roughness"])[0] < rough[5] - 0.1


@pytest.mark.parametrize("channels", [1, 3])
def test_degree_0_decides_on_the_diffuse_part(channels):
    """Compare with brute force over (roughness, metallic, base colour), from Eq. 7 and 11."""
    rng = np.random.default_rng(31337)
    S_L, S_B = spectra(rng, 8, channels)
    E = rng.random((8, S_L.shape[2])) * 3
    switches = preset("default", method="spectrum", sigma=0.02)
    grid = PrincipledGrid(4, 3, 5)
    posterior = spectrum_posterior(S_L, S_B, grid, preset=switches, irradiance=E)
    p, H = np.array(posterior.probabilities), np.array(posterior.entropy())
    unit = mean_power(S_B)
    alpha = np.maximum(np.linspace(0, 1, 4) ** 2, 1e-3)
    albedo = split_sum(alpha)[..., :2].sum(axis=2).mean(axis=1)
    for t in range(8):
        x = np.zeros((S_L.shape[2], 4, 3, 5))
        for c, k, i, j in itertools.product(*map(range, x.shape)):
            roughness, m, color = k / 3, i / 2, j / 4
            Ks = albedo[k] * (0.04 * (1 - m) + m * color)
            model = oracle.model(S_L[t, :, c].astype(float), Ks, max(roughness**2, 1e-3))
            d = ((S_B[t, 1:, c] - model[1:]) ** 2).sum()
            constant = 2 * (1 - m) * color * E[t, c] / np.sqrt(np.pi) + Ks * S_L[t, 0, c] ** 0.5
            x[c, k, i, j] = d / (2 * (0.02 * unit) ** 2) + (
                (S_B[t, 0, c] ** 0.5 - constant) ** 2 / (2 * switches.constant_sigma**2 * unit)
            )
        z = np.exp(-(x - x.min(axis=3, keepdims=True))).sum(axis=3)
        row = np.exp((-x.min(axis=3) + np.log(z)).sum(axis=0))
        row /= row.sum()
        given = np.exp(-(x - x.min(axis=3, keepdims=True))) / z[..., None]
        truth = row[None, ..., None] * given
        expected = truth[0] if channels == 1 else np.moveaxis(truth, 0, 3)
        np.testing.assert_allclose(p[t], expected, atol=3e-6)
        assert abs(H[t] - np.mean([oracle.entropy(q) for q in truth])) < 2e-6


def test_grid_with_missing_inputs_is_refused():
    for more, sentence in (
        ({}, "PrincipledGrid needs the irradiance"),
        ({"preset": "paper", "irradiance": np.ones((2, 3))}, "channels='sum'"),
        ({"irradiance": -np.ones((2, 3))}, "irradiance is negative"),
    ):
        with pytest.raises(OptionError, match=sentence):
            spectrum_posterior(*spectra(np.random.default_rng(1), 2), PrincipledGrid(), **more)


@pytest.mark.parametrize("channels", ["sum", "grey"])
def test_divergence_matches_brute_force_and_is_0_on_itself(channels):
    rng = np.random.default_rng(877)
    switches = preset("default", method="spectrum", channels=channels, sigma=0.3)
    a = spectrum_posterior(*spectra(rng, 6), GRID, preset=switches)
    b = spectrum_posterior(*spectra(rng, 4), GRID, preset=switches)
    KL = np.array(a.kl(b))
    p, q = (np.array(x.probabilities, np.float64).reshape(x.count, -1) for x in (a, b))
    assert KL.shape == (6, 4)
    assert (KL >= 0).all()
    for i, j in itertools.product(range(6), range(4)):
        ratio = np.maximum(p[i], 1e-30) / np.maximum(q[j], 1e-30)  # documented minimum
        truth = (p[i] * np.log(ratio)).sum() / a.channels
        assert KL[i, j] == pytest.approx(truth, rel=1e-3, abs=1e-5)
    np.testing.assert_allclose(np.diag(np.array(a.kl(a))), 0, atol=1e-6)


def test_divergence_of_different_grids_is_refused():
    S_L, S_B = spectra(np.random.default_rng(5), 2)
    with pytest.raises(ShapeError, match="grids differ"):
        spectrum_posterior(S_L, S_B).kl(spectrum_posterior(S_L, S_B, GRID))


def test_probabilities_that_do_not_fit_name_the_way_out():
    S_L, S_B = (np.ones((200000, 3, 3), np.float32) for _ in range(2))
    posterior = spectrum_posterior(S_L, S_B, ParameterGrid(32, 32))
    with pytest.raises(OptionError, match="2 GiB; use entropy"):
        _ = posterior.probabilities
    assert posterior.entropy().shape == (200000,)


def test_no_texels_is_an_empty_posterior():
    for switches in RULES:
        posterior = spectrum_posterior(np.zeros((0, 4, 3)), np.zeros((0, 4, 3)), preset=switches)
        assert posterior.count == 0
        assert posterior.entropy().shape == (0,)
        assert posterior.probabilities.shape[0] == 0
        assert posterior.marginal("roughness").shape == (0, 8)
        assert posterior.map()["roughness"].shape == (0,)


def test_grid_nodes_follow_the_preset_unless_told_otherwise():
    own = ParameterGrid(spacing="uniform").resolved(preset("default", method="spectrum"))
    ours = ParameterGrid().resolved(preset("default", method="spectrum"))
    np.testing.assert_allclose(own.specular_nodes, np.linspace(0, 1, 8))
    np.testing.assert_allclose(ours.specular_nodes, 0.04 + 0.96 * np.linspace(0, 1, 8) ** 2)
    np.testing.assert_allclose(ours.roughness_nodes, np.linspace(0, 1, 8))
    with pytest.raises(OptionError, match=r"must be in \[2, 64\]"):
        ParameterGrid(roughness=1)
    with pytest.raises(OptionError, match=r"must be in \[2, 64\]"):
        replace(ours, specular=65)


@pytest.mark.parametrize(
    "change, error, message",
    [
        ({"outgoing": np.ones((3, 6, 3))}, ShapeError, r"outgoing|\(3, 6, 3\)"),
        ({"incoming": np.ones((3, 7))}, ShapeError, "incoming"),
        ({"observed": np.ones(2, bool)}, ShapeError, "observed has 2 values for 3 texels"),
        ({"prior": np.ones((7, 8))}, ShapeError, r"prior must be \(8, 8\)"),
        ({"prior": -np.ones(8)}, OptionError, "non-negative"),
        ({"incoming": -np.ones((3, 7, 3))}, OptionError, "texel 0 is negative"),
        ({"outgoing": np.full((3, 7, 3), np.nan)}, OptionError, "not finite"),
        ({"sigma": 0.0}, OptionError, "sigma must be"),
    ],
)
def test_wrong_input_is_named(change, error, message):
    good = {"incoming": np.ones((3, 7, 3)), "outgoing": np.ones((3, 7, 3))}
    with pytest.raises(error, match=message):
        spectrum_posterior(**(good | change))
