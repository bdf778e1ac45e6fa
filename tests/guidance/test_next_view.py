"""Capture guidance: Eq. 13 against brute force, greedy choice, and what it is good for."""

from __future__ import annotations

import dataclasses
import itertools
from functools import cache
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from oracle import guidance as oracle
from scipy import stats
from support.helpers import launched_kernels, render_ball, unit_vectors

import svu_mi as svu
from svu_mi import scenes
from svu_mi.capture.scene import to_world
from svu_mi.capture.sensors import directions_of, sphere_sensors
from svu_mi.core.arrays import to_drjit
from svu_mi.core.local_memory import padded_to_quads
from svu_mi.errors import OptionError
from svu_mi.guidance import guidance_result, strategies, strategy_inputs
from svu_mi.guidance.angular_forecast import AngularForecast
from svu_mi.guidance.forecast import Hypotheses
from svu_mi.guidance.greedy import GROWTH, GreedyScorer
from svu_mi.guidance.growing_band_limit import GrowingForecast
from svu_mi.guidance.objectives import Colors, EntropyMeasure, VarianceMeasure, prior_tables
from svu_mi.guidance.predicted_responses import Responses
from svu_mi.guidance.spectral_forecast import SpectrumForecast
from svu_mi.guidance.strategies import STRATEGIES, TABLE
from svu_mi.guidance.strategy_inputs import StrategyInputs
from svu_mi.posterior.grid import ParameterGrid, PrincipledGrid
from svu_mi.posterior.quadrature import bin_edges
from svu_mi.presets import preset

SUN = {"type": "sunsky", "turbidity": 3.0, "sun_direction": [0.4, 0.8, 0.45]}
BASELINES = [name for name in STRATEGIES if not TABLE[name].needs_forecast]
LOW = 3  # degree, where kernels of the usual one do the same and take ten times as long to compile
# With .1, spectra under this sky contain almost no information.
SHARP = preset("paper", method="spectrum", sigma=1e-3)
PAINT = {"type": "principled", "base_color": {"type": "rgb", "value": [0.5, 0.3, 0.2]},
         "roughness": 0.4, "metallic": 0.0}  # fmt: skip


def responses_of(table: np.ndarray) -> Responses:
    """Responses that hold a table (V, T, K)."""
    _, count, columns = table.shape
    made = Responses.of(to_drjit(mi.Float, table[..., 0].ravel()), columns, count)
    rest = np.zeros((int((table[..., 0] > 0).sum()), padded_to_quads(columns - 1)), np.float32)
    rest[:, : columns - 1] = table[table[..., 0] > 0, 1:]
    return dataclasses.replace(made, rest=to_drjit(mi.Float, rest.ravel()))


def test_responses_of_texels_that_no_view_sees():
    responses = Responses.of(to_drjit(mi.Float, np.zeros(15, np.float32)), 7, 5)
    assert not responses.seen.any() and not responses.table().any()
    assert responses.table().shape == (3, 5, 7)
    assert not np.array(responses.read(mi.UInt32(2), 1)).any()


def power_of(samples: np.ndarray, switches: svu.Preset) -> np.ndarray:
    """S_L, fitted to samples (V, K) of the light."""
    samples = samples.astype(np.float64)
    return oracle.refitted_power(
        samples[:, 1:4], samples[:, 0], samples[:, 4:], switches.degree, switches.regularizer,
        switches.penalize_constant,
    )  # fmt: skip


def posteriors(rng: np.random.Generator, count: int, cells: int) -> np.ndarray:
    """Peaked and flat distributions (T, N)."""
    p = rng.dirichlet(np.full(cells, 0.2), count)
    p[0] = 1 / cells
    return p


def angular_forecast(
    rng: np.random.Generator, views: int, count: int, grid: PrincipledGrid, *,
    nodes: bool = True, channels: int = 1, lobes: int = 1, copies: int = 1, kappa: float = np.inf,
    averaged: bool = True, prior: np.ndarray | None = None, hypotheses: int = 4096,
    brightness: float = 1.5,
) -> tuple[AngularForecast, np.ndarray, np.ndarray]:  # fmt: skip
    """A forecast of random lobes; its table and the probabilities of its truths."""
    levels, metallic, cells = grid.shape
    table = rng.gamma(1.0, brightness, (views, count, 1 + 4 * levels * lobes)).astype(np.float32)
    table[..., 0] = rng.uniform(0.05, 1.0, (views, count))
    table *= rng.random((views, count, 1)) < 0.6
    p = posteriors(rng, count, levels * metallic)
    edges, axis = bin_edges(grid.base_color_nodes), grid.axes["base_color"]
    width = np.diff(edges) if cells > 1 else np.ones(1)
    if nodes:
        truths, width = rng.choice(axis, (count, levels * metallic, channels)), np.ones(cells)
    elif cells > 1:
        truths = rng.random((count, levels * metallic, channels))
    else:
        truths = np.full((count, levels * metallic, channels), axis[0])
    if prior is None:
        prior = np.ones((levels, metallic, 1)) * width
    prior = prior / prior.sum()
    rows, given = prior_tables(prior, width / width.sum())
    forecast = AngularForecast(
        responses=responses_of(table), prior=rows, grid=grid, kappa=kappa, averaged=averaged,
        truths=to_drjit(mi.Float, truths.ravel()), channels=channels,
        precision=to_drjit(mi.Float, rng.uniform(0.5, 1.5, count)),
        colors=Colors(edges, copies, given, axis if nodes else None),
        hypotheses=Hypotheses.draw(p, hypotheses, np.zeros(count)),
        measure=EntropyMeasure(float(np.log(np.prod(grid.shape)))),
    )  # fmt: skip
    return forecast, table.astype(np.float64), p


