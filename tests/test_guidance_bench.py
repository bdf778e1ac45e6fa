"""The guidance benchmark on tiny sizes, and how it judges curves."""

from __future__ import annotations

import json
import zlib
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy import stats

from svu_mi.bench.accuracy import Bench
from svu_mi.bench.cells import own_cells
from svu_mi.bench.guidance import curves, draw_guidance, guidance_tables, run_guidance
from svu_mi.bench.guidance import run as module
from svu_mi.bench.guidance.curves import Shoot
from svu_mi.bench.guidance.run import few_lights
from svu_mi.bench.guidance.verdict import (
    compare,
    find_bars,
    mean_gain,
    times_as_many,
    views_needed,
)
from svu_mi.bench.sizes import GuidanceSizes, Sizes
from svu_mi.capture.poses import bounding_sphere, directions_of
from svu_mi.progress import Progress
from svu_mi.recovery.options import ShOptions
from svu_mi.surface import texels

TINY = GuidanceSizes(
    lights=1, texels=24, starts=1, kinds=("one-sided",), start=2, asked=3, marks=(1, 2),
    strategies=("entropy", "error", "farthest", "random"), speed_texels=12, candidates=(3, 6),
    fewer=(8,), added=2, refits=(1, 1), repeats=1,
)  # fmt: skip
PICTURES = Sizes(views=8, film=32, spp=4, texels=32, guidance=TINY)
CELLS = own_cells(["vase"], ["window", "overcast"])
STEPS = 15  # of every recovery: how good it is, nobody asks here
MARKS = (1, 2, 4)


def test_views_needed_is_where_a_curve_crosses_for_good():
    assert views_needed(MARKS, [10, 10.5, 11.5, 12], 1.0) == pytest.approx(1.5)
    assert views_needed(MARKS, [10, 11.5, 10.5, 12], 1.0) == pytest.approx(2 + 2 / 3)
    assert views_needed(MARKS, [10, 12, 12, 12], 1.0) == pytest.approx(0.5)
    assert np.isnan(views_needed(MARKS, [10, 11.5, 11.5, 10.9], 1.0))


def test_mean_gain_is_the_area_under_a_curve():
    assert mean_gain(MARKS, [5, 6, 7, 9]) == pytest.approx((0.5 + 1.5 + 2 * 3) / 4)


def runs_of(first, second, starts=1):
    """Runs of two strategies in as many cells as there are rows; a start per column."""
    return [
        {"cell": f"cell {c} {s}", "object": f"object {c}", "curves": {
            name: {"psnr": [0, *rows[c][s]], "entropy": [0, *(-x for x in rows[c][s])]}
            for name, rows in (("entropy", first), ("random", second))}}
        for c in range(len(first)) for s in range(starts)
    ]  # fmt: skip


def test_starts_of_an_object_are_no_independent_samples():
    rng = np.random.default_rng(0)
    first, second = (rng.normal(1, 0.2, (6, 2, 2)).tolist() for _ in range(2))
    sizes = GuidanceSizes(strategies=("entropy", "random"), judged=("entropy",), marks=(1, 2))
    (found,) = compare(runs_of(first, second, 2), sizes)
    gains = [[mean_gain((1, 2), [0, *s]) for s in cell] for cell in first]
    others = [[mean_gain((1, 2), [0, *s]) for s in cell] for cell in second]
    exact = stats.ttest_rel(np.mean(gains, axis=1), np.mean(others, axis=1))
    assert found["p"] == pytest.approx(exact.pvalue) and found["objects"] == 6
    (entropy,) = compare(runs_of(first, second, 2), sizes, "entropy")
    assert entropy["difference"] == pytest.approx(found["difference"])  # lower is better there


def test_who_never_gets_there_needs_at_least_all_views():
    sizes = GuidanceSizes(strategies=("entropy", "random"), judged=("entropy",), marks=(1, 2))
    runs = runs_of([[[1.0, 2.0]]], [[[0.1, 0.2]]])
    assert times_as_many(runs, sizes, "entropy", "random") == pytest.approx(2)
    assert np.isnan(times_as_many(runs, sizes, "random", "entropy"))


