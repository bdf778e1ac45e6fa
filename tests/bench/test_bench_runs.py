"""All benchmarks on tiny sizes, run once, and their scores."""

from __future__ import annotations

import json
import runpy
from dataclasses import replace
from functools import partial
from importlib import import_module

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image
from scipy import stats

from svu_mi.bench import guidance, speed
from svu_mi.bench.cases import own_cases
from svu_mi.bench.compared_estimators import Variant
from svu_mi.bench.experiment import BenchRun
from svu_mi.bench.guidance import ViewSelectionCase
from svu_mi.bench.guidance.guidance_tables import compare, mean_increase, views_needed, views_ratio
from svu_mi.bench.problem_sizes import GuidanceSizes, ProblemSizes, RecoverySizes
from svu_mi.bench.recovery import RelightingScorer, TextureScorer, next_light_case
from svu_mi.bench.recovery.methods import PATH, SH, SH_PAPER
from svu_mi.bench.recovery.recovery_tables import find_bars
from svu_mi.bench.study import Selection, read_record, run_bench, study_of
from svu_mi.capture.sensors import bounding_sphere, directions_of
from svu_mi.evaluation.psnr import CEILING_DB
from svu_mi.geometry.texels import texels
from svu_mi.recovery.recover import recover
from svu_mi.recovery.svbrdf_textures import lay_out, uniform_textures

CASES = own_cases(["vase"], ["window"])
METHODS = (SH, PATH, SH_PAPER)
STRATEGIES = ("entropy", "farthest", "random")
SIZES = ProblemSizes(
    views=6, film=32, spp=4, texels=32, speed_texels=32, reference_texels=20, reference_spp=4,
    speed_film=32, repeats=1,
    recovery=RecoverySizes(
        rows=tuple(row.label for row in METHODS), relit_views=1, relit_spp=2, repeats=1, long_s=1e4,
        scale=0.05,
    ),
    guidance=GuidanceSizes(
        lights=1, texels=24, kinds=("one-sided",), start=2, asked=3, marks=(1, 2),
        strategies=STRATEGIES, judged=("entropy",),
    ),
)  # fmt: skip
LABEL = "spectrum default"
ON_SCENES = ["accuracy", "speed", "recovery", "guidance"]
VARIANTS = (Variant(LABEL, "spectrum", "default"),)
SHORT = {"DEGREES": (2, 4), "NODES": (4,), "VIEWS": (3, 10), "SAMPLES": (2, 4, 8),
         "WARM_UP": 1}  # fmt: skip
SELECTION = Selection(cases=CASES, variants=VARIANTS)


@pytest.fixture(scope="module", params=[pytest.param("all", marks=pytest.mark.slow)])
def finished(tmp_path_factory):
    """Run of every benchmark on one case, and its records."""
    bench = BenchRun(tmp_path_factory.mktemp("bench"), SIZES, quick=True)
    with pytest.MonkeyPatch.context() as patch:
        for name, short in SHORT.items():
            patch.setattr(speed, name, short)
        patch.setattr(guidance, "recover", partial(recover, sh=SH.options(0.05)[0]))
        return bench, run_bench(bench, ON_SCENES, SELECTION, "svu b")


@pytest.fixture
def capture(finished):
    return finished[0].capture(CASES[0])


# --- the whole ----------------------------------------------------------------------------


def test_figures_tables_and_plots_are_written(finished, root):
    bench, record = finished
    assert {path.name for path in bench.folder.glob("*.*")} == {
        *(f"{name}.json" for name in ON_SCENES), "bench.md", "time_error.png", "scatter.png",
        "sparsification.png", "scaling.png", "recovery.png", "guidance.png",
    }  # fmt: skip
    for name in ON_SCENES:
        path = bench.folder / f"{name}.json"
        written = json.loads(path.read_text())
        assert written["study"] == name and written["command"] == "svu b"
        assert written["environment"]["versions"]["mitsuba"] == mi.__version__
        assert len(written["code"]) == 1 and written["cells"] == record[name]["cells"]
        assert str(bench.folder.parent) not in path.read_text()
        assert study_of(name).markdown(read_record(path)) == study_of(name).markdown(record[name])
    script = runpy.run_path(str(root / "notebooks" / "write_benchmarks.py"))
    text = script["overview"](script["read_all"](bench.folder))
    assert f"| `{LABEL}` |" in text and "`svu b` (cases: 1" in text and "1 objects" not in text
    text = (bench.folder / "bench.md").read_text()
    words = (*(row.label for row in METHODS), *STRATEGIES, LABEL, "brightness", "number of views",
             "vase / window", "90%", "(extrapolated)", "paired t-test", "Quick sizes")  # fmt: skip
    for word in words:
        assert word in text, word
    textures = text.partition("# Recovery of textures")[2].partition("\n# ")[0]
    assert textures and "nan" not in textures
    with Image.open(bench.folder / "time_error.png") as picture:
        assert picture.width > 600