def angular_oracle(forecast, table, texel, views, prior=None):
    """The same forecast of one texel, by brute force, and its truths (R * M, C)."""
    grid, colors = forecast.grid, forecast.colors
    levels, metallic, cells = grid.shape
    seen = [v for v in views if table[v, texel, 0] > 0]
    if prior is None:
        width = np.ones(cells)
        if colors.nodes is None and cells > 1:
            width = np.diff(bin_edges(grid.base_color_nodes))
        prior = np.ones((levels * metallic, 1)) * width
    exact = oracle.Angular(
        lobes=table[seen, texel, 1:].reshape(len(seen), levels, -1, 4),
        metallic=grid.axes["metallic"], prior=(prior / prior.sum()).reshape(-1, cells),
        precision=float(forecast.precision.numpy()[texel]), kappa=forecast.kappa,
        averaged=forecast.averaged, copies=colors.copies,
        colors=grid.axes["base_color"] if cells == 1 else colors.nodes,
    )  # fmt: skip
    shape = (-1, levels * metallic, forecast.channels)
    return exact, forecast.truths.numpy().reshape(shape)[texel].astype(np.float64)


def exact_entropy(forecast, table, p, views, texel, prior=None):
    exact, truths = angular_oracle(forecast, table, texel, views, prior)
    total = sum(w * exact.entropy(row, truths[row]) for row, w in enumerate(p[texel]) if w > 0)
    return total / np.log(np.prod(forecast.grid.shape))


GRIDS = {
    "cube": PrincipledGrid(4, 3, 5),
    "8 x 8": PrincipledGrid(8, 8, 8, known={"metallic": 0.0}),
    "known colour": PrincipledGrid(3, 6, 8, known={"base_color": 0.4}),
}
RULES = {  # of colours, and how errors of views combine
    "at nodes, averaged": {},
    "in colour, added": {"nodes": False, "channels": 3, "lobes": 3, "averaged": False,
                         "kappa": 2.0},
    "grey light": {"nodes": False, "channels": 3, "averaged": False},
    "all grey": {"nodes": False, "copies": 3, "averaged": False, "brightness": 0.5},
}  # fmt: skip


class TestAngular:
    @pytest.mark.few(3)
    @pytest.mark.parametrize(("name", "rule"), [
        *(("cube", rule) for rule in RULES), ("8 x 8", "grey light"),
        ("known colour", "in colour, added"),
    ])  # fmt: skip
    def test_equals_brute_force(self, name, rule):
        rng, grid = np.random.default_rng(1), GRIDS[name]
        forecast, table, p = angular_forecast(rng, 7, 19, grid, **RULES[rule])
        views, candidates = np.arange(4), np.array([6, 4, 5])
        now = forecast.current(views)
        texels = np.array([0, 3, 12])
        expected = forecast.expected(views, candidates, texels)
        near = 1e-4  # the oracle's quadrature of colours
        for t in texels:
            seen = table[:4, t, 0].any()
            before = exact_entropy(forecast, table, p, range(4), t) if seen else 1.0
            assert now[t] == pytest.approx(before, abs=near)
        for (a, v), (i, t) in [(x, y) for x in enumerate(candidates) for y in enumerate(texels)]:
            if table[v, t, 0] == 0:
                assert np.isnan(expected[a, i])
            else:
                exact = exact_entropy(forecast, table, p, [*range(4), v], t)
                assert expected[a, i] == pytest.approx(exact, abs=near)

    @pytest.mark.parametrize("averaged", [True, False])
    def test_prior_and_noise_that_grows(self, averaged):
        rng, grid = np.random.default_rng(2), GRIDS["cube"]
        prior = rng.dirichlet(np.ones(60)).reshape(grid.shape) + 1e-3
        forecast, table, p = angular_forecast(
            rng, 5, 6, grid, kappa=1 / 0.7, prior=prior, averaged=averaged, nodes=averaged
        )
        expected = forecast.expected(np.arange(3), np.array([3, 4]), np.arange(6))
        for a, v in enumerate((3, 4)):
            for t in np.flatnonzero(table[v, :, 0]):
                exact = exact_entropy(forecast, table, p, [0, 1, 2, v], t, prior)
                assert expected[a, t] == pytest.approx(exact, abs=1e-4)

    @pytest.mark.parametrize("rule", ["at nodes, averaged", "in colour, added"])
    def test_expected_error(self, rule):
        rng, grid = np.random.default_rng(6), GRIDS["cube"]
        forecast, table, p = angular_forecast(rng, 5, 8, grid, **RULES[rule])
        present, prior = (0.1, 0.05, 0.02), (0.14, 0.17, 0.125)
        measure = VarianceMeasure(present, prior, forecast.channels)
        errors = dataclasses.replace(forecast, measure=measure)
        axes = (grid.axes["roughness"], grid.axes["metallic"])
        values = np.stack([x.ravel() for x in np.meshgrid(*axes, indexing="ij")], axis=1)
        expected = errors.expected(np.arange(3), np.array([3, 4]), np.arange(8))
        now = errors.current(np.arange(3))
        for t in range(8):
            for views, got in (([0, 1, 2], now[t]), ([0, 1, 2, 3], expected[0, t])):
                if np.isnan(got) or not table[views, t, 0].any():
                    continue
                exact, truths = angular_oracle(forecast, table, t, views)
                spread = sum(
                    w * exact.variance(row, truths[row], values) for row, w in enumerate(p[t])
                )
                assert got == pytest.approx((spread / present).sum(), rel=1e-3, abs=1e-5)
        unseen = ~(table[:3, :, 0] > 0).any(axis=0)
        assert (now[unseen] == np.float32(1.4 + 3.4 + 6.25)).all()

    @pytest.mark.parametrize("rule", ["at nodes, averaged", "in colour, added"])
    def test_bright_light_leaves_no_nan_and_the_truth_its_place(self, rule):
        rng, grid = np.random.default_rng(3), GRIDS["cube"]
        forecast, table, p = angular_forecast(rng, 4, 5, grid, **RULES[rule])
        bright = np.where(np.arange(table.shape[-1]) > 0, 1e6, 1) * table.astype(np.float32)
        blinding = dataclasses.replace(forecast, kappa=np.inf, responses=responses_of(bright))
        expected = blinding.expected(np.arange(3), np.array([3]), np.arange(5))
        seen = table[3, :, 0] > 0
        # Everything is told apart, but for cells that are the same whatever the light.
        assert np.isfinite(expected[0, seen]).all() and (expected[0, seen] < 0.2).all()


