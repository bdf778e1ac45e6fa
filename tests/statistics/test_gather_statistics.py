"""Tests of statistics against stored samples, in double precision."""

from __future__ import annotations

import re
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from oracle import angular as oracle
from support.helpers import as_values
from support.walled import ROUGHNESS, SIZE, Samples, angular, noise_capture, seen_in, walled_ball

import svu_mi as svu
from svu_mi.core.arrays import to_drjit
from svu_mi.errors import OptionError, ShapeError
from svu_mi.posterior.observations import observe
from svu_mi.presets import Skip
from svu_mi.statistics.cholesky_factors import FLOOR, PAIRS, Factors
from svu_mi.statistics.gather_statistics import Weighting
from svu_mi.statistics.statistics import Statistics

# --- gathered, against the samples ----------------------------------------------------------


def products(factors: Factors) -> np.ndarray:
    """Return U^T U of each texel, (R, C, 10, S) float64."""
    U = dict(zip(PAIRS, np.moveaxis(factors.table().astype(np.float64), 2, 0), strict=True))
    return np.stack([sum(U[k, i] * U[k, j] for k in range(i + 1)) for i, j in PAIRS], axis=2)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return walled_ball(tmp_path_factory.mktemp("wall"))


def factor_error(U, c, m):
    """Return |U (c (1 - m), c m, m, 1)|^2 of entries (10,), with U_44 not squared."""
    x = np.array([c * (1 - m), c * m, m, 1.0])
    square = np.zeros((4, 4))
    for pair, value in zip(PAIRS, U.astype(np.float64), strict=True):
        square[pair] = value
    return float(((square @ x) ** 2).sum())


def assert_sufficient(capture, switches, kappa=np.inf, current=None, seed=1):
    """Compare errors of random (c, m) from sums and factors with errors of the samples."""
    observed = seen_in(capture)
    if current is not None:
        current = current(len(observed.seen))
    statistics = observed.statistics(
        ROUGHNESS, switches, switches.colors,
        weighting=Weighting(kappa, current=None if current is None else as_values(current)),
    )  # fmt: skip
    samples = Samples(observed, switches, kappa, current)
    np.testing.assert_array_equal(statistics.views.numpy(), samples.seen.sum(axis=0))
    np.testing.assert_array_equal(statistics.texel.numpy(), observed.seen)
    assert statistics.channels == switches.colors
    # Weights that depend on current parameters give NaN kappa, so these sums do not add.
    np.testing.assert_equal(statistics.kappa, kappa if current is None else np.nan)
    np.testing.assert_allclose(statistics.weight, samples.w.sum(axis=0), rtol=1e-5)
    rng, factors = np.random.default_rng(seed), statistics.factor()
    U = factors.table()
    c, m = rng.random((2, 3))
    errors = statistics.errors(m, c)
    for texel in range(statistics.count):
        w, columns, b = samples.of(texel)
        size = np.sqrt((w * b**2).sum(axis=1) / w.sum())  # (C,)
        for level, channel in np.ndindex(len(ROUGHNESS), switches.colors):
            own = [x[level, channel] for x in columns]
            for k in range(len(c)):
                exact = (w * (b[channel] - oracle.modelled(own, c[k], m[k])) ** 2).sum() / w.sum()
                # Rounding of radiance limits the residual of samples that fit exactly.
                rounded = 4e-7 * size[channel] * np.sqrt(exact)
                ours = errors[texel, level, channel, k, k]
                assert abs(ours - exact) < max(1e-4 * exact, rounded)
                assert abs(np.sqrt(ours) - np.sqrt(exact)) < 5e-6 * size[channel]
                theirs = factor_error(U[level, channel, :, texel], c[k], m[k])
                assert abs(theirs - exact) < max(1e-4 * exact, rounded)
                assert abs(np.sqrt(theirs) - np.sqrt(exact)) < 5e-6 * size[channel]


MODELS = [
    (angular(), np.inf),
    (angular(channels="joint"), np.inf),
    (angular(), 0.8),
    (angular(occluded=False), np.inf),
    (angular("fast", channels="joint"), 1.3),
    (angular("paper"), np.inf),
    (angular("paper", fresnel="none"), np.inf),
]


def label(switches):
    return f"{switches.name}-{switches.channels}-{switches.fresnel}-{switches.occluded}"


