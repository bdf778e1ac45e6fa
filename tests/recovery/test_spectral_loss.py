"""Continuous roughness, and the losses of SH recovery, against float64 and their differences."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from oracle import continuous as oracle
from support.helpers import STUDIO, launched_kernels, random_textures, render_ball, unit

import svu_mi as svu
from svu_mi.core.arrays import to_drjit
from svu_mi.errors import CaptureError, OptionError
from svu_mi.frequency.spectra import fit_coefficients, fit_spectra
from svu_mi.geometry.sample_view import TexelLanes
from svu_mi.light import latlong
from svu_mi.light.band_limited import moment_map
from svu_mi.light.prefiltered import filter_light
from svu_mi.parameters import NAMES
from svu_mi.posterior.observations import observe
from svu_mi.presets import preset
from svu_mi.recovery.sh.angular_l1_loss import angular_objective
from svu_mi.recovery.sh.spectral_loss import spectral_objective
from svu_mi.reflection.lobes import lobe_profile, split_sum
from svu_mi.reflection.mix_columns import mixed_radiance
from svu_mi.reflection.principled import alpha_from_roughness
from svu_mi.reflection.render_model import prefiltered_model, shade

TRUTH = {"base_color": [0.7, 0.4, 0.2], "roughness": [0.45], "metallic": [0.6]}
PAINT = {"type": "principled", "base_color": {"type": "rgb", "value": TRUTH["base_color"]},
         "roughness": TRUTH["roughness"][0], "metallic": TRUTH["metallic"][0]}  # fmt: skip
LEVELS = 7
SIZE = 12


def angular(name, **switches):
    if name == "gaussian":  # the paper's lobes without the fit of light
        name, switches = "paper", {"name": name, "fit": None} | switches
    return preset(name, method="angular", **switches)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ball")
    return render_ball(folder, STUDIO, PAINT, views=16, resolution=(40, 40), spp=16)


@pytest.fixture(scope="module")
def observed(capture):
    """Views, texels, visibility and light."""
    return observe(capture, svu.texels(capture.mesh, SIZE))


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
    gradients = [
        np.array(textures[name].grad, np.float64).reshape(SIZE * SIZE, -1) for name in NAMES
    ]
    return float(dr.detach(loss)[0]), np.concatenate(gradients, axis=1)


# --- the model ------------------------------------------------------------------------------


def tables(lighting, name, levels=LEVELS):
    """Light grids and albedo of the levels, float64."""
    alpha = alpha_from_roughness(np.linspace(0, 1, levels))
    profile = lobe_profile("gaussian" if name == "gaussian" else "ggx")
    filtered = filter_light(lighting, alpha.tolist(), profile)
    grids = [np.array(texture.tensor(), np.float64) for texture in filtered.textures]
    return grids, split_sum(alpha)


def moments_of(moments):
    """(S, 3, 8)."""
    return np.array([[x.numpy() for x in c] for c in moments], np.float64).transpose(2, 0, 1)


def part(mirror, alpha):
    """A smooth function of two arguments for NumPy and Dr.Jit, in place of visibility."""
    x, y, z = mirror
    return 0.5 + 0.3 * x * y - 0.2 * alpha * z


@pytest.mark.few(3)
@pytest.mark.parametrize("hidden", [False, True], ids=["open", "hidden"])
@pytest.mark.parametrize("name", ["default", "fast", "gaussian"])
def test_the_model_is_that_of_float64(observed, name, hidden):
    """All four columns for random views and roughness, and radiance's derivative."""
    surface, lighting = TexelLanes.of(observed.texels), observed.lighting
    model = prefiltered_model(lighting, angular(name), LEVELS)
    moments = moment_map(lighting.environment).in_world(surface.normal)
    rng = np.random.default_rng(4410)
    normal = unit(surface.normal.numpy().T)
    direction = unit(normal + 0.9 * rng.uniform(-1, 1, normal.shape))
    keep = np.einsum("ni,ni->n", normal, direction) > 0.05
    direction[~keep] = normal[~keep]
    roughness = rng.random(len(normal))
    grids, albedo = tables(lighting, name)
    to_local, arriving = lighting.environment.to_local, moments_of(moments)

    def exact(rough):
        return oracle.columns(
            rough, grids, albedo, to_local, normal, direction, arriving,
            paper=name == "gaussian", narrow=name != "gaussian",
            visible=(lambda mirror, alpha: part(mirror.T, alpha)) if hidden else None,
        )  # fmt: skip

    lanes = [to_drjit(kind, x.T.astype(np.float32)) for kind, x in
             ((mi.Normal3f, normal), (mi.Vector3f, direction))]  # fmt: skip
    rough = to_drjit(mi.Float, roughness.astype(np.float32))
    dr.enable_grad(rough)
    parts = shade(model, rough, *lanes, moments, visible=part if hidden else None)
    for ours, theirs in zip(zip(*parts, strict=True), exact(roughness), strict=True):
        for c in range(3):
            # Directions in single precision, times the light's steepest slope.
            value = dr.detach(ours[c]).numpy()
            np.testing.assert_allclose(value, theirs[:, c], rtol=1e-4, atol=2e-4 * theirs.max())
    color, metallic = [0.3, 0.6, 0.9], 0.4
    green = mixed_radiance(parts, color, [mi.Float(metallic)])[1]
    dr.forward(rough)
    step = 1e-6  # the slope is discontinuous at every level
    every = np.full(len(normal), metallic)
    ends = [oracle.radiance(exact(roughness + s * step), np.array(color), every) for s in (1, -1)]
    difference = ((ends[0] - ends[1]) / (2 * step))[:, 1]
    place = roughness * (LEVELS - 1)
    smooth = (np.abs(place - np.rint(place)) > 0.02) & (np.abs(roughness - 0.0316) > 0.01)
    error = np.abs(dr.grad(green).numpy() - difference)[smooth]
    assert np.quantile(error, 0.95) < 2e-3 * np.abs(difference).max()
    assert np.median(error) < 2e-4 * np.abs(difference).max()