class TestRankOne:
    """Must show 1: a fit with one more sample is the fit from scratch."""

    @pytest.mark.few(1)
    @pytest.mark.parametrize("switches", [
        preset("paper", method="spectrum", degree=LOW, sigma=0.02, regularizer=1e-2),
        preset("default", method="spectrum", degree=LOW, parameters="specular", sigma=0.05),
    ])  # fmt: skip
    def test_expected_entropy_equals_brute_force(self, switches):
        rng, count, views = np.random.default_rng(5), 9, 8
        grid = ParameterGrid(3, 4).resolved(switches)
        directions = unit_vectors(rng, views, count)
        light = rng.gamma(1.0, 0.3, (views, count, switches.colors))
        table = np.concatenate([np.abs(directions[..., 2:]), directions, light], axis=2)
        table *= rng.random((views, count, 1)) < 0.7
        table = table.astype(np.float32)
        p = posteriors(rng, count, 12)
        forecast = SpectrumForecast(
            responses=responses_of(table), prior=None,
            hypotheses=Hypotheses.draw(p, 12, np.zeros(count)), grid=grid,
            switches=switches, sigma=switches.sigma, prefilter=0.0,
            measure=EntropyMeasure(float(np.log(12))),
        )  # fmt: skip
        alphas = grid.roughness_nodes**2
        alphas = np.maximum(alphas, 1e-3) if switches.bounded_alpha else alphas

        def exact(chosen, t):
            rows = [v for v in chosen if table[v, t, 0] > 0]
            S_L = power_of(table[rows, t], switches)
            return oracle.expected(
                p[t], oracle.spectrum_distances(S_L, alphas, grid.specular_nodes, switches.sigma)
            )

        known, candidates = np.arange(4), np.array([4, 5, 6, 7])
        now = forecast.current(known)
        expected = forecast.expected(known, candidates, np.arange(count))
        for t in range(count):
            if table[:4, t, 0].any():
                assert now[t] == pytest.approx(exact(range(4), t), abs=2e-5)
            for a, v in enumerate(candidates):
                if table[v, t, 0] > 0:
                    assert expected[a, t] == pytest.approx(exact([*range(4), v], t), abs=2e-5)


class TestGrowing:
    """Eq. 13 as printed: light that is sharper with every view, truths as likely as it says."""

    PHOTOGRAPHS, VIEWS, COUNT = 3, 8, 11

    def case(self, switches, prior=None, seed=5):
        """A forecast on a grid of 3 x 4; its table (V, T, K) for a number of views, S_B of the
        texels that photographs show, and alpha and Ks of the grid."""
        rng, grid = np.random.default_rng(seed), ParameterGrid(3, 4).resolved(switches)
        shape, colors = (self.VIEWS, self.COUNT), switches.colors
        directions = unit_vectors(rng, *shape)
        seen = rng.random((*shape, 1)) < 0.7
        seen[:5, 0] = False  # first seen by a candidate
        seen[: self.PHOTOGRAPHS, 1] = False
        seen[5, :2] = True
        light = rng.gamma(1.0, 0.3, (*shape, colors))
        shown = rng.gamma(1.0, 0.02, (self.COUNT, switches.degree + 1, colors)).astype(np.float32)

        def table(views):
            sharp = light * (1 + 0.2 * views * np.sin(np.arange(light.size)).reshape(light.shape))
            whole = np.concatenate([np.abs(directions[..., 2:]), directions, sharp], axis=2)
            return (whole * seen).astype(np.float32)

        observed = seen[: self.PHOTOGRAPHS, :, 0].any(axis=0)
        cells = np.ones((self.COUNT, 12)) if prior is None else np.tile(prior, (self.COUNT, 1))
        energies = None
        if prior is not None:
            energies = to_drjit(mi.Float, np.minimum(-np.log(np.maximum(prior, 1e-300)), 1e4))
        unseen = 1.0 if prior is None else oracle.entropy(np.zeros(12), prior)
        forecast = GrowingForecast(
            responses=responses_of(table(0)), hypotheses=Hypotheses.of(cells), grid=grid,
            prior=energies, measure=EntropyMeasure(float(np.log(12)), unseen), switches=switches,
            sigma=switches.sigma, prefilter=0.0,
            photographs=to_drjit(mi.Float, shown.ravel()), observed=to_drjit(mi.Bool, observed),
            relight=lambda views: (responses_of(table(views)), 0.0),
        )  # fmt: skip
        alphas = grid.roughness_nodes**2
        alphas = np.maximum(alphas, 1e-3) if switches.bounded_alpha else alphas
        return forecast, table, shown, observed, (alphas, grid.specular_nodes)

    def exact(self, case, switches, chosen, views, t, prior=None):
        """E[H] of a texel from some views, in the light for a number of views."""
        _, table, shown, observed, nodes = case
        rows = [v for v in chosen if table(views)[v, t, 0] > 0]
        if not rows:
            return 1.0 if prior is None else oracle.entropy(np.zeros(12), prior)
        S_L = power_of(table(views)[rows, t], switches)
        S_B = shown[t].astype(np.float64) if observed[t] else None
        return oracle.printed(S_B, S_L, *nodes, switches.sigma, prior)

    @pytest.mark.few(2)
    @pytest.mark.parametrize("weights", [None, "prior"])
    @pytest.mark.parametrize("switches", [
        preset("paper", method="spectrum", degree=LOW, sigma=0.02, regularizer=1e-2),
        preset("paper", method="spectrum", degree=LOW, sigma=1e-4),
        preset("default", method="spectrum", degree=LOW, parameters="specular", sigma=0.05),
    ])  # fmt: skip
    def test_equals_the_equation_step_by_step(self, switches, weights):
        """All of the greedy loop: before, with each candidate, and again in sharper light."""
        prior = None
        if weights is not None:
            prior = np.random.default_rng(3).random(12) * (np.arange(12) % 5 > 0)
            prior /= prior.sum()
        case, taken = self.case(switches, prior), list(range(self.PHOTOGRAPHS))
        forecast, near = case[0], {"abs": 1e-5}
        greedy = GreedyScorer(forecast, self.PHOTOGRAPHS)
        assert not case[3].all()
        for _ in range(3):
            views, gains = len(taken) + 1, greedy.scores()
            before = [self.exact(case, switches, taken, views, t, prior) for t in range(self.COUNT)]
            np.testing.assert_allclose(greedy.entropy, before, atol=1e-5)
            for candidate in set(range(self.VIEWS)) - set(taken):
                gain = greedy.information_gain(candidate - self.PHOTOGRAPHS)
                for t in range(self.COUNT):
                    after = before[t]
                    if forecast.seen[candidate, t]:
                        after = self.exact(case, switches, [*taken, candidate], views, t, prior)
                    assert gain[t] == pytest.approx(before[t] - after, **near)
                assert gains[candidate - self.PHOTOGRAPHS] == pytest.approx(gain.mean(), **near)
            best = int(np.argmax(gains))
            greedy.choose(best)
            taken.append(self.PHOTOGRAPHS + best)

    def test_truths_equal_the_posterior_in_the_light_of_photographs(self, sunny):
        """What they are weighed by is what the estimate has, if the light is the same."""
        capture, texels = sunny
        used = (0, 3, 5, 9)
        estimate = svu.estimate(some(capture, used), texels, "spectrum", SHARP)
        around = svu.Candidates.at(capture, [1, 2])
        forecast = inputs_of(estimate, around, band_limit="growing").forecast
        same = inputs_of(estimate, around, hypotheses=64, band_limit="photographs").forecast
        assert isinstance(forecast, GrowingForecast)
        four, _ = forecast.relight(4)
        np.testing.assert_array_equal(four.table(), same.responses.table())
        lit = dataclasses.replace(forecast, relight=lambda views: forecast.relight(views - 1))
        exact = same.current(np.arange(4))
        np.testing.assert_allclose(lit.current(np.arange(4)), exact, atol=1e-4)
        assert np.abs(forecast.current(np.arange(4)) - exact).max() > 1e-3

    def test_refused(self, estimated):
        estimate = estimated(0, 1)
        for strategy in ("entropy", "coverage"):
            with pytest.raises(svu.SvuError, match="growing' needs power spectra"):
                svu.next_best_view(estimate, band_limit="growing", strategy=strategy)
        spectra = estimated(0, 1, method="spectrum")
        with pytest.raises(svu.SvuError, match="parameters='specular'"):
            svu.next_best_view(spectra, band_limit="growing")
        with pytest.raises(svu.SvuError, match="band_limit must be one of"):
            svu.GuidanceOptions(band_limit="sharp")