def test_stored_results_are_complete(finished):
    bench, record = finished
    for name in ON_SCENES:
        study = import_module(f"svu_mi.bench.{name}").STUDY
        again = study.run(replace(bench, stored=True), SELECTION)
        assert again["cells"] == record[name]["cells"] and again["failed"] == []


def test_accuracy_has_every_figure_in_its_range(finished):
    record = finished[1]["accuracy"]
    (case,) = record["cells"]
    assert list(case["rows"]) == [variant.label for variant in VARIANTS]
    for row in case["rows"].values():
        assert -1 <= row["pearson"] <= 1 and -1 <= row["spearman"] <= 1
        assert 0 <= row["mean_entropy"] <= 1
        assert 0 < sum(row["timings"].values()) <= row["seconds"]
        assert row["credible"]["0.5"]["plain"] <= row["credible"]["0.9"]["plain"]
        assert list(row["parameters"]) == ["roughness", "metallic", "base_color"]
        assert len(row["entropy"]) == case["reference"]["texels"]
    assert 0 < case["reference"]["half_overlap"] < 1
    assert list(case["reference"]["parameters"]) == ["roughness", "metallic", "base_color"]
    kinds = [row["kind"] for row in record["summary"]]
    assert kinds == ["estimator", "sanity", "sanity", "reference"]


def test_run_times_of_one_case(finished):
    (case,) = finished[1]["speed"]["cells"]
    parts = case["rows"]
    ((label, times),) = parts["estimators"].items()
    assert label == LABEL and times["cold"]["kernels"] > 3
    assert list(times["warm"]) == list(times["cold"]["timings"])
    assert times["cold"]["process_seconds"] > times["cold"]["seconds"] > 0
    values = {what: [point["value"] for point in next(iter(parts[what].values()))]
              for what in ("degree", "grid", "views", "reference_spp")}  # fmt: skip
    assert values == {"degree": [2, 4], "grid": [4], "views": [3, 6], "reference_spp": [2, 4]}
    brute = parts["brute"]
    assert brute["psi"] == 512 and brute["sample_rays"] % (8 * brute["spp"]) == 0
    assert brute["seconds"] == pytest.approx(16 * brute["linear_seconds"])
    assert brute["seconds"] > brute["sample_seconds"]


def test_every_way_of_recovery_has_figures(finished):
    (case,) = finished[1]["recovery"]["cells"]
    assert [row.label for row in METHODS] == list(case["rows"])
    assert 0 < case["seen"] <= case["texels"] and case["relit"] != case["light"]
    for label, row in case["rows"].items():
        assert row["seconds"] > 0 and row["steps"] >= 1
        assert row["compiled"] == 0, label
        assert 0 < row["psnr"]["average"] < CEILING_DB
        assert set(row["psnr"]) == {"base_color", "roughness", "metallic", "average"}
        assert -1 <= row["relit"]["ssim"] <= 1 and -1 <= row["entropy_correlation"] <= 1
        assert case["truth_relit"]["psnr_ldr"] > row["relit"]["psnr_ldr"]


def test_every_strategy_adds_scored_views(finished):
    (run,) = finished[1]["guidance"]["cells"]
    assert (run["cell"], run["kind"], len(run["start"])) == ("vase / window", "one-sided", 2)
    assert len(run["agreement"]["gains"]) == len(run["agreement"]["changes"]) == 3
    for curve in run["rows"].values():
        assert len(set(curve["order"])) == 2 and not set(curve["order"]) & set(run["start"])
        assert len(curve["psnr"]) == len(curve["entropy"]) == 3
        assert curve["psnr"][0] == run["first"]["psnr"]["average"]
        assert curve["entropy"][-1] < curve["entropy"][0]
        single = [values[1] for values in curve["parameters"].values()]
        assert curve["psnr"][1] == pytest.approx(np.mean(single))
    whats = [bar["what"] for bar in finished[1]["guidance"]["bars"]]
    assert any("one-sided" in what for what in whats)
    assert any("correlation" in what for what in whats)


# --- recovery -----------------------------------------------------------------------------


def test_true_textures_have_no_error_and_others_do(capture, tmp_path):
    grid = texels(capture.mesh, 48)
    scorer = TextureScorer.of(capture, grid, poor=2)
    true = lay_out(grid, scorer.truth.values)
    best, grey = scorer.score(true), scorer.score(uniform_textures(grid))
    assert best["psnr"]["average"] > 99 and grey["psnr"]["average"] < 20
    seen = scorer.coverage > 0
    by_hand = np.mean((scorer.truth.values["roughness"][seen] - 0.5) ** 2)
    assert grey["psnr"]["roughness"] == pytest.approx(-10 * np.log10(by_hand), rel=1e-6)
    relit = RelightingScorer.of(capture, next_light_case(CASES[0], None, tmp_path), 2, 16)
    best, grey = relit.score(true), relit.score(uniform_textures(grid))
    for name in ("psnr_hdr", "psnr_ldr", "ssim"):
        assert best[name] > grey[name]


