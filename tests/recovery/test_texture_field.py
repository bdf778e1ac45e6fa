"""Uncertainty of recovered textures: fields, draws, images, against dense linear algebra."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from recovery.test_quadratic_error import TEXELS, columns, exact, factors_of, parameters, upper
from support.helpers import as_values

import svu_mi as svu
from svu_mi.core.arrays import to_drjit
from svu_mi.core.io.array_cache import ArrayCache
from svu_mi.core.io.npz import write_arrays
from svu_mi.core.progress import Progress
from svu_mi.errors import OptionError, ShapeError
from svu_mi.parameters import CHANNELS, NAMES
from svu_mi.recovery.recover import recover
from svu_mi.recovery.relighting import relight_draws
from svu_mi.recovery.sh.quadratic_error import information
from svu_mi.recovery.uncertainty import clipped_normal
from svu_mi.recovery.uncertainty import gmrf as smoothers
from svu_mi.recovery.uncertainty import texture_field as module
from svu_mi.recovery.uncertainty.field_draws import smooth_fields
from svu_mi.recovery.uncertainty.gmrf import Nested, Smoother
from svu_mi.recovery.uncertainty.texture_field import TextureField, texture_field

SIDE = 6  # of a square of texels
EPSILON = 0.01


def square(side: int = SIDE) -> np.ndarray:
    """Return neighbours (4, T) of a square of texels; missing ones are the texel itself."""
    number = np.arange(side * side).reshape(side, side)
    padded = np.pad(number, 1, constant_values=-1)
    around = np.stack([padded[1:-1, 2:], padded[1:-1, :-2], padded[2:, 1:-1], padded[:-2, 1:-1]])
    around = around.reshape(4, -1)
    return those_first(np.where(around < 0, np.arange(side * side), around))


def those_first(around: np.ndarray) -> np.ndarray:
    """Return neighbours (K, T), existing ones first."""
    order = np.argsort(around == np.arange(around.shape[1]), axis=0, kind="stable")
    return np.take_along_axis(around, order, axis=0)


def made(fields: int = 2, seed: int = 5) -> tuple[Smoother, np.ndarray]:
    """A smoother of random precision and values, and its matrix, (N, T, T) float64."""
    random, count = np.random.default_rng(seed), SIDE * SIDE
    precision = random.uniform(0.5, 200, (fields, count))
    values = random.uniform(0, 1, (fields, count)) ** 4
    table = square()
    matrix = np.zeros((fields, count, count))
    for field in range(fields):
        for column in table:
            for i, j in enumerate(column):
                if i != j:
                    weight = 3 / np.hypot(values[field, i] - values[field, j], EPSILON)
                    matrix[field, i, i] += weight
                    matrix[field, i, j] -= weight
        matrix[field] += np.diag(precision[field])
    around = [to_drjit(mi.UInt32, column.astype(np.uint32)) for column in table]
    return Smoother.of(precision, values, around, 3.0, EPSILON), matrix


@pytest.mark.parametrize("fields", [1, 2, 4, 5])
def test_smoothing_solves_the_equations_of_the_field(fields: int) -> None:
    smoother, matrix = made(fields)
    right = np.random.default_rng(1).standard_normal((fields, SIDE * SIDE))
    solution = smoother.solve(right)
    wanted = np.linalg.solve(matrix, right[..., None])[..., 0]
    np.testing.assert_allclose(solution, wanted, atol=2e-3 * np.abs(wanted).max())


@pytest.mark.parametrize("few", [20, 600])
def test_multilevel_solver_needs_fewer_iterations(monkeypatch, few: int) -> None:
    """If most texels are uncertain, values spread over long distances."""
    side, sizes = 48, []

    def counted(smoother: Smoother, *state: Any) -> Any:
        sizes.append(dr.width(smoother.around[0]))
        return iterate(smoother, *state)

    iterate = Smoother._iterate
    monkeypatch.setattr(Smoother, "_iterate", counted)
    monkeypatch.setattr(smoothers, "FEW_TEXELS", few)
    squares = np.stack(np.divmod(np.arange(side * side), side), axis=1)
    values = np.stack([np.sin(squares @ (0.1, 0.2)), squares[:, 0] > 20])
    known = np.random.default_rng(2).random((2, side * side)) < 0.01
    around = [to_drjit(mi.UInt32, column.astype(np.uint32)) for column in square(side)]
    smoother = Smoother.of(np.where(known, 100, 1e-2), values, around, 1.0, EPSILON)
    right = np.where(known, 100 * values, 0)
    solution, fine = Nested.of(smoother, squares).solve(right), sizes.count(side * side)
    assert fine < len(sizes)
    sizes.clear()
    smoother.solve(right)
    taken = len(sizes)
    monkeypatch.setattr(smoothers, "TOLERANCE", 1e-6)
    np.testing.assert_allclose(solution, smoother.solve(right), atol=0.01)
    assert fine < 0.7 * taken


def test_isolated_texels_are_not_grouped() -> None:
    squares = 2 * np.stack(np.divmod(np.arange(2**15), 256), axis=1)
    around = [dr.arange(mi.UInt32, len(squares))]
    alone = np.ones((1, len(squares)))
    assert Nested.of(Smoother.of(alone, alone, around, 1.0, EPSILON), squares).coarser is None


def test_sampled_links_have_covariance_K() -> None:
    smoother, matrix = made(fields=1)
    K = matrix[0] - np.diag(smoother.precision[0])
    random = np.random.default_rng(3)
    drawn = np.stack([smoother.sample_links(random)[0] for _ in range(2000)])
    size = np.sqrt(np.outer(np.diag(K), np.diag(K)))
    apart = drawn.T @ drawn / len(drawn) / size - K / size
    noise = 1 / np.sqrt(len(drawn))
    assert np.abs(apart).max() < 5 * noise and np.sqrt((apart**2).mean()) < 1.2 * noise
    assert np.abs(drawn.sum(axis=1)).max() < 1e-2 * np.abs(drawn).max()  # forces cancel


@pytest.mark.parametrize(("place", "width"), [
    (0.5, 0.1), (0.02, 0.1), (-0.3, 0.2), (1.1, 0.4), (0.4, 3.0), (0.7, 0.0), (1.0, 1e-4),
])  # fmt: skip
def test_moments_of_clipped_normals(place: float, width: float) -> None:
    random = np.random.default_rng(0).standard_normal(400_000)
    drawn = np.clip(place + width * random, 0, 1)
    mean, sd = clipped_normal.moments(np.array([place]), np.array([width]))
    assert mean[0] == pytest.approx(drawn.mean(), abs=4 * width / 600 + 1e-9)
    assert sd[0] == pytest.approx(drawn.std(), rel=0.01, abs=1e-9)
    low, high = clipped_normal.interval(np.array([place]), np.array([width]), 0.9)
    assert 0 <= low[0] <= high[0] <= 1


def test_width_of_inverts_clipping() -> None:
    place, wanted = np.meshgrid(np.linspace(0, 1, 41), np.geomspace(1e-4, 0.4, 60))
    width = clipped_normal.width_of(place, wanted)
    assert (width >= wanted).all() and (width < clipped_normal.WIDEST).all()
    np.testing.assert_allclose(clipped_normal.moments(place, width)[1], wanted, rtol=2e-3)
    none = clipped_normal.width_of(np.array([0.0, 0.5, 1.0]), np.zeros(3))
    assert not none.any()
    assert clipped_normal.width_of(np.array([0.5]), np.array([0.6])) == pytest.approx(
        clipped_normal.WIDEST
    )


def test_smooth_fields_have_a_gaussian_correlation() -> None:
    place = np.zeros((3, 5), np.float32)
    place[0] = np.array([0, 0.3, 0.8, 1.5, 4])
    random, drawn = np.random.default_rng(2), []
    for _ in range(400):
        drawn.append(np.array(smooth_fields(3, to_drjit(mi.Point3f, place), random)))
    values = np.concatenate(drawn)  # (1200, 5)
    wanted = np.exp(-0.5 * (place[0] - place[0][:, None]) ** 2)
    np.testing.assert_allclose(values.T @ values / len(values), wanted, atol=0.1)


def test_information_is_the_gauss_newton_matrix() -> None:
    """Against second differences of the error where the residuals are straight."""
    samples = columns()
    entries, values = upper(samples), parameters()
    matrix = information(factors_of(samples), as_values(values))
    got = np.array([[np.array(x) for x in row] for row in matrix])
    np.testing.assert_allclose(got, np.swapaxes(got, 0, 1), rtol=1e-4, atol=1e-6)
    step = 1e-3
    for k in range(5):
        if k == 3:
            continue  # splines bend
        above, below = values.copy(), values.copy()
        above[k] += step
        below[k] -= step
        second = exact(entries, above) + exact(entries, below) - 2 * exact(entries, values)
        np.testing.assert_allclose(got[k, k], second / step**2 / 2, rtol=2e-2, atol=1e-4)
    assert (np.linalg.eigvalsh(np.moveaxis(got, 2, 0)) > -1e-5).all()
    assert got.shape == (5, 5, TEXELS)


@pytest.fixture(scope="module")
def recovered(vase: SimpleNamespace) -> SimpleNamespace:
    """Recovered textures of the vase, and their field."""
    recovery = recover(vase.estimate, parameters=NAMES)
    field = texture_field(recovery, mesh=vase.capture.mesh)
    return SimpleNamespace(recovery=recovery, field=field)


@pytest.fixture(scope="module")
def draws(recovered: SimpleNamespace) -> list:
    return list(recovered.field.draw(200, seed=1))


@pytest.fixture(scope="module")
def inverses(recovered: SimpleNamespace) -> dict[int, np.ndarray]:
    """(D + K)^-1 of some values, from the equations."""
    return {row: np.linalg.inv(dense(recovered.field, row)) for row in (0, 3, 4)}


def dense(field: TextureField, row: int) -> np.ndarray:
    """(T, T) float64, D + K of one value, from the equations."""
    T, epsilon = field.texels.count, float(field.smoother.epsilon[0])
    D = field.smoother.precision[row]
    strength, x0 = float(field.smoother.strength[0]), field.values[row]
    Q = np.diag(D)
    for column in field.smoother.around:
        i, j = np.arange(T), np.array(column, np.int64)
        weight = np.where(i == j, 0, strength / np.hypot(x0 - x0[j], epsilon))
        np.add.at(Q, (i, i), weight)
        np.add.at(Q, (i, j), -weight)
    return Q


@pytest.mark.slow
def test_field_variance_is_the_diagonal_of_the_inverse(recovered, inverses) -> None:
    """The approximation by the lattice, against dense inverses: right on average."""
    for row, inverse in inverses.items():
        ratio = np.sqrt(recovered.field._variance[row] / np.diag(inverse))
        assert 0.9 < np.median(ratio) < 1.1
        assert np.quantile(ratio, 0.02) > 0.6 and np.quantile(ratio, 0.98) < 1.6


def test_field_has_standard_deviations_of_every_texel(recovered: SimpleNamespace) -> None:
    field, T = recovered.field, recovered.field.texels.count
    seen = recovered.recovery.coverage > 0
    for name in NAMES:
        sd, (low, high) = field.sd(name), field.interval(name)
        assert sd.shape == ((T, 3) if CHANNELS[name] > 1 else (T,))
        assert np.isfinite(sd).all() and (sd >= 0).all() and (sd <= 0.5).all()
        value = field.textures.at(field.texels, name)
        assert (low <= value + 1e-6).all() and (value <= high + 1e-6).all()
        assert low.min() >= 0 and high.max() <= 1
        inner = field.interval(name, 0.5)
        assert (inner[0] >= low - 1e-12).all() and (inner[1] <= high + 1e-12).all()
        flat = sd.reshape(T, -1).mean(axis=1)
        assert flat[~seen].mean() > flat[seen].mean()  # unseen texels


@pytest.mark.slow
def test_draws_have_the_mean_and_sd_of_the_field(recovered, draws) -> None:
    """Neighbours have the correlation of the field."""
    field = recovered.field
    for name in NAMES:
        values = np.stack([draw.at(field.texels, name) for draw in draws]).astype(np.float64)
        mean, sd = field.mean(name), field.sd(name)
        assert values.std(axis=0, ddof=1).mean() == pytest.approx(sd.mean(), rel=0.03)
        assert values.mean() == pytest.approx(mean.mean(), rel=0.03)
        apart = (values.mean(axis=0) - mean) / np.maximum(sd, 1e-3)
        assert np.sqrt((apart**2).mean()) < 2.5 / np.sqrt(200)
        assert values.min() >= 0 and values.max() <= 1


def exact_coherent(field: TextureField, row: int, inverse: np.ndarray) -> np.ndarray:
    """(T,) float64, c of one value, from the equations."""
    K = dense(field, row)
    D = field.smoother.precision[row]
    K -= np.diag(D)
    d = module.NARROW * np.median(np.diag(K))
    apart = np.linalg.solve(K + d * np.eye(len(K)), d * np.abs(field.values - field.own_mean)[row])
    alone = (inverse @ (1 / field.deviation[row])) ** 2
    square = alone + module.DISAGREEMENT * apart**2
    seen, size = field.seen, np.array(field.texels.footprint, np.float64)
    slope = np.sqrt(exact_squared_steps(field, row)[seen]).sum() / size[seen].sum()
    most = (0.1 * field.texels.extent * slope) ** 2
    limit = 0.4**2 * alone + square * most / (most + square)
    return np.sqrt(np.where(seen, np.minimum(square, limit), square))


def exact_squared_steps(field: TextureField, row: int) -> np.ndarray:
    """(T,) float64, mean squared difference of one value from linked texels."""
    K, x0 = dense(field, row), field.values[row]
    linked = (K != 0) & ~np.eye(len(K), dtype=bool)
    squares = np.where(linked, np.square(x0 - x0[:, None]), 0)
    return squares.sum(axis=1) / np.maximum(linked.sum(axis=1), 1)


@pytest.mark.slow
def test_standard_deviations_are_larger_at_edges(recovered, inverses) -> None:
    """Where nothing is clipped: rho c^2 + (1 - rho) / precision + e h^2."""
    field, row = recovered.field, 3
    steps = exact_squared_steps(field, row)
    coherent = exact_coherent(field, row, inverses[row])
    rho = np.where(recovered.recovery.coverage > 0, 0.5, 1)
    smooth = rho * coherent**2 + (1 - rho) * field._variance[row]
    value, width = field.values[row], field.width[row]
    inner = np.abs(value - 0.5) < 0.5 - clipped_normal.FAR * width
    edges = inner & (0.2 * steps > 0.1 * smooth)
    assert edges.sum() > 30 and inner.sum() > 300
    wanted = np.sqrt(smooth + 0.2 * steps)
    np.testing.assert_allclose(width[inner], wanted[inner], rtol=0.02)


@pytest.mark.slow
def test_draws_have_the_correlation_of_neighbours(recovered, draws, inverses) -> None:
    """Dense: rho c c L L k(p_i, p_j) + (1 - rho) (D + K)^-1, where nothing is clipped."""
    field = recovered.field
    row = 3  # roughness
    inverse = inverses[row]
    coherent = exact_coherent(field, row, inverse)
    np.testing.assert_allclose(field._coherent_sd[row], coherent, atol=0.02 * coherent.max())
    place = np.array(field.texels.position, np.float64).T
    random = np.random.default_rng(0)
    middle, sd = field.textures.at(field.texels, "roughness"), field.sd("roughness")
    inner = np.flatnonzero(np.abs(middle - 0.5) < 0.5 - 2 * sd)
    i = random.choice(inner, 300)
    j = np.array(recovered.recovery.around.table()[0])[i]
    both = np.isin(j, inner) & (j != i) & (field.common[row, i] == field.common[row, j])
    i, j = i[both], j[both]
    assert len(i) > 50
    distance = np.linalg.norm(place[i] - place[j], axis=1) / (module.LENGTH * field.texels.extent)
    rho = module.COMMON
    roots = field.roots()
    alike = (roots[i, row] * roots[j, row]).sum(axis=1)  # of their correlations
    covariance = rho * coherent[i] * coherent[j] * np.exp(-(distance**2) / 2) * alike
    covariance += (1 - rho) * inverse[i, j]
    share = [field.common[row, k] for k in (i, j)]
    variance = [
        part * coherent[k] ** 2 + (1 - part) * inverse[k, k]
        for k, part in zip((i, j), share, strict=True)
    ]
    wanted = covariance / np.sqrt(variance[0] * variance[1])
    values = np.stack([draw.at(field.texels, "roughness") for draw in draws])
    centered = values - values.mean(axis=0)
    sd = values.std(axis=0)
    correlation = (centered[:, i] * centered[:, j]).mean(axis=0) / (sd[i] * sd[j])
    assert correlation.mean() == pytest.approx(wanted.mean(), abs=0.03)
    assert np.abs(correlation - wanted).mean() < 0.08


def test_draws_depend_on_the_seed_only(recovered: SimpleNamespace) -> None:
    field = recovered.field
    first, again = list(field.draw(2, seed=7)), list(field.draw(1, seed=7))
    np.testing.assert_array_equal(np.array(first[0].roughness), np.array(again[0].roughness))
    assert np.ptp(np.array(first[0].roughness) - np.array(first[1].roughness)) > 0
    assert list(field.draw(0)) == []


def test_parameters_not_recovered_have_no_deviation(vase: SimpleNamespace) -> None:
    recovery = recover(vase.estimate, parameters=("roughness",))
    field = texture_field(recovery, mesh=vase.capture.mesh)
    assert not field.sd("metallic").any() and field.sd("roughness").any()
    (draw,) = field.draw(1)
    np.testing.assert_array_equal(np.array(draw.metallic), np.array(recovery.textures.metallic))


def test_invalid_arguments_of_fields_are_refused(
    vase: SimpleNamespace, recovered: SimpleNamespace
) -> None:
    field = recovered.field
    with pytest.raises(OptionError, match="level must be in"):
        field.interval("roughness", 1.0)
    with pytest.raises(OptionError, match="count must be at least 0"):
        list(field.draw(-1))
    with pytest.raises(OptionError, match="no parameter|Unknown parameter"):
        field.sd("shine")
    paper = svu.estimate(vase.capture, vase.texels, preset="paper")
    with pytest.raises(OptionError, match="needs an RGB estimate with noise levels"):
        texture_field(recovered.recovery, paper)
    with pytest.raises(OptionError, match="at least 2 draws, got 1"):
        relight_draws(vase.capture, field.textures, field.draw(1), spp=1)


@pytest.mark.slow
def test_relit_sd_is_larger_for_uncertain_textures(
    vase: SimpleNamespace, recovered: SimpleNamespace
) -> None:
    field, sensors = recovered.field, vase.capture.sensors[:2]
    relit = relight_draws(vase.capture, field.textures, field.draw(6), None, sensors, spp=4)
    assert len(relit) == 2
    for view in relit:
        assert view.picture.shape == view.sd.shape == (*view.inside.shape, 3)
        assert (view.sd[~view.inside] == 0).all()
        assert (view.sd[view.inside] > 0).mean() > 0.9
        np.testing.assert_array_equal(view.mean[~view.inside], view.picture[~view.inside])
    same = relight_draws(
        vase.capture, field.textures, [field.textures, field.textures], None, sensors, spp=4
    )
    for view in same:  # common random numbers: no noise remains
        assert view.sd.max() < 1e-5 * view.picture.max()


def test_an_estimate_of_other_texels_is_refused(
    vase: SimpleNamespace, recovered: SimpleNamespace
) -> None:
    other = svu.estimate(vase.capture, svu.texels(vase.capture.mesh, (32, 24)))
    with pytest.raises(ShapeError, match=r"\(64, 48\) texels, but \(32, 24\)"):
        texture_field(recovered.recovery, other)


def test_a_field_is_read_for_the_same_textures_only(recovered, tmp_path) -> None:
    """A later command reads the same bits; other textures and forged files are computed."""
    kept = ArrayCache(tmp_path, progress=(progress := Progress()))
    # A new object each time, as fields remember what they have computed.
    plain, first, second = (replace(recovered.field, cache=c) for c in (ArrayCache(), kept, kept))
    for field in (first, second):
        np.testing.assert_array_equal(field.sds, plain.sds)
    reading = f"Reading field from {tmp_path}"
    assert reading in progress.timings and len(list(tmp_path.iterdir())) == 1
    changed = first.to_textures(np.clip(first.values + 0.2, 0, 1))
    for other in ({"textures": changed}, {"own_mean": 1 - first.own_mean}):
        a, b = (replace(recovered.field, cache=c, **other) for c in (ArrayCache(), kept))
        np.testing.assert_array_equal(b.sds, a.sds)
        assert (a.sds != plain.sds).any()
    assert len(list(tmp_path.iterdir())) == 3
    for file in tmp_path.iterdir():
        write_arrays(file, {"sd": np.full(plain.sds.shape, -1.0)})
    np.testing.assert_array_equal(replace(first, cache=kept).sds, plain.sds)