@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("switches", "kappa"), MODELS, ids=[f"{label(s)}-{kappa}" for s, kappa in MODELS]
)
def test_statistics_are_sufficient(scene, switches, kappa):
    """Compare errors of random (c, m) with errors of all samples."""
    assert_sufficient(noise_capture(scene), switches, kappa)


@pytest.mark.parametrize("kappa", [np.inf, 0.8])
def test_a_lamp_in_the_photograph_is_a_sample_like_others(scene, kappa):
    assert_sufficient(noise_capture(scene, bright=1e4), angular(), kappa)


@pytest.mark.parametrize("channels", ["grey", "joint"])
def test_one_view_and_identical_views_are_no_special_case(scene, channels):
    """One sample has no residual; identical samples have dependent columns."""
    assert_sufficient(noise_capture(scene, [0]), angular(channels=channels))
    assert_sufficient(noise_capture(scene, [0] * 5), angular(channels=channels))


def test_samples_count_less_the_more_parameters_are_off(scene):
    """Weights are 1 / |r - b|, with r interpolated between two levels: absolute errors."""

    def current(count):
        return np.random.default_rng(50159).random((5, count)).astype(np.float32)

    assert_sufficient(noise_capture(scene), angular("fast", channels="joint"), 0.9, current)
    sums = np.zeros((1, 1, 10, 2))
    odd = Statistics.of(sums, np.ones(2), np.ones(2), np.zeros(1), np.nan)
    with pytest.raises(OptionError, match="because the weights differ"):
        _ = odd + odd


def test_unseen_texels_have_no_statistics(scene):
    capture = noise_capture(scene, [0])
    observed = observe(capture, svu.texels(capture.mesh, SIZE), skip=Skip(unseen=False))
    statistics = observed.statistics(ROUGHNESS, angular(), 1)
    unseen = statistics.views.numpy() == 0
    assert unseen.any() and statistics.count == observed.texels.count
    assert (statistics.table()[..., unseen] == 0).all()
    assert (statistics.weight[unseen] == 0).all()
    assert (statistics.errors(np.array([0.3]), np.array([0.6]))[unseen] == 0).all()
    assert (statistics.factor().table()[..., unseen] == 0).all()


def test_statistics_of_chosen_texels_match_all(scene):
    """Texels in any order, traced together or later, seen or not."""
    observed = seen_in(noise_capture(scene, [0, 4]))
    whole = observed.statistics(ROUGHNESS, angular(), 1)
    unseen = np.flatnonzero(observed.coverage == 0)[:3]
    lanes = np.array([7, 0, 31])
    chosen = np.concatenate([observed.seen[lanes], unseen])
    some = observed.statistics(ROUGHNESS, angular(), 1, texels=chosen)
    np.testing.assert_array_equal(some.texel.numpy(), chosen)
    np.testing.assert_allclose(some.table()[..., :3], whole.table()[..., lanes], rtol=1e-6)
    assert (some.weight[3:] == 0).all()


# --- sums that add --------------------------------------------------------------------------


ENERGIES = 100  # number of parameter points


def random_columns(rng, views, texels=5, levels=3, channels=2):
    """Return w (V, S), e, p, q, d (V, R, C, S) and b (V, C, S); some pairs are not visible."""
    columns = rng.exponential(size=(4, views, levels, channels, texels))
    columns[0] = 0.5 + rng.random((views, 1, channels, texels))
    b = rng.exponential(size=(views, channels, texels))
    w = rng.uniform(0.1, 1, (views, texels)) * (rng.random((views, texels)) < 0.8)
    w[0] = 1  # each texel is seen
    return w, columns, b


def summed(samples, chosen, kappa=np.inf):
    """Return ``Statistics`` of some views, computed with NumPy."""
    w, columns, b = (x[chosen] if k != 1 else x[:, chosen] for k, x in enumerate(samples))
    last = [np.moveaxis(x, 0, -1) for x in columns]
    table = oracle.products(np.moveaxis(w, 0, -1), last, np.moveaxis(b, 0, -1))
    levels = np.linspace(0, 1, table.shape[1])
    return Statistics.of(
        np.moveaxis(table, 0, 2), w.sum(axis=0), (w > 0).sum(axis=0), levels, kappa
    )


def points(seed=31807):
    """Return all pairs of metallic and base colour."""
    return np.random.default_rng(seed).random((2, 10))


