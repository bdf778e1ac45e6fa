"""Continuous roughness, and the losses of SH recovery, against float64 and their differences."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import render_ball
from oracle import continuous as oracle

import svu_mi as svu
from svu_mi import scenes
from svu_mi.angular import reflection
from svu_mi.errors import CaptureError, OptionError
from svu_mi.frequency.gather import fit_coefficients, fit_spectra
from svu_mi.interop import owned
from svu_mi.light import environment as env
from svu_mi.light import light
from svu_mi.light.moments import moment_map
from svu_mi.options import preset
from svu_mi.parameters import CHANNELS, NAMES
from svu_mi.recovery.sh.angular import angular_objective
from svu_mi.recovery.sh.gradient import look_up
from svu_mi.recovery.sh.spectral import spectral_objective
from svu_mi.reflection.continuous import Continuous, continuous, shade
from svu_mi.reflection.lobes import dielectric_albedo, split_sum
from svu_mi.reflection.narrow import lost_light, visible_part
from svu_mi.visibility import Surface, pack_views, survey

STUDIO = {"type": "envmap", "filename": str(scenes.FOLDER / "lights" / "studio.exr")}
TRUTH = {"base_color": [0.7, 0.4, 0.2], "roughness": [0.45], "metallic": [0.6]}
PAINT = {"type": "principled", "base_color": {"type": "rgb", "value": TRUTH["base_color"]},
         "roughness": TRUTH["roughness"][0], "metallic": TRUTH["metallic"][0]}  # fmt: skip
LEVELS = 7
SIZE = 12


def angular(name, **switches):
    return preset(name, method="angular", **switches)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ball")
    return render_ball(folder, STUDIO, PAINT, views=16, resolution=(40, 40))


@pytest.fixture(scope="module")
def parts(capture):
    """Views, texels, survey and light."""
    views = pack_views(capture)
    texels = svu.texels(capture.mesh, SIZE)
    return views, texels, survey(views, Surface.of(texels)), light(capture, capture.count)


def constant(values):
    return {
        name: mi.TensorXf(
            owned(mi.Float, np.tile(np.float32(values[name]), SIZE * SIZE)),
            shape=(SIZE, SIZE, CHANNELS[name]),
        )
        for name in NAMES
    }


def random_textures(seed=9213):
    rng = np.random.default_rng(seed)
    return {
        name: mi.TensorXf(
            owned(mi.Float, rng.uniform(0.1, 0.9, SIZE * SIZE * CHANNELS[name])),
            shape=(SIZE, SIZE, CHANNELS[name]),
        )
        for name in NAMES
    }


def as_rows(textures, place):
    """(S, 5) float64."""
    flat = [np.array(textures[name], np.float64).reshape(SIZE * SIZE, -1) for name in NAMES]
    return np.concatenate(flat, axis=1)[np.array(place)]


def backward(objective, textures, step=0):
    """Value and (H W, 5) derivatives."""
    for tensor in textures.values():
        dr.enable_grad(tensor)
        dr.clear_grad(tensor)
    loss = objective(textures, step)
    dr.backward(loss)
    found = [np.array(textures[name].grad, np.float64).reshape(SIZE * SIZE, -1) for name in NAMES]
    return float(dr.detach(loss)[0]), np.concatenate(found, axis=1)


# --- the model ------------------------------------------------------------------------------


def tables(model):
    """Light grids and albedo of a ``Reflection``, float64."""
    grids = [np.array(texture.tensor(), np.float64) for texture in model.levels.textures]
    pair, exact = split_sum(model.alpha), dielectric_albedo(model.alpha)
    return grids, np.concatenate([pair, exact[..., None]], axis=2)


def moments_of(model):
    """(S, 3, 8)."""
    return np.array([[x.numpy() for x in c] for c in model.arriving.diffuse], np.float64).transpose(
        2, 0, 1
    )


def visible_oracle(model, free):
    """What ``visible_part`` says, in single precision: it has an oracle of its own."""
    if not model.arriving.visible:
        return None

    def visible(mirror, alpha):
        lost = lost_light(model.arriving, owned(mi.Vector3f, mirror.T.astype(np.float32)))
        width = owned(mi.Float, alpha.astype(np.float32))
        part = visible_part(lost, width, model.cell_blur, mi.Bool(free))
        return part.numpy().astype(np.float64)

    return visible


@pytest.mark.parametrize("name", ["default", "fast", "paper"])
def test_the_model_is_that_of_float64(parts, name):
    """All four columns for random views and roughness, and radiance's derivative."""
    views, texels, _, lighting = parts
    surface = Surface.of(texels)
    switches = angular(name)
    model = reflection(
        views.scene, surface, lighting, np.linspace(0, 1, LEVELS), switches, channels=3
    )
    rng = np.random.default_rng(4410)
    normal = surface.normal.numpy().T.astype(np.float64)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    direction = normal + 0.9 * rng.uniform(-1, 1, normal.shape)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    keep = np.einsum("ni,ni->n", normal, direction) > 0.05
    direction[~keep] = normal[~keep]
    roughness, free = rng.random(len(normal)), rng.random(len(normal)) < 0.7
    grids, albedo = tables(model)
    to_local = lighting.environment.to_local
    seen = visible_oracle(model, free)

    def exact(rough):
        return oracle.columns(
            rough, grids, albedo, to_local, normal, direction, moments_of(model),
            paper=name == "paper", narrow=name != "paper", visible=seen,
        )  # fmt: skip

    lanes = [owned(kind, x.T.astype(np.float32)) for kind, x in
             ((mi.Normal3f, normal), (mi.Vector3f, direction))]  # fmt: skip
    visible = None
    if seen is not None:

        def visible(mirror, alpha):  # noqa: ANN001
            lost = lost_light(model.arriving, mirror)
            return visible_part(lost, alpha, model.cell_blur, mi.Bool(free))

    rough = owned(mi.Float, roughness.astype(np.float32))
    dr.enable_grad(rough)
    shading = shade(Continuous.of(model), rough, *lanes, model.arriving.diffuse, visible=visible)
    for ours, theirs in zip(shading.parts, exact(roughness), strict=True):
        for c in range(3):
            # Directions in single precision, times the light's steepest slope.
            value = dr.detach(ours[c]).numpy()
            np.testing.assert_allclose(value, theirs[:, c], rtol=1e-4, atol=2e-4 * theirs.max())
    color, metallic = [0.3, 0.6, 0.9], 0.4
    green = shading.radiance(color, mi.Float(metallic))[1]
    dr.forward(rough)
    # Wide enough for what of it is in single precision; a kink is at every level.
    step = 1e-6 if seen is None else 1e-3
    every = np.full(len(normal), metallic)
    ends = [oracle.radiance(exact(roughness + s * step), np.array(color), every) for s in (1, -1)]
    difference = ((ends[0] - ends[1]) / (2 * step))[:, 1]
    place = roughness * (LEVELS - 1)
    smooth = (np.abs(place - np.rint(place)) > 0.02) & (np.abs(roughness - 0.0316) > 0.01)
    error = np.abs(dr.grad(green).numpy() - difference)[smooth]
    assert np.quantile(error, 0.95) < 2e-3 * np.abs(difference).max()
    assert np.median(error) < 2e-4 * np.abs(difference).max()


