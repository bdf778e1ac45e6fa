"""Tests of the calibrated posterior, against its oracle and against samples of its model."""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from oracle import calibrated as oracle
from oracle.levels import levels as levels_of
from scipy import stats

import svu_mi as svu
from svu_mi.errors import OptionError, ShapeError
from svu_mi.posterior import empirical_bayes
from svu_mi.posterior.calibrated import calibrated_posterior
from svu_mi.posterior.intervals import shortest_interval
from svu_mi.posterior.node_integration import energy_at
from svu_mi.posterior.noise import noise_variance
from svu_mi.posterior.quadrature import uniform_axis
from svu_mi.posterior.tables import row_colors
from svu_mi.posterior.truncated_normal import ChannelLikelihood, erfcx
from svu_mi.reflection.principled import mixture
from svu_mi.statistics.statistics import Statistics
from svu_mi.statistics.texel_blocks import to_blocks

LEVELS = levels_of(8)
PARTS = oracle.even(42), oracle.mixed(14, 0.8)


def lobe(roughness: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Return a highlight that is wider and lower with roughness."""
    alpha = 0.15 + 0.6 * roughness
    return (alpha**2 + 0.02) / (alpha**2 + np.sin(angle) ** 2) * (0.3 + 0.7 / (1 + 6 * alpha))


def columns(rng: np.random.Generator, count: int, views: int, at: np.ndarray) -> list[np.ndarray]:
    """Return e, p, q, d, (S, R, V, 3), at roughness (S or 1, R)."""
    angle = rng.uniform(0, 0.9, (count, 1, views, 1))
    tint = rng.uniform(0.6, 1.4, (count, 1, 1, 3))
    light = 4 * tint * lobe(at[:, :, None, None], angle)
    grazing = 0.05 * (angle / 0.9) ** 5
    e = 0.6 * tint * rng.uniform(0.7, 1.3, (count, 1, views, 1)) + 0 * light
    return [e, light * (1 - grazing), light * grazing, 0.04 * light + light * grazing]


def simulate(
    count: int,
    views: int,
    noise: float,
    seed: int = 0,
    exposure: float = 1.0,
    materials: int | None = None,
) -> tuple[oracle.Samples, dict[str, np.ndarray]]:
    """Sample parameters from the prior, and photographs from the likelihood.

    With ``materials``, texels share the parameters of a few.
    """
    rng = np.random.default_rng(seed)
    metals = rng.random(count)
    truth = {
        "roughness": rng.random(count),
        "metallic": np.select([metals < 0.4, metals < 0.8], [0.0, 1.0], rng.random(count)),
        "base_color": rng.random((count, 3)),
    }
    if materials is not None:
        truth = {name: np.resize(x[:materials], x.shape) for name, x in truth.items()}
    levels = np.concatenate([np.tile(LEVELS, (count, 1)), truth["roughness"][:, None]], axis=1)
    e, p, q, d = (exposure * x for x in columns(rng, count, views, levels))
    m, c = truth["metallic"][:, None, None], truth["base_color"][:, None]
    b = (1 - m) * (c * e[:, -1] + d[:, -1]) + m * (c * p[:, -1] + q[:, -1])
    w = rng.uniform(0.3, 1, (count, views))
    b = b + exposure * noise / np.sqrt(w)[..., None] * rng.standard_normal(b.shape)
    return oracle.Samples(*(x[:, :-1] for x in (e, p, q, d)), b, w), truth


def statistics(samples: oracle.Samples) -> Statistics:
    views = np.full(len(samples.b), samples.b.shape[1])
    return Statistics.of(samples.sums(), samples.w.sum(axis=1), views, LEVELS, 0.5)


def channels(samples: oracle.Samples, count: int) -> oracle.Samples:
    """Repeat the first channel."""
    e, p, q, d, b = (np.repeat(x[..., :1], count, axis=-1) for x in
                     (samples.e, samples.p, samples.q, samples.d, samples.b))  # fmt: skip
    return oracle.Samples(e, p, q, d, b, samples.w)


def switches(**changed: object) -> svu.AngularPreset:
    return svu.preset("default", method="angular", **changed)


@pytest.fixture(scope="module")
def setting() -> tuple[svu.Posterior, oracle.Truth]:
    samples, _ = simulate(96, 12, 0.05)
    weight, views = samples.w.sum(axis=1), np.full(96, 12)
    parts = PARTS[0], oracle.mixed(14, 0.8, share=0.3)
    truth = oracle.posterior(
        samples.sums(), weight, views, tau=3.5, nu=4, r=parts[0], m=parts[1],
        prior=oracle.bright_metals(*parts),
    )  # fmt: skip
    return calibrated_posterior(statistics(samples), preset=switches(metal_share=0.3)), truth


def test_energies_match_the_samples() -> None:
    samples, _ = simulate(40, 9, 0.05)
    factors = statistics(samples).factor()
    rng = np.random.default_rng(1)
    for _ in range(100):
        level, metallic, color = rng.integers(8), rng.random(40), rng.random((40, 3))
        exact = samples.error(int(level), metallic, color)
        reader, energies = factors.reader(), np.zeros(40)
        for channel in range(3):
            U = reader.entries(mi.UInt32(int(level)))[channel]
            c, m = (mi.Float(x.astype(np.float32)) for x in (color[:, channel], metallic))
            rest = 2 * np.array(energy_at(U, mixture(m).at(c)), np.float64)
            energies += rest + np.array(reader.residual_floor[channel], np.float64)
        energies *= samples.w.sum(axis=1)
        scale = samples.error(int(level), 0 * metallic, 0 * color)  # error of a black model
        assert np.all(np.abs(energies - exact) <= 1e-6 * np.maximum(exact, scale))


def test_erfcx() -> None:
    from scipy.special import erfcx as exact

    x = np.concatenate([np.linspace(0, 8, 5000), np.geomspace(8, 1e6, 1000)])
    assert np.abs(np.array(erfcx(mi.Float64(x))) / exact(x) - 1).max() < 1e-9


def test_color_in_closed_form_is_its_quadrature() -> None:
    """Means inside and far outside of [0, 1], standard deviations from small to large."""
    rng = np.random.default_rng(0)
    A, mu = 10 ** rng.uniform(-1, 5, 2000), rng.uniform(-1, 2, 2000)
    mu[::5] = rng.uniform(-8, 9, 400)
    u, v = (x.astype(np.float32) for x in (np.sqrt(A), -mu * np.sqrt(A)))
    zero = mi.Float(np.zeros(2000, np.float32))
    edges = np.concatenate([[0], (np.arange(7) + 0.5) / 7, [1]])
    likelihood = ChannelLikelihood.of([mi.Float(u), zero], [mi.Float(v), zero, zero], zero)
    integrals = likelihood.integrate(edges.tolist())
    A, mu = u.astype(float) ** 2, -v.astype(float) / u
    best = np.clip(mu, 0, 1)

    def integral(low: float, high: float, power: int) -> np.ndarray:
        """Integrate by Gauss-Legendre quadrature on pieces refined towards the best colour."""
        x, w = np.polynomial.legendre.leggauss(40)
        reach = np.concatenate([-np.geomspace(60, 0.02, 14), [0], np.geomspace(0.02, 60, 14)])
        ends = np.clip(best + reach[:, None] / np.sqrt(A), low, high)
        ends = np.concatenate([np.full((1, 2000), low), ends, np.full((1, 2000), high)])
        total = np.zeros(2000)
        for a, b in zip(ends[:-1], ends[1:], strict=True):
            c = (a + b) / 2 + (b - a) / 2 * x[:, None]
            f = np.exp(-0.5 * A * (c - best) * (c + best - 2 * mu)) * c**power
            total += (w[:, None] * f).sum(axis=0) * (b - a) / 2
        return total

    whole = integral(0, 1, 0)
    mean = integral(0, 1, 1) / whole
    sd = np.sqrt(np.maximum(integral(0, 1, 2) / whole - mean**2, 0))
    assert np.abs(np.array(integrals.mass) / whole - 1).max() < 1e-5  # nats
    assert np.abs(np.array(integrals.mean) - mean).max() < 1e-6
    assert np.abs(np.sqrt(np.array(integrals.variance, float)) - sd).max() < 1e-5
    cells = [integral(a, b, 0) / whole for a, b in zip(edges[:-1], edges[1:], strict=True)]
    assert np.abs(np.array([np.array(x) for x in integrals.bins]) - cells).max() < 1e-5
    prior = [0.1, 2.0, 0.5, 1.0, 1.5, 0.01, 1.0, 3.0]
    weighted = likelihood.integrate(edges.tolist(), [mi.Float(g) for g in prior])
    expected = np.array(prior)[:, None] * cells
    total = expected.sum(axis=0)
    assert np.abs(np.array(weighted.mass) / (whole * total) - 1).max() < 5e-4
    assert np.abs(np.array([np.array(x) for x in weighted.bins]) - expected / total).max() < 5e-4


def test_noise_matches_the_student_prior() -> None:
    least, views = np.array([3.0, 10.0, 40.0, 0.0, 0.0]), np.array([10, 10, 10, 3, 0])
    for assumed in (0.02, 2.0):
        variances = noise_variance(least, views, 3, 4.0, assumed)
        usual = 10 / 25  # residuals of three views contain no information
        assert np.allclose(variances[:3], (4 * usual + least[:3]) / 29)
        assert np.allclose(variances[3:], usual)
    few = noise_variance(0 * least, np.minimum(views, 5), 3, 4.0, 0.02)
    assert np.allclose(few, 0.02**2)
    # t is 1 for a quarter of the seen texels, so log s_0 is halfway to the median.
    views = np.array([8, 5, 5, 5, 0])
    variances = noise_variance(0.1 * (3 * views - 5), views, 3, 4.0, 2.0)
    assert np.allclose(variances[1:], np.sqrt(0.1 * 4))


@pytest.mark.parametrize("noise", [4e-3, 0.01])
def test_another_view_never_lowers_the_noise_at_once(noise: float) -> None:
    """Number of views varies from too few for any texel to enough for all."""
    rng = np.random.default_rng(0)
    share, s = rng.uniform(0.3, 1, 400), []
    for number in range(1, 61):
        views = np.floor(share * number)
        least = noise**2 * rng.chisquare(np.maximum(3 * views - 5, 0) + 1e-9)
        s.append(np.sqrt(np.median(noise_variance(least, views, 3, 4.0, 0.02))))
    assert np.allclose(s[:5], 0.02)
    assert s[-1] == pytest.approx(max(noise, 4e-3), rel=0.05)
    steps = np.diff(np.log(s)) / np.log(noise / 0.02)
    assert steps.max() < 0.45


def test_noise_above_the_assumed_value_shows_at_once() -> None:
    views = np.full(400, 4)
    least = 0.3**2 * np.random.default_rng(0).chisquare(7, 400)
    variances = noise_variance(least, views, 3, 4.0, 0.02)
    assert np.sqrt(np.median(variances)) == pytest.approx(0.3, rel=0.1)


def test_agrees_with_its_oracle(setting: tuple[svu.Posterior, oracle.Truth]) -> None:
    posterior, truth = setting
    assert np.abs(np.array(posterior.entropy()) - truth.entropy(posterior.prior)).max() < 1e-5
    for name in ("roughness", "metallic", "base_color"):
        assert np.abs(np.array(posterior.mean(name)) - truth.mean[name]).max() < 1e-5, name
        assert np.abs(np.array(posterior.sd(name)) - truth.sd[name]).max() < 1e-5, name
    assert np.abs(np.array(posterior.probabilities) - truth.cells).max() < 1e-5
    assert np.abs(posterior.kernel.noise / truth.noise - 1).max() < 1e-5


@pytest.mark.parametrize("level", [0.5, 0.9])
def test_intervals_are_the_shortest_that_hold_enough(
    setting: tuple[svu.Posterior, oracle.Truth], level: float
) -> None:
    posterior, truth = setting
    for name, parts, masses in (
        ("roughness", PARTS[0], truth.roughness), ("metallic", PARTS[1], truth.metallic),
    ):  # fmt: skip
        low, high = (np.array(end, np.float64) for end in posterior.interval(name, level))
        below = np.concatenate([np.zeros((1, 96)), np.cumsum(masses, axis=0)])
        # Metallic near 0 or 1, as in 8-bit textures, is inside of intervals.
        atoms = 0.02 * (parts.low == parts.high)
        lows, highs = np.maximum(parts.low - atoms, 0), np.minimum(parts.high + atoms, 1)
        for t in range(96):
            a = np.flatnonzero(np.isclose(lows, low[t]))
            b = np.flatnonzero(np.isclose(highs, high[t]))
            held = max(below[j + 1, t] - below[i, t] for i in a for j in b)
            assert held >= level - 1e-3
            shorter = [
                below[j + 1, t] - below[i, t]
                for i in range(len(masses)) for j in range(i, len(masses))
                if highs[j] - lows[i] < high[t] - low[t] - 1e-6
            ]  # fmt: skip
            assert max(shorter, default=0) < level + 1e-3
    low, high = (np.array(end) for end in posterior.interval("base_color", level))
    assert low.shape == (96, 3)
    for name in ("roughness", "metallic", "base_color"):
        all_of_them = posterior.interval(name, level)
        some = posterior.interval(name, level, [5, 80, 5])
        for end, other in zip(some, all_of_them, strict=True):
            assert np.array_equal(np.array(end), np.array(other)[[5, 80, 5]])
    narrow = np.array(posterior.sd("base_color")) < 0.05
    width = 2 * stats.norm.ppf(0.5 + level / 2) * np.array(posterior.sd("base_color"))
    assert np.all((high - low)[narrow] <= width[narrow] * 1.25)
    drawn = np.array(posterior.draw(1000, seed=5)["base_color"])
    assert abs(((drawn >= low) & (drawn <= high)).mean() - level) < 0.01


@pytest.mark.parametrize("level", [0.5, 0.9])
def test_divided_intervals_are_the_shortest_of_a_density(level: float) -> None:
    """The density is constant within each of ten parts of unequal masses."""
    parts, places = uniform_axis(np.linspace(0, 1, 6), 10), np.linspace(0, 1, 2001)
    masses = np.random.default_rng(4).gamma(0.5, size=(10, 40)).astype(np.float32)
    blocks = to_blocks(mi.Float, masses)
    low, high = (np.array(x) for x in shortest_interval(blocks, parts, 40, level, divided=True))
    for t, mass in enumerate((masses / masses.sum(axis=0)).T):
        below = np.interp(places, np.append(0, parts.high), np.append(0, np.cumsum(mass)))
        held = np.interp([low[t], high[t]], places, below)
        assert abs(held[1] - held[0] - level) < 1e-3
        wanted = below[below < 1 - level] + level
        ends = np.interp(wanted, below + 1e-12 * np.arange(2001), places)
        assert abs(high[t] - low[t] - (ends - places[: len(ends)]).min()) < 2e-3


@pytest.mark.slow
def test_credible_sets_cover_samples_of_the_model() -> None:
    """With parameters sampled from the prior, the coverage of intervals equals their level."""
    samples, truth = simulate(4000, 10, 0.15, seed=3)
    posterior = calibrated_posterior(
        statistics(samples),
        preset=switches(overdispersion=1.0, degrees=1000.0, bare_metals=0.0),
    )
    drawn = posterior.draw(99, seed=1)
    for name in ("roughness", "base_color"):
        low, high = (np.array(end) for end in posterior.interval(name, 0.9))
        inside = (truth[name] >= low) & (truth[name] <= high)
        # That of roughness ends at edges of parts.
        assert 0.88 < inside.mean() < {"roughness": 0.95, "base_color": 0.91}[name], name
        rank = (np.array(drawn[name]) < truth[name]).sum(axis=0).ravel() / 100
        assert stats.kstest(rank, "uniform").statistic < 0.04, name
        z = (np.array(posterior.mean(name)) - truth[name]) ** 2
        assert 0.9 < z.mean() / (np.array(posterior.sd(name)) ** 2).mean() < 1.1, name
    believed = np.array(posterior.mean("metallic"))
    for low_end in np.arange(0, 1, 0.25):
        chosen = (believed >= low_end) & (believed < low_end + 0.25)
        assert abs(truth["metallic"][chosen].mean() - believed[chosen].mean()) < 0.06


@pytest.mark.slow
def test_draws_are_of_the_posterior(setting: tuple[svu.Posterior, oracle.Truth]) -> None:
    posterior, truth = setting
    drawn = {name: np.array(x) for name, x in posterior.draw(400, seed=5).items()}
    assert drawn["base_color"].shape == (400, 96, 3)
    assert drawn["roughness"].shape == (400, 96)
    for name, values in drawn.items():
        assert np.all((values >= 0) & (values <= 1))
        off = (values.mean(axis=0) - truth.mean[name]) / (truth.sd[name] / 20 + 1e-4)
        assert np.abs(off).max() < 5, name
    # Correlations within the draws match correlations of the posterior.
    again = {name: np.array(x) for name, x in posterior.draw(400, seed=5).items()}
    assert all(np.array_equal(drawn[name], again[name]) for name in drawn)
    m, c = drawn["metallic"], drawn["base_color"].mean(axis=2)
    p = np.array(posterior.probabilities, np.float64).mean(axis=-1)
    nodes = np.arange(8) / 7
    joint = np.einsum("trmk,m,k->t", p, nodes, nodes)
    cov = joint - np.einsum("trmk,m->t", p, nodes) * np.einsum("trmk,k->t", p, nodes)
    own = ((m - m.mean(axis=0)) * (c - c.mean(axis=0))).mean(axis=0)
    assert np.corrcoef(cov, own)[0, 1] > 0.95


def test_unseen_texels_have_the_calibrated_prior() -> None:
    samples, _ = simulate(32, 6, 0.1)
    table, weight, views = samples.sums(), samples.w.sum(axis=1), np.full(32, 6)
    table[..., 7], weight[7], views[7] = 0, 0, 0
    posterior = calibrated_posterior(Statistics.of(table, weight, views, LEVELS, 0.5), texels=40)
    entropy, unseen = np.array(posterior.entropy()), [7, *range(32, 40)]
    assert np.all(entropy[unseen] == 1)
    assert np.all(np.isfinite(entropy))
    p = np.array(posterior.probabilities_of(unseen))
    assert np.allclose(p, posterior.prior[..., None], atol=1e-6)
    assert np.isclose(posterior.prior.sum(axis=(0, 2))[0], 0.4 + 0.2 / 14)
    assert np.allclose(np.array(posterior.mean("metallic"))[unseen], 0.5)
    low, high = (np.array(end) for end in posterior.interval("base_color"))
    assert np.all(low[unseen] == 0)
    assert np.all(high[unseen] == 1)
    drawn = posterior.draw(2)
    assert all(np.isfinite(np.array(x)).all() for x in drawn.values())


def test_a_prior_of_cells_is_bayes() -> None:
    """Weights of bins multiply the probabilities."""
    samples, _ = simulate(48, 5, 0.3)
    rng = np.random.default_rng(0)
    weights = rng.uniform(0.1, 1, (8, 8, 8))
    # One channel, because channels are marginalised under the same weights.
    one = statistics(channels(samples, 1))
    plain = calibrated_posterior(one)
    posterior = calibrated_posterior(one, prior=plain.prior * weights)
    expected = np.array(plain.probabilities, np.float64) * weights
    expected /= expected.sum(axis=(1, 2, 3), keepdims=True)
    assert np.abs(np.array(posterior.probabilities) - expected).max() < 1e-4
    weights[:2], weights[:, :, 5:] = 0, 0
    posterior = calibrated_posterior(statistics(samples), prior=weights)
    p = np.array(posterior.probabilities)
    assert np.all(p[:, :2] == 0)
    assert np.all(p[:, :, :, 5:] == 0)
    assert np.allclose(p.sum(axis=(1, 2, 3)), 1, atol=1e-5)
    for name, most in (("base_color", 4.5 / 7), ("roughness", 1.0)):
        mean = np.array(posterior.mean(name))
        assert np.isfinite(mean).all()
        assert mean.max() <= most + 1e-6
    assert np.isfinite(np.array(posterior.entropy())).all()


@pytest.mark.slow
@pytest.mark.parametrize("careful", [True, False])
def test_shared_prior_matches_expectation_maximisation(careful: bool) -> None:
    """Compare with the prior that the oracle learns from the same texels, and their neighbours."""
    samples, smoothed = simulate(100, 12, 0.2)
    alone = calibrated_posterior(statistics(samples), preset=switches(bare_metals=0.0))
    options = {"tau": 3.5, "nu": 4, "r": PARTS[0], "m": PARTS[1]}
    given = samples.sums(), samples.w.sum(axis=1), np.full(100, 12)
    own, near = oracle.posterior(*given, **options), {}
    ends = np.array([-1e9, *(np.arange(7) + 0.5) / 7, 1e9])  # normals are cut off at 0 and 1
    for name, sd in own.sd.items():
        width = np.maximum(0.5 * sd, 0.03).reshape(100, -1)
        z = (ends[:, None, None] - smoothed[name].reshape(100, -1)) / width
        near[name] = np.diff(stats.norm.cdf(z), axis=0)  # (K, T, C)
    likely = np.einsum("rt,mt,ktc->trmkc", near["roughness"][..., 0], near["metallic"][..., 0],
                       near["base_color"])  # fmt: skip
    rounds, otherwise, power = (1, 0.1, 0.8) if careful else (2, 1e-3, 1.3)
    prior = oracle.common_prior(
        *given, alone.prior, rounds=rounds, sharpness=power, otherwise=otherwise,
        likely=likely + 1e-30 if careful else 1.0, **options,
    )  # fmt: skip
    truth = oracle.posterior(*given, prior=prior, **options)
    shared = empirical_bayes.with_empirical_prior(alone, smoothed if careful else None)
    np.testing.assert_allclose(shared.prior, prior.mean(axis=-1), atol=2e-5)
    assert np.abs(np.array(shared.probabilities) - truth.cells).max() < 2e-4
    for name in ("roughness", "metallic"):
        assert np.abs(np.array(shared.mean(name)) - truth.mean[name]).max() < 2e-4, name
        assert np.abs(np.array(shared.sd(name)) - truth.sd[name]).max() < 2e-4, name


@pytest.mark.parametrize(("views", "noise", "materials", "parts"), [
    (8, 0.25, 2, (0.7, 0.7, 0.9)), (12, 0.1, None, (1.2, 1.2, 1.2)),
])  # fmt: skip
def test_shared_prior_separates_materials(views, noise, materials, parts) -> None:
    """A few views determine a texel poorly, but many texels determine two materials.

    For parameters sampled from the prior, the prior learned from 600 texels is noisy.
    """
    samples, truth = simulate(600, views, noise, materials=materials)
    alone = calibrated_posterior(statistics(samples))
    shared = empirical_bayes.with_empirical_prior(alone)
    for name, part in zip(("metallic", "roughness", "base_color"), parts, strict=True):
        error = [((np.array(p.mean(name)) - truth[name]) ** 2).mean() for p in (alone, shared)]
        assert error[1] < part * error[0], name
    if materials:
        assert np.array(shared.entropy()).mean() < np.array(alone.entropy()).mean()


def test_the_colour_of_a_row_is_one_that_its_prior_allows() -> None:
    """Where the prior has gaps, the mean can be a colour that the prior excludes."""
    samples, _ = simulate(7, 5, 0.1, seed=619)
    rng = np.random.default_rng(620)
    prior = rng.random((8, 8, 8)) * (rng.random((8, 8, 8)) < 0.4)
    posterior = calibrated_posterior(statistics(samples), prior=prior)
    p, edges = (
        np.array(posterior.probabilities).reshape(7, 64, 8, 3),
        posterior.kernel.problem.edges,
    )
    colors = row_colors(p, edges)
    middle = (edges[1:] + edges[:-1]) / 2
    mean = np.einsum("trkc,k->trc", p, middle) / np.maximum(p.sum(axis=2), 1e-30)
    moved = np.abs(colors - mean) > 1e-6
    assert moved.any() and not moved.all()
    cell = np.clip(np.searchsorted(edges, colors, "right") - 1, 0, 7)
    some = prior.reshape(64, 8).any(axis=1)
    assert (np.take_along_axis(p, cell[:, :, None], axis=2) > 0)[:, some].mean() > 0.99
    masses, same = posterior.kernel.rows(np.arange(7))
    assert np.allclose(same, colors, atol=1e-6)
    masses = masses / masses.sum(axis=1, keepdims=True)
    assert np.allclose(masses, p[..., 0].sum(axis=2), atol=1e-6)


def test_known_parameters_leave_the_grid() -> None:
    samples, _ = simulate(200, 12, 0.05)
    for known in ({"metallic": 1.0}, {"base_color": 0.4}, {"roughness": 0.5}):
        grid = svu.PrincipledGrid(known=known)
        levels = LEVELS if "roughness" not in known else np.array([0.5])
        table = samples.sums()
        if "roughness" in known:
            table = table[[4]]
        source = Statistics.of(table, samples.w.sum(axis=1), np.full(200, 12), levels, 0.5)
        posterior = calibrated_posterior(source, grid)
        ((name, value),) = known.items()
        assert np.allclose(np.array(posterior.mean(name)), value)
        assert np.allclose(np.array(posterior.sd(name)), 0, atol=1e-3)
        entropy = np.array(posterior.entropy())
        assert np.isfinite(entropy).all()
        assert 0 < entropy.mean() < 1
        drawn = posterior.draw(1)
        assert np.allclose(np.array(drawn[name]), value)


def test_equal_channels_may_stand_for_three() -> None:
    samples, _ = simulate(64, 8, 0.1)
    short = calibrated_posterior(statistics(channels(samples, 1)), copies=3)
    full = calibrated_posterior(statistics(channels(samples, 3)))
    assert np.abs(np.array(short.entropy()) - np.array(full.entropy())).max() < 2e-5
    assert np.abs(np.array(short.probabilities) - np.array(full.probabilities)).max() < 1e-5
    for end, other in zip(short.interval("base_color"), full.interval("base_color"), strict=True):
        assert np.allclose(np.array(end), np.array(other))


def test_metals_are_a_switch() -> None:
    samples, _ = simulate(64, 8, 0.1)
    posterior = calibrated_posterior(statistics(samples), preset=switches(metals=0.0))
    assert np.allclose(posterior.prior.sum(axis=(0, 2)), [1 / 14, *[1 / 7] * 6, 1 / 14])


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"scale": 0.0}, OptionError, "scale must be positive"),
        ({"prior": np.ones((2, 2))}, ShapeError, "prior must be"),
        ({"prior": -np.ones((8, 8, 8))}, OptionError, "non-negative"),
        ({"copies": 0}, OptionError, "copies"),
        ({"texels": 3}, OptionError, "texels greater than"),
    ],
)
def test_bad_arguments(options: dict[str, object], error: type[Exception], words: str) -> None:
    samples, _ = simulate(8, 4, 0.1)
    with pytest.raises(error, match=words):
        calibrated_posterior(statistics(samples), **options)


def test_bad_questions(setting: tuple[svu.Posterior, oracle.Truth]) -> None:
    posterior, _ = setting
    with pytest.raises(OptionError, match="unknown parameter 'colour'"):
        posterior.mean("colour")
    for level in (0, 1, -0.1, float("nan")):
        with pytest.raises(OptionError, match="level must be in"):
            posterior.interval("roughness", level)
    with pytest.raises(OptionError, match="count must be a whole number >= 1"):
        posterior.draw(0)
    with pytest.raises(OptionError, match="seed must be a whole number >= 0"):
        posterior.draw(1, seed=-1)


def test_grids_answer_the_same_questions(setting: tuple[svu.Posterior, oracle.Truth]) -> None:
    """All posteriors provide means, standard deviations, intervals and draws."""
    samples, _ = simulate(32, 8, 0.2)
    at_nodes = replace(statistics(samples), roughness=np.linspace(0, 1, 8))
    posterior = svu.angular_posterior(at_nodes, preset=switches(noise="relative"))
    p = np.array(posterior.probabilities, np.float64)
    nodes = np.arange(8) / 7
    marginal = p[..., 0].sum(axis=(2, 3))
    mean = marginal @ nodes
    assert np.allclose(np.array(posterior.mean("roughness")), mean, atol=1e-6)
    sd = np.sqrt(np.maximum(marginal @ nodes**2 - mean**2, 0))
    assert np.allclose(np.array(posterior.sd("roughness")), sd, atol=3e-4)
    edges = np.concatenate([[0], (np.arange(7) + 0.5) / 7, [1]])
    low, high = (np.array(end) for end in posterior.interval("roughness", 0.8))
    for t in range(32):
        i, j = np.abs(edges - low[t]).argmin(), np.abs(edges - high[t]).argmin()
        assert marginal[t, i:j].sum() >= 0.8 - 1e-5
    drawn = np.array(posterior.draw(3000, seed=2)["roughness"])
    assert np.abs(drawn.mean(axis=0) - mean).max() < 0.04
    assert set(np.unique(drawn.round(4))) <= set(nodes.round(4).astype(np.float32))


@pytest.mark.parametrize("order", [(2, 40), (40, 2), (9, 12)])
def test_grids_of_one_process_do_not_share_memory(order: tuple[int, int]) -> None:
    """Local memory of another size compiles another kernel; otherwise the process would crash."""
    samples, _ = simulate(16, 6, 0.2)
    for metallic in order:
        grid = svu.PrincipledGrid(4, metallic, 3)
        posterior = calibrated_posterior(statistics(samples), grid)
        p = np.array(posterior.probabilities, np.float64)
        q = posterior.prior
        nats = -(p * np.log(np.maximum(p, 1e-300))).sum(axis=(1, 2, 3)).mean(axis=-1)
        exact = np.clip(nats / -(q * np.log(q)).sum(), 0, 1)
        assert np.abs(np.array(posterior.entropy()) - exact).max() < 1e-5


@pytest.mark.slow
@pytest.mark.parametrize("small", [0.0, 1e-30])
def test_a_prior_may_contradict_the_photographs(small: float) -> None:
    """The prior only allows white, which contradicts the likelihood by hundreds of nats."""
    samples, _ = simulate(64, 20, 0.02)
    weights = np.full((8, 8, 8), small)
    weights[..., 7] = 1
    posterior = calibrated_posterior(statistics(samples), prior=weights)
    p = np.array(posterior.probabilities, np.float64)
    assert np.allclose(p.sum(axis=(1, 2, 3)), 1, atol=1e-5)
    mean = np.array(posterior.mean("base_color"))
    assert np.all(mean > 13 / 14 - 1e-6 if small == 0 else mean > 0)
    for name in ("roughness", "metallic", "base_color"):
        low, high = (np.array(end) for end in posterior.interval(name))
        assert np.all(low < high)
    drawn = np.array(posterior.draw(3)["base_color"])
    assert np.isfinite(drawn).all()
    if small == 0:
        assert drawn.min() >= 13 / 14 - 1e-6


def test_draws_of_grey_light_have_three_channels() -> None:
    samples, _ = simulate(16, 6, 0.2)
    one = statistics(channels(samples, 1))
    for known in ({}, {"base_color": 0.5}):
        posterior = calibrated_posterior(one, svu.PrincipledGrid(known=known), copies=3)
        assert posterior.draw(5)["base_color"].shape == (5, 16, 3)


@pytest.mark.slow
def test_prior_of_one_bin_has_entropy_0() -> None:
    samples, _ = simulate(8, 6, 0.2)
    weights = np.zeros((8, 8, 8))
    weights[3, 0, 5] = 1
    posterior = calibrated_posterior(statistics(samples), prior=weights, texels=9)
    entropy = np.array(posterior.entropy())
    assert np.all(entropy[:8] == 0)
    assert entropy[8] == 1
    low, high = (np.array(end) for end in posterior.interval("roughness"))
    assert np.allclose([low[8], high[8]], [2.5 / 7, 3.5 / 7])
    drawn = posterior.draw(50, seed=3)
    unseen = np.array(drawn["roughness"])[:, 8]
    assert np.all((unseen >= 2.5 / 7) & (unseen <= 3.5 / 7))
    assert np.array_equal(np.array(posterior.draw(2, seed=3)["roughness"])[:, 8], unseen[:2])


@pytest.mark.parametrize("levels", [[0.2, 1.0], [0.0, 0.1, 0.5, 1.0], [0.3], [0.0, 0.5, 1.0]])
def test_levels_that_cannot_be_interpolated_are_refused(levels: list[float]) -> None:
    samples, _ = simulate(8, 4, 0.1)
    table = samples.sums()[: len(levels)]
    source = Statistics.of(table, samples.w.sum(axis=1), np.full(8, 4), np.array(levels), 0.5)
    with pytest.raises(ShapeError, match=r"at least 4 levels of roughness_levels"):
        calibrated_posterior(source)


def test_unseen_texels_have_the_moments_of_the_prior() -> None:
    samples, _ = simulate(8, 6, 0.2)
    for nodes in (2, 8):
        grid = svu.PrincipledGrid(nodes, nodes, nodes)
        posterior = calibrated_posterior(statistics(samples), grid, texels=2000)
        assert np.array(posterior.sd("roughness"))[-1] == pytest.approx(12**-0.5, abs=1e-3)
        assert np.array(posterior.sd("metallic"))[-1] == pytest.approx(
            (0.8 / 4 + 0.2 / 12) ** 0.5, abs=0.02
        )
        drawn = np.array(posterior.draw(1)["roughness"])[0, 8:]
        assert stats.kstest(drawn, "uniform").pvalue > 1e-3


@pytest.mark.slow
def test_draws_obey_a_prior_of_colours() -> None:
    samples, _ = simulate(32, 1, 0.5)
    weights = np.zeros((8, 8, 8))
    weights[..., 4:6] = [1, 3]
    posterior = calibrated_posterior(statistics(samples), prior=weights)
    drawn = np.array(posterior.draw(300, seed=1)["base_color"])
    assert drawn.min() >= 3.5 / 7 - 1e-6
    assert drawn.max() <= 5.5 / 7 + 1e-6
    p = np.array(posterior.probabilities, np.float64).sum(axis=(1, 2))
    assert np.abs((drawn > 4.5 / 7).mean(axis=0) - p[:, 5]).max() < 0.12
    assert np.abs(drawn.mean(axis=0) - np.array(posterior.mean("base_color"))).max() < 0.03