class TestHypotheses:
    def test_draws_are_within_one_of_their_share_and_unbiased(self):
        p = posteriors(np.random.default_rng(1), 4, 100)
        total = np.zeros_like(p)
        for seed in range(400):
            drawn = Hypotheses.draw(p, 10, np.full(4, seed / 400))
            counts = drawn.counts.numpy()
            cells = drawn.bins.numpy().reshape(-1, 4)
            weights = drawn.weights.numpy().reshape(-1, 4)
            for t in range(4):
                shares = weights[: counts[t], t]
                assert shares.sum() == pytest.approx(1, abs=1e-6)
                exact = 10 * p[t, cells[: counts[t], t]]
                assert (np.abs(10 * shares - exact) < 1 + 1e-5).all()
                total[t, cells[: counts[t], t]] += shares / 400
        assert np.abs(total - p).max() < 0.02


class GrowingGains:
    """A forecast of one texel, that one photograph and four candidates see, some of which are worth
    more with every view."""

    first, growth = np.array([1, 0.9, 0.885, 0.8]), np.array([1, 1.08, 1, 1.08])

    def __init__(self, is_separable):
        self.is_separable, self.seen = is_separable, np.ones((5, 1), bool)

    def current(self, views):
        chosen = enumerate(np.asarray(views)[1:] - 1)
        return np.array([10 - sum(self.gain(number, step) for step, number in chosen)])

    def expected(self, views, candidates, texels):
        assert texels.tolist() == [0]
        gains = [self.gain(number, len(views) - 1) for number in candidates - 1]
        return self.current(views)[None] - np.array(gains)[:, None]

    def gain(self, number, step):
        return self.first[number] * self.growth[number] ** step


class TestGreedy:
    def forecast(self, seed=4, views=14, count=60):
        rng = np.random.default_rng(seed)
        return angular_forecast(rng, views, count, GRIDS["cube"], hypotheses=6)[0]

    def test_only_changed_pairs_are_evaluated_again(self):
        forecast, taken = self.forecast(), [0, 1, 2]
        greedy = GreedyScorer(forecast, 3)
        for _ in range(5):
            gains = greedy.scores()
            before, exact = forecast.current(np.array(taken)), np.full(11, -np.inf)
            free = [c for c in range(11) if 3 + c not in taken]
            expected = forecast.expected(np.array(taken), 3 + np.array(free), np.arange(60))
            change = np.where(np.isfinite(expected), before - expected, 0).mean(axis=1)
            exact[free] = change
            np.testing.assert_allclose(gains, exact, atol=1e-6)
            best = int(np.argmax(gains))
            greedy.choose(best)
            taken.append(3 + best)
            np.testing.assert_allclose(greedy.entropy, forecast.current(np.array(taken)), atol=1e-6)
        pairs = int(forecast.seen[3:].sum())
        assert greedy.evaluated < 5 * pairs

    def test_lazy_chooses_the_same_and_evaluates_less(self, monkeypatch):
        monkeypatch.setattr("svu_mi.guidance.greedy.BATCH", 2)
        chosen, evaluated = [], []
        for lazy in (False, True):
            greedy = GreedyScorer(self.forecast(views=40, count=200), 3, lazy=lazy)
            order = []
            for _ in range(6):
                order.append(int(np.argmax(greedy.scores())))
                greedy.choose(order[-1])
            chosen.append(order)
            evaluated.append(greedy.evaluated)
        assert chosen[0] == chosen[1]
        assert evaluated[1] < evaluated[0]

    @pytest.mark.parametrize(("growth", "is_separable", "third"), [
        (0.1, True, 3), (0.0, True, 2), (0.0, False, 3),
    ])  # fmt: skip
    def test_gains_that_grow_with_every_view(self, monkeypatch, growth, is_separable, third):
        """Candidate 3 is the third best, but was below the second when it was last looked at."""
        monkeypatch.setattr("svu_mi.guidance.greedy.BATCH", 1)
        monkeypatch.setattr("svu_mi.guidance.greedy.GROWTH", growth)
        greedy = GreedyScorer(GrowingGains(is_separable), 1, lazy=True)
        order = []
        for _ in range(3):
            order.append(int(np.argmax(greedy.scores())))
            greedy.choose(order[-1])
        assert order == [0, 1, third]

    def test_a_candidate_that_sees_nothing_gains_nothing(self):
        forecast = self.forecast()
        table = forecast.responses.table().copy()
        table[5] = 0
        greedy = GreedyScorer(dataclasses.replace(forecast, responses=responses_of(table)), 3)
        assert greedy.scores()[2] == 0

    def test_nothing_seen_so_far(self):
        greedy = GreedyScorer(self.forecast(), 0)
        assert (greedy.entropy == 1).all()
        assert (greedy.scores() > 0).all()


