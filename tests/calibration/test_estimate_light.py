"""Estimate of light: transport, prior, Gauss-Newton step, uncertainty, background."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from oracle.cells import gains
from scipy.spatial.distance import jensenshannon
from support.helpers import made_up_light, render_ball, turning
from support.made_up_samples import (
    SWITCHES,
    free_samples,
    made_up,
    photographed,
    reflected,
    smooth_light,
)

import svu_mi as svu
from svu_mi.calibration.light import dim_light
from svu_mi.calibration.light.dim_light import divergence, with_level_of_dim_cells
from svu_mi.calibration.light.gauss_newton import (
    COLOR_SD,
    MATERIAL_SD,
    MAX_CHANGE,
    ROUGHNESS_STEP,
    LightFit,
    LightPriors,
    normal_equations,
)
from svu_mi.calibration.light.light_prior import SD, BackgroundPixels, prior_of
from svu_mi.calibration.light.light_samples import FACING, TexelSamples
from svu_mi.calibration.light.light_summary import compare_lights
from svu_mi.calibration.light.light_transport import (
    WIDENED,
    Columns,
    Materials,
    SampleMoments,
    Transport,
    columns_of,
    materials_of,
)
from svu_mi.calibration.light.light_uncertainty import sample_lights, scale_of, widening_of
from svu_mi.core.arrays import fibonacci, to_drjit
from svu_mi.errors import CaptureError, OptionError
from svu_mi.posterior.empirical_bayes import with_empirical_prior
from svu_mi.reflection.lobes import ALBEDO_NODES, split_sum

SHINY = {"type": "principled", "roughness": 0.25, "metallic": 1.0,
         "base_color": {"type": "rgb", "value": [0.7, 0.6, 0.5]}}  # fmt: skip


def of_oracle(samples: TexelSamples, materials: Materials, number: int) -> np.ndarray:
    """Return the (S, N, 3) transport of each sample."""
    cells, normals = fibonacci(number), samples.surface.normal.numpy().T
    return np.stack([
        gains(cells, normals[t], direction, materials.roughness[t], *materials.mixed[t],
              materials.color[t], WIDENED)
        for t, direction in zip(samples.owner, samples.direction.astype(np.float64), strict=True)
    ])  # fmt: skip


def of_all(transport: Transport, materials: Materials) -> np.ndarray:
    """Return the (3, S, N) transport of all samples."""
    samples, light = transport.samples, np.ones((transport.number, 3))
    every = transport.matrix(materials, light, np.ones(samples.count), slice(0, samples.count))
    return np.stack(every).transpose(0, 2, 1)


# --- transport --------------------------------------------------------------------------------


@pytest.mark.parametrize("number", [64, 700])
def test_transport_is_that_of_the_equations(number):
    samples, materials = made_up(12, 5)
    light = np.exp(smooth_light(number))
    truth = np.einsum("snc,nc->sc", of_oracle(samples, materials, number), light)
    transport = Transport.of(samples, number)
    np.testing.assert_allclose(reflected(transport, light, materials), truth, rtol=1e-4)
    weight = np.linspace(1, 2, samples.count)
    K = np.stack(transport.matrix(materials, light, weight, slice(7, 40)), axis=2)
    np.testing.assert_allclose(K.sum(axis=0) / weight[7:40, None], truth[7:40], rtol=1e-4)
    texels, chosen = zip(*samples.blocks(7), strict=True)
    assert [part.stop for part in texels[:-1]] == [part.start for part in texels[1:]]
    assert [chosen[0].start, chosen[-1].stop, texels[-1].stop] == [0, samples.count, 12]
    assert all((samples.owner[s] == t.start).all() for t, s in zip(texels, chosen, strict=True))


def test_light_that_moves_is_that_of_turned_cameras():
    samples, materials = made_up(6, 4)
    cells = fibonacci(64)
    turns = np.stack([np.linalg.qr(np.random.default_rng(k).normal(size=(3, 3)))[0]
                      for k in range(4)])  # fmt: skip
    turns *= np.sign(np.linalg.det(turns))[:, None, None]
    moving = of_all(Transport.of(replace(samples, cameras=turns), 64, moves=True), materials)
    normals = samples.surface.normal.numpy().T
    for s in (0, 5, 23):
        t = samples.owner[s]
        truth = gains(
            cells @ turns[samples.view[s]].T, normals[t], samples.direction[s].astype(np.float64),
            materials.roughness[t], *materials.mixed[t], materials.color[t], WIDENED,
        )  # fmt: skip
        np.testing.assert_allclose(moving[:, s].T, truth, rtol=1e-3, atol=1e-5 * truth.max())


@pytest.mark.parametrize("roughness", [0.3, 0.6, 1.0])
def test_constant_light_reflects_as_the_directional_albedo_says(roughness):
    cosine = (np.array([16, 22, 30]) + 0.5) / ALBEDO_NODES
    directions = np.stack([np.sqrt(1 - cosine**2), 0 * cosine, cosine], axis=1)[None]
    transport = Transport.of(free_samples(np.array([[0, 0, 1.0]]), directions), 4096)
    columns = transport.columns(np.ones((4096, 3)), np.array([roughness]))
    alpha = np.array([roughness**2])
    A, B, D = split_sum(alpha)[0, [16, 22, 30]].T
    np.testing.assert_allclose(columns.p[:, 0, 0], A, rtol=0.04)
    np.testing.assert_allclose(columns.q[:, 0, 0], B, rtol=0.04, atol=2e-3)
    np.testing.assert_allclose(columns.d[:, 0, 0], D, rtol=0.04)


@pytest.mark.parametrize("moves", [False, True])
def test_a_cell_right_behind_the_texel_is_hidden(moves):
    """Opposite directions have no half vector."""
    behind = fibonacci(64)[:9].astype(np.float32).astype(np.float64)
    samples = free_samples(-behind, np.repeat(-behind[:, None], 2, axis=1))
    transport = Transport.of(samples, 64, moves)
    columns = transport.columns(np.ones((64, 3)), np.array([0.0, 0.5, 1.0]))
    assert all(np.isfinite(part).all() for part in columns)
    materials = Materials(np.full(9, 0.5), np.zeros((9, 1)), np.full((9, 3), 0.5))
    matrix = of_all(transport, materials)
    assert np.isfinite(matrix).all()
    assert not matrix[:, np.arange(18), np.arange(9).repeat(2)].any() and matrix.any()


def test_a_narrow_lobe_gathers_its_light_wherever_it_points():
    """Cells wider than the lobe are not missed."""
    turn = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    directions = np.stack([0.5 * np.cos(turn), 0.5 * np.sin(turn), 0 * turn + 0.75**0.5], axis=1)
    transport = Transport.of(free_samples(np.array([[0, 0, 1.0]]), directions[None]), 256)
    columns = transport.columns(np.ones((256, 3)), np.array([0.0]))
    whole = (columns.p + columns.q)[:, 0, 0]
    assert whole.min() > 0.8 and whole.max() < 1.3  # lobes at a cell, and between cells
    assert abs(whole.mean() - 1) < 0.06


# --- prior ------------------------------------------------------------------------------------


def test_the_prior_is_a_distribution():
    prior = prior_of(64)
    x = np.random.default_rng(3).normal(size=(64, 3))
    for matrix in (prior.brightness, prior.color, prior.precision()):
        np.testing.assert_allclose(matrix, matrix.T, atol=1e-9 * np.abs(matrix).max())
        assert np.linalg.eigvalsh(matrix).min() > 0
    np.testing.assert_allclose(
        prior.pull(x).T.ravel(), prior.precision() @ x.T.ravel(), atol=1e-9 * np.abs(x).max() * 100
    )
    covariance = np.linalg.inv(prior.brightness)
    assert covariance[0, 0] == pytest.approx(3.0**2 + SD**2)  # its level is undetermined


# --- a step of the light ----------------------------------------------------------------------


def fit_of(samples: TexelSamples, x: np.ndarray) -> LightFit:
    transport = Transport.of(samples, len(x))
    columns = SampleMoments.of(samples, columns_of(transport, np.exp(x), SWITCHES))
    posterior = columns.posterior(SWITCHES)
    system = normal_equations(
        transport, np.exp(x), posterior, SWITCHES.overdispersion, LightPriors(prior_of(len(x)))
    )
    return LightFit(transport, x, system, 0.1)


class Joint:
    """Normal equations of light and materials in double precision, without elimination."""

    def __init__(self, samples, x, materials, w, mixed=MATERIAL_SD[1]):
        self.samples, self.x, self.materials, self.w = samples, x, materials, w
        self.texels, self.number = samples.texels, len(x)
        self.precision = prior_of(self.number).precision()
        self.freedom = np.tile(1 / np.square([MATERIAL_SD[0], mixed, *[COLOR_SD] * 3]), self.texels)

    def moved(self, k: int, by: np.ndarray) -> Materials:
        """Return materials with a different parameter k of five."""
        table = np.column_stack(self.materials)
        table[:, k] += by
        return Materials(table[:, 0], table[:, 1:2], table[:, 2:])

    def predicted(self, x, materials) -> np.ndarray:
        estimate = of_oracle(self.samples, materials, self.number)
        return np.einsum("snc,nc->sc", estimate, np.exp(x))

    def jacobian(self) -> np.ndarray:
        """Return the Jacobian, (S, 3, 3 N + 5 n)."""
        samples, N = self.samples, self.number
        J = np.zeros((samples.count, 3, 3 * N + 5 * self.texels))
        K = of_oracle(samples, self.materials, N) * np.exp(self.x)
        for c in range(3):
            J[:, c, c * N : (c + 1) * N] = K[:, :, c]
        r = self.materials.roughness
        for k in range(5):
            # Roughness of the solver, between two grid values.
            step = np.full(self.texels, 0.01)
            ends = [np.clip(r + way * ROUGHNESS_STEP, 0, 1) - r for way in (-1, 1)]
            ends = ends if k == 0 else [-step, step]
            low, high = (self.predicted(self.x, self.moved(k, end)) for end in ends)
            slope = (high - low) / (ends[1] - ends[0])[samples.owner, None]
            for s, t in enumerate(samples.owner):
                J[s, :, 3 * N + 5 * t + k] = slope[s]
        return J

    def energy(self, x) -> float:
        off = self.samples.radiance - self.predicted(x, self.materials)
        flat = x.T.ravel()
        return float(0.5 * (self.w[:, None] * off**2).sum() + 0.5 * flat @ self.precision @ flat)

    def normal(self) -> tuple[np.ndarray, np.ndarray]:
        J, N = self.jacobian(), self.number
        off = self.samples.radiance - self.predicted(self.x, self.materials)
        H = np.einsum("s,sci,scj->ij", self.w, J, J, optimize=True)
        H[: 3 * N, : 3 * N] += self.precision
        H[3 * N :, 3 * N :] += np.diag(self.freedom)
        g = -np.einsum("s,sci,sc->i", self.w, J, off, optimize=True)
        g[: 3 * N] += self.precision @ self.x.T.ravel()
        color = self.materials.color
        g[3 * N :].reshape(-1, 5)[:, 2:] += (color - color.mean(axis=0)) / COLOR_SD**2
        return H, g


@pytest.mark.parametrize("known", [{}, {"metallic": 0.25}])
def test_elimination_equals_full_normal_equations(known):
    """A known parameter is no unknown of the elimination."""
    samples, truth = photographed(8, 6, 64, noise=0.05)
    samples = replace(samples, grid=svu.PrincipledGrid(known=known))
    x = truth + 0.3 * np.random.default_rng(2).normal(size=truth.shape)
    transport = Transport.of(samples, 64)
    columns = SampleMoments.of(samples, columns_of(transport, np.exp(x), SWITCHES))
    posterior = columns.posterior(SWITCHES)
    tau = SWITCHES.overdispersion
    columns = normal_equations(transport, np.exp(x), posterior, tau, LightPriors(prior_of(64)))
    w = samples.weight / (posterior.kernel.noise[samples.owner] ** 2 * tau)
    materials = materials_of(with_empirical_prior(posterior))
    assert not known or np.all(materials.mixed == 0.25)
    joint = Joint(samples, x, materials, w, 1e-4 if known else MATERIAL_SD[1])
    H, g = joint.normal()
    n = 3 * 64
    taken = np.linalg.solve(H[n:, n:], np.column_stack([H[n:, :n], g[n:]]))
    matrix, gradient = H[:n, :n] - H[:n, n:] @ taken[:, :-1], g[:n] - H[:n, n:] @ taken[:, -1]
    np.testing.assert_allclose(columns.matrix, matrix, atol=2e-4 * np.abs(matrix).max())
    np.testing.assert_allclose(columns.gradient, gradient, atol=2e-4 * np.abs(gradient).max())
    # Elimination increases the uncertainty of the light.
    assert np.abs(H[:n, :n] - matrix).max() > 0.02 * np.abs(matrix).max()
    step = np.clip(np.linalg.solve(H, -g)[:n].reshape(3, 64).T, -MAX_CHANGE, MAX_CHANGE)
    np.testing.assert_allclose(columns.step(), step, atol=0.02)
    for seed in range(3):  # gradient of the energy
        d = np.random.default_rng(seed).normal(size=x.shape)
        slope = (joint.energy(x + 1e-4 * d) - joint.energy(x - 1e-4 * d)) / 2e-4
        assert slope == pytest.approx(g[:n] @ d.T.ravel(), rel=1e-4, abs=1e-4 * np.abs(g).max())


# --- uncertainty ------------------------------------------------------------------------------


def test_the_level_is_asked_of_views_that_face_the_surface():
    """Steep views and rarely seen texels are removed; other samples are unchanged."""
    samples, _ = made_up(12, 9)
    steep = np.where(samples.owner < 3, 0.2, 0.9).astype(np.float32)
    steep[samples.owner == 5] = np.where(np.arange(9) < 3, 0.9, FACING)
    samples = replace(samples, cosine=steep)
    facing, which = samples.without_steep_views()
    left = [3, 4, 6, 7, 8, 9, 10, 11]
    np.testing.assert_array_equal(which, np.flatnonzero(np.isin(samples.owner, left)))
    np.testing.assert_array_equal(facing.owner, np.repeat(np.arange(8), 9))
    for name in ("direction", "radiance", "weight", "view"):
        np.testing.assert_array_equal(getattr(facing, name), getattr(samples, name)[which])
    normals = (each.surface.normal.numpy().T for each in (facing, samples))
    np.testing.assert_array_equal(next(normals), next(normals)[left])
    everything, which = replace(samples, cosine=np.full(samples.count, 0.1)).without_steep_views()
    assert everything.count == len(which) == samples.count  # better than no estimate


def test_sums_of_dimmer_light_are_those_of_its_columns():
    samples, x = photographed(12, 8, 64, noise=0.05)
    columns = columns_of(Transport.of(samples, 64), np.exp(x), SWITCHES)
    dimmed = Columns(*(0.6 * part for part in columns))
    moments, colored = SampleMoments.of(samples, columns), np.array([1.0, 0.5, 2.0])
    first = moments.posterior(SWITCHES, 0.6)
    second = SampleMoments.of(samples, dimmed).posterior(SWITCHES)
    np.testing.assert_allclose(first.kernel.noise, second.kernel.noise, rtol=1e-4)
    for one, other in zip(materials_of(first), materials_of(second), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-4)
    # Several factors at once; the noise of a texel depends on the others under the same light.
    noise = [moments.posterior(SWITCHES, f).kernel.noise for f in (colored, 1.0)] + [
        first.kernel.noise
    ]
    factors = np.stack([colored, np.ones(3), np.full(3, 0.6)])
    together = moments.noise(SWITCHES, factors)
    expected = np.exp(np.log(noise).mean(axis=1)) / samples.unit
    np.testing.assert_allclose(together, expected, rtol=1e-6)


def test_light_that_is_twice_as_bright_is_found_out():
    samples, x = photographed(80, 12, 64, noise=0.02)
    transport = Transport.of(samples, 64)
    right, double = (
        scale_of(samples, columns_of(transport, np.exp(x + added), SWITCHES), SWITCHES)
        for added in (0, np.log(2))
    )
    assert (abs(double.best + np.log(2)) < 1.645 * double.sd).all()
    assert (abs(right.best) < 1.645 * right.sd).all()
    np.testing.assert_allclose(double.best - right.best, -np.log(2), atol=0.15)
    assert right.anchored and 1.645 * right.common < np.log(2)


def test_light_of_another_colour_is_found_out():
    samples, x = photographed(80, 12, 64, noise=0.02)
    transport = Transport.of(samples, 64)
    right, red = (
        scale_of(samples, columns_of(transport, np.exp(x + added), SWITCHES), SWITCHES)
        for added in (np.zeros(3), np.array([0.3, 0, -0.15]))
    )
    tint, wrong = (one.best - one.best.mean() for one in (right, red))
    assert (abs(tint) < 1.645 * right.tint).all() and (right.tint < 0.3).all()
    np.testing.assert_allclose(wrong - tint, [-0.25, 0.05, 0.2], atol=0.08)
    assert (right.sd >= right.common).all()


@pytest.mark.parametrize(
    "added, views, draw", [(0.0, 12, 31), (0.7, 12, 31), (0.7, 12, 2), (0.7, 16, 1)]
)
def test_a_room_that_is_too_bright_beside_its_window_is_found_out(added, views, draw, monkeypatch):
    """Each texel has a material of its own here; objects have fewer, so that 20 are assumed."""
    monkeypatch.setattr(dim_light, "PATCHES", 100)
    samples, materials = made_up(200, views, draw)
    window = fibonacci(256) @ [0.48, 0.6, 0.64] > 0.9
    x = np.log(np.where(window, 100.0, 0.2))[:, None] * np.ones((1, 3))
    noise = 1 + 0.02 * np.random.default_rng(5).normal(size=(samples.count, 3))
    seen = (reflected(Transport.of(samples, 256), np.exp(x), materials) * noise).astype(np.float32)
    samples = replace(samples, radiance=seen, unit=float(seen.mean()))
    wrong = x + added * ~window[:, None]
    found = with_level_of_dim_cells(Transport.of(samples, 256), wrong, SWITCHES)
    assert np.quantile(np.abs(found - x), 0.98) < 0.1


def test_two_means_are_compared_by_their_divergence():
    rng = np.random.default_rng(20931)
    p, share = rng.dirichlet(np.full(24, 0.3), (9, 3)).transpose(0, 2, 1), rng.random(9)
    two = [np.average(p, axis=0, weights=w) for w in (share, 1 - share)]
    expected = np.square(jensenshannon(*two)).mean()  # per channel
    assert divergence(p.reshape(9, 2, 3, 4, 3), share) == pytest.approx(expected)


def test_other_lights_are_as_bright_and_textures_less_certain():
    samples, x = photographed(24, 8, 64, noise=0.05)
    fit = fit_of(samples, x)
    estimate = sample_lights(fit, 6)
    level = np.exp(estimate.draws).mean(axis=1)
    np.testing.assert_allclose(level, np.tile(np.exp(x).mean(axis=0), (6, 1)), rtol=1e-9)
    np.testing.assert_array_equal(estimate.draws, sample_lights(fit, 6).draws)
    assert not np.array_equal(estimate.draws, sample_lights(fit, 6, seed=1).draws)
    mean = np.kron(np.full((1, 3), 1 / 3), np.eye(64))
    share = np.exp(x).mean(axis=1) / np.exp(x).mean(axis=1).sum()
    mean = (np.eye(64) - share) @ mean  # at fixed level
    covariance = mean @ np.linalg.inv(fit.system.matrix) @ mean.T
    np.testing.assert_allclose(estimate.cell_sd, np.sqrt(np.diag(covariance)), rtol=1e-4)
    columns = columns_of(fit.transport, np.exp(x), SWITCHES)
    right = scale_of(samples, columns, SWITCHES)
    several = widening_of(fit.transport, x, estimate.draws, right, SWITCHES)
    same, nowhere = np.tile(x, (6, 1, 1)), replace(right, best=np.zeros(3), common=1e-6)
    sure = widening_of(fit.transport, x, same, nowhere, SWITCHES)
    assert sure == pytest.approx(1, abs=1e-3) and several > sure


# --- background -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def outdoors(tmp_path_factory):
    """Shiny ball in an asymmetric light that is visible in the photographs."""
    rng, cells = np.random.default_rng(9), fibonacci(256)
    uneven = sum(np.sin(k * cells @ rng.normal(size=(3, 3)) + rng.uniform(0, 6, 3))
                 for k in (1, 2, 3))  # fmt: skip
    light = replace(made_up_light(), logarithm=uneven).radiance
    folder = tmp_path_factory.mktemp("outdoors")
    emitter = {"type": "envmap", "bitmap": mi.Bitmap(light), "to_world":
               mi.ScalarTransform4f().rotate([0.6, 0.8, 0], 77)}  # fmt: skip
    return render_ball(folder, emitter, SHINY, views=16, resolution=(48, 48), spp=16)


def seen_from(emitter, directions: np.ndarray) -> np.ndarray:
    """Return (N, 3) radiance of an emitter from directions, evaluated by Mitsuba."""
    si = dr.zeros(mi.SurfaceInteraction3f, len(directions))
    si.wi = -to_drjit(mi.Vector3f, directions.T.astype(np.float32))
    return np.array(emitter.eval(si)).T


def alike(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.corrcoef(a.ravel(), b.ravel())[0, 1])


@pytest.mark.few(1)
@pytest.mark.parametrize("moves", [False, True])
def test_the_background_is_light_from_where_the_camera_looks(outdoors, moves):
    """On a turntable all photographs show the same part of the light, in camera space."""
    capture = turning(outdoors, spp=16) if moves else outdoors
    looks = BackgroundPixels.of(capture, moves=moves)
    truth = seen_from(outdoors.environment, looks.direction)
    assert alike(looks.radiance, truth) > 0.99
    np.testing.assert_allclose(looks.radiance.mean(axis=0), truth.mean(axis=0), rtol=0.02)
    other = BackgroundPixels.of(capture, moves=not moves)  # in the frame of the other hypothesis
    assert alike(other.radiance, seen_from(outdoors.environment, other.direction)) < 0.5


def test_cells_have_the_mean_of_the_pixels_that_show_them(outdoors):
    number = 256
    precision, estimate = BackgroundPixels.of(outdoors).at(number)
    cells = precision > 0
    assert 0.5 < cells.mean() <= 1
    points = fibonacci(64 * number)
    owner = (points @ fibonacci(number).T).argmax(axis=1)
    sums = [np.bincount(owner, channel) for channel in seen_from(outdoors.environment, points).T]
    truth = np.log(np.stack(sums, axis=1) / np.bincount(owner)[:, None])[cells]
    assert alike(estimate[cells], truth) > 0.95
    assert abs((estimate[cells] - truth).mean()) < 0.05
    assert not estimate[~cells].any()


def test_there_may_be_no_background_or_nothing_but_black(outdoors):
    """A black object is refused under any light."""
    masks = tuple(np.ones(image.shape[:2], bool) for image in outdoors.images)
    with pytest.raises(CaptureError, match="^No photograph shows background pixels"):
        BackgroundPixels.of(replace(outdoors, masks=masks))
    black = replace(outdoors, images=tuple(image * 0 for image in outdoors.images))
    with pytest.raises(CaptureError, match="^The background of all photographs is b"):
        BackgroundPixels.of(black)
    with pytest.raises(CaptureError, match="black"):
        svu.estimate_light(black, svu.texels(outdoors.mesh, 16))


@pytest.mark.slow
def test_the_background_helps(outdoors):
    texels = svu.texels(outdoors.mesh, 32)
    options = svu.LightOptions(texels=60, depths=((128, 4),), draws=2, moves=False)
    without, looked = (
        svu.estimate_light(outdoors, texels, replace(options, background=name))
        for name in ("none", "distant")
    )
    first, second = (compare_lights(one, outdoors.environment) for one in (without, looked))
    assert second.correlation > max(first.correlation + 0.2, 0.8)  # .64 and .95
    assert looked.known_part > without.known_part
    # The level is determined by the background.
    assert np.abs(np.log(second.scale)).max() < 0.15 and looked.scale_interval[1].max() < 1.3
    assert not any("level of the light" in remark for remark in looked.remarks)


# --- options ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"texels": 15}, r"texels must be in \[16, 10000\], got 15\.$"),
        ({"texels": 99.5}, r"texels must be a whole number, got 99\.5\.$"),
        ({"draws": 1}, r"draws must be in \[2, 64\], got 1\.$"),
        ({"seed": -1}, r"seed must be in \[0, .*\], got -1\.$"),
        ({"background": "near"}, r"background must be one of none, distant, got 'near'\.$"),
        ({"moves": "yes"}, r"moves must be True, False or None, got 'yes'\.$"),
        ({"depths": ()}, r"depths must be \(cells, rounds\), ascending, of 64 .*, got \(\)\.$"),
        ({"depths": ((256, 3), (64, 3))}, "depths must be "),
        ({"depths": ((63, 3),)}, r"depths must be \(cells, rounds\), ascending, of 64 "),
        ({"depths": ((64, 0),)}, "depths must be "),
        ({"depths": (64, 3)}, r"depths\[0\] must be a tuple, got 64\.$"),
        ({"depths": ((64,),)}, r"depths\[0\] must have 2 values, got \(64,\)\.$"),
        ({"known": {"roughness": 0.2}}, r"known must be a value in \[0, 1\] of metallic only"),
        ({"known": {"metallic": 1.5}}, "known must be a value"),
        ({"depths": ((64.5, 3),)}, r"depths\[0\]\[0\] must be a whole number, got 64\.5\.$"),
        ({"known": {"metallic": "0"}}, r"known\['metallic'\] must be a number, got '0'\.$"),
    ],
)
def test_options_that_make_no_sense_are_refused(given, message):
    with pytest.raises(OptionError, match=f"^LightOptions: {message}"):
        svu.LightOptions(**given)