def assert_same(ours, theirs):
    """Compare views, weights and energies at 100 random points, to 1e-6 of the energy."""
    np.testing.assert_array_equal(ours.views.numpy(), theirs.views.numpy())
    np.testing.assert_array_equal(ours.texel.numpy(), theirs.texel.numpy())
    np.testing.assert_allclose(ours.weight, theirs.weight, rtol=1e-12)
    a, b = (x.errors(*points()) for x in (ours, theirs))
    assert a.shape[-1] * a.shape[-2] == ENERGIES
    np.testing.assert_allclose(a, b, rtol=1e-6)


def splits(rng, views):
    """Yield halves, a shuffle cut in two, blocks of views, and single views."""
    order = rng.permutation(views)
    halves = [np.arange(views)[: views // 2], np.arange(views)[views // 2 :]]
    cuts = np.sort(rng.integers(0, views + 1, 6))
    yield halves
    yield [order[: views // 3], order[views // 3 :]]
    yield np.split(order, cuts)
    if views <= 40:
        yield [np.array([view]) for view in order]


@pytest.mark.parametrize("views", [1, 2, 3, 7, 40, 150, 500])
def test_halves_shuffles_and_blocks_of_views_add_up_to_all(views):
    rng = np.random.default_rng(90533 + views)
    samples = random_columns(rng, views)
    whole = summed(samples, np.arange(views))
    for parts in splits(rng, views):
        total = summed(samples, parts[0])
        for part in parts[1:]:
            total = total + summed(samples, part)
        assert_same(total, whole)
        # Factors and posterior of the sum are equal, too.
        np.testing.assert_allclose(
            products(total.factor()), products(whole.factor()), rtol=1e-5, atol=1e-5
        )
    assert_samples(whole, samples)


def assert_samples(statistics, samples, rtol=1e-6):
    """Compare energies of sums and factors with samples at 100 random points."""
    w, columns, b = samples
    m, c = points()
    errors = statistics.errors(m, c)
    for i, j in np.ndindex(len(m), len(c)):
        r = oracle.modelled(columns, c[j], m[i])  # (V, R, C, S)
        squares = w[:, None, None] * (r - b[:, None]) ** 2
        exact = squares.sum(axis=0) / w.sum(axis=0)
        np.testing.assert_allclose(np.moveaxis(errors[..., i, j], 0, -1), exact, rtol=rtol)


def test_errors_of_exact_fits_are_not_negative():
    """Rounding cannot make the square negative if the residual is 0."""
    rng = np.random.default_rng(88)
    w, columns, _ = random_columns(rng, 30, levels=1)
    m, c = points()
    b = oracle.modelled(columns, c[3], m[5])[:, 0]
    errors = summed((w, columns, b), np.arange(30)).errors(m, c)
    assert (errors >= 0).all()
    assert (errors[..., 5, 3] < 1e-13 * (b**2).mean()).all()


def parts_of(scene, groups, texels, switches, kappa, places, **options):
    """Return statistics of the same texels for several captures; all texels are kept."""
    results = []
    for chosen in groups:
        capture = noise_capture(scene, chosen, places=places, **options)
        observed = observe(capture, texels, skip=Skip(unseen=False))
        results.append(observed.statistics(
            ROUGHNESS, switches, switches.colors, weighting=Weighting(kappa)
        ))  # fmt: skip
    return results


@pytest.mark.few(1)
@pytest.mark.parametrize("places", [6, 130, 500])
def test_many_views_add_up(scene, places):
    texels = svu.texels(noise_capture(scene, [0]).mesh, 6)
    order = np.random.default_rng(places).permutation(places)
    cut = max(places // 3, 1)
    groups = range(places), order[:cut], order[cut:]
    whole, *parts = parts_of(scene, groups, texels, angular("fast"), np.inf, places, size=16)
    assert_same(parts[0] + parts[1], whole)
    assert int(whole.views.numpy().max()) >= places // 10


# --- sums that do not add -------------------------------------------------------------------


def test_sums_with_other_shape_or_kappa_are_refused():
    rng = np.random.default_rng(2)
    one = summed(random_columns(rng, 4), np.arange(4), 0.5)
    shape = "5 texels x 3 levels x 2 channels"
    texels = summed(random_columns(rng, 4, texels=6), np.arange(4), 0.5)
    levels = summed(random_columns(rng, 4, levels=4), np.arange(4), 0.5)
    channels = summed(random_columns(rng, 4, channels=1), np.arange(4), 0.5)
    elsewhere = replace(one, texel=one.texel + 1)
    nodes = replace(one, roughness=one.roughness**2)
    for other in (texels, levels, channels, elsewhere, nodes):
        with pytest.raises(ShapeError, match=re.escape(shape)) as caught:
            one + other
        assert_a_sentence(caught)
    kappa = summed(random_columns(rng, 4), np.arange(4), 0.25)
    for other in (kappa, replace(one, kappa=np.inf), replace(one, edges=0.0)):
        words = r"kappa 0.5 and (0.25|inf|0.5) \(edges 60 and (60|0)\) cannot be added"
        with pytest.raises(OptionError, match=words) as caught:
            one + other
        assert_a_sentence(caught)


def assert_a_sentence(caught):
    text = str(caught.value)
    assert "\n" not in text and text.endswith(".") and text.count(". ") == 0


# --- the square root of sums ----------------------------------------------------------------


def upper(samples):
    """Return entries of U, (R, C, 10, S), by NumPy's QR factorisation of weighted samples."""
    w, (e, p, q, d), b = samples
    columns = np.stack([e, p, q - d, d - b[:, None]])  # (4, V, R, C, S)
    _, levels, channels, texels = e.shape
    entries = np.empty((levels, channels, len(PAIRS), texels))
    for r, c, t in np.ndindex(levels, channels, texels):
        root = np.sqrt(w[:, t] / w[:, t].sum())
        R = np.linalg.qr(root[:, None] * columns[:, :, r, c, t].T, mode="r")
        R *= np.where(np.diag(R) < 0, -1, 1)[:, None]
        entries[r, c, :, t] = [R[pair] for pair in PAIRS]
    return entries


@pytest.mark.parametrize("texels", [1, 16, 19])
def test_factor_matches_qr_factorisation(texels):
    samples = random_columns(np.random.default_rng(12), 14, texels, channels=3)
    samples[0][:] = np.maximum(samples[0], 0.05)
    factors = summed(samples, np.arange(14)).factor()
    np.testing.assert_allclose(factors.table(), upper(samples), rtol=2e-5, atol=1e-6)
    np.testing.assert_allclose(factors.reader().weight.numpy(), samples[0].sum(axis=0), rtol=1e-6)


def test_residual_floor_is_stored_separately():
    """For each channel: levels are relative to the floor, and never negative."""
    samples = random_columns(np.random.default_rng(3), 14, channels=3)
    factors, exact = summed(samples, np.arange(14)).factor(), upper(samples)[:, :, FLOOR] ** 2
    reader = factors.reader()
    for channel in range(3):
        least = exact[:, channel].min(axis=0)
        np.testing.assert_allclose(reader.residual_floor[channel].numpy(), least, rtol=1e-5)
        for level in range(factors.levels):
            floor = reader.entries(mi.UInt32(level))[channel][FLOOR].numpy()
            assert (floor >= 0).all()
            np.testing.assert_allclose(
                floor, exact[level, channel] - least, atol=1e-6 * exact.max()
            )


def test_dependent_columns_leave_no_nan_and_no_error():
    """One view, or p = 2 e: U has zeros, and U^T U equals the sums."""
    w, columns, b = random_columns(np.random.default_rng(9), 8)
    columns[1] = 2 * columns[0]
    for chosen in (np.arange(8), np.array([0]), np.array([0, 0, 0])):
        statistics = summed((w, columns, b), chosen)
        factors = statistics.factor()
        assert np.isfinite(factors.table()).all()
        exact = statistics.table() / statistics.weight
        np.testing.assert_allclose(products(factors), exact, rtol=1e-5, atol=1e-6)


def test_rounding_that_breaks_cauchy_and_schwarz_stays_rounding():
    """Columns that hardly vary between views, with two views of negligible weight."""
    rng, texels = np.random.default_rng(140219), 3000
    w, columns, b = random_columns(rng, 3, texels)
    columns[:] = columns[:, :1] * (1 + 0.01 * rng.normal(size=columns.shape))
    columns[2:] *= 0.01
    b[1:] = 10 ** rng.uniform(1, 4, (2, 1, texels))
    w[:] = rng.uniform(0.3, 1, w.shape)
    w[1:] = 1 / (1 + 60 * b[1:, 0] ** 2)
    statistics = summed((w, columns, b), np.arange(3))
    U, (m, c) = statistics.factor().table().astype(np.float64), rng.random((2, 5))
    errors = statistics.errors(m, c)
    size = np.sqrt((w[:, None] * b**2).sum(axis=0) / w.sum(axis=0))  # (C, S)
    square = np.zeros((4, 4, *U.shape[:2], texels))
    for place, pair in enumerate(PAIRS):
        square[pair] = U[:, :, place]
    for k in range(5):
        x = np.array([c[k] * (1 - m[k]), c[k] * m[k], m[k], 1])
        theirs = (np.einsum("ijrcs,j->ircs", square, x) ** 2).sum(axis=0)
        ours = np.moveaxis(errors[..., k, k], 0, -1)
        assert (np.abs(np.sqrt(theirs) - np.sqrt(ours)) / size).max() < 5e-6


def test_products_and_some_of_the_texels():
    samples = random_columns(np.random.default_rng(21), 9, texels=20)
    statistics = summed(samples, np.arange(9))
    factors = statistics.factor()
    assert statistics.factor() is factors  # cached
    np.testing.assert_allclose(
        products(factors), statistics.table() / statistics.weight, rtol=1e-5, atol=1e-6
    )
    chosen = np.array([3, 19, 0, 3])
    some = factors.subset(chosen)
    assert isinstance(some, Factors) and some.count == 4
    np.testing.assert_array_equal(some.table(), factors.table()[..., chosen])
    np.testing.assert_array_equal(some.texel.numpy(), chosen)
    np.testing.assert_array_equal(some.views.numpy(), statistics.views.numpy()[chosen])
    np.testing.assert_array_equal(
        factors.reader(to_drjit(mi.UInt32, chosen)).weight.numpy(), some.reader().weight.numpy()
    )


@pytest.mark.parametrize("count", [1, 16, 37])
def test_statistics_of_some_lanes_and_back(count):
    rng = np.random.default_rng(count)
    table, weight = rng.random((2, 3, 10, count)), rng.random(count)
    statistics = Statistics.of(table, weight, np.arange(1, count + 1), np.array([0.0, 1.0]), 2.0)
    lanes = rng.permutation(count)[: max(count // 2, 1)]
    some = statistics.subset(lanes)
    np.testing.assert_array_equal(some.table(), table[..., lanes])
    np.testing.assert_array_equal(some.weight, weight[lanes])
    np.testing.assert_array_equal(some.views.numpy(), lanes + 1)
    np.testing.assert_array_equal(some.texel.numpy(), lanes)
    twice = statistics.replaced(lanes, some + some)
    wanted = table.copy()
    wanted[..., lanes] *= 2
    np.testing.assert_array_equal(twice.table(), wanted)
    assert twice.views.numpy()[lanes].tolist() == (2 * (lanes + 1)).tolist()
    np.testing.assert_array_equal(statistics.table(), table)  # unchanged
    nothing = np.zeros(0, np.int64)
    assert statistics.subset(nothing).count == 0
    np.testing.assert_array_equal(
        statistics.replaced(nothing, statistics.subset(nothing)).table(), table
    )


@pytest.mark.slow
@pytest.mark.few(1)
@pytest.mark.parametrize("kappa", [np.inf, 0.8], ids=["plain", "kappa"])
def test_statistics_of_two_captures_add(scene, kappa):
    """Split views into halves, a shuffle and single views, including rays and kernels."""
    texels, places = svu.texels(noise_capture(scene, [0]).mesh, 8), 9
    switches = angular(channels="joint")
    order = np.random.default_rng(6).permutation(places).tolist()
    whole = noise_capture(scene, range(places), places=places)
    per_view = observe(whole, texels).visibility.per_view
    able = np.flatnonzero(per_view)[:4]  # some see the back of the wall
    for groups in ([range(4), range(4, 9)], [order[:2], order[2:]], [[k] for k in able]):
        whole, *parts = parts_of(
            scene, [[k for group in groups for k in group], *groups], texels, switches, kappa,
            places,
        )  # fmt: skip
        total = parts[0]
        for part in parts[1:]:
            total = total + part
        assert_same(total, whole)