def test_few_lights_of_every_object():
    cells = own_cells(["vase", "knot"])
    kept = few_lights(cells, 2)
    assert [cell.object for cell in kept] == ["vase", "vase", "knot", "knot"]


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("guidance")
    bench = Bench(folder, PICTURES, Progress(), quick=True)
    options = ShOptions()
    brief = replace(options, descent=replace(options.descent, steps=STEPS))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(curves, "recover", partial(curves.recover, sh=brief))
        return bench, run_guidance(bench, CELLS)


def test_every_strategy_adds_views_that_are_judged(finished):
    _, record = finished
    (run,) = record["runs"]
    assert run["cell"] == "vase / window" and len(run["start"]) == 2
    assert run["kind"] == "one-sided"
    assert len(run["agreement"]["gains"]) == len(run["agreement"]["changes"]) == 3
    for strategy in TINY.strategies:
        curve = run["curves"][strategy]
        assert len(set(curve["order"])) == 2
        assert not set(curve["order"]) & set(run["start"])
        assert len(curve["psnr"]) == len(curve["entropy"]) == 3
        assert curve["psnr"][0] == run["curves"]["entropy"]["psnr"][0]
        assert curve["entropy"][-1] < curve["entropy"][0]
        assert curve["psnr"][1] == pytest.approx(
            np.mean([values[1] for values in curve["parameters"].values()])
        )


def test_steps_are_timed_at_every_size(finished):
    speed = finished[1]["speed"]
    assert len(speed["methods"]) == 3
    for row in speed["methods"]:
        assert {(p["candidates"], p["texels"] > 0) for p in row["points"]} == {
            (3, True), (6, True)}  # fmt: skip
        assert row["per_view"] > 0
    assert speed["refitting"]["evaluations"] == 6 * 64
    assert speed["refitting"]["times"] > 1


def test_tables_bars_and_plot(finished, tmp_path):
    _, record = finished
    text = guidance_tables(record)
    for word in (*TINY.strategies, "vase / window", "Time per added view", "paired t-test"):
        assert word in text
    bars = {bar["what"]: bar for bar in find_bars(record, TINY)}
    assert any(bar["limit"] == 1.2 and "one-sided" in what for what, bar in bars.items())
    assert any("correlation" in what and bar["limit"] == 0.8 for what, bar in bars.items())
    assert any("over refitting" in what or "refitting" in what for what in bars)
    json.dumps(record["runs"])
    (path,) = draw_guidance(tmp_path, record)
    assert path.stat().st_size > 10_000


def test_a_second_run_chooses_nothing_again(finished, monkeypatch):
    bench, record = finished

    def refuse(*_, **__):
        raise AssertionError("a finished run was computed again")

    monkeypatch.setattr(module.Shoot, "curves", refuse)
    monkeypatch.setattr(module, "measure_speed", lambda *_: None)
    again = run_guidance(bench, CELLS)
    assert again["runs"][0]["curves"] == record["runs"][0]["curves"]


def test_farthest_is_the_library_s_own(finished):
    bench, record = finished
    capture = bench.capture(CELLS[0])
    own = zlib.crc32(b"vase__window 0")
    shoot = Shoot(capture, texels(capture.mesh, 24), TINY, own, "one-sided")
    assert shoot.start == record["runs"][0]["start"]
    even = Shoot(capture, texels(capture.mesh, 24), TINY, own)
    assert even.start[0] == shoot.start[0]  # the nearest to it, and the farthest
    directions = directions_of(capture.sensors, bounding_sphere(capture.shape)[0])
    angles = directions @ directions[shoot.start[0]]
    assert np.argsort(-angles)[1] == shoot.start[1] and np.argmin(angles) == even.start[1]
    assert shoot.order("farthest") == record["runs"][0]["curves"]["farthest"]["order"]