class TestBaselines:
    def test_farthest(self):
        d = unit_vectors(np.random.default_rng(0), 30)
        strategy, taken = strategies.FarthestScorer(d, 4), list(range(4))
        for _ in range(6):
            best = int(np.argmax(strategy.scores()))
            angles = np.arccos(np.clip(d @ d[taken].T, -1, 1)).min(axis=1)
            assert 4 + best == int(np.argmax(angles))
            assert strategy.scores()[best] == pytest.approx(angles.max())
            strategy.choose(best)
            taken.append(4 + best)
        assert strategies.farthest(d, range(4), 6) == taken
        assert sorted(strategies.farthest(d, [7], 99)) == list(range(30))

    def test_coverage_prefers_what_few_views_see(self):
        seen = np.zeros((4, 10), bool)
        seen[0, :6] = True  # photographed
        seen[1, :5], seen[2, 6:], seen[3, 4:8] = True, True, True
        strategy = strategies.CoverageScorer(seen, 1)
        np.testing.assert_allclose(strategy.scores(), [0.25, 0.4, 0.3])
        strategy.choose(1)
        np.testing.assert_allclose(strategy.scores()[[0, 2]], [0.25, 0.2])

    def test_random_is_a_permutation_that_a_seed_fixes(self):
        a, b = strategies.RandomScorer(20, 3).scores(), strategies.RandomScorer(20, 4).scores()
        assert sorted(a) == list(range(20)) and (a == strategies.RandomScorer(20, 3).scores()).all()
        assert (a != b).any()


@pytest.fixture(scope="module")
def sunny(tmp_path_factory):
    """A ball under a clear sky: 20 photographs from all sides, and its texels."""
    capture = render_ball(tmp_path_factory.mktemp("sunny"), SUN, PAINT, views=20, spp=16)
    return capture, svu.texels(capture.mesh, (48, 24))


def some(capture, used):
    """The capture, of which only some views are photographed."""
    flags = tuple(i in used for i in range(capture.count))
    return dataclasses.replace(capture, used=flags)


@pytest.fixture(scope="module")
def estimated(sunny):
    """Estimates from some of the photographs, each made once."""
    capture, texels = sunny

    @cache
    def of(*used, method="angular", preset="default"):
        return svu.estimate(some(capture, used), texels, method, preset)

    return of


def inputs_of(estimate, candidates, **options):
    """Candidates and all texels of an estimate."""
    texels = np.arange(estimate.texels.count)
    options = svu.GuidanceOptions(**options)
    return StrategyInputs(estimate, estimate.observed, candidates, texels, options)


