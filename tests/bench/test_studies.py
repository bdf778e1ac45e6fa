"""Every benchmark on tiny sizes: figures for every row, tables, stored results."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.helpers import memory_capture, render_views, write_ball

import svu_mi as svu
from svu_mi.bench import (
    BENCHMARKS,
    calibration,
    light,
    paper,
    paths,
    plain_balls,
    poses,
    posterior_scores,
    reflected,
    scaling,
    sureness,
    verdict,
)
from svu_mi.bench.captures import FRONT, uneven_views
from svu_mi.bench.cases import own_cases
from svu_mi.bench.compared_estimators import Variant
from svu_mi.bench.experiment import BenchRun
from svu_mi.bench.paper import figure9, table2, table3
from svu_mi.bench.problem_sizes import ProblemSizes, RecoverySizes
from svu_mi.bench.radiance_error import radiance_error
from svu_mi.bench.recovery.methods import RecoveryMethod
from svu_mi.bench.scaling import line, repeated
from svu_mi.bench.speed import run_from_files, timed_kernels
from svu_mi.bench.study import Selection, study_of
from svu_mi.bench.timing import in_new_process, run, spread
from svu_mi.calibration.poses import refine_poses
from svu_mi.capture.scene import to_world
from svu_mi.capture.sensors import sphere_sensors
from svu_mi.errors import OptionError, SvuEnvironmentError
from svu_mi.evaluation.ground_truth import ground_truth
from svu_mi.geometry.packed_views import pack_views
from svu_mi.geometry.sample_view import TexelLanes
from svu_mi.geometry.visibility import trace_visibility
from svu_mi.posterior.observations import observe
from svu_mi.presets import preset
from svu_mi.recovery.recover import recover

SIZES = ProblemSizes(
    views=8, film=24, spp=4, texels=24, reference_texels=12, reference_spp=2,
    recovery=RecoverySizes(relit_views=1, relit_spp=2, repeats=1, scale=0.05, warm=False),
)  # fmt: skip
CASES = own_cases(["vase"], ["window"])
BASE = Variant("spectrum default", "spectrum", "default")
ENTROPY_ROWS = table3._entropy_rows()[:3]


def _briefly(*known, preset="default", **words):
    sh = RecoveryMethod("", "sh", preset).options(0.05)[0]
    return recover(*known, preset=preset, **words, sh=sh)


TINY = {
    light: {"QUICK": {"views": 12, "film": 32, "spp": 4}, "QUICK_TEXELS": 20},
    calibration: {"QUICK": {"views": 12, "film": 24, "spp": 2}, "QUICK_TEXELS": 12,
                  "QUICK_TRACED": 10, "QUICK_SPP": 2},
    plain_balls: {"QUICK_FILM": 16, "TEXELS": 16},
    scaling: {"QUICK": scaling.ScalingSizes(
        resolutions=(12, 16, 24), views=(3, 4, 6), resolution=16, photographs=(6, 24), repeats=1)},
    paths: {"QUICK": (12, 2), "SIDE": 16},
    poses: {"QUICK": {"views": 8, "film": 32, "spp": 2}, "QUICK_TEXELS": 16},
    refine_poses: {"OUTLINES": 1, "COARSE": ((16, 1.0),), "FINE": ((16, 0.5),)},
    reflected: {"QUICK": {"views": 12, "film": 24, "spp": 2}, "QUICK_TEXELS": 12,
                "QUICK_PATHS": (20, 4), "QUICK_TRACED": (6, 4)},
    verdict: {"QUICK": {"views": 16, "film": 32, "spp": 4}, "QUICK_TEXELS": 20},
    sureness: {"SPP": 4, "DRAWS": 4, "VIEWS": 2, "LIGHTS": 1, "recover": _briefly},
    table2: {"QUICK_FILM": 24, "QUICK_TEXELS": 16, "QUICK_SPP": 2, "ROWS": table2.ROWS[:2]},
    table3: {"QUICK": (12, 4), "_entropy_rows": lambda: ENTROPY_ROWS},
    figure9: {"QUICK_VIEWS": 12, "ADDED": (1,), "QUICK_TEXELS": 16, "recover": _briefly},
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "cases", "rows"),
    [("calibration", 2, 9), ("light", 1, 1), ("paper", 3, None), ("paths", 1, 1),
     ("poses", 1, 5), ("reflected", 1, 9), ("scaling", 1, 4), ("sureness", 1, 5),
     ("verdict", 1, 4)],
)  # fmt: skip
def test_a_study_measures_every_row(name, cases, rows, tmp_path, monkeypatch):
    for module, changes in TINY.items():
        for constant, value in changes.items():
            monkeypatch.setattr(module, constant, value)
    monkeypatch.setattr(RecoveryMethod.recover, "__defaults__", (0.05,))
    study, selection = study_of(name), Selection(cases=CASES, variants=[BASE])
    record = study.run(BenchRun(tmp_path, SIZES, quick=True), selection)
    assert len(record["cells"]) == cases and record["failed"] == []
    assert rows is None or len(record["cells"][0]["rows"]) == rows
    assert study.markdown(record).count("\n| ") > 2
    again = study.run(BenchRun(tmp_path, SIZES, quick=True, stored=True), selection)
    assert again["cells"] == record["cells"]


def test_every_benchmark_has_a_study():
    assert all(study_of(name).title for name in BENCHMARKS)


def test_parts_of_the_paper_are_chosen_by_name(tmp_path):
    bench, cases = BenchRun(tmp_path), own_cases(["vase"])
    every = list(paper.STUDY.experiment(bench, Selection(cases=cases)).subjects)
    names = [subject.name.partition("/")[0] for subject in every]
    assert [names.count(part) for part in paper.PARTS] == [4, 3, 2]
    one = paper.STUDY.experiment(bench, Selection(cases=cases, rows=["table2"])).subjects
    assert [subject.name for subject in one] == [s.name for s in every if "table2" in s.name]
    with pytest.raises(OptionError, match="Unknown part of the paper 'table9'"):
        paper.STUDY.experiment(bench, Selection(cases=cases, rows=["table9"]))


# --- parts --------------------------------------------------------------------------------


def test_the_survey_and_both_bare_ways_trace_the_same_rays():
    capture = timed_kernels.fine_capture(3, 24)
    layout = svu.texels(capture.mesh, 32)
    views, surface = pack_views(capture), TexelLanes.of(layout)
    rays = timed_kernels.record_rays(views, surface)
    slot = np.array(rays.slot).reshape(3, layout.count)
    traced = slot != timed_kernels.NO_RAY
    np.testing.assert_array_equal(slot[traced], np.arange(rays.count))
    normal = np.array(layout.geometric_normal)[:, np.nonzero(traced)[1]]
    assert (np.array(rays.direction) * normal).sum(axis=0).min() > 0
    assert (traced.sum(axis=0) >= np.array(trace_visibility(views, surface).coverage)).all()
    gather = timed_kernels.measure_gather(capture, 32, 1)
    assert gather["triangles"] > 70_000 and 0 < gather["rays"] == rays.count
    free = {way["free"] for way in gather["ways"].values()}
    assert len(free) == 1 and 0 < free.pop() < rays.count


def test_run_counts_kernels_and_compilation():
    factor = 1 + np.random.default_rng().random()  # a literal no cache has seen

    def function():
        return dr.sin(dr.arange(mi.Float, 10_000) * factor)

    first = run(function)
    assert first.compiled == 1 and first.compile > 0
    runs = [run(function) for _ in range(3)]
    assert (runs[-1].compiled, runs[-1].launched) == (0, 1) and runs[-1].kernel > 0
    assert spread([3.0, 1.0, 2.0]) == {"median": 2, "low": 1, "high": 3}


@pytest.mark.slow
def test_a_failed_process_reports_its_error(tmp_path):
    with pytest.raises(SvuEnvironmentError, match="failed in a new process: .*nowhere"):
        arguments = {"source": str(tmp_path / "nowhere"), "resolution": 8, "method": "angular"}
        in_new_process(run_from_files, **arguments)


def test_line_and_exponent_are_fitted():
    fit = line([1, 2, 4, 8], [5.0, 7.0, 11.0, 19.0])
    assert (fit["a"], fit["b"], fit["r2"]) == pytest.approx((3, 2, 1))
    assert line([1, 2, 4, 8], [1, 4, 16, 64])["slope"] == pytest.approx(2)
    assert line([1, 2, 4, 8], [1, 4, 16, 64])["r2"] < 0.98


def test_views_are_repeated_spread_or_crowded_on_one_side(shot):
    capture = svu.load_capture(shot)
    assert repeated(capture, 18).names == (capture.names * 3)[:18]
    assert repeated(capture, 3).names == tuple(capture.names[i] for i in (0, 4, 7))
    uneven = uneven_views(capture, 3, 1)
    assert uneven.count == len(set(uneven.names)) == 4
    axis = np.array(FRONT) / np.linalg.norm(FRONT)

    def cosines(views):
        origins = np.array([to_world(sensor)[:3, 3] for sensor in views.sensors])
        return np.sort(origins / np.linalg.norm(origins, axis=1, keepdims=True) @ axis)[::-1]

    np.testing.assert_allclose(cosines(uneven)[:3], cosines(capture)[:3], atol=1e-6)
    with pytest.raises(OptionError, match="too many"):
        uneven_views(capture, 7, 2)


def test_crps_is_that_of_all_pairs_of_draws():
    rng = np.random.default_rng(8)
    drawn, true = rng.random((20, 5, 2)), rng.random((5, 2))
    apart = np.abs(drawn[:, None] - drawn[None]).sum(axis=(0, 1)) / (20 * 19)
    expected = (np.abs(drawn - true).mean(axis=0) - apart / 2).mean()
    assert posterior_scores.crps(drawn, true) == pytest.approx(expected)


def test_errors_of_radiance_are_those_of_the_light_and_not_of_the_paths(tmp_path):
    """Light that is a fifth too bright makes all radiance a fifth too bright."""
    paint = {"type": "principled", "roughness": 0.9,
             "base_color": {"type": "rgb", "value": [0.5, 0.3, 0.2]}}  # fmt: skip
    mesh = {"type": "ply", "filename": str(write_ball(tmp_path)), "bsdf": paint}
    dim, bright = (
        mi.load_dict({"type": "scene", "ball": mesh,
                      "light": {"type": "envmap", "bitmap": mi.Bitmap(np.full((8, 16, 3), x, "f"))},
                      "integrator": {"type": "path", "max_depth": 2}}, optimize=False)
        for x in (1.0, 1.2)
    )  # fmt: skip
    sensors = sphere_sensors(dim.shapes()[0], 6, (24, 24))
    capture = memory_capture(bright, render_views(dim, sensors, 4), sensors)
    observed = observe(capture, svu.texels(capture.mesh, 24))
    _ = observed.distant_light  # read before the scene is replaced
    for scene, expected in ((bright, 0.0), (dim, 0.2)):
        wrong = replace(observed, capture=replace(capture, scene=scene))
        found = radiance_error(wrong, preset("default", method="angular"), 150, 16)
        # Root mean squares have fewer paths; the model differs by .01 (median).
        assert found["radiance median"] == pytest.approx(expected, abs=0.05)
        assert found["radiance rms"] == pytest.approx(expected, abs=0.02)


@pytest.mark.slow
def test_figures_of_calibration_are_parts(vase):
    chosen = np.flatnonzero(np.array(vase.estimate.coverage))[::5]
    known = ground_truth(vase.capture, vase.texels)
    truth = {name: known[name][chosen] for name in posterior_scores.NAMES}
    figures = posterior_scores.posterior_figures(vase.estimate.posterior, truth, chosen)
    assert all(np.isfinite(value).all() for value in figures.values())
    assert all(
        0 <= figures[key] <= 1 for key in figures if key.startswith(("90", "50", "interval"))
    )
