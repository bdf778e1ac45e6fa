"""Regularisers against Eq. 14 and 15 and total variation in float64, and against differences."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from geometry.test_neighbors import links, quad, together
from support.helpers import as_tensor, ball, launched_kernels

from svu_mi.capture.mesh import make_mesh
from svu_mi.core.arrays import to_drjit
from svu_mi.errors import OptionError, ShapeError
from svu_mi.geometry.neighbors import neighbors
from svu_mi.geometry.texels import Texels, texels
from svu_mi.posterior.estimate import Estimate
from svu_mi.posterior.grid import ParameterGrid
from svu_mi.posterior.posterior import Posterior
from svu_mi.posterior.tabulated import TabulatedKernel, tabulated_posterior
from svu_mi.presets import preset
from svu_mi.recovery.regularizers.global_sharing import GlobalSharing, divergences
from svu_mi.recovery.regularizers.sharing_seeds import find_seeds, least_minima
from svu_mi.recovery.regularizers.total_variation import TotalVariation

RESOLUTION = (24, 16)
GRID = ParameterGrid(4, 3)


@cache
def sphere() -> tuple[Texels, Any]:
    mesh = make_mesh("ball", ball())
    return texels(mesh, RESOLUTION), mesh


def a_texture(seed: int, channels: int | None = 3, resolution=RESOLUTION) -> np.ndarray:
    width, height = resolution
    shape = (height, width) if channels is None else (height, width, channels)
    return np.random.default_rng(seed).random(shape).astype(np.float32)


def differentiated(regularizer: Any, values: np.ndarray) -> tuple[float, np.ndarray]:
    """Return loss and gradient, as in the loop of a caller."""
    texture = as_tensor(values)
    dr.enable_grad(texture)
    loss = regularizer(texture)
    dr.backward(3 * loss)
    return float(loss[0]), np.array(texture.grad, np.float64) / 3


def flat(where: Texels, values: np.ndarray) -> np.ndarray:
    """(T, C) float64 values of the texels of a texture."""
    width, height = where.resolution
    return values.astype(np.float64).reshape(width * height, -1)[where.index.numpy()]


def check_gradient(oracle: Any, gradient: np.ndarray, values: np.ndarray, seed: int) -> None:
    """Compare with central differences of the float64 oracle along random directions."""
    rng = np.random.default_rng(seed)
    for _ in range(4):
        way = rng.normal(size=values.shape)
        step = 1e-5
        slope = (oracle(values + step * way) - oracle(values - step * way)) / (2 * step)
        # float32 gradients: 1e-5 of the sum of magnitudes.
        assert abs((gradient * way).sum() - slope) < 1e-5 * np.abs(gradient * way).sum() + 1e-9


# --- total variation


def variation(where, around, values, epsilon=1e-2, edge=0.0) -> float:
    """Return the mean over pairs in float64, by the definition."""
    psi = flat(where, values)
    first, second = (column.numpy() for column in around.pairs)
    difference = psi[first] - psi[second]
    size = np.sqrt(difference**2 + epsilon**2) - epsilon
    size = edge * np.log1p(size / edge) if edge else size
    return float(size.sum() / max(len(first), 1))


@pytest.mark.parametrize("channels", [3, 1, None, 5])
@pytest.mark.parametrize(("epsilon", "edge"), [(1e-2, 0.0), (0.3, 0.0), (1e-2, 0.15)])
def test_total_variation_matches_its_definition(channels, epsilon, edge):
    where, mesh = sphere()
    around = neighbors(where, mesh)
    values = a_texture(59120447, channels)
    rule = TotalVariation(where, mesh, epsilon=epsilon, edge=edge)
    loss, gradient = differentiated(rule, values)

    def oracle(psi):
        return variation(where, around, psi, epsilon, edge)

    assert loss == pytest.approx(oracle(values), rel=1e-5)
    check_gradient(oracle, gradient, values, 771204)
    outside = ~where.inside()
    assert outside.any() and not gradient[outside].any()


def test_pixels_outside_charts_have_no_influence():
    where, mesh = sphere()
    values = a_texture(1287)
    other = values.copy()
    other[~where.inside()] = np.nan
    one, two = (differentiated(TotalVariation(where, mesh), x) for x in (values, other))
    assert one[0] == two[0]
    np.testing.assert_array_equal(one[1], two[1])


@cache
def two_charts() -> tuple[Texels, Any]:
    """Charts that touch in the map but not in space, a third chart, and holes around."""
    mesh = together(
        quad((0, 0, 0), (4, 0, 0), (0, 4, 0), (0, 0, 0.5, 0.5)),
        quad((9, 0, 0), (4, 0, 0), (0, 4, 0), (0.5, 0, 1, 0.5)),
        quad((20, 0, 0), (2, 0, 0), (0, 3, 0), (0.2, 0.6, 0.5, 0.95)),
    )
    return texels(mesh, RESOLUTION), mesh


def printed_variation(where: Texels, image: np.ndarray) -> tuple[float, np.ndarray]:
    """Mean of |right - here| and |below - here| where both are inside; float64, with gradient."""
    inside = where.inside()
    image = image.astype(np.float64).reshape(*inside.shape, -1)
    total, pairs, gradient = 0.0, 0, np.zeros_like(image)
    for axis in (0, 1):
        first = [slice(None)] * 2
        second = [slice(None)] * 2
        first[axis], second[axis] = slice(None, -1), slice(1, None)
        both = inside[tuple(first)] & inside[tuple(second)]
        difference = np.where(both[..., None], image[tuple(second)] - image[tuple(first)], 0)
        total, pairs = total + np.abs(difference).sum(), pairs + both.sum()
        gradient[tuple(second)] += np.sign(difference)
        gradient[tuple(first)] -= np.sign(difference)
    return total / pairs, gradient / pairs


@pytest.mark.parametrize("scene", [sphere, two_charts])
@pytest.mark.parametrize("steps", [3, 1 << 20])
@pytest.mark.parametrize("channels", [3, 1, None])
def test_tv_in_texture_space_is_the_papers(scene, steps, channels):
    """Coarse steps, so that many neighbours are equal and have no gradient."""
    where, _ = scene()
    values = np.round(a_texture(1663204127, channels) * steps) / np.float32(steps)
    loss, gradient = differentiated(TotalVariation(where, epsilon=0.0), values)
    wanted, slope = printed_variation(where, values)
    assert loss == pytest.approx(wanted, rel=1e-5)
    np.testing.assert_allclose(gradient.reshape(slope.shape), slope, atol=1e-5 * slope.max())


def test_total_variation_crosses_seams():
    """A stripe has the same total variation at the border of the map as in its middle."""
    where, mesh = sphere()
    width, height = RESOLUTION
    row, column = np.divmod(where.index.numpy().astype(int), width)
    belt = (row > 2) & (row < height - 3)  # at the poles all columns meet

    def stripe(first: int, mesh: Any) -> float:
        inside = (belt & ((column - first) % width < 2)).astype(np.float32)
        return differentiated(TotalVariation(where, mesh), where.to_image(inside))[0]

    assert stripe(0, mesh) == pytest.approx(stripe(width // 4, mesh), rel=1e-5)
    # Without the mesh, both borders are separate.
    assert stripe(0, None) < 0.65 * stripe(width // 4, None)


@pytest.mark.parametrize("kind", ["tv", "sharing", "dragging"])
def test_gradients_are_bitwise_reproducible(kind):
    where, mesh = sphere()
    regularizer = {
        "tv": lambda: TotalVariation(where, mesh),
        "sharing": lambda: GlobalSharing(materials(0), seeds=5),
        "dragging": lambda: GlobalSharing.printed(materials(0), seeds=5),
    }[kind]()
    runs = [differentiated(regularizer, a_texture(4471)) for _ in range(4)]
    for loss, gradient in runs[1:]:
        assert loss == runs[0][0]
        np.testing.assert_array_equal(gradient, runs[0][1])


@pytest.mark.parametrize("kind", ["tv", "sharing"])
def test_other_textures_and_weights_need_no_compilation(kind):
    where, mesh = sphere()
    make_one = {
        "tv": lambda k: TotalVariation(where, mesh, epsilon=0.01 * (k + 1)),
        "sharing": lambda k: GlobalSharing(materials(k), seeds=4 + k, tau=0.4 + 0.1 * k),
    }[kind]
    differentiated(make_one(0), a_texture(1))
    differentiated(make_one(1), a_texture(2))
    another = make_one(2)
    with launched_kernels() as kernels:
        differentiated(another, a_texture(3))
    assert all(kernel["cache_hit"] for kernel in kernels)


@pytest.mark.parametrize("kind", ["tv", "sharing"])
def test_forward_derivatives_agree_with_backward_ones(kind):
    where, mesh = sphere()
    regularizer = TotalVariation(where, mesh) if kind == "tv" else GlobalSharing(materials(2))
    values = a_texture(70071)
    way = np.random.default_rng(5).normal(size=values.shape).astype(np.float32)
    _, gradient = differentiated(regularizer, values)
    texture = as_tensor(values)
    dr.enable_grad(texture)
    dr.set_grad(texture, as_tensor(way))
    slope = float(dr.forward_to(regularizer(texture))[0])
    assert slope == pytest.approx((gradient * way).sum(), abs=1e-5 * np.abs(gradient * way).sum())


@pytest.mark.parametrize("kind", ["tv", "sharing"])
def test_textures_of_other_shapes_are_refused(kind):
    where, mesh = sphere()
    regularizer = TotalVariation(where, mesh) if kind == "tv" else GlobalSharing(materials(0))
    for shape in ((24, 16, 3), (16, 24, 3, 1), (384,), (16, 24, 0)):
        with pytest.raises(ShapeError, match=r"\(16, 24, C\).*got \("):
            regularizer(dr.zeros(mi.TensorXf, shape))
    with pytest.raises(OptionError, match=r"mi\.TensorXf, got ndarray"):
        regularizer(np.zeros((16, 24)))
    with pytest.raises(OptionError, match='TensorXu8; no gradient passes; set format="variant" on'):
        regularizer(dr.zeros(mi.TensorXu8, (16, 24, 1)))


def test_wrong_arguments_are_refused():
    where, mesh = sphere()
    for epsilon in (-1, float("inf"), float("nan")):
        with pytest.raises(OptionError, match="epsilon"):
            TotalVariation(where, mesh, epsilon=epsilon)
    with pytest.raises(TypeError, match="positional arguments"):
        TotalVariation(where, mesh, np.ones(where.count, bool))  # once which texels count
    other = texels(mesh, 8)
    with pytest.raises(ShapeError, match="got neighbours of"):
        TotalVariation(where, neighbors(other, mesh))
    with pytest.raises(ShapeError, match="got neighbours of"):
        GlobalSharing(materials(0), neighbors(other, mesh))
    for wrong in ({"seeds": 0}, {"tau": 0}, {"tau": float("inf")}, {"divergence": "both"},
                  {"seeding": "most"}):  # fmt: skip
        with pytest.raises(OptionError, match=next(iter(wrong)).rstrip("s")):
            GlobalSharing(materials(0), **wrong)
    for seeds, problem in (([0, 10**6], "no texel 1000000"), ([0.5], "no"), ([True], "1 flags")):
        with pytest.raises(OptionError, match=f"GlobalSharing: {problem}"):
            GlobalSharing(materials(0), seeds=seeds)


# --- global sharing


def an_estimate(energies: np.ndarray, observed: np.ndarray, where: Texels) -> Estimate:
    posterior = tabulated_posterior(energies, GRID, observed)
    return Estimate(
        method="angular", preset=preset("default", method="angular"), texels=where,
        posterior=posterior, coverage=to_drjit(mi.UInt32, observed.astype(np.uint32)),
        seen_per_view=np.array([int(observed.sum())]), skipped={},
    )  # fmt: skip


@cache
def materials(seed: int) -> Estimate:
    """Two materials in the left and right half with few certain texels; the poles are unseen."""
    where, _ = sphere()
    rng = np.random.default_rng(seed)
    energies = rng.random((where.count, *GRID.shape))
    left = where.index.numpy() % RESOLUTION[0] < RESOLUTION[0] // 2
    energies[left, 0, 0] -= rng.uniform(0, 12, left.sum())
    energies[~left, 3, 2] -= rng.uniform(0, 12, (~left).sum())
    row = where.index.numpy() // RESOLUTION[0]
    return an_estimate(energies, (row > 2) & (row < RESOLUTION[1] - 3), where)


def kl(p: np.ndarray, q: np.ndarray) -> float:
    """KL(p || q), float64."""
    p, q = p.ravel().astype(np.float64), q.ravel().astype(np.float64)
    return float((p * (np.log(np.maximum(p, 1e-30)) - np.log(np.maximum(q, 1e-30)))).sum())


def oracle_weights(posterior: Posterior, chosen: np.ndarray, tau: float, kind: str) -> np.ndarray:
    """(S, T) of Eq. 15, pair by pair."""
    p = np.array(posterior.probabilities)
    table = np.array([
        [kl(p[i], p[q]) if kind == "forward" else kl(p[q], p[i]) for i in range(len(p))]
        for q in chosen
    ])  # fmt: skip
    return np.exp(-(table**2) / (2 * (tau * table.mean()) ** 2))


def shared(where: Texels, weights: np.ndarray, chosen: np.ndarray, values: np.ndarray,
           fixed: np.ndarray | None = None) -> float:  # fmt: skip
    """Eq. 14, float64; ``fixed`` are the values that seeds keep."""
    psi = flat(where, values)
    at = (psi if fixed is None else flat(where, fixed))[chosen]
    apart = ((psi[None] - at[:, None]) ** 2).sum(axis=-1)
    return float((weights * apart).sum() / where.count)


@pytest.mark.parametrize("divergence", ["forward", "reverse"])
@pytest.mark.parametrize("anchored", [True, False])
@pytest.mark.parametrize("channels", [3, None])
def test_sharing_is_equation_14(divergence, anchored, channels):
    estimate, (where, mesh) = materials(41), sphere()
    sharing = GlobalSharing(
        estimate, mesh, seeds=6, tau=0.5, divergence=divergence, anchored=anchored
    )
    weights = oracle_weights(estimate.posterior, sharing.seeds, 0.5, divergence)
    table = np.array(sharing.weights).reshape(weights.shape)
    np.testing.assert_allclose(table, weights, atol=2e-5)  # float32 logarithms of 12 cells
    np.testing.assert_allclose(sharing.pull(), weights.sum(axis=0), atol=1e-4)
    values = a_texture(920117, channels)
    loss, gradient = differentiated(sharing, values)
    assert loss == pytest.approx(shared(where, table, sharing.seeds, values), rel=1e-5)
    fixed = values if anchored else None
    check_gradient(lambda x: shared(where, table, sharing.seeds, x, fixed), gradient, values, 12)


def test_sharing_weights_form_an_image():
    estimate, (where, _) = materials(41), sphere()
    sharing = GlobalSharing(estimate)
    image = sharing.image()
    assert image.shape == RESOLUTION[::-1] and not image[~where.inside()].any()
    np.testing.assert_array_equal(image.ravel()[where.index.numpy()], sharing.pull())


@pytest.mark.parametrize("divergence", ["forward", "reverse"])
def test_texels_are_pulled_to_plausible_seeds(divergence):
    """A third certain material differs from both certain seeds."""
    where, _ = sphere()
    energies = np.full((where.count, *GRID.shape), 30.0)
    a, b, c = (0, 0), (3, 2), (1, 1)
    energies[:, *a] = 0
    energies[1, *b] = energies[2, *c] = 0
    energies[1, *a] = energies[2, *a] = 30.0
    energies[3, *b] = 0.5  # is either of two materials
    estimate = an_estimate(energies, np.ones(where.count, bool), where)
    sharing = GlobalSharing(estimate, seeds=[0, 1], divergence=divergence)
    to_a, to_b = np.array(sharing.weights).reshape(2, -1)
    assert to_a[0] > 0.99 and to_b[1] > 0.99
    assert max(to_b[0], to_a[1]) < 0.05 and max(to_a[2], to_b[2]) < 0.05
    # KL(P_p || P_q) has half of p's mass where the seed has none, KL(P_q || P_p) is log 2.
    assert (min(to_a[3], to_b[3]) > 0.9) == (divergence == "reverse")


def test_anchored_seeds_have_no_gradient():
    estimate, (where, _) = materials(7), sphere()
    free, held = (GlobalSharing(estimate, seeds=[50], anchored=a) for a in (False, True))
    values = a_texture(40412)
    at = where.index.numpy()[50]
    forces = [differentiated(s, values)[1].reshape(-1, 3)[at] for s in (free, held)]
    assert np.abs(forces[0]).max() > 0.01 and not forces[1].any()


def test_sharing_without_observed_texels_is_zero():
    where, mesh = sphere()
    unseen = an_estimate(np.zeros((where.count, *GRID.shape)), np.zeros(where.count, bool), where)
    sharing = GlobalSharing(unseen, mesh)
    assert len(sharing.seeds) == 0 and not sharing.image().any()
    loss, gradient = differentiated(sharing, a_texture(5))
    assert loss == 0 and not gradient.any()


def test_single_texel_is_its_own_seed():
    mesh = make_mesh("ball", ball())
    where = texels(mesh, 1)
    estimate = an_estimate(np.zeros((1, *GRID.shape)), np.ones(1, bool), where)
    sharing = GlobalSharing(estimate, mesh)
    np.testing.assert_array_equal(sharing.seeds, [0])
    loss, gradient = differentiated(sharing, a_texture(6, 3, (1, 1)))
    assert loss == 0 and not gradient.any()


def test_all_posteriors_of_the_package_share():
    """Distributions per channel: the mean of their divergences, as in Posterior.kl."""

    class PerChannel(TabulatedKernel):
        channels = 3

        def tables(self, texels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            p, best = super().tables(texels)
            p = np.concatenate([p, np.roll(p, 1, axis=1), p[:, ::-1]], axis=-1)
            return p, np.repeat(best, 3, axis=-1)

    estimate = materials(29)
    posterior: Any = estimate.posterior
    kernel = PerChannel(GRID, posterior.kernel.energies)
    colored = replace(posterior, kernel=kernel)
    expected = np.array(colored.kl(colored))[:, [5, 60]].T
    computed = divergences(colored, np.array([5, 60]), "forward")
    np.testing.assert_allclose(computed, expected, atol=1e-4)
    sharing = GlobalSharing(replace(estimate, posterior=colored), seeds=[5, 60])
    assert np.isfinite(differentiated(sharing, a_texture(8))[1]).all()


def test_divergences_do_not_depend_on_chunks(monkeypatch):
    posterior = materials(11).posterior
    some = np.array([3, 40])
    whole = divergences(posterior, some, "reverse")
    monkeypatch.setattr("svu_mi.recovery.regularizers.global_sharing.CHUNK", 12 * 7)
    np.testing.assert_allclose(divergences(posterior, some, "reverse"), whole, atol=1e-5)
    expected = np.array(posterior.kl(posterior))[:, some].T
    np.testing.assert_allclose(divergences(posterior, some, "forward"), expected, atol=1e-4)


# --- seeds


def oracle_minima(
    values: np.ndarray, observed: np.ndarray, pairs: set[tuple[int, int]]
) -> list[int]:
    """Visit every plateau of equal values; it is a minimum without a lower neighbour."""
    beside: dict[int, set[int]] = {t: set() for t in np.flatnonzero(observed).tolist()}
    for a, b in pairs:
        if observed[a] and observed[b]:
            beside[a].add(b)
            beside[b].add(a)
    lowest, done = [], set()
    for first in beside:
        plateau, front = {first}, [first]
        while front:
            equal = {n for n in beside[front.pop()] if values[n] == values[first]} - plateau
            plateau |= equal
            front += equal
        lower = any(values[n] < values[first] for t in plateau for n in beside[t])
        if not lower and first not in done:
            lowest.append(min(plateau))
        done |= plateau
    return sorted(lowest, key=lambda t: (values[t], t))


@pytest.mark.parametrize("scene", [sphere, two_charts])
@pytest.mark.parametrize("surface", [True, False])
@pytest.mark.parametrize("steps", [3, 8, 1 << 40])
@pytest.mark.parametrize("part", [1.0, 0.6, 0.0])
def test_least_minima_match_a_search_over_all_texels(scene, surface, steps, part):
    """With and without ties, across seams; unseen texels are not seeds and have no effect."""
    where, mesh = scene()
    around = neighbors(where, mesh if surface else None)
    rng = np.random.default_rng(2083364731 + steps)
    values = np.round(rng.random(where.count) * steps) / steps
    observed = rng.random(where.count) < part
    wanted = oracle_minima(values, observed, links(around))
    assert (len(wanted) > 3) == (part > 0)
    for count in (1, 3, 20, 10**6):
        seeds = least_minima(values, observed, around, count)
        assert seeds.dtype == np.int64
        np.testing.assert_array_equal(seeds, wanted[:count])


def test_seeds_are_seen_certain_and_few():
    estimate, (where, mesh) = materials(23), sphere()
    around = neighbors(where, mesh)
    entropy = np.array(estimate.entropy)
    for count in (1, 2, 5):
        seeds = find_seeds(estimate, around, count)
        assert 1 <= len(seeds) <= count and len(set(seeds)) == len(seeds)
        assert (np.array(estimate.coverage)[seeds] > 0).all()
        assert (entropy[seeds] < np.median(entropy)).all()


def test_seeds_are_of_different_materials():
    """Both materials get seeds, although one is more certain everywhere."""
    where, mesh = sphere()
    rng = np.random.default_rng(1931)
    left = where.index.numpy() % RESOLUTION[0] < RESOLUTION[0] // 2
    energies = np.zeros((where.count, *GRID.shape))
    energies[left, 0, 0] -= rng.uniform(6, 12, left.sum())
    energies[~left, 3, 2] -= rng.uniform(5, 9, (~left).sum())
    estimate = an_estimate(energies, np.ones(where.count, bool), where)
    seeds = find_seeds(estimate, neighbors(where, mesh), 2)
    assert sorted(left[seeds]) == [False, True]


@pytest.mark.parametrize("epsilon", [1e-2, 0.0])
def test_constant_textures_have_no_variation(epsilon):
    where, mesh = sphere()
    loss, gradient = differentiated(
        TotalVariation(where, mesh, epsilon=epsilon), np.full((16, 24, 3), 0.37, "f4")
    )
    assert loss == 0 and not gradient.any()
