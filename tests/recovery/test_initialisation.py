"""Smoothing of a start, compared with the regularisers of textures; its descent."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import svu_mi as svu
from svu_mi.geometry.neighbors import neighbors
from svu_mi.parameters import CHANNELS, NAMES
from svu_mi.recovery.sh.likelihood import QuadraticPrior, SmoothedStart
from svu_mi.recovery.svbrdf_textures import Textures

STRENGTH = 30.0


def random_textures(texels: Any, seed: int = 3) -> Textures:
    width, height = texels.resolution
    rng = np.random.default_rng(seed)
    return Textures.of({
        name: rng.random((height, width, CHANNELS[name])).astype(np.float32) for name in NAMES
    })  # fmt: skip


def smoothing_of(vase: SimpleNamespace, names: tuple[str, ...], epsilon: float) -> SmoothedStart:
    around = neighbors(vase.texels, vase.capture.mesh)
    posterior = vase.estimate.posterior
    return SmoothedStart.of(posterior, vase.texels, names, around, (STRENGTH, epsilon))


@pytest.mark.parametrize("epsilon", [0.0, 1e-2])
def test_smoothed_start_is_prior_plus_total_variation(vase: SimpleNamespace, epsilon: float):
    textures = random_textures(vase.texels)
    smoothing = smoothing_of(vase, NAMES, epsilon)
    channels = smoothing.start(textures)
    dr.enable_grad(channels)
    loss = smoothing(channels)
    dr.backward(loss)

    tensors = {name: mi.TensorXf(tensor) for name, tensor in textures.items()}
    dr.enable_grad(tensors)
    variation = svu.TotalVariation(vase.texels, vase.capture.mesh, epsilon=epsilon)
    expected = QuadraticPrior.of(vase.estimate.posterior, vase.texels)(tensors)
    expected += STRENGTH * sum(variation(tensor) for tensor in tensors.values())
    dr.backward(expected)

    assert float(loss[0]) == pytest.approx(float(expected[0]), rel=1e-5)
    gradients = smoothing.laid_out(textures, {key: dr.grad(x) for key, x in channels.items()})
    wanted = Textures.of({name: np.array(dr.grad(x)) for name, x in tensors.items()})
    for name in NAMES:
        ours, theirs = (one.at(vase.texels, name) for one in (gradients, wanted))
        np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-6 * np.abs(theirs).max())


def test_only_recovered_parameters_are_smoothed(vase: SimpleNamespace):
    textures = random_textures(vase.texels)
    smoothing = smoothing_of(vase, ("roughness",), 1e-2)
    channels = smoothing.start(textures)
    assert len(channels) == 1
    changed = smoothing.laid_out(textures, {key: 0 * x for key, x in channels.items()})
    assert not changed.at(vase.texels, "roughness").any()
    outside = ~vase.texels.inside()
    for name in NAMES:
        before, after = (np.array(one[name]) for one in (textures, changed))
        np.testing.assert_array_equal(before[outside], after[outside])
        if name != "roughness":
            np.testing.assert_array_equal(before, after)