class TestNextBestView:
    @pytest.mark.few(1)
    @pytest.mark.parametrize("switches", [{}, {"method": "spectrum", "preset": "paper"}])
    def test_photographs_of_candidates_are_not_used(self, sunny, switches):
        capture, texels = sunny
        used = (0, 1, 2, 3)
        clean = some(capture, used)
        garbage = np.full_like(capture.images[0], np.nan)
        garbage[::2] = 1e9
        images = tuple(x if i in used else garbage for i, x in enumerate(capture.images))
        dirty = dataclasses.replace(clean, images=images, masks=tuple(
            None if i in used else np.zeros((64, 64), bool) for i in range(20)))  # fmt: skip
        both = [
            svu.next_best_view(
                svu.estimate(c, texels, **switches), svu.Candidates.without_photograph(c), 3
            )
            for c in (clean, dirty)
        ]
        assert both[0].candidates.count == 16
        np.testing.assert_array_equal(both[0].scores, both[1].scores)
        assert [p.name for p in both[0].proposals] == [p.name for p in both[1].proposals]

    @pytest.mark.slow
    def test_visibility_of_candidates_equals_that_of_photographs(self, sunny, estimated):
        capture, texels = sunny
        whole = svu.estimate(capture, texels)
        around = svu.Candidates.at(capture, range(1, 20))
        known = inputs_of(estimated(0), around, hypotheses=1, strategy="coverage")
        assert (known.seen == known.forecast.seen).all()  # by rays alone, and as forecasts have it
        every = known.forecast
        bits, lanes = whole.observed.visibility.bits, dr.arange(mi.UInt32, texels.count)
        exact = np.stack([np.array(bits.test(mi.UInt32(v), lanes)) for v in range(20)])
        assert (every.seen == exact).mean() > 0.999
        assert exact.sum() > 1000

    @pytest.mark.parametrize(("scores", "wrong"), [
        (lambda inputs: inputs.directions[:, 0], r"scores of shape \(8,\)"),  # of photographs, too
        (lambda inputs: inputs.directions[3:, 0] * np.nan, "NaN"),
    ])  # fmt: skip
    def test_wrong_scores_name_their_strategy(self, sunny, estimated, monkeypatch, scores, wrong):
        make = lambda inputs: SimpleNamespace(scores=lambda: scores(inputs))  # noqa: E731
        monkeypatch.setitem(TABLE, "coverage", strategies.GuidanceStrategy("texels", make))
        around = svu.Candidates.around(sunny[0], 5)
        with pytest.raises(OptionError, match=f"'coverage' returned {wrong}.* of the 5 candidates"):
            svu.next_best_view(estimated(0, 5, 9), around, strategy="coverage")

    def test_hidden_side_is_looked_at_first(self, sunny):
        """Must show 4."""
        capture, texels = sunny
        towards = np.array([to_world(s)[:3, 3] for s in capture.sensors])
        right = np.argsort(-towards[:, 0])[:4]
        spectra = preset(
            "default", method="spectrum", parameters="specular", penalize_constant=True
        )
        for method, named in (("angular", "default"), ("spectrum", spectra)):
            estimate = svu.estimate(some(capture, right), texels, method, named)
            unseen = float((np.array(estimate.coverage) == 0).mean())
            assert 0.3 < unseen < 0.7
            guidance = svu.next_best_view(estimate, svu.Candidates.around(capture, 40), 3)
            assert sum(p.new for p in guidance.proposals) > 0.7 * unseen
            sides = [to_world(p.sensor)[0, 3] for p in guidance.proposals]
            # One sample has hardly a spectrum: there, where the light is counts for more.
            assert max(sides) < 0 if method == "angular" else min(sides) < 0

    @pytest.mark.slow
    def test_gain_of_a_sample_equals_that_of_all_within_its_error(self, sunny, estimated):
        capture, texels = sunny
        plain = svu.preset("default", method="angular", bare_metals=0.0, metal_share=0.5)
        estimate = estimated(0, 5, 9, preset=plain)
        around = svu.Candidates.without_photograph(some(capture, (0, 5, 9)))
        every = svu.next_best_view(estimate, around, texels=10**6)
        assert every.proposals[0].error == 0
        assert every.skipped["texels not looked at"] == 0
        few = [svu.next_best_view(estimate, around, texels=300, seed=seed) for seed in range(20)]
        z = [
            (g.scores[p.candidate] - every.scores[p.candidate]) / p.error
            for g in few
            for p in g.proposals
        ]
        assert np.abs(z).max() < 4 and 0.4 < np.sqrt(np.mean(np.square(z))) < 1.5
        assert all(0 < g.proposals[0].error < 0.02 for g in few)

    @pytest.mark.slow
    def test_blocks_of_a_large_gain_map_have_the_gain_of_one_texel(
        self, sunny, estimated, monkeypatch
    ):
        _, texels = sunny
        guidance = svu.next_best_view(estimated(0, 5, 9), count=2)
        every = guidance.gain_maps()
        monkeypatch.setattr(guidance_result, "MAP_SIZE", 12)  # blocks of 4 x 4
        maps = dataclasses.replace(guidance).gain_maps()
        assert not np.array_equal(maps, every)
        row, column = np.divmod(texels.index.numpy(), 48)
        block = row // 4 * 12 + column // 4
        for values, exact in zip(maps, every, strict=True):
            for number in np.unique(block):
                own = values[block == number]
                gains = np.unique(own[own != 0])
                assert len(gains) <= 1 and all(np.abs(exact[block == number] - v).min() < 1e-5
                                               for v in gains)  # fmt: skip
        assert maps.mean() == pytest.approx(every.mean(), rel=0.2)

    def test_unreachable_candidates_are_never_proposed(self, sunny, estimated):
        capture, _ = sunny
        estimate = estimated(0, 1)
        candidates = svu.Candidates.without_photograph(some(capture, (0, 1)))
        best = svu.next_best_view(estimate, candidates).proposals[0].candidate
        flags = np.ones(18, bool)
        flags[best] = False
        with pytest.warns(svu.SvuWarning, match="of 100 views are proposed: there are no more"):
            guidance = svu.next_best_view(estimate, candidates.restricted(flags), 100)
        assert len(guidance.proposals) == 17
        assert best not in [p.candidate for p in guidance.proposals]
        assert np.isnan(guidance.scores[best]) and best not in guidance.ranking
        assert sorted(guidance.ranking) == [c for c in range(18) if c != best]

    @pytest.mark.slow
    def test_every_strategy_reports_its_results(self, sunny, estimated):
        capture, _ = sunny
        estimate = estimated(0, 1, 2)
        around = svu.Candidates.around(capture, 40)
        final = {}
        for strategy in STRATEGIES:
            guidance = svu.next_best_view(estimate, around, count=4, strategy=strategy)
            names = [p.candidate for p in guidance.proposals]
            assert len(set(names)) == 4
            assert guidance.entropy == pytest.approx(np.array(estimate.entropy).mean())
            forecast = TABLE[strategy].needs_forecast
            for p in guidance.proposals:
                assert np.isfinite([p.gain, p.error, p.entropy]).all() == forecast
                assert 0 <= p.new <= p.sees <= 1
            greedy = inputs_of(estimate, around).greedy
            for name in names:
                greedy.choose(name)
            final[strategy] = greedy.entropy.mean()
        assert final["entropy"] <= min(final.values()) + 2e-3
        assert final["entropy"] < final["random"]

    @pytest.mark.parametrize("strategy", BASELINES)
    @pytest.mark.parametrize("method", ["angular", "spectrum"])
    def test_who_needs_no_forecast_pays_for_none(
        self, sunny, estimated, monkeypatch, strategy, method
    ):
        """Neither responses nor truths, and no kernel but that of visibility."""
        capture, _ = sunny
        estimate = estimated(0, 1, 2, method=method)
        asked = []
        monkeypatch.setattr(strategy_inputs, "forecast_of", lambda *_: asked.append("forecast"))
        monkeypatch.setattr(Hypotheses, "draw", lambda *_: asked.append("truths"))
        monkeypatch.setattr(GreedyScorer, "__init__", lambda *_: asked.append("Eq. 13"))
        around = svu.Candidates.around(capture, 9)
        svu.next_best_view(estimate, around, 3, strategy=strategy)
        with launched_kernels() as kernels:
            svu.next_best_view(estimate, around, 3, strategy=strategy)
        with launched_kernels() as rays:
            inputs_of(estimate, around, strategy=strategy).seen  # noqa: B018
        known = {kernel["hash"] for kernel in rays}
        # Besides, matrices of sensors are multiplied.
        assert not asked
        assert all(k["hash"] in known or k["operation_count"] < 100 for k in kernels)

    @pytest.mark.slow
    def test_kernels_do_not_depend_on_views_or_texels(self, sunny, estimated):
        capture, _ = sunny
        estimate = estimated(0, 1, 2)
        svu.next_best_view(estimate, svu.Candidates.around(capture, 11), 3, texels=200)
        other = estimated(4, 5, 6, 7, 8)
        with launched_kernels() as kernels:
            svu.next_best_view(other, svu.Candidates.around(capture, 23), 4, texels=333)
        assert not [k for k in kernels if not k["cache_hit"] and not k["cache_disk"]]

    @pytest.mark.slow
    def test_expected_change_equals_the_change_by_photographs(self, sunny, estimated):
        """With the photograph taken, entropy falls as was expected, over all candidates.

        From one side of the ball, where candidates differ by more than the noise of all texels
        does once there is another photograph.
        """
        capture, _ = sunny
        taken, left = range(1, 9), [0, *range(9, 20)]
        estimate = estimated(*taken)
        guidance = svu.next_best_view(estimate, [capture.sensors[v] for v in left], hypotheses=64)
        before = np.array(estimate.entropy).mean()
        real = np.array([before - np.array(estimated(*taken, v).entropy).mean() for v in left])
        # The truth is one of many that were averaged over: gains are right on average, and those
        # of single candidates agree far beyond chance.
        assert stats.pearsonr(guidance.scores, real, alternative="greater").pvalue < 0.01
        assert np.corrcoef(guidance.scores, real)[0, 1] > 0.8
        assert 0.5 < guidance.scores.mean() / real.mean() < 1.5

    def test_current_entropy_equals_the_estimate_s(self, sunny, estimated):
        """Photographs as the model has them: what they are expected to say is what they say."""
        capture, _ = sunny
        estimate = estimated(0, 5, 9, 14, preset="fixed")
        around = svu.Candidates.at(capture, [0])
        forecast = inputs_of(estimate, around, hypotheses=512).forecast
        seen = np.array(estimate.coverage) > 0
        now, entropy = forecast.current(np.arange(4)), np.array(estimate.entropy)
        assert np.corrcoef(now[seen], entropy[seen])[0, 1] > 0.99
        assert np.sqrt(np.mean((now - entropy)[seen] ** 2)) < 0.03
        assert (now[~seen] == 1).all()

    def test_a_single_texel_has_no_standard_error(self, estimated):
        assert np.isnan(svu.next_best_view(estimated(0, 1), texels=1).proposals[0].error)

    def test_a_black_photograph_has_been_taken(self, sunny):
        capture, texels = sunny
        black = some(capture, range(1, 20))  # loading leaves view 0 out, with a warning
        images = (np.zeros_like(capture.images[0]), *capture.images[1:])
        estimate = svu.estimate(dataclasses.replace(black, images=images), texels)
        assert svu.next_best_view(estimate, texels=50).candidates.count == 100

    @pytest.mark.slow
    @pytest.mark.parametrize(
        "switches",
        [preset("fast", method="angular"),
         preset("fixed", method="angular", noise="heteroscedastic", sigma=0.02)],
        ids=lambda switches: f"{switches.name}-{switches.noise}",
    )  # fmt: skip
    def test_other_noise_and_prior(self, sunny, switches):
        capture, texels = sunny
        prior = np.ones((8, 8, 8))
        prior[:2] = 0  # nothing is a mirror
        estimate = svu.estimate(some(capture, (0, 1, 2)), texels, preset=switches, prior=prior)
        guidance = svu.next_best_view(estimate, count=2)
        assert 0 < guidance.entropy < 1
        assert all(np.isfinite(p.gain) for p in guidance.proposals)

    @pytest.mark.few(1)
    @pytest.mark.parametrize("method, name, known, axis", [
        ("angular", "fixed", {"metallic": 0.0}, 1), ("angular", "fixed", {"roughness": 3 / 7}, 0),
        pytest.param("spectrum", SHARP, {"specular": 5 / 7}, 1, marks=pytest.mark.slow),
        pytest.param("spectrum", SHARP, {"roughness": 3 / 7}, 0, marks=pytest.mark.slow),
    ])  # fmt: skip
    def test_known_parameters_equal_a_prior_on_their_value(self, sunny, method, name, known, axis):
        """E[H] log n is the same on the whole grid with all of the prior on that node, and so are
        the proposals; also where nobody looked."""
        capture, texels = sunny
        some_views, (value,) = some(capture, (0, 5)), known.values()
        alone = svu.estimate(some_views, texels, method, name, known=known)
        shape = tuple(8 if n == 1 else n for n in alone.posterior.grid.shape)
        prior = np.zeros(shape)
        prior[(slice(None),) * axis + (round(7 * value),)] = 2.0
        whole = svu.estimate(some_views, texels, method, name, prior=prior)
        n = np.log([np.prod(e.posterior.grid.shape) for e in (alone, whole)])
        unseen = np.array(alone.coverage) == 0
        assert unseen.any()
        assert (np.array(alone.entropy)[unseen] == 1).all()
        assert np.array(whole.entropy)[unseen] == pytest.approx(n[0] / n[1], rel=1e-6)
        around = svu.Candidates.at(capture, [v for v in range(20) if v not in (0, 5)])
        forecasts = [inputs_of(e, around, hypotheses=4).forecast for e in (alone, whole)]
        views, asked, every = np.arange(2), np.arange(2, 20), np.arange(texels.count)
        for evaluate in (lambda f: f.current(views), lambda f: f.expected(views, asked, every)):
            both = [evaluate(forecast) * m for forecast, m in zip(forecasts, n, strict=True)]
            np.testing.assert_allclose(both[1], both[0], atol=2e-5 * n[1])
        options = svu.GuidanceOptions(hypotheses=4)
        proposed = [svu.next_best_view(e, around, 3, options=options) for e in (alone, whole)]
        ranks = [[p.candidate for p in guidance.proposals] for guidance in proposed]
        assert ranks[0] == ranks[1]
        nats = [guidance.scores * m for guidance, m in zip(proposed, n, strict=True)]
        np.testing.assert_allclose(nats[1], nats[0], atol=1e-5)

    @pytest.mark.parametrize("method, name", [("angular", "fixed"), ("spectrum", SHARP)])
    def test_truths_of_unseen_texels_are_drawn_from_the_prior(self, sunny, method, name):
        capture, texels = sunny
        estimate = svu.estimate(
            some(capture, (0, 5)), texels, method, name, prior=np.eye(8)[3] + 0.5 * np.eye(8)[6]
        )
        around = svu.Candidates.around(capture, 4)
        forecast = inputs_of(estimate, around, hypotheses=4096).forecast
        unseen = np.flatnonzero(np.array(estimate.coverage) == 0)
        table = np.zeros((8, len(unseen)))
        columns = np.prod(estimate.posterior.grid.shape[1:-1] if method == "angular" else 8)
        for k in range(int(forecast.hypotheses.counts.numpy().max())):
            cell, weight = forecast.hypotheses.at(mi.UInt32(k), mi.UInt32(unseen))
            active = k < forecast.hypotheses.counts.numpy()[unseen]
            rows = cell.numpy().astype(int) // int(columns)
            np.add.at(table, (rows[active], np.flatnonzero(active)), weight.numpy()[active])
        exact = np.zeros((8, 1))
        exact[3], exact[6] = 2 / 3, 1 / 3
        np.testing.assert_allclose(table, np.broadcast_to(exact, table.shape), atol=1e-6)
        H = estimate.posterior.prior_entropy
        assert 0.3 < H < 0.9
        np.testing.assert_allclose(forecast.current(np.arange(2))[unseen], H, rtol=1e-6)

    def test_bad_input(self, sunny, estimated):
        capture, texels = sunny
        estimate = estimated(0, 1)
        for words, sentence in (
            ({"count": 0}, "count must be at least 1"), ({"count": 2.5}, "whole number"),
            ({"texel": 3}, "unknown option 'texel'"), ({"texels": 0}, "texels must be at least 1"),
            ({"strategy": "best"}, "strategy must be one of"),
            ({"options": {"texels": 5}}, "must be a GuidanceOptions, got"),
        ):  # fmt: skip
            with pytest.raises(svu.SvuError, match=sentence):
                svu.next_best_view(estimate, **words)
        with pytest.raises(svu.SvuError, match="proposal must be 0 to 0"):
            svu.next_best_view(estimate).image(1)
        with pytest.raises(svu.SvuError, match="has no observations"):
            svu.next_best_view(dataclasses.replace(estimate, observed=None))

    @pytest.mark.slow
    def test_estimates_that_predict_nothing_are_refused(self, sunny, estimated):
        capture, texels = sunny
        spectra = estimated(0, 1, method="spectrum")
        with pytest.raises(svu.SvuError, match="parameters='specular'"):
            svu.next_best_view(spectra)
        specular = preset("fixed", method="angular", parameters="specular")
        with pytest.raises(svu.SvuError, match="parameters='principled'"):
            svu.next_best_view(svu.estimate(some(capture, (0, 1)), texels, preset=specular))
        other = preset("fixed", method="angular", channels="joint")
        with pytest.raises(svu.SvuError, match="cannot predict"):
            svu.next_best_view(svu.estimate(some(capture, (0, 1)), texels, preset=other))
        paper = estimated(0, 1, method="spectrum", preset="paper")
        with pytest.raises(svu.SvuError, match="error needs"):
            svu.next_best_view(paper, strategy="error")

    @pytest.mark.slow
    @pytest.mark.parametrize("views", [2, 6])
    def test_gains_grow_by_less_than_is_allowed_for(self, views):
        """The vase under an overcast sky: where they grew most among our own scenes."""
        capture = svu.render_capture(
            scenes.path("vase"), 8, views=views, resolution=(96, 96),
            defines={"light": "overcast"},
        )  # fmt: skip
        estimate = svu.estimate(capture, svu.texels(capture.mesh, 32))
        around = svu.Candidates.around(capture, 24)
        known = inputs_of(estimate, around, lazy=False).greedy
        gains, order = [], []
        for _ in range(4):
            gains.append(known.scores())
            order.append(int(np.argmax(gains[-1])))
            known.choose(order[-1])
        growth = np.concatenate([
            after[free] / before[free] - 1
            for before, after in itertools.pairwise(gains) for free in [np.isfinite(after)]
        ])  # fmt: skip
        assert 0 < growth.max() < GROWTH
        lazy = inputs_of(estimate, around).greedy
        for candidate in order:
            assert np.argmax(lazy.scores()) == candidate
            lazy.choose(candidate)
        assert lazy.evaluated < known.evaluated


