"""What is known in units: figures by hand, and the sentence that says them."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest

from svu_mi.capture.capture import LightUncertainty
from svu_mi.output.interval_summary import IntervalSummary
from svu_mi.posterior.grid import PrincipledGrid
from svu_mi.posterior.intervals import subsample
from svu_mi.posterior.tabulated import tabulated_posterior

AXES = {"roughness": np.linspace(0, 1, 21), "base_color": np.linspace(0, 1, 21)}
# Five texels, the last of them unseen: their sides, and ends of their intervals.
FOOTPRINT, COVERAGE = (1.0, 2.0, 3.0, 1.0, 5.0), (1, 4, 2, 1, 0)
ROUGHNESS = ([0.0, 0.3, 0.5, 0.0, 0.0], [0.1, 0.5, 0.58, 1.0, 1.0])
COLOR = (np.zeros((5, 3)), np.array([[0.1, 0.02, 0.1], [0.1] * 3, [0.02, 0.02, 0.12], [0.3] * 3,
                                     [0.0] * 3]))  # fmt: skip


class Given:
    """A posterior whose intervals are given; it counts how often they are asked for."""

    def __init__(self, ends, axes):
        self.ends, self.axes, self.asked = ends, axes, []

    count, continuous = 5, False

    def interval(self, name, level, chosen):
        self.asked.append((name, level))
        return tuple(mi.TensorXf(np.array(end, np.float32)[chosen]) for end in self.ends[name])

    def half_width(self, name, level, chosen):
        self.asked.append((name, level))
        low, high = (np.array(end, np.float32)[chosen] for end in self.ends[name])
        return mi.TensorXf((high - low).reshape(len(low), -1).max(axis=1) / 2)


def estimate_of(posterior, coverage=COVERAGE, footprint=FOOTPRINT, light_uncertainty=None):
    capture = SimpleNamespace(light_uncertainty=light_uncertainty)
    return SimpleNamespace(
        posterior=posterior, coverage=mi.UInt32(coverage),
        entropy=np.linspace(0, 1, len(coverage)), observed=SimpleNamespace(capture=capture),
        texels=SimpleNamespace(footprint=mi.Float(footprint), resolution=(8, 4)),
    )  # fmt: skip


@pytest.fixture
def posterior():
    return Given({"roughness": ROUGHNESS, "base_color": COLOR}, AXES)


def test_figures_are_those_computed_by_hand(posterior):
    """Areas seen are 1, 4, 9, 1; half-widths 0.05, 0.1, 0.04, 0.5 and 0.05, 0.05, 0.06, 0.15."""
    summary = IntervalSummary.of(estimate_of(posterior))
    assert summary.seen_part == pytest.approx(15 / 40)
    assert summary.known_part == pytest.approx({"roughness": 10 / 15, "base_color": 5 / 15})
    assert summary.all_known_part == pytest.approx(1 / 15)
    assert summary.median_half_width == pytest.approx({"roughness": 0.04, "base_color": 0.06})
    assert summary.cell_width == {}
    assert summary.sentence() == (
        "Roughness known to ±0.05 on 67 % of the surface area seen, base colour on 33 % "
        "(90 % intervals of 8×4 texels)."
    )


def test_all_that_was_found_is_one_line(posterior):
    """The mean entropy is that of the four texels seen, of 0, 0.25, 0.5, 0.75 and 1."""
    assert IntervalSummary.of(estimate_of(posterior)).summary() == (
        "38 % of the surface area seen, mean entropy 0.38. Roughness known to ±0.05 on 67 % of the "
        "surface area seen, base colour on 33 % (90 % intervals of 8×4 texels)."
    )
    nearly = replace(IntervalSummary.of(estimate_of(posterior)), seen_part=0.998)
    assert nearly.summary().startswith("Over 99 % of the surface area seen")
    nothing = IntervalSummary.of(estimate_of(posterior, coverage=(0,) * 5))
    assert nothing.summary() == "No parameter is known: no photograph shows the surface."


@pytest.mark.parametrize("most", [4096, 3000, 7])
def test_the_given_number_of_texels_is_taken_at_equal_steps(most):
    for count in (0, 5, most, most + 1, 3003, 16693):
        taken = subsample(np.arange(count), most)
        assert len(taken) == len(set(taken.tolist())) == min(count, most)
        if len(taken) > 1:
            steps = np.diff(taken)
            assert taken[0] == 0 and steps.max() - steps.min() <= 1
            assert count - taken[-1] <= -(-count // most)


def test_what_is_known_beforehand_is_no_finding(posterior):
    posterior.axes = {"roughness": np.array([0.3]), "base_color": AXES["base_color"]}
    summary = IntervalSummary.of(estimate_of(posterior))
    assert list(summary.known_part) == ["base_color"]
    assert summary.all_known_part == pytest.approx(1 / 3)
    assert summary.sentence() == (
        "Base colour known to ±0.05 on 33 % of the surface area seen (90 % intervals of 8×4 "
        "texels)."
    )
    posterior.axes = {name: np.array([0.3]) for name in AXES}
    summary = IntervalSummary.of(estimate_of(posterior))
    assert summary.sentence() == "All parameters were given."


def test_nothing_is_called_known_under_estimated_light(posterior):
    """The intervals remain, but no share of the surface is derived from them."""
    summary = IntervalSummary.of(estimate_of(posterior, light_uncertainty=LightUncertainty()))
    assert (summary.known_part, summary.all_known_part) == ({}, None)
    assert summary.median_half_width == pytest.approx({"roughness": 0.04, "base_color": 0.06})
    assert summary.summary() == (
        "38 % of the surface area seen, mean entropy 0.38. No parameter is called known to ±0.05: "
        "the light or its brightness is estimated, and then, often, fewer than 90 % of the "
        "90 % intervals of a parameter contain the truth."
    )
    posterior.axes = {name: np.array([0.3]) for name in AXES}
    given = IntervalSummary.of(estimate_of(posterior, light_uncertainty=LightUncertainty()))
    assert given.sentence() == "All parameters were given."


def certain(grid, cell):
    """A texel of which one cell is left."""
    energies = np.full((1, *grid.shape), 80.0)
    energies[(0, *cell)] = 0
    return tabulated_posterior(energies, grid, np.ones(1, bool))


def test_a_coarse_grid_knows_no_better_than_its_cells():
    """The one cell left is 1/7 wide, or half of that at an end of the range."""
    posterior = certain(PrincipledGrid(8, 8, 21), (3, 0, 5))
    summary = IntervalSummary.of(estimate_of(posterior, (1,), (1.0,)))
    half = {"roughness": 1 / 14, "metallic": 1 / 28, "base_color": 1 / 40}
    assert summary.median_half_width == pytest.approx(half, abs=1e-6)
    assert summary.known_part == {"roughness": 0, "metallic": 1, "base_color": 1}
    assert summary.cell_width == pytest.approx({"roughness": 1 / 7, "metallic": 1 / 7})
    assert summary.sentence().endswith("8×4 texels; the grid's cells are up to 0.14 wide).")


def test_nothing_seen_is_said_and_nothing_computed(posterior):
    summary = IntervalSummary.of(estimate_of(posterior, coverage=(0,) * 5))
    assert (summary.seen_part, summary.known_part, summary.all_known_part) == (0, {}, 0)
    assert summary.sentence() == "No parameter is known: no photograph shows the surface."
    assert posterior.asked == []