def test_the_truth_under_its_own_light_is_the_photograph(capture):
    """With the light and the samples of the photographs, relit pictures are equal."""
    relit = RelightingScorer.of(capture, CASES[0], 6, SIZES.spp, SIZES.seed)
    for picture, photograph, mask in zip(relit.truth, capture.images, relit.masks, strict=True):
        np.testing.assert_allclose(picture[mask], photograph[mask], rtol=2e-3)  # half floats


def test_bars_separate_met_and_missed_limits(finished):
    record = json.loads(json.dumps(finished[1]["recovery"], default=vars))
    rows = record["cells"][0]["rows"]

    def bars(of_path):
        for row, average, seconds in ((SH, 20, 1), (PATH, of_path, 16), (SH_PAPER, 19, 2)):
            rows[row.label]["psnr"]["average"] = average
            rows[row.label]["seconds"] = seconds
        return find_bars(record)[:2]

    over, part = bars(20.4)
    assert over.value == pytest.approx(-0.4) and over.holds
    assert part.value == pytest.approx(1 / 16) and part.holds
    assert not bars(20.6)[0].holds
    del rows[PATH.label]
    assert [bar.limit for bar in find_bars(record)] == [0, 1]  # comparisons with the paper


# --- guidance -----------------------------------------------------------------------------

MARKS = (1, 2, 4)


def test_views_needed_is_the_last_crossing():
    assert views_needed(MARKS, [10, 10.5, 11.5, 12], 1.0) == pytest.approx(1.5)
    assert views_needed(MARKS, [10, 11.5, 10.5, 12], 1.0) == pytest.approx(2 + 2 / 3)
    assert views_needed(MARKS, [10, 12, 12, 12], 1.0) == pytest.approx(0.5)
    assert np.isnan(views_needed(MARKS, [10, 11.5, 11.5, 10.9], 1.0))


def runs_of(first, second, starts=1):
    """Return runs of two strategies; rows are cases, columns are initial sets."""
    return [
        {"cell": f"cell {c} {s}", "object": f"object {c}", "rows": {
            name: {"psnr": [0, *rows[c][s]], "entropy": [0, *(-x for x in rows[c][s])]}
            for name, rows in (("entropy", first), ("random", second))}}
        for c in range(len(first)) for s in range(starts)
    ]  # fmt: skip


def test_runs_of_an_object_are_averaged():
    rng = np.random.default_rng(0)
    first, second = (rng.normal(1, 0.2, (6, 2, 2)).tolist() for _ in range(2))
    sizes = GuidanceSizes(strategies=("entropy", "random"), judged=("entropy",), marks=(1, 2))
    (comparison,) = compare(runs_of(first, second, 2), sizes)
    gains = [[mean_increase((1, 2), [0, *s]) for s in case] for case in first]
    others = [[mean_increase((1, 2), [0, *s]) for s in case] for case in second]
    exact = stats.ttest_rel(np.mean(gains, axis=1), np.mean(others, axis=1))
    assert comparison["p"] == pytest.approx(exact.pvalue) and comparison["objects"] == 6
    (entropy,) = compare(runs_of(first, second, 2), sizes, "entropy")
    assert entropy["difference"] == pytest.approx(comparison["difference"])  # lower is better there


def test_a_strategy_below_the_step_needs_all_views():
    sizes = GuidanceSizes(strategies=("entropy", "random"), judged=("entropy",), marks=(1, 2))
    runs = runs_of([[[1.0, 2.0]]], [[[0.1, 0.2]]])
    assert views_ratio(runs, sizes, "entropy", "random") == pytest.approx(2)
    assert np.isnan(views_ratio(runs, sizes, "random", "entropy"))


def test_farthest_uses_the_sampling_of_guidance(finished, capture):
    bench, record = finished
    (run,) = record["guidance"]["cells"]
    sided, even = (ViewSelectionCase(bench, CASES[0], 0, kind) for kind in ("one-sided", "even"))
    assert sided.start == run["start"] and even.start[0] == sided.start[0]
    directions = directions_of(capture.sensors, bounding_sphere(capture.shape)[0])
    angles = directions @ directions[sided.start[0]]  # the nearest to it, and the farthest
    assert np.argsort(-angles)[1] == sided.start[1] and np.argmin(angles) == even.start[1]
    assert sided.order("farthest") == run["rows"]["farthest"]["order"]
