"""Tests of the prior of metals: their colours, and their share learned from the object."""

from __future__ import annotations

import numpy as np
import pytest
from numerics.ball import around, ball
from oracle.calibrated import metal_color
from support.helpers import STUDIO

import svu_mi as svu
from svu_mi.posterior.metal_colors import color_density

PLAIN = svu.preset("default", method="angular", bare_metals=0.0, metal_share=0.5)
BLACK = {"metallic": 0.0, "roughness": 0.5, "base_color": 0.0}
GOLD = {"metallic": 1.0, "roughness": 0.5, "base_color": [1.0, 0.766, 0.336]}


def test_color_density_of_metals_and_dielectrics() -> None:
    edges = np.array([0, 0.05, 0.1, 0.3, 0.55, 0.8, 1])
    width = np.diff(edges)
    dielectric, between, metal = color_density(edges, np.array([0, 0.25, 1]), 0.5)
    expected = metal_color(edges[:-1], edges[1:])
    expected[0] = 0.01 * width[0]  # the least density
    np.testing.assert_allclose(metal * width, expected / expected.sum(), rtol=1e-4)
    assert np.array_equal(dielectric, np.ones(6))
    np.testing.assert_allclose(between, 0.75 + 0.25 * metal)


def held(estimate: svu.Estimate, metallic: float) -> float:
    """Share of seen texels whose 90 % interval contains the true value of metallic."""
    seen = np.flatnonzero(np.array(estimate.coverage))
    low, high = (np.array(end) for end in estimate.posterior.interval("metallic", 0.9, seen))
    return float(((low <= metallic) & (metallic <= high)).mean())


def error_of(estimate: svu.Estimate, metallic: float) -> float:
    """Root mean squared error of metallic over seen texels."""
    seen = np.array(estimate.coverage) > 0
    return float(
        np.sqrt(np.square(np.array(estimate.posterior.mean("metallic"))[seen] - metallic).mean())
    )


@pytest.mark.few(1)
@pytest.mark.parametrize(("paint", "metal"), [(BLACK, False), (GOLD, True)])
def test_a_black_ball_is_no_metal_and_a_gold_ball_is_one(tmp_path, paint, metal) -> None:
    capture = ball(paint=paint, directions=around(24), light=STUDIO, size=64).capture(tmp_path)
    estimate = svu.estimate(capture, svu.texels(capture.mesh, 32))
    assert held(estimate, float(metal)) > 0.9
    error, before = (
        error_of(one, metal) for one in (estimate, svu.estimate(estimate, preset=PLAIN))
    )
    assert error < 0.2 and (metal or before > 0.3)
    # Odds learned from the object: at most (1 + 0.3 / 4) / (0.3 * 3 / 4) of metals, and at most
    # (1 + 0.3 * 3 / 4) / (0.3 / 4) of dielectrics, which have 3 without evidence.
    share = np.array(estimate.posterior.prior).sum(axis=(0, 2))[[0, -1]]
    odds = share[1] / share[0] if metal else share[0] / share[1]
    assert (1.5 < odds < 4.8) if metal else (3 < odds < 16.4)
    # A prior that is given replaces both.
    even = svu.estimate(estimate, prior=np.ones((8, 8, 8))).posterior.prior
    np.testing.assert_allclose(even, 1 / 512, rtol=1e-6)