def test_moments_by_normal_are_sums_over_the_light(observed):
    """The maps against quadrature over all directions of the light, in double precision."""
    environment = observed.lighting.environment
    rows, columns = environment.radiance.shape[:2]
    local = latlong.directions(columns, rows).reshape(-1, 3)
    solid = np.repeat(latlong.quadrature(rows) * 2 * np.pi / columns, columns)
    flux = environment.radiance.reshape(-1, 3) * solid[:, None]
    rng = np.random.default_rng(802)
    normal = unit(rng.normal(size=(20, 3)))
    world = normal @ environment.to_local  # rows: local to world
    moments = moment_map(environment).at(to_drjit(mi.Normal3f, world.T.astype(np.float32)))
    for k, n in enumerate(normal):
        cosine = np.maximum(local @ n, 0)
        for power, first in ((0, 0), (5, 4)):
            weight = (cosine * (1 - cosine) ** power)[:, None] * flux
            exact = np.concatenate([weight.sum(axis=0)[None], local.T @ weight])  # (4, 3)
            ours = [[channel[first + i].numpy()[k] for channel in moments] for i in range(4)]
            # Degrees above 16 are omitted; the maps are interpolated.
            np.testing.assert_allclose(ours, exact, atol=4e-3 * flux.sum(axis=0).max())


# --- the losses ----------------------------------------------------------------------------


def objectives(observed, kind):
    if kind == "paper":
        return angular_objective(observed, angular(kind))
    name, domain = kind.split()
    return spectral_objective(observed, preset(name, method="spectrum"), domain)


KINDS = ("paper", "default coefficients", "default spectrum")


@pytest.mark.few(1)
@pytest.mark.parametrize("kind", KINDS)
def test_nothing_is_compiled_between_steps(observed, kind):
    objective = objectives(observed, kind)
    for step in range(5):
        with launched_kernels() as kernels:
            backward(objective, random_textures((SIZE, SIZE), step, 0.1, 0.9), step)
        if step > 1:
            assert kernels and all(kernel["cache_hit"] for kernel in kernels)


# --- losses on spherical harmonics ----------------------------------------------------------


@pytest.mark.parametrize("domain", ["coefficients", "spectrum"])
@pytest.mark.parametrize("name", ["default", "paper"])
def test_spectral_losses_and_gradients_match_float64(observed, name, domain):
    texels, switches = observed.texels, preset(name, method="spectrum", degree=4)
    objective = spectral_objective(observed, switches, domain)
    fitted = fit_coefficients(observed, switches)
    table = np.array(fitted.values, np.float64).reshape(25, 6, texels.count)
    table = table[..., np.array(objective.texel)].transpose(2, 0, 1)
    textures = random_textures((SIZE, SIZE), 9213, 0.1, 0.9)
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


def test_coefficients_have_the_power_of_the_spectra(observed):
    texels, switches = observed.texels, preset("default", method="spectrum", channels="sum")
    spectra, fitted = fit_spectra(observed, switches), fit_coefficients(observed, switches)
    table = np.array(fitted.values).reshape(49, 6, texels.count) ** 2
    for l in range(7):
        power = table[l * l : (l + 1) ** 2].sum(axis=0).T
        for rows, tensor in ((power[:, :3], spectra.outgoing), (power[:, 3:], spectra.incoming)):
            np.testing.assert_allclose(rows, np.array(tensor)[:, l], rtol=1e-4, atol=1e-6)


# --- refusals -------------------------------------------------------------------------------


def test_invalid_spectral_losses_are_refused(observed):
    with pytest.raises(OptionError, match="preset 'default' has no fit; use preset"):
        angular_objective(observed, angular("default"))


def test_black_photographs_are_refused(observed):
    seen = observed.visibility
    black = replace(observed, visibility=replace(seen, total=0 * seen.total))
    with pytest.raises(CaptureError, match="No photograph shows a texel"):
        svu.recover(black)