class TestCandidates:
    def test_around_takes_the_camera_of_the_photographs(self, sunny):
        capture, _ = sunny
        candidates = svu.Candidates.around(capture, 30, lowest=0.2, up=(0, 0, -1))
        places = np.array([to_world(s)[:3, 3] for s in candidates.sensors])
        radius = np.linalg.norm(to_world(capture.sensors[0])[:3, 3])
        np.testing.assert_allclose(np.linalg.norm(places, axis=1), radius, rtol=1e-5)
        sine = -places[:, 2] / radius
        assert sine.min() >= 0.2 - 1e-6 and sine.max() > 0.95
        ups = np.array([to_world(s)[:3, 1] for s in candidates.sensors])
        assert (-ups[sine < 0.9, 2] > 0.4).all()  # upright
        looks = np.array([to_world(s)[:3, 2] for s in candidates.sensors])
        np.testing.assert_allclose(looks, -places / radius, atol=1e-5)

    def test_a_sphere_is_even(self):
        ball = mi.load_dict({"type": "sphere"})
        d = directions_of(sphere_sensors(ball, 200, (8, 8), up=(1, 2, -1)), np.zeros(3))
        assert np.abs(d.mean(axis=0)).max() < 0.01
        nearest = np.sort(np.arccos(np.clip(d @ d.T, -1, 1)), axis=1)[:, 1]
        assert nearest.min() > 0.5 * nearest.max()

    def test_refused(self, sunny):
        capture, _ = sunny
        with pytest.raises(svu.SvuError, match="Every sensor"):
            svu.Candidates.without_photograph(capture)
        for flags, sentence in (
            (np.zeros(5, bool), "no candidate is reachable"), (np.ones(4, bool), "4 flags for 5"),
            ([0, 1, 2, 3, 4], "must be bool flags"),
        ):  # fmt: skip
            with pytest.raises(svu.SvuError, match=sentence):
                svu.Candidates.around(capture, 5).restricted(flags)
        for words, sentence in (
            ({"count": 0}, "Cannot place 0"), ({"lowest": 1.0}, "lowest elevation"),
            ({"up": (0, 0, 0)}, "up must be a direction"), ({"distance": -1}, "must be positive"),
        ):  # fmt: skip
            with pytest.raises(svu.SvuError, match=sentence):
                svu.Candidates.around(capture, **{"count": 5} | words)
        with pytest.raises(svu.SvuError, match="no such file"):
            svu.Candidates.read("nowhere.json")
