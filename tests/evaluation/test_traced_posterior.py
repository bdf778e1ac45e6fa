"""The path-traced reference: right, repeatable, and harmless to the capture."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from contextlib import contextmanager
from dataclasses import replace
from typing import Any
from unittest.mock import MagicMock

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.helpers import ball, ball_scene, memory_capture, render_ball, render_views, write_ball

from svu_mi.capture import mesh as capture_mesh
from svu_mi.capture.sensors import sphere_sensors
from svu_mi.core.progress import Progress
from svu_mi.errors import CaptureError, OptionError, SvuWarning
from svu_mi.evaluation import path_trace, traced_posterior, visible_pairs
from svu_mi.evaluation.squared_errors import TexelMeans, derive_all, render_all
from svu_mi.evaluation.traced_posterior import reference_posterior
from svu_mi.geometry.texels import texels
from svu_mi.pipeline import estimate
from svu_mi.posterior.grid import PrincipledGrid
from svu_mi.presets import AngularPreset
from svu_mi.statistics.cholesky_factors import PAIRS

GRID = PrincipledGrid(3, 3, 3)
TRUTH = (1, 2, 1)  # cell of GRID
SEED = 52673  # drawn


def sky(gain: float = 1.0) -> dict[str, Any]:
    """A soft gradient and two windows: every roughness looks different under it."""
    image = np.full((16, 32, 3), 0.2, np.float32)
    image[:8] += np.linspace(0.6, 0, 8, dtype=np.float32)[:, None, None]
    image[3:6, 4:7] = (6, 5, 4)
    image[8:11, 20:24] = (2, 3, 4)
    return {"type": "envmap", "bitmap": mi.Bitmap(image * np.float32(gain))}


def paint(roughness: float = 0.5, metallic: float = 1.0, base_color: float = 0.5) -> dict[str, Any]:
    color = {"type": "rgb", "value": base_color}
    return {"type": "principled", "roughness": roughness, "metallic": metallic, "base_color": color}


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ball")
    return render_ball(folder, sky(), paint(), views=24, resolution=(48, 48), spp=64)


@pytest.fixture(scope="module")
def layout(capture):
    return texels(capture.mesh, 24)


def traced(capture, layout, subset, spp, **options: Any):
    """The reference on ``GRID``, with one seed unless another is given."""
    options = {"grid": GRID, "seed": SEED} | options
    return reference_posterior(capture, layout, subset, spp, **options)


def energies(reference) -> np.ndarray:
    """Free of Monte Carlo variance, which few paths have a lot of."""
    whole, first, second = reference.tables
    return np.asarray((4 * whole - first - second) / 2)


def valley() -> capture_mesh.MeshArrays:
    """Two squares that face each other across a right angle, one half of the chart each."""
    x = np.array([0.0, 1.0])
    left = [(u, v, 0.0) for v in x for u in x]
    right = [(0.0, v, u) for v in x for u in x]
    uvs = [(0.05 + 0.4 * u + side, 0.05 + 0.9 * v) for side in (0, 0.5) for v in x for u in x]
    faces = [(0, 1, 3), (0, 3, 2), (4, 7, 5), (4, 6, 7)]
    return capture_mesh.MeshArrays(np.array(left + right), np.array(faces), None, np.array(uvs))


def valley_capture(tmp_path, max_depth: int):
    path = tmp_path / "valley.ply"
    capture_mesh.make_mesh("valley", valley()).write_ply(str(path))
    white = {"type": "ply", "filename": str(path), "face_normals": True, "bsdf": paint(1, 0, 1)}
    tracer = {"type": "path", "max_depth": max_depth}
    scene = mi.load_dict(
        {"type": "scene", "integrator": tracer, "light": {"type": "constant"}, "valley": white},
        optimize=False,
    )
    sensors = sphere_sensors(scene.shapes()[0], 12, (32, 32))
    return memory_capture(scene, render_views(scene, sensors, 128), sensors)


# --- right -------------------------------------------------------------------------------


@pytest.mark.slow
def test_four_corners_reproduce_a_row_if_paths_are_shared(capture, layout):
    """At metallic 0 and 1 sampling does not depend on the base colour: equal path by path."""
    a, b = (
        traced(capture, layout, 30, 8, method=m).posterior.kernel.energies
        for m in ("linear", "brute")
    )
    ends = [0, 2]
    # Both sum the same float32 radiances in another order.
    assert a[:, :, ends] == pytest.approx(b[:, :, ends], rel=1e-3, abs=1e-3)
    assert not np.allclose(a[:, :, 1], b[:, :, 1], rtol=1e-3, atol=1e-3)


@pytest.mark.slow
def test_linear_and_brute_agree_within_their_noise(capture, layout):
    """z-scores of the mean energy of each cell, over independent runs of both methods."""
    some = np.arange(0, layout.count, 36)
    runs = {
        method: np.array([
            energies(traced(capture, layout, some, 16, method=method, seed=seed + run)).mean(axis=0)
            for run in range(8)
        ])
        for method, seed in (("linear", SEED), ("brute", SEED + 100))
    }  # fmt: skip
    means = {name: values.mean(axis=0) for name, values in runs.items()}
    error = np.sqrt(sum(values.var(axis=0, ddof=1) / len(values) for values in runs.values()))
    z = (means["linear"] - means["brute"]) / error
    # |z| has mean 0.8; of 27 cells with Student's tails of 14 degrees, 4.5 is one in 200 runs.
    assert np.abs(z).mean() < 1.4
    assert np.abs(z).max() < 4.5
    assert error.max() < 0.05 * means["brute"].max(), "too noisy to see a difference"


@pytest.mark.slow
def test_light_between_parts_needs_brute_force(tmp_path):
    """In a white valley a third of the light comes by way of the other side."""
    capture = valley_capture(tmp_path, max_depth=3)
    layout = texels(capture.mesh, 16)
    direct, bounced = (
        traced(capture, layout, 40, 128, grid=PrincipledGrid(2, 2, 2), method="brute",
               max_depth=depth)
        for depth in (2, 3)
    )  # fmt: skip
    rough_white = (slice(None), 1, 0, 1)
    seen = direct.posterior.observed
    right, wrong = energies(bounced)[rough_white][seen], energies(direct)[rough_white][seen]
    assert seen.sum() > 20
    assert abs(right.mean()) < 0.2
    assert wrong.mean() > 1
    assert (wrong > right).mean() > 0.9


def assert_finds_truth(reference, part: float = 0.95) -> None:
    """Chance would find 1 in 27; noise of the photographs takes some texels to a neighbour."""
    best = energies(reference).reshape(reference.count, -1).argmin(axis=1)
    truth = np.ravel_multi_index(TRUTH, GRID.shape)
    often = reference.coverage >= 4
    assert often.sum() > 40
    assert (best == truth)[often].mean() >= part


@pytest.mark.slow
def test_the_true_material_has_the_smallest_energy(capture, layout):
    reference = traced(capture, layout, 200, 128)
    assert reference.count == 200
    assert reference.dropped <= 0.01 * reference.coverage.sum()
    assert (reference.coverage > 0).all()
    assert_finds_truth(reference)
    # The neighbours in the grid are far away; what doubt there is has few views.
    assert np.median(reference.entropy) < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["neighbour", "twosided", "flipped", "area light"])
def test_the_rest_of_the_scene_stays(tmp_path, kind):
    """Other shapes shade, other lights shine, and the object keeps its orientation."""
    scene = {"type": "scene", "light": sky(), "ball": ball_part(tmp_path, kind, paint())}
    if kind == "neighbour":
        turn = mi.ScalarTransform4f().translate([0, 1.2, 0]).rotate([1, 0, 0], 90).scale(2)
        both = {"type": "twosided", "nested": {"type": "diffuse"}}
        scene["lid"] = {"type": "disk", "to_world": turn, "bsdf": both}
    if kind == "area light":
        area = {"type": "area", "radiance": {"type": "rgb", "value": [9, 7, 5]}}
        scene["lamp"] = {"type": "sphere", "center": [0, 2.5, 0], "radius": 0.4, "emitter": area}
    made = mi.load_dict({"integrator": {"type": "path", "max_depth": 2}, **scene}, optimize=False)
    sensors = sphere_sensors(made.shapes()[0], 20, (40, 40))
    images = render_views(made, sensors, 64)
    target = next(shape for shape in made.shapes() if shape.id() == "ball")
    capture = memory_capture(made, images, sensors, shape=target, mesh=target)
    reference = traced(capture, texels(capture.mesh, 16), 80, 128)
    assert_finds_truth(reference, 0.9)
    # The photographs' own noise leaves 0.6 to 0.8; without the lid it would be 60.
    assert energies(reference)[:, *TRUTH].mean() < 1.5


def ball_part(tmp_path, kind: str, bsdf: dict[str, Any]) -> dict[str, Any]:
    if kind == "flipped":
        inside_out = ball()
        path = write_ball(tmp_path, faces=inside_out.faces[:, ::-1], normals=-inside_out.normals)
        return {"type": "ply", "filename": str(path), "flip_normals": True, "bsdf": bsdf}
    if kind == "twosided":
        bsdf = {"type": "twosided", "nested": bsdf}
    return {"type": "ply", "filename": str(write_ball(tmp_path)), "bsdf": bsdf}


@pytest.fixture
def asked(monkeypatch):
    """Pairs and traced halves that a reference asks for, in lists that fill up."""
    result, rendered = [], []
    find, render = traced_posterior.visible_pairs, traced_posterior.trace

    def keep(name, into, do):
        monkeypatch.setattr(traced_posterior, name, lambda *x: into.append(do(*x)) or into[-1])

    keep("visible_pairs", result, find)
    keep("trace", rendered, render)
    return result, rendered


@pytest.mark.few(1)
@pytest.mark.parametrize("noise", ["relative", "heteroscedastic"])
def test_energies_are_weighted_squares_of_the_mean_radiance(capture, layout, asked, noise):
    """Every psi of every texel again, from the pairs and the traced halves, in NumPy."""
    result, rendered = asked
    grid, sigma = PrincipledGrid(2, 2, 3), 0.05
    how = {"grid": grid, "sigma": sigma, "method": "brute", "noise": noise}
    reference = traced(capture, layout, 20, 4, **how)
    (pair,), scale = result, reference.scale
    halves = np.array(rendered)  # (psi, half, P, channel)
    assert halves.shape == (12, 2, pair.count, 3)
    halves = halves.mean(axis=-1)
    for k in range(20):
        own = pair.texel == k
        b = pair.observed[own]
        w = np.ones(len(b)) if noise == "relative" else 1 / (1 + (b / scale) ** 2)
        a, c = halves[:, 0, own], halves[:, 1, own]
        for table, r in zip(
            (reference.posterior, *reference.halves), ((a + c) / 2, a, c), strict=True
        ):
            expected = (w * (b - r) ** 2).sum(axis=1) / len(b) / (2 * (sigma * scale) ** 2)
            # Only the order of sums in float64 differs.
            assert table.kernel.energies[k].ravel() == pytest.approx(expected, rel=1e-9)
        product = (w * (b - a) * (b - c)).mean(axis=1) / (2 * (sigma * scale) ** 2)
        assert energies(reference)[k].ravel() == pytest.approx(product, rel=1e-9, abs=1e-9)


@pytest.mark.slow
def test_estimated_noise_equals_that_of_weighted_samples(capture, layout, asked):
    """Sums of one texel again, from the pairs and the traced halves, in NumPy; and their uses."""
    result, rendered = asked
    reference = traced(capture, layout, 20, 4, noise="estimated")
    switches = AngularPreset()
    (pair,), levels, kappa = result, switches.levels, switches.knee * reference.unit
    halves = np.array(rendered).reshape(levels, 4, 2, pair.count, 3)  # corner, half
    for k in range(20):
        own = pair.texel == k
        b, grey = pair.radiance[own], pair.observed[own]
        w = 1 / (1 + (grey**2 + switches.edges * pair.contrast[own]) / kappa**2)
        assert reference.weight[k] == pytest.approx(w.sum(), rel=1e-9)
        a, c = halves[:, :, 0, own], halves[:, :, 1, own]
        for table, r in zip(reference.tables, ((a + c) / 2, a, c), strict=True):
            black, white, dark, bright = np.moveaxis(r, 1, 0)  # (R, P, C) each
            x = np.stack([white - black, bright - dark, dark - black, black - b])
            expected = np.einsum("p,irpc,jrpc->rcij", w, x, x)
            pairs_of = np.stack([expected[..., i, j] for i, j in PAIRS], axis=-1)
            assert table[..., k] == pytest.approx(pairs_of, rel=1e-9, abs=1e-12)
    assert reference.posterior.channels == 3
    assert np.array(reference.posterior.probabilities).shape == (20, *GRID.shape, 3)


@pytest.mark.slow
def test_estimated_noise_gives_the_posterior_of_the_estimator(tmp_path):
    """From one side of the ball, so that some texels are seen by few views; 256 paths leave a
    correlation of 0.95, and 1024 no more.

    Pixels and texels are small: paths lead to centres of texels, while the estimator averages
    narrow lobes over the normals of a pixel.
    """
    scene = ball_scene(tmp_path, sky(), paint())
    sensors = sphere_sensors(scene.shapes()[0], 24, (192, 192))[:12]
    half = memory_capture(scene, render_views(scene, sensors, 64), sensors)
    layout = texels(half.mesh, 96)
    ours, fixed = (estimate(half, layout, preset=name) for name in ("default", "fixed"))
    reference = reference_posterior(ours, None, 80, 256, noise="estimated", seed=SEED)
    H, other = (np.array(x.entropy)[reference.subset] for x in (ours, fixed))
    rho = np.corrcoef(H, reference.entropy)[0, 1]
    assert rho > 0.9
    assert rho > np.corrcoef(other, reference.entropy)[0, 1] + 0.1
    assert np.abs(H - reference.entropy).mean() < 0.06
    assert abs((H - reference.entropy).mean()) < 0.03
    for name, bar in (("roughness", 0.06), ("metallic", 0.05), ("base_color", 0.03)):
        a = np.array(ours.posterior.mean(name))[reference.subset]
        assert np.abs(a - np.array(reference.posterior.mean(name))).mean() < bar, name
    # More of the paths' noise can only be taken for noise of the photographs.
    noise, usual = (np.median(p.kernel.noise) for p in (reference.posterior, ours.posterior))
    assert 1 < noise / usual < 2
    assert reference.split_half().correlation > 0.85


def test_weights_go_through_the_four_corners():
    """Where radiance is exactly bilinear, both ways give the same weighted means."""
    rng = np.random.default_rng(SEED)
    texel, observed, weight = rng.integers(0, 3, 40), rng.random(40), rng.random(40)
    corners = rng.random((2, 2, 2, 40, 3))  # half, metallic, base colour, pair, channel

    def render(psi: Mapping[str, float]) -> tuple[np.ndarray, np.ndarray]:
        m, c = psi["metallic"], psi["base_color"]
        return tuple(np.einsum("hmcpk,m,c->hpk", corners, [1 - m, m], [1 - c, c]))

    mean = TexelMeans(texel, 3, weight)
    a, b = (derive(observed, mean, GRID, render) for derive in (derive_all, render_all))
    assert a == pytest.approx(b, rel=1e-9)


# --- what it is made of --------------------------------------------------------------------


@pytest.mark.slow
def test_batches_change_nothing_but_the_random_numbers(capture, layout, monkeypatch):
    whole = traced(capture, layout, 60, 32)
    monkeypatch.setattr(traced_posterior, "LANES", 600)  # 25 texels of 24 views
    parts = traced(capture, layout, 60, 32)
    assert np.array_equal(parts.subset, whole.subset)
    assert np.array_equal(parts.coverage, whole.coverage)
    assert parts.brightness == pytest.approx(whole.brightness, rel=1e-6)
    assert parts.rays == whole.rays == whole.coverage.sum() * 3 * 4 * 32
    assert np.median(np.abs(parts.entropy - whole.entropy)) < 0.05


@pytest.mark.parametrize("noise", ["relative", "estimated"])
def test_rays_that_miss_are_dropped(capture, layout, monkeypatch, noise):
    monkeypatch.setattr(visible_pairs, "TOLERANCE", 0.0)
    reference = reference_posterior(capture, layout, 20, 2, grid=GRID, noise=noise)
    assert reference.dropped > 20
    assert reference.rays == 0
    assert not reference.posterior.observed.any()
    assert (reference.entropy == 1).all()
    assert np.isnan(reference.split_half().correlation)


@pytest.mark.parametrize("noise", ["relative", "estimated"])
def test_unseen_texel_has_entropy_one(capture, layout, noise):
    masks = tuple(np.arange(48 * 48).reshape(48, 48) % 48 < 24 for _ in capture.images)
    half, everyone = replace(capture, masks=masks), np.arange(layout.count)
    reference = reference_posterior(half, layout, everyone, 2, grid=GRID, noise=noise)
    unseen = reference.coverage == 0
    assert np.array_equal(reference.posterior.observed, ~unseen)
    assert (reference.entropy[unseen] == 1).all()
    drawn = reference_posterior(half, layout, layout.count, 2, grid=GRID)
    assert np.array_equal(drawn.subset, np.flatnonzero(~unseen))


@pytest.mark.slow
@pytest.mark.parametrize("noise", ["relative", "heteroscedastic"])
def test_errors_may_be_summed_over_views(capture, layout, tmp_path, noise):
    """Eq. 3 as printed: so many views say so much more. From a cache, too."""
    asked = {"subset": 30, "spp": 8, "noise": noise}
    mean = traced(capture, layout, sigma=0.5, **asked)
    energies = mean.tables[0] * mean.coverage[:, None, None, None]
    p = np.exp(-(energies - energies.min(axis=(1, 2, 3), keepdims=True)))
    p /= p.sum(axis=(1, 2, 3), keepdims=True)
    for again in (False, True):
        total = traced(capture, layout, sigma=0.5, errors="sum", cache=tmp_path, **asked)
        assert total.cached == again
        result = np.array(total.posterior.probabilities)
        np.testing.assert_allclose(result[total.coverage > 0], p[total.coverage > 0], atol=1e-6)
    assert total.entropy.mean() < mean.entropy.mean() - 0.05


def test_split_half_tells_noise(capture, layout):
    reference = reference_posterior(capture, layout, 100, 64, grid=PrincipledGrid(4, 4, 4))
    halves = reference.split_half()
    correlation, first, second = halves.correlation, halves.first, halves.second
    assert first.shape == second.shape == (100,)
    assert not np.array_equal(first, second)
    assert correlation == pytest.approx(np.corrcoef(first, second)[0, 1])
    assert 0.8 < correlation < 1
    assert repr(halves) == f"SplitHalf(correlation={correlation})"
    assert "array" not in repr(reference)
    assert "spp=64" in repr(reference)


@pytest.mark.slow
def test_kernels_do_not_depend_on_psi_or_batch(capture, layout, monkeypatch):
    """After two renders of the first batch, everything is found in the cache."""
    monkeypatch.setattr(traced_posterior, "LANES", 600)
    monkeypatch.setattr(path_trace, "LANES", 500)
    done: list[int] = []

    class Watch(Progress):
        @contextmanager
        def _shown(self, *_: Any):
            yield self

        def update(self, now: int, _total: int) -> None:
            done.append(now)
            if now == 2:
                dr.kernel_history_clear()

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        reference_posterior(capture, layout, 60, 4, grid=GRID, progress=Watch())
        history = dr.kernel_history((dr.KernelType.JIT,))
    renders = 36
    assert done == list(range(1, renders + 1))
    assert len(history) > renders - 2
    assert all(entry["cache_hit"] and not entry["cache_disk"] for entry in history)


def test_the_capture_is_not_touched(capture, layout):
    def state() -> dict[str, Any]:
        params = mi.traverse(capture.scene)
        return {name: np.array(getattr(value, "matrix", value)) for name, value in params}

    def picture() -> np.ndarray:
        return np.array(mi.render(capture.scene, sensor=capture.sensors[0], spp=4, seed=SEED))

    before, image = state(), picture()
    reference_posterior(capture, layout, 10, 2, grid=GRID)
    after = state()
    assert before.keys() == after.keys()
    assert all(np.array_equal(before[name], after[name]) for name in before)
    assert np.array_equal(picture(), image)


# --- cache -------------------------------------------------------------------------------


@pytest.fixture
def calls(monkeypatch):
    """Counts how often anything is traced."""
    trace = MagicMock(wraps=path_trace.trace)
    monkeypatch.setattr(traced_posterior, "trace", trace)
    return trace.call_args_list


@pytest.mark.parametrize("noise", ["relative", "estimated"])
def test_a_cached_reference_is_not_traced_again(capture, layout, tmp_path, calls, noise):
    options = {"grid": GRID, "noise": noise, "cache": tmp_path / "new"}
    first = reference_posterior(capture, layout, 20, 2, **options)
    count = len(calls)
    second = reference_posterior(capture, layout, 20, 2, **options)
    assert count > 0
    assert len(calls) == count
    assert (first.cached, second.cached) == (False, True)
    for name in ("subset", "brightness", "coverage", "entropy"):
        assert np.array_equal(getattr(first, name), getattr(second, name)), name
    for name in ("scale", "unit", "seconds", "rays", "dropped", "spp", "max_depth", "method"):
        assert getattr(first, name) == getattr(second, name), name
    assert np.array_equal(first.tables, second.tables)
    for name in ("observed", "probabilities"):
        a, b = (np.array(getattr(x.posterior, name)) for x in (first, second))
        assert np.array_equal(a, b), name
    if noise == "estimated":
        assert np.array_equal(first.weight, second.weight)
        assert np.array_equal(first.posterior.kernel.noise, second.posterior.kernel.noise)
    else:
        assert np.array_equal(energies(first), energies(second))
    assert second.split_half().correlation == first.split_half().correlation


@pytest.mark.slow
def test_relevant_inputs_change_the_cache_key(capture, layout, tmp_path):
    def run(capture=capture, subset=8, spp=2, **changes: Any) -> bool:
        return not traced(capture, layout, subset, spp, cache=tmp_path, **changes).cached

    assert run()
    assert not run()
    images = list(capture.images)
    images[3] = images[3].copy()
    images[3][24, 24] *= 1.5
    assert run(replace(capture, images=tuple(images)))
    masks = (np.ones((48, 48), bool), *capture.masks[1:])
    assert run(replace(capture, masks=masks))
    assert run(replace(capture, sensors=capture.sensors[1:] + capture.sensors[:1]))
    assert run(replace(capture, used=(False, *capture.used[1:])))
    other = ball_scene(tmp_path, sky(1.5), paint())
    assert run(replace(capture, scene=other, shape=other.shapes()[0]))
    for changes in (
        {"subset": 9}, {"subset": np.arange(8)}, {"spp": 4}, {"seed": 2}, {"sigma": 0.1},
        {"grid": PrincipledGrid(3, 3, 2)}, {"method": "brute"}, {"noise": "heteroscedastic"},
        {"noise": "estimated"}, {"noise": "estimated", "grid": PrincipledGrid(3, 3, 2)},
    ):  # fmt: skip
        assert run(**changes), changes
    assert not run()


def test_a_damaged_cache_is_traced_again(capture, layout, tmp_path):
    first = reference_posterior(capture, layout, 20, 2, grid=GRID, cache=tmp_path)
    (path,) = tmp_path.glob("*.npz")
    path.write_bytes(path.read_bytes()[:-99])
    with pytest.warns(SvuWarning, match="traced again"):
        again = reference_posterior(capture, layout, 20, 2, grid=GRID, cache=tmp_path)
    assert not again.cached
    assert np.array_equal(energies(again), energies(first))
    with warnings.catch_warnings(action="error"):
        assert reference_posterior(capture, layout, 20, 2, grid=GRID, cache=tmp_path).cached


# --- bad input ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"spp": 1}, "spp must be in [2, inf], got 1"),
        ({"spp": 33}, "spp must be even, for two halves that measure the noise, got 33"),
        ({"spp": 4.0}, "spp must be a whole number, got 4.0"),
        ({"subset": 0}, "number of texels (at least 1) or a list of texel indices, got 0"),
        ({"subset": [0, 10**6]}, "subset: no texel 1000000; texels are numbered from 0 to"),
        ({"subset": [-1]}, "no texel -1"),
        ({"subset": [0.5]}, "no texel 0.5"),
        ({"subset": [True, False]}, "2 flags for"),
        ({"subset": []}, "list of texel indices"),
        ({"sigma": 0}, "sigma must be positive"),
        ({"sigma": np.nan}, "sigma must be positive"),
        ({"max_depth": 1}, "max_depth must be in [2, inf]"),
        ({"max_depth": 3}, "unless method is brute, got 3"),
        ({"method": "magic"}, "method must be one of linear, brute, got 'magic'"),
        (
            {"noise": "fixed"},
            "noise must be one of relative, heteroscedastic, estimated, got 'fixed'",
        ),
        ({"noise": "estimated", "method": "brute"}, "method must be linear with estimated noise"),
        ({"noise": "estimated", "max_depth": 3}, "unless method is brute, got 3"),
        ({"errors": "median"}, "errors must be one of mean, sum, got 'median'"),
        ({"noise": "estimated", "errors": "sum"}, "sums over views already"),
        ({"seed": -1}, "seed must be in [0, inf]"),
    ],
)
def test_bad_options_are_refused_in_a_sentence(capture, layout, changes, sentence):
    with pytest.raises(OptionError) as caught:
        reference_posterior(capture, layout, **{"subset": 5, "spp": 2, **changes})
    assert sentence in str(caught.value)
    assert "\n" not in str(caught.value)


def test_nothing_seen_and_nothing_bright_are_refused(capture, layout):
    nothing = tuple(np.zeros((48, 48), bool) for _ in capture.images)
    with pytest.raises(CaptureError, match="No texel of 'ball' is seen"):
        reference_posterior(replace(capture, masks=nothing), layout, 5, 2)
    black = tuple(np.zeros_like(image) for image in capture.images)
    with pytest.raises(CaptureError, match="is black"):
        reference_posterior(replace(capture, images=black), layout, 5, 2)
