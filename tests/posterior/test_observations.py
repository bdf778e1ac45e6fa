"""Tests of ``Observed``: later stages trace no ray and compute no silhouette again."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from evaluation.test_traced_posterior import paint, sky
from support.helpers import as_values, render_ball

import svu_mi as svu
from svu_mi.bench.captures import chosen_views
from svu_mi.posterior import observations as module
from svu_mi.posterior.grid import PrincipledGrid
from svu_mi.recovery.recovery_options import DescentOptions, ShOptions
from svu_mi.statistics.gather_statistics import Weighting

TRACERS = (
    "pack_views",
    "trace_visibility",
    "trace_light_visibility",
    "trace_samples",
    "read_lighting",
)
BRIEF = ShOptions(descent=DescentOptions(steps=2))
GRID = PrincipledGrid(3, 3, 3)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("once")
    return render_ball(folder, sky(), paint(), views=8, resolution=(32, 32), spp=16)


@pytest.fixture(scope="module")
def layout(capture):
    return svu.texels(capture.mesh, 16)


@pytest.fixture
def calls(monkeypatch) -> Counter[str]:
    """Count the calls of functions that trace rays or read data for ``Observed``."""
    counted: Counter[str] = Counter()

    def watch(place: Any, name: str) -> Callable[..., Any]:
        original = getattr(place, name)

        def called(*args: Any, **kwargs: Any) -> Any:
            counted[name] += 1
            return original(*args, **kwargs)

        return called

    for name in TRACERS:
        monkeypatch.setattr(module, name, watch(module, name))
    return counted


USES: dict[str, Callable[[Any], Any]] = {
    "estimate": lambda e: svu.estimate(e),
    "spectrum": lambda e: svu.estimate(e, method="spectrum"),
    "fixed": lambda e: svu.estimate(e, preset="fixed"),
    "fast": lambda e: svu.estimate(e, preset="fast"),
    "recover": lambda e: svu.recover(e, sh=BRIEF),
    "sharing": lambda e: svu.recover(e, sh=BRIEF, sharing=True),
    "coefficients": lambda e: svu.recover(e, preset="coefficients"),
    "next_best_view": lambda e: svu.next_best_view(e, svu.Candidates.around(
        e.observed.capture, 5)),
    "reference": lambda e: svu.reference_posterior(e, subset=10, spp=2, grid=GRID),
}  # fmt: skip


def test_an_estimate_traces_everything_once(capture, layout, calls):
    svu.estimate(capture, layout)
    assert calls == dict.fromkeys(TRACERS, 1)


@pytest.mark.few(2)
@pytest.mark.parametrize("name", USES)
def test_later_stages_trace_no_ray_again(capture, layout, calls, name):
    """No rays to cameras or light cells are traced again, except from unseen texels."""
    estimate = svu.estimate(capture, layout)
    calls.clear()
    USES[name](estimate)
    # Forecasts include texels that are unseen so far, whose rays are new. The irradiance of the
    # spectrum method uses fewer, larger cells.
    allowed = {"trace_light_visibility"} if name in ("spectrum", "next_best_view") else set()
    assert set(calls) <= allowed and sum(calls.values()) <= 1
    calls.clear()
    if name != "next_best_view":
        USES[name](estimate)
        assert not calls


def test_forecasts_of_seen_texels_trace_no_cell_again(capture, layout, calls, monkeypatch):
    from svu_mi.geometry.packed_views import pack_sensors
    from svu_mi.guidance.guidance_options import GuidanceOptions
    from svu_mi.guidance.make_forecast import forecast_of

    estimate = svu.estimate(capture, layout)
    packed = pack_sensors(capture.scene, capture.shape, capture.sensors[:2])
    calls.clear()
    forecast_of(
        estimate, estimate.observed.seen[::3], packed, GuidanceOptions(hypotheses=4), ()
    )
    assert not calls


@pytest.mark.slow
def test_observations_can_replace_an_estimate(capture, layout, calls):
    observed = module.observe(capture, layout)
    assert calls == {"pack_views": 1, "trace_visibility": 1}
    first = svu.estimate(observed)
    assert calls == dict.fromkeys(TRACERS, 1)
    svu.recover(observed, sh=BRIEF)
    svu.reference_posterior(observed, subset=10, spp=2, grid=GRID)
    assert calls == dict.fromkeys(TRACERS, 1)
    assert first.observed is observed


def test_presets_without_occlusion_trace_no_light_cell(capture, layout, calls):
    """``fast`` and ``paper`` read prefiltered light."""
    for preset in ("fast", "paper"):
        svu.estimate(capture, layout, preset=preset)
    svu.estimate(capture, layout, "spectrum", "paper")
    assert not {"trace_light_visibility", "trace_samples"} & set(calls)


def test_other_texels_or_none_are_refused(capture, layout):
    estimate = svu.estimate(capture, layout)
    other = svu.texels(capture.mesh, 16)
    for use in (svu.estimate, svu.recover, svu.reference_posterior):
        with pytest.raises(svu.SvuError, match="texels differ from the estimate's"):
            use(estimate, other)
        with pytest.raises(svu.SvuError, match="A capture needs texels"):
            use(capture)


def test_reference_of_unseen_texels_has_entropy_1(capture, layout):
    one = chosen_views(capture, [0])  # from one side, so that the other side is unseen
    estimate = svu.estimate(one, layout)
    unseen = np.flatnonzero(estimate.observed.coverage == 0)[:4]
    assert len(unseen)
    reference = svu.reference_posterior(estimate, subset=unseen, spp=2, grid=GRID)
    np.testing.assert_array_equal(reference.entropy, 1)
    assert not reference.coverage.any()


def test_mirrors_are_read_where_narrow_lobes_are(capture, layout, calls):
    """A known roughness determines which lobes are computed."""
    estimate = svu.estimate(capture, layout, known={"roughness": 0.9})
    assert calls["trace_samples"] == 0
    svu.estimate(estimate, known={"roughness": 0.1})
    assert calls["trace_samples"] == 1
    model = estimate.observed.model
    narrow = model(np.array([0.1]), estimate.preset, 1)
    assert narrow.wide is None and narrow.reads_mirrors
    assert not model(np.array([0.9]), estimate.preset, 1).reads_mirrors


def test_a_spectrum_may_trace_few_cells(capture, layout):
    rays = svu.preset("default", method="spectrum", rays=16)
    few = svu.estimate(capture, layout, "spectrum", rays)
    assert np.isfinite(np.array(few.entropy)).all()


def test_models_and_weights_that_cannot_be_are_refused(capture, layout):
    observed = module.observe(capture, layout)
    switches = svu.preset("default", method="angular")
    with pytest.raises(svu.SvuError, match="must be ascending"):
        observed.model(np.array([0.9, 0.1]), switches, 1)
    with pytest.raises(svu.SvuError, match="current needs a finite kappa"):
        zeros = as_values(np.zeros((5, len(observed.seen))))
        observed.statistics(np.linspace(0, 1, 4), switches, 3, weighting=Weighting(current=zeros))
