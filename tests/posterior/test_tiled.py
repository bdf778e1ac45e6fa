"""Tests of tiles: results are equal to those without tiles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.photographs import in_integers

import svu_mi as svu
from svu_mi import pipeline
from svu_mi.pipeline import materialized
from svu_mi.posterior import calibrated, estimators
from svu_mi.posterior.observations import Observed
from svu_mi.posterior.tiled import TiledKernel
from svu_mi.recovery.uncertainty.texture_field import texture_field

MAPS = [f"roughness_{what}" for what in ("mean", "sd", "low", "high")]


SMALL = 496  # texels per tile; 1500 texels, so the last tile is smaller


@pytest.fixture
def tiled(monkeypatch):
    """Estimate (or ``do`` something else) in small tiles."""

    def estimated(*args, do=svu.estimate, **options):
        monkeypatch.setattr(pipeline, "TILE", SMALL)
        monkeypatch.setattr(TiledKernel, "size", SMALL)
        monkeypatch.setattr(calibrated, "TEXELS_PER_CHUNK", SMALL)
        result = do(*args, **options)
        monkeypatch.undo()
        return result

    return estimated


@pytest.fixture(scope="module", params=["floats", "clipped"])
def shown(request, vase):
    """Return the vase in floats, or in 8 bits with saturated highlights."""
    if request.param == "floats":
        return vase.capture
    return in_integers(vase.capture, vase.estimate.observed, 0.3)[0]


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["default", "paper"])
def test_tiles_match_all_texels_at_once(vase, shown, tiled, preset):
    together = svu.estimate(shown, vase.texels, preset=preset)
    apart = tiled(shown, vase.texels, preset=preset)
    assert isinstance(apart.posterior.kernel, TiledKernel)
    assert apart.posterior.count > 3 * SMALL
    names = ["entropy", "coverage", *(MAPS if "metallic" in apart.posterior.axes else [])]
    for name in names:
        np.testing.assert_allclose(
            apart.image(name), together.image(name), rtol=1e-6, atol=2e-6, err_msg=name
        )


def test_requests_for_some_texels_recompute_only_these(vase, tiled):
    together, apart = vase.estimate.posterior, tiled(vase.capture, vase.texels).posterior
    chosen = np.random.default_rng(0).permutation(together.count)[:700]
    for ask in (
        lambda p: p.probabilities_of(chosen[:40]),
        lambda p: p.interval("base_color", 0.8, chosen)[1],
        lambda p: p.half_width("base_color", 0.9, chosen),
        lambda p: p.marginal("metallic", chosen),
        lambda p: p.map(chosen)["roughness"],
        lambda p: p.sd("base_color"),
        lambda p: p.kernel.noise_of(np.flatnonzero(p.observed)[::7]),
    ):
        np.testing.assert_allclose(np.array(ask(apart)), np.array(ask(together)), atol=2e-6)
    np.testing.assert_array_equal(apart.prior, together.prior)
    assert apart.channels == 3 and apart.continuous and apart.max_entropy == together.max_entropy


@pytest.mark.slow
def test_draws_of_tiles_have_the_moments_of_their_texels(vase, tiled):
    posterior = tiled(vase.capture, vase.texels).posterior
    drawn = np.array(posterior.draw(64, seed=3)["roughness"])
    seen = posterior.observed
    mean, sd = (np.array(x)[seen] for x in (posterior.mean("roughness"), posterior.sd("roughness")))
    off = (drawn[:, seen].mean(axis=0) - mean) / np.maximum(sd, 1e-3) * 8
    assert abs(off.mean()) < 0.1 and 0.8 < off.std() < 1.2


@pytest.mark.slow
def test_guidance_and_recovery_go_on_from_tiles(vase, tiled):
    apart = tiled(vase.capture, vase.texels)
    whole = materialized(apart)
    np.testing.assert_array_equal(np.array(whole.entropy), np.array(vase.estimate.entropy))
    assert materialized(vase.estimate) is vase.estimate
    recovered = svu.recover(apart, preset="default")
    known = svu.recover(replace(vase.estimate), preset="default")
    np.testing.assert_allclose(
        recovered.textures.roughness, known.textures.roughness, rtol=1e-4, atol=1e-4
    )


@pytest.mark.few(2)
@pytest.mark.parametrize("preset", ["default", "fixed"])
def test_whole_keeps_statistics_of_all_tiles(vase, shown, tiled, preset):
    together = svu.estimate(shown, vase.texels, preset=preset)
    apart = tiled(shown, vase.texels, preset=preset, whole=True)
    assert type(apart.posterior.kernel) is type(together.posterior.kernel)
    one, other = (source.posterior.kernel.problem.factors for source in (apart, together))
    np.testing.assert_allclose(one.table(), other.table(), rtol=1e-6, atol=1e-7)
    np.testing.assert_array_equal(one.texel.numpy(), other.texel.numpy())
    np.testing.assert_array_equal(one.views.numpy(), other.views.numpy())
    for name in ("entropy", *MAPS):
        np.testing.assert_allclose(apart.image(name), together.image(name), rtol=1e-6, atol=2e-6)


@pytest.mark.few(1)
@pytest.mark.parametrize("sharing", [False, True])
def test_recovery_is_equal_with_and_without_tiles(vase, shown, tiled, sharing):
    together = svu.recover(shown, vase.texels, sharing=sharing)
    apart = tiled(shown, vase.texels, do=svu.recover, sharing=sharing)
    sure = tiled(apart, None, shown.mesh, do=texture_field)
    usual = texture_field(together, None, shown.mesh)
    for name, texture in together.textures.items():
        np.testing.assert_allclose(apart.textures[name], texture, atol=1e-4, err_msg=name)
        np.testing.assert_allclose(sure.sd(name), usual.sd(name), rtol=1e-3, atol=1e-4)


def test_kernel_of_few_texels_is_cached(vase, tiled, monkeypatch):
    posterior = tiled(vase.capture, vase.texels).posterior
    made = []

    def make(texels):
        made.append(len(texels))
        return original(texels)

    original = posterior.kernel.make
    object.__setattr__(posterior.kernel, "make", make)
    few = np.arange(0, posterior.count, 13)
    kept = [posterior.half_width(name, 0.9, few) for name in posterior.axes]
    assert not made  # the first pass caches half-widths of a sample
    for name, half_width in zip(posterior.axes, kept, strict=True):
        np.testing.assert_allclose(
            half_width, vase.estimate.posterior.half_width(name, 0.9, few), atol=1e-6
        )
    first = [posterior.half_width(name, 0.8, few) for name in posterior.axes]
    assert len([count for count in made if count > 1]) == 1
    posterior.kernel._last.clear()
    again = posterior.half_width("roughness", 0.8, few)
    np.testing.assert_array_equal(np.array(first[0]), np.array(again))


def test_too_many_statistics_are_refused_before_gathering(vase, tiled, monkeypatch):
    """Dr.Jit uses 32-bit indices: 11 million texels with 388 values in three channels."""
    limit = 388 * 1000
    monkeypatch.setattr(estimators, "_factors", None)

    def asked(*args, **options):
        monkeypatch.setattr(estimators, "MAX_LANES", limit, raising=False)
        return svu.estimate(*args, **options)

    with pytest.raises(svu.SvuError, match="at most 1000 are possible: lower the resolution"):
        tiled(vase.capture, vase.texels, do=asked, whole=True)


def test_noise_of_each_tile_is_at_least_the_rounding_of_its_texels(vase, tiled, monkeypatch):
    monkeypatch.setattr(Observed, "rounding", lambda seen, _: np.square(seen.seen + 1.0))
    apart = tiled(vase.capture, vase.texels, whole=True)
    seen = np.flatnonzero(apart.observed.coverage)
    np.testing.assert_array_less(seen + 0.99, apart.posterior.kernel.noise_of(seen))