def test_levels_of_the_angular_model_are_met(parts):
    """At the levels themselves nothing is interpolated: both models are one."""
    views, texels, _, lighting = parts
    surface = Surface.of(texels)
    switches = angular("default")
    roughness = np.linspace(0, 1, LEVELS)
    model = reflection(views.scene, surface, lighting, roughness, switches, channels=3)
    same = continuous(lighting, switches, LEVELS)
    found = Continuous.of(model)
    np.testing.assert_array_equal(np.array(same.light.values), np.array(found.light.values))
    np.testing.assert_array_equal(np.array(same.albedo), np.array(found.albedo))
    direction = mi.Vector3f(surface.normal)
    for level in range(LEVELS):
        ours = found.light.radiance(mi.Float(level), direction)
        theirs = model.levels.radiance(level, direction)
        for a, b in zip(ours, theirs, strict=True):
            np.testing.assert_allclose(np.array(a), np.array(b), rtol=2e-6, atol=1e-6)


def test_moments_by_normal_are_sums_over_the_light(parts):
    """The maps against quadrature over all directions of the light, in double precision."""
    *_, lighting = parts
    environment = lighting.environment
    rows, columns = environment.radiance.shape[:2]
    local = env.directions(columns, rows).reshape(-1, 3)
    solid = np.repeat(env.quadrature(rows) * 2 * np.pi / columns, columns)
    flux = environment.radiance.reshape(-1, 3) * solid[:, None]
    rng = np.random.default_rng(802)
    normal = rng.normal(size=(20, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    world = normal @ environment.to_local  # rows: local to world
    moments = moment_map(environment).at(owned(mi.Normal3f, world.T.astype(np.float32)))
    for k, n in enumerate(normal):
        cosine = np.maximum(local @ n, 0)
        for power, first in ((0, 0), (5, 4)):
            weight = (cosine * (1 - cosine) ** power)[:, None] * flux
            exact = np.concatenate([weight.sum(axis=0)[None], local.T @ weight])  # (4, 3)
            ours = [[channel[first + i].numpy()[k] for channel in moments] for i in range(4)]
            # Degrees above 16 are left out; the maps are interpolated.
            np.testing.assert_allclose(ours, exact, atol=4e-3 * flux.sum(axis=0).max())


# --- the angular loss -----------------------------------------------------------------------


def stored(objective):
    """Every sample: seen (N, S), direction (N, S, 3), radiance (N, S, 3), free (N, S)."""
    rows = []
    for slot in range(int(objective.found.count[0])):
        index = dr.opaque(mi.UInt32, slot)
        seen = objective.found.look(objective.views, objective.surface, index)
        free = mi.Bool(True)
        if objective.free is not None:
            free = objective.free.test(index, objective.surface.lane)
        arrays = seen.seen, seen.direction, seen.radiance, free
        dr.eval(arrays)
        count = objective.surface.count
        rows.append([np.broadcast_to(x.numpy().T, (count, *x.numpy().T.shape[1:])) for x in arrays])
    return [np.array(x) for x in zip(*rows, strict=True)]


@pytest.mark.parametrize("name", ["default", "paper"])
def test_the_angular_loss_and_its_slopes_are_those_of_float64(parts, name):
    views, texels, found, lighting = parts
    objective = angular_objective(views, texels, found, lighting, angular(name), LEVELS)
    textures = random_textures()
    loss, slopes = backward(objective, textures)
    rows = as_rows(textures, objective.place)
    model = objective.arriving
    grids, albedo = tables(model)
    normal = objective.surface.normal.numpy().T.astype(np.float64)
    total, expected = 0.0, np.zeros_like(rows)
    for on, direction, observed, free in zip(*stored(objective), strict=True):
        seen = visible_oracle(model, free)

        def modelled(values, direction=direction, seen=seen):
            columns = oracle.columns(
                values[:, 3], grids, albedo, lighting.environment.to_local, normal,
                direction.astype(np.float64), moments_of(model), paper=name == "paper",
                narrow=name != "paper", visible=seen,
            )  # fmt: skip
            return oracle.radiance(columns, values[:, :3], values[:, 4])

        with np.errstate(all="ignore"):  # texels that the view does not see
            away = modelled(rows) - observed
            slope = oracle.slopes(modelled, rows, 1e-6 if seen is None else 1e-3)
            part = (slope * np.sign(away)).sum(axis=2).T
        total += np.abs(away[on]).sum()
        expected[on] += part[on]
    samples = 3 * int(np.array(found.coverage).sum())
    unit = samples * found.scale
    assert loss == pytest.approx(total / unit, rel=1e-5)
    ours = slopes[np.array(objective.place)]
    size = np.abs(expected / unit).max()
    np.testing.assert_allclose(ours[:, [0, 1, 2, 4]], expected[:, [0, 1, 2, 4]] / unit,
                               atol=2e-3 * size)  # fmt: skip
    # Roughness: a sample whose interpolation crosses a node of the light has two slopes.
    error = np.abs(ours[:, 3] - expected[:, 3] / unit)
    assert np.quantile(error, 0.9) < 0.01 * np.abs(expected[:, 3] / unit).max()
    outside = np.ones(SIZE * SIZE, bool)
    outside[np.array(objective.place)] = False
    assert not slopes[outside].any()


def objectives(parts, kind):
    views, texels, found, lighting = parts
    if kind in ("default", "paper"):
        return angular_objective(views, texels, found, lighting, angular(kind))
    name, domain = kind.split()
    return spectral_objective(views, texels, found, lighting, preset(name), domain)


KINDS = ("default", "paper", "default coefficients", "default spectrum")


@pytest.mark.parametrize("kind", KINDS)
def test_the_truth_is_nearly_stationary(parts, kind):
    """No textures a step away from the true ones fit much better, and those far off do not."""
    objective = objectives(parts, kind)
    best = float(objective(constant(TRUTH), 0)[0])
    far = [("roughness", [0.9]), ("metallic", [0.1]), ("base_color", [0.4, 0.1, 0.5]),
           ("base_color", [1.0, 0.7, 0.5])]  # fmt: skip
    for name, value in far:
        assert float(objective(constant({**TRUTH, name: value}), 0)[0]) > 1.4 * best, name
    for name in NAMES:
        for sign in (-1, 1):
            near = {**TRUTH, name: [value + sign * 0.04 for value in TRUTH[name]]}
            # Gaussian lobes, and the power of few views of a hemisphere, are further off.
            least = 0.95 if kind == "default" else 0.85
            assert float(objective(constant(near), 0)[0]) > least * best, (name, sign)


@pytest.mark.parametrize("kind", KINDS)
def test_nothing_is_compiled_between_steps(parts, kind):
    objective = objectives(parts, kind)
    for step in range(5):
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            backward(objective, random_textures(step), step)
            kernels = dr.kernel_history([dr.KernelType.JIT])
        if step > 1:
            assert kernels and all(kernel["cache_hit"] for kernel in kernels)


# --- losses on spherical harmonics ----------------------------------------------------------


@pytest.mark.parametrize("domain", ["coefficients", "spectrum"])
@pytest.mark.parametrize("name", ["default", "paper"])
def test_the_spectral_losses_and_their_slopes_are_those_of_float64(parts, name, domain):
    views, texels, found, lighting = parts
    switches = preset(name, degree=4)
    objective = spectral_objective(views, texels, found, lighting, switches, domain)
    fitted = fit_coefficients(views, lighting, texels, found, switches)
    table = np.array(fitted.values, np.float64).reshape(25, 6, texels.count)
    table = table[..., np.array(objective.texel)].transpose(2, 0, 1)
    textures = random_textures()
    loss, slopes = backward(objective, textures)
    rows = as_rows(textures, objective.place)
    irradiance = np.stack([np.array(E, np.float64) for E in objective.irradiance], axis=-1)
    albedo = np.array(objective.albedo, np.float64)

    def errors(values):
        return oracle.spectral_error(
            values, table[..., :3], table[..., 3:], irradiance, albedo, domain
        )

    factor = float(objective.factor[0])
    assert loss == pytest.approx(errors(rows).sum() * factor, rel=2e-6)
    expected = oracle.slopes(errors, rows).T * factor
    ours = slopes[np.array(objective.place)]
    scale = np.abs(expected).max(axis=0)
    # Kinks: an absolute value within single precision of zero.
    assert np.quantile(np.abs(ours - expected) / scale, 0.99) < 1e-4


def test_coefficients_have_the_power_of_the_spectra(parts):
    views, texels, found, lighting = parts
    switches = preset("default", channels="joint")
    spectra = fit_spectra(views, lighting, texels, found, switches)
    fitted = fit_coefficients(views, lighting, texels, found, switches)
    table = np.array(fitted.values).reshape(49, 6, texels.count) ** 2
    for l in range(7):
        power = table[l * l : (l + 1) ** 2].sum(axis=0).T
        for rows, tensor in ((power[:, :3], spectra.outgoing), (power[:, 3:], spectra.incoming)):
            np.testing.assert_allclose(rows, np.array(tensor)[:, l], rtol=1e-4, atol=1e-6)


# --- refusals -------------------------------------------------------------------------------


def test_wrong_requests_are_named(capture, parts):
    views, texels, found, lighting = parts
    grey = pack_views(capture, 1)
    with pytest.raises(OptionError, match="2 or more roughness levels, got 1"):
        angular_objective(views, texels, found, lighting, angular("paper"), 1)
    with pytest.raises(OptionError, match="photographs in colour"):
        angular_objective(grey, texels, found, lighting, angular("paper"))
    with pytest.raises(OptionError, match="photographs in colour"):
        spectral_objective(grey, texels, found, lighting, preset("paper"), "spectrum")
    with pytest.raises(OptionError, match="one of coefficients, spectrum, got 'power'"):
        spectral_objective(views, texels, found, lighting, preset("paper"), "power")


def test_black_photographs_are_refused(parts):
    views, texels, found, lighting = parts
    black = replace(found, total=0 * found.total)
    for prepare in (
        lambda: angular_objective(views, texels, black, lighting, angular("paper")),
        lambda: spectral_objective(views, texels, black, lighting, preset("paper"), "spectrum"),
    ):
        with pytest.raises(CaptureError, match="No texel is seen with any radiance"):
            prepare()


def test_textures_are_looked_up_where_the_texels_are(parts):
    _, texels, *_ = parts
    textures = random_textures()
    values = look_up(textures, texels.index)
    rows = as_rows(textures, texels.index)
    for k, value in enumerate(values):
        np.testing.assert_array_equal(np.array(value), np.float32(rows[:, k]))
